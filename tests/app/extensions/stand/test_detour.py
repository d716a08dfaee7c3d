"""The way that shows trees without a diameter from the sides that were never seen."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.extensions.stand.detour import FARTHEST_VIEW, NEAREST_VIEW, VIEW_ARC, Detour, shortest_detour
from pipeline.seen_area import CELL, SeenArea
from pipeline.tracking.observation import SECTORS, WIDTH, seen_sides

HALF, WIDTH_OF_ROBOT = math.pi, 0.9


def area(half: float) -> SeenArea:
    """An observed square around the origin."""
    side = np.arange(-round(half / CELL), round(half / CELL))
    place = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    n = len(place)
    return SeenArea(CELL, place, np.ones(n), np.ones(n, np.int64), np.ones(n, np.bool_))


def seen_from(bearing: float) -> int:
    """The sectors of a tree that was seen from one direction only."""
    return int(seen_sides(bearing, VIEW_ARC))


def found(position: list[list[float]], sides: list[int | None], half: float = 15.0) -> Detour | None:
    place = np.reshape(np.array(position, float), (-1, 2))
    return shortest_detour(
        np.zeros(2), place, np.full(len(place), 0.2), sides, HALF, area(half), WIDTH_OF_ROBOT
    )


def shown(way: Detour, tree: np.ndarray, bits: int) -> int:
    """Number of sectors of a tree that are seen after the way, each decimetre of which is a view."""
    for a, b in zip(way.points[:-1], way.points[1:], strict=True):
        for share in np.linspace(0.0, 1.0, max(2, int(10 * np.hypot(*(b - a))))):
            there = a + share * (b - a) - tree
            if NEAREST_VIEW - CELL <= np.hypot(*there) <= FARTHEST_VIEW + CELL:
                bits |= int(seen_sides(math.atan2(there[1], there[0]), VIEW_ARC))
    return bits.bit_count()


def test_a_tree_that_was_seen_from_one_side_is_seen_from_another():
    tree = np.array([6.0, 0.0])
    way = found([tree.tolist()], [seen_from(math.pi)])  # from the robot
    assert way is not None
    assert way.trees == [0]
    assert shown(way, tree, seen_from(math.pi)) * WIDTH >= HALF
    assert 2.0 < way.length < 12.0
    np.testing.assert_array_equal(way.points[0], np.zeros(2))


def test_the_way_is_clear_of_the_trees_and_stays_in_the_observed_area():
    rng = np.random.default_rng(4)
    trees = rng.uniform(-12.0, 12.0, (25, 2))
    trees = trees[np.hypot(*trees.T) > 2.0]
    bearings = np.arctan2(*-trees.T[::-1])
    way = found(trees.tolist(), [seen_from(float(bearing)) for bearing in bearings])
    assert way is not None
    assert len(way.trees) >= 0.8 * len(trees)
    steps = np.concatenate(
        [np.linspace(a, b, 50) for a, b in zip(way.points[:-1], way.points[1:], strict=True)]
    )
    gaps = np.hypot(*np.moveaxis(steps[:, None] - trees, -1, 0))
    assert gaps.min() >= 0.2 + 0.5 * WIDTH_OF_ROBOT
    assert np.abs(steps).max() <= 15.0


def test_without_a_tree_or_a_place_there_is_no_way():
    assert found([], []) is None
    assert found([[6.0, 0.0]], [None]) is None
    assert found([[60.0, 0.0]], [seen_from(math.pi)]) is None
    assert found([[6.0, 0.0]], [seen_from(math.pi)], half=0.0) is None


def test_a_tree_behind_another_is_not_completed_from_there():
    wall = [[4.0, y] for y in np.arange(-16.0, 16.0, 0.35).tolist()]
    way = found([[8.0, 0.0], *wall], [seen_from(math.pi / 2), *[None] * len(wall)])
    assert way is None  # the wall of stems hides it and cannot be passed


@settings(max_examples=30, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(3.0, 9.0))
def test_wherever_a_tree_is_the_way_completes_it(bearing, distance):
    tree = distance * np.array([math.cos(bearing), math.sin(bearing)])
    bits = seen_from(bearing + math.pi)
    way = found([tree.tolist()], [bits], half=20.0)
    assert way is not None
    assert shown(way, tree, bits) >= SECTORS // 2 - 1
