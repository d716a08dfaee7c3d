"""The accumulated points of a tree and the section at breast height, against the voxels and closed forms."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.explain.build import BREAST_HIGH, BREAST_LOW, REACH, points_around, section, tree_story
from app.worker.session import Session
from pipeline.classification.voxel_map import SIDE, VoxelMap
from tests.app.explain.test_build import drive


def voxels_of(points: np.ndarray) -> VoxelMap:
    voxels = VoxelMap.empty()
    voxels.add(points.astype(np.float32), 0, 1 << 18)
    return voxels


def ring(x: float, y: float, radius: float, height: float, n: int = 400) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(n, height)])


@given(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
def test_the_points_of_a_tree_are_the_voxels_around_it_wherever_it_is(x: float, y: float):
    trunk = np.concatenate([ring(x, y, 0.2, height) for height in (0.5, 1.3, 3.1)])
    voxels = voxels_of(np.concatenate([trunk, ring(x + 2.0, y, 0.2, 1.3)]))
    points = np.array(points_around(voxels, np.array([x, y])))
    mean = voxels.mean[: voxels.used].astype(np.float64)
    near = mean[np.hypot(mean[:, 0] - x, mean[:, 1] - y) <= REACH]
    assert len(points) == len(near)
    found = points[np.lexsort(points.T)] + [x, y, 0.0]
    assert np.abs(np.sort(found[:, 2]) - np.sort(near[:, 2])).max() < 0.006
    reach = np.hypot(points[:, 0], points[:, 1])
    assert reach.max() < 0.22
    assert reach.min() > 0.15  # the mean of a part of a ring is inside of it
    # Those at breast height come first.
    at_breast = (points[:, 2] >= BREAST_LOW) & (points[:, 2] < BREAST_HIGH)
    assert at_breast.any()
    assert (np.diff(at_breast.astype(int)) <= 0).all()


def test_a_thicket_is_thinned_evenly():
    rng = np.random.default_rng(0)
    points = np.array(points_around(voxels_of(rng.uniform([-1, -1, 0], [1, 1, 6], (60_000, 3))), np.zeros(2)))
    at_breast = ((points[:, 2] >= BREAST_LOW) & (points[:, 2] < BREAST_HIGH)).sum()
    assert 400 < at_breast <= 600
    assert len(points) == at_breast + 900
    for axis in (0, 1):
        assert abs(points[:, axis].mean()) < 0.05
    assert abs(points[at_breast:, 2].mean() - 3.1) < 0.15  # all heights but those between 1.0 and 1.6 m


def test_without_voxels_there_is_nothing():
    assert points_around(VoxelMap.empty(), np.zeros(2)) == []
    assert section(np.zeros((0, 3))).cells.shape == (0, 2)


@given(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0))
def test_the_section_holds_the_cells_at_breast_height_only(x: float, y: float):
    voxels = voxels_of(np.concatenate([ring(x, y, 0.3, 1.3), ring(x + 3.0, y, 0.3, 0.5), ring(x, y, 0.5, 3)]))
    found = section(voxels.mean[: voxels.used])
    assert found.side == SIDE
    centre = np.array(found.origin) + (found.cells + 0.5) * found.side
    reach = np.hypot(*(centre - [x, y]).T)
    assert len(centre) > 12
    assert ((reach > 0.3 - SIDE) & (reach < 0.3 + SIDE)).all()


def test_a_large_section_has_larger_cells_and_covers_the_same_places():
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-200, 200, (120_000, 2)), np.full(120_000, 1.3)])
    found = section(places)
    assert found.side in (2 * SIDE, 4 * SIDE, 8 * SIDE, 16 * SIDE, 32 * SIDE)
    assert 2_000 < len(found.cells) <= 20_000
    held = {tuple(cell) for cell in found.cells.tolist()}
    wanted = np.floor((places[:, :2] - found.origin) / found.side).astype(int)
    inside = sum(tuple(cell) in held for cell in wanted.tolist())
    assert inside == len(places)


def test_the_points_of_a_mapped_tree_are_on_its_fitted_circle(session: Session):
    assert session.shown.frame is not None
    assert session.run is not None
    truth = session.run.source.truth()
    assert truth is not None
    assert truth.trees is not None
    trees = session.shown.frame.trees
    rows = np.flatnonzero(trees.confirmed & (trees.observations >= 10))
    errors = []
    for row in rows:
        x, y = trees.position[row]
        distance = np.hypot(truth.trees.x - x, truth.trees.y - y)
        true = np.argmin(distance)
        if truth.trees.kind[true] != "tree" or distance[true] > 0.1:
            continue
        story = tree_story(drive(session), session.shown.frame, int(trees.number[row]))
        points = np.array(story.points).reshape(-1, 3)
        at_breast = points[(points[:, 2] >= BREAST_LOW) & (points[:, 2] < BREAST_HIGH)]
        if len(at_breast) < 10:  # far away, every fourth scan is accumulated only
            continue
        reach = np.median(np.hypot(at_breast[:, 0], at_breast[:, 1]))
        errors.append(abs(reach - 0.5 * truth.trees.dbh[true]))
    assert len(errors) > 5
    assert np.median(errors) < 0.02
    assert np.mean(np.array(errors) < 0.06) > 0.8  # at some trees bushes are in reach
