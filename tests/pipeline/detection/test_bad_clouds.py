"""Clouds without trees, with invalid values or of millions of points: each gives a frame without a false
tree."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground.scan_ground import NO_GROUND, find_terrain, height_above
from pipeline.mapper import Mapper
from pipeline.types.records import Scan, Sensor, Step

RNG = np.random.default_rng(7)
FOREST = preset("forest")


def _grid(x, y, z):
    return np.stack([axis.ravel() for axis in np.meshgrid(x, y, z)], axis=1).astype(np.float32)


WALL = _grid([6.0], np.arange(-8.0, 8.0, 0.05), np.arange(-0.8, 3.0, 0.1))
CLOUDS = {
    "empty": np.zeros((0, 3), np.float32),
    "one point": np.array([[3.0, 0.0, -0.8]], np.float32),
    "ten identical points": np.full((10, 3), 4.0, np.float32),
    "all one wall": WALL,
    "a wall without its foot": WALL[WALL[:, 2] > 1.0],
    "a ceiling alone": _grid(np.arange(-10, 10, 0.2), np.arange(-10, 10, 0.2), [2.5]),
    "the ground alone": _grid(np.arange(-20, 20, 0.2), np.arange(-20, 20, 0.2), [-0.8]),
    "a slanted plane": _grid(np.arange(-9, 9, 0.1), np.arange(-9, 9, 0.1), [0.0])
    + np.array([0.0, 0.0, -0.8], np.float32),
    "noise everywhere": RNG.uniform(-20.0, 20.0, (5000, 3)).astype(np.float32),
    "one straight line": np.outer(np.linspace(1.0, 20.0, 500), [1.0, 0.3, -0.02]).astype(np.float32),
}
CLOUDS["a slanted plane"][:, 2] += 0.5 * CLOUDS["a slanted plane"][:, 0]


def mapper() -> Mapper:
    sensor = Sensor(name="VLP-16", rings=16, ring_step=float(np.radians(2.0)))
    mounting = Pose3(np.eye(3), np.array([0.0, 0.0, 0.8]))
    return Mapper(FOREST, sensor=sensor, T_base_lidar=mounting, seed=0)


def _steps(points, scans):
    for k in range(scans):
        yield Step(k, Scan(100_000_000 * k, points), Pose2(0.02 * k, 0.0, 0.0))


@pytest.mark.parametrize("name", CLOUDS)
def test_no_tree_is_invented_and_no_number_is_lost(name):
    points = CLOUDS[name]
    run = mapper()
    for frame in [run.process(step) for step in _steps(points, 12)]:
        assert np.all(np.isfinite(frame.estimate.T_map_base.as_array()))
        assert np.isfinite(frame.base_z)
        assert not frame.trees.confirmed.any()
    assert np.all(np.isfinite(run.height_map.height))
    above = height_above(points, find_terrain(points, FOREST.ground))
    assert above.shape == (len(points),)
    assert np.all(np.isfinite(above))


@pytest.mark.parametrize("name", CLOUDS)
def test_a_scan_without_ground_is_said_to_be_one(name):
    (frame,) = map(mapper().process, _steps(CLOUDS[name], 1))
    ground = name in ("empty", "the ground alone", "a slanted plane")
    assert (NO_GROUND in frame.warnings) != ground


@pytest.mark.parametrize("name", [name for name, points in CLOUDS.items() if len(points)])
def test_only_a_scan_that_shows_the_ground_votes_by_heights_above_it(name):
    run = mapper()
    frame = [run.process(step) for step in _steps(CLOUDS[name], 3)][-1]
    is_silent = run.voxels.added == 0 and len(run.height_map.height) == 0
    assert is_silent == (NO_GROUND in frame.warnings)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_what_is_no_number_harms_no_other_point(value):
    clean = CLOUDS["the ground alone"]
    dirty = clean.copy()
    dirty[::50, 0], dirty[1::50, 1], dirty[2::50, 2] = value, value, value
    bad = ~np.all(np.isfinite(dirty) & (np.abs(dirty) < 1e6), axis=1)
    above = height_above(dirty, find_terrain(dirty, FOREST.ground))
    np.testing.assert_allclose(above[~bad], 0.0, atol=1e-4)


def test_two_million_points_are_one_scan():
    many = RNG.uniform(-30.0, 30.0, (2_000_000, 3)).astype(np.float32)
    many[:, 2] = np.where(many[:, 2] > -10.0, -0.8, 1.0 + 0.05 * many[:, 2])
    terrain = find_terrain(many, FOREST.ground)
    assert np.all(np.isfinite(terrain.height))
    low = many[:, 2] == np.float32(-0.8)
    near = low & (np.hypot(many[:, 0], many[:, 1]) < 10.0)
    assert np.abs(np.median(height_above(many[near], terrain))) < 0.3


def test_two_million_points_are_one_frame_without_a_tree():
    many = RNG.uniform(-30.0, 30.0, (2_000_000, 3)).astype(np.float32)
    many[:, 2] = -0.8 + np.abs(many[:, 2]) / 100.0  # grass on a level ground
    (frame,) = map(mapper().process, _steps(many, 1))
    assert frame.counts["returns"] == 2_000_000
    assert (
        sum(frame.counts[name] for name in ("out of range", "out of the box", "ground or too high"))
        > 1_900_000
    )
    assert not frame.trees.confirmed.any()
    assert len(frame.detections.cluster) == 0


def stand(trunk, rng):
    """Level ground, grass, two bushes without a stem, and a trunk of 1.2 m around (5, 0) or none."""
    flat = CLOUDS["the ground alone"]
    grass = np.column_stack([rng.uniform(-9.0, 9.0, (3000, 2)), rng.uniform(-0.8, -0.65, 3000)])
    bushes = [
        rng.normal(middle, (0.3, 0.3, 0.15), (400, 3)) for middle in ((4.0, 3.0, -0.4), (-3.0, 2.0, -0.4))
    ]
    parts = [flat, grass, *bushes]
    if trunk:
        turn, up = rng.uniform(0.5 * np.pi, 1.5 * np.pi, 1500), rng.uniform(-0.8, 3.0, 1500)
        parts.append(np.column_stack([5.0 + 0.2 * np.cos(turn), 0.2 * np.sin(turn), up]))
    return np.concatenate(parts).astype(np.float32)


def test_a_cloud_without_trees_gives_frames_and_none():
    frames = list(map(mapper().process, _steps(stand(False, np.random.default_rng(1)), 12)))
    assert not any(frame.trees.confirmed.any() for frame in frames)
    assert NO_GROUND not in frames[-1].warnings
    assert len(frames[-1].clusters.size) > 0, "the bushes are looked at"


@pytest.mark.parametrize("limit", [4.85, 4.95, 5.0, 6.0])
def test_a_trunk_that_the_border_cuts_is_a_frame_and_gets_no_wrong_diameter(limit):
    """The front face of the pass-through box cuts the trunk of 40 cm around (5, 0), or just does not."""
    run = mapper()
    run.parameters = FOREST.replace({"filters.x_max": limit})
    points = stand(True, np.random.default_rng(2))
    frames = [run.process(step) for step in _steps(points, 12)]
    trees = frames[-1].trees
    near = np.hypot(trees.position[:, 0] - 5.0, trees.position[:, 1]) < 0.3
    assert not (trees.confirmed & ~near).any(), "none is invented"
    told = trees.dbh[np.isfinite(trees.dbh)]
    assert np.all(np.abs(told - 0.4) < 0.05)
