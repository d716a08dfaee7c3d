"""The way of the robot in the scene: where its lines lie, and when they are sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.scene import Scene
from app.scene.robot import OF_ZONE, way_lines
from pipeline.config.stages import Obstacles
from pipeline.detection.obstacles import find_clearance
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Clearance, Zone
from tests.app.scene.frames import make_frame

P = Obstacles()
PATH = np.zeros((1, 4))
NOTHING = np.zeros((0, 3), np.float32)


@given(st.floats(-1.5, 1.5), st.booleans())
def test_what_stands_between_the_drawn_sides_is_in_the_way(curvature: float, backward: bool):
    lines = way_lines(curvature, backward, P.reach, P).reshape(-1, 3)[:, :2].astype(np.float64)
    count = len(lines) // 2
    half = 2 * 12
    right, left = lines[:half], lines[half : 2 * half]
    assert count > 0
    twist = (-0.8 if backward else 0.8, 0.0, (-0.8 if backward else 0.8) * curvature)
    middle = 0.5 * (right + left)[6]
    looks = np.array([[x, y, 0.0] for x in (-9.0, 9.0) for y in np.linspace(-2, 2, 9)])
    for place, seen in ((middle, True), (right[6] + 0.2 * (right - left)[6], False)):
        points = np.vstack([looks, np.tile([*place, 1.0], (P.min_points, 1))]).astype(np.float32)
        found = find_clearance(points, NOTHING, None, np.array([0.0, 0.0, 0.3]), twist, P)
        assert found is not None
        assert (found.zone is not Zone.CLEAR) is seen


async def test_the_way_is_ahead_of_the_robot(scene: Scene):
    def node():
        return scene._server.scene.get_handle_by_name("/world/robot/way")

    frame = make_frame(0)
    scene.show(frame, PATH)
    assert not node().visible
    near = Clearance(Zone.STOP, 0.7, 0.0, 1.1, 0.0, 0.101, False, 3.0)
    scene.show(replace(frame, clearance=near), PATH)
    assert node().visible
    drawn = np.array(node().points)
    elsewhere = make_frame(0, pose=Pose2(2.0, 1.0, 0.0))
    scene.show(replace(elsewhere, clearance=near), PATH)
    np.testing.assert_allclose(node().points, drawn + np.array([2.0, 1.0, 0.0]), atol=1e-5)
    scene.show(replace(frame, clearance=Clearance(Zone.CLEAR, curvature=0.5)), PATH)
    assert len(node().points) < len(drawn), "no ring without an obstacle"
    scene.show(replace(frame, clearance=replace(near, begins=2.0)), PATH)
    assert np.array(node().points)[: len(way_lines(0.1, False, 2.0, P)), :, 0].min() > 1.5, (
        "from the robot's end"
    )
    scene.choose("way", False)
    assert not node().visible


def test_every_zone_has_its_colour():
    assert set(OF_ZONE) == set(Zone)
    assert len(set(OF_ZONE.values())) == len(Zone)
