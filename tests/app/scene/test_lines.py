"""A path is sent in pieces, and only the pieces that changed."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.scene import Scene, colours
from app.scene.nodes import CHUNK, LineNode, Segments


def drawn(line: LineNode) -> np.ndarray:
    """The points of the line that are visible."""
    pieces = [chunk.node.points for chunk in line._chunks if chunk.node.visible]
    if not pieces:
        return np.zeros((0, 2))
    segments = np.concatenate(pieces)
    return np.vstack([segments[:1, 0, :2], segments[:, 1, :2]])


async def test_a_line_is_what_was_shown_last(scene: Scene):
    @given(st.lists(st.integers(0, 3 * CHUNK + 5), min_size=1, max_size=6), st.booleans())
    def law(lengths: list[int], bent: bool):
        line = LineNode(scene._server.scene, "/law", (1, 2, 3), 0.0)
        points = np.zeros((0, 2))
        for turn, length in enumerate(lengths):
            along = np.arange(float(length))
            points = np.column_stack([along, along * (turn if bent else 1)])
            line.show(True, points)
        if len(points) > 1:
            np.testing.assert_allclose(drawn(line), points, rtol=1e-6)
        else:
            assert len(drawn(line)) == 0

    law()


async def test_a_step_forward_sends_only_the_last_piece(scene: Scene):
    line = LineNode(scene._server.scene, "/step", (1, 2, 3), 0.0)
    points = np.column_stack([np.arange(1000.0), np.zeros(1000)])
    line.show(True, points[:700])
    before = scene.messages
    line.show(True, points[:701])
    assert scene.messages - before == 1


def test_one_colour_of_all_segments_is_sent_for_each_of_them(scene: Scene):
    """viser's client takes a single one as sRGB, unlike those of segments, so the path was nearly black."""
    lines = Segments(scene._server.scene, "/one", 1.0)
    lines.show(True, np.zeros((2, 2, 3)), colours.PATH)
    wanted = colours.of_lines(np.array([colours.PATH], np.uint8))[0]
    np.testing.assert_array_equal(lines.node.colors, np.broadcast_to(wanted, (2, 2, 3)))


def test_lines_are_seen_in_the_colour_that_was_meant():
    meant = np.array([(230, 159, 0)], dtype=np.uint8)
    linear = colours.of_lines(meant) / 255.0
    seen = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * seen, meant, atol=3)
