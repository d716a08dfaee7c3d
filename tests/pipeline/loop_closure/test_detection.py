"""Loop closure: path and map are corrected after a loop, and otherwise unchanged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification.column_classifier import corrected_columns, no_columns
from pipeline.classification.voxel_map import SIDE, VoxelMap, corrected_voxels
from pipeline.config import preset
from pipeline.geometry.pose_arrays import PathCorrection, composed, inverse
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground.terrain_map import CELL, COLUMNS, VIEWS, WEIGHT, corrected_tiles
from pipeline.ground.terrain_map import SIDE as CELLS
from pipeline.loop_closure.detection import through
from pipeline.mapper import Mapper
from pipeline.slam.keyframe_graph import drift_of
from pipeline.slam.motion import Noise, compounded
from pipeline.tracking import Tracker
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Landmarks, PoseEstimate
from tests.benchmarks.wide_ring import REACH, SENSOR, WideRing, mapped
from tests.pipeline.strategies import first_of, seeds
from tests.pipeline.test_mapper import as_bytes

NOISE = Noise(0.05, 0.01, 0.03)
SURE = np.diag(np.square([0.02, 0.02, 0.004]))
STEMS = preset("stems")


def circle(n=300, radius=30.0, laps=1.0, turn=0.0, longer=1.0):
    """A path around, with steps that turn and go too far."""
    step = 2.0 * np.pi * laps / n
    path = [np.zeros(3)]
    for _ in range(n - 1):
        motion = np.array([[longer * radius * step, 0.0, step + turn]])
        path.append(composed(path[-1][None], motion)[0])
    return np.array(path)


def test_a_pose_through_a_local_frame_has_the_covariance_of_both():
    T, R = (
        Pose2(10.0, -4.0, 0.7),
        np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 4e-4]]),
    )
    local, own = Pose2(3.0, 2.0, 0.4), np.diag([0.09, 0.01, 1e-3])
    pose, covariance = through(T, R, local, own)
    h = 1e-6

    def joined(a, b):
        return (Pose2(*a) @ Pose2(*b)).as_array()

    a, b = T.as_array(), local.as_array()
    np.testing.assert_allclose(pose.as_array(), joined(a, b))
    F = np.stack([(joined(a + d, b) - joined(a, b)) / h for d in h * np.eye(3)], axis=1)
    G = np.stack([(joined(a, b + d) - joined(a, b)) / h for d in h * np.eye(3)], axis=1)
    np.testing.assert_allclose(covariance, F @ R @ F.T + G @ own @ G.T, atol=1e-6)


def driven(path):
    """The odometry of a path without jumps."""
    return np.concatenate([np.zeros((1, 3)), composed(inverse(path[:-1]), path[1:])])


@given(seeds, st.integers(0, 20))
def test_the_drift_is_that_of_the_steps_one_after_another(seed, first):
    random = np.random.default_rng(seed)
    steps = random.normal(0.0, [0.5, 0.1, 0.2], (40, 3))
    path, motion, covariance = [np.zeros(3)], np.zeros(3), np.zeros((3, 3))
    for k, step in enumerate(steps):
        path.append(composed(path[-1][None], step[None])[0])
        if k >= first:
            d = float(np.hypot(*step[:2]))
            along, turn = NOISE.distance**2 * d, NOISE.turn_distance**2 * d + NOISE.turn**2 * abs(step[2])
            noise = np.diag([along, along, turn])
            motion, covariance = compounded(motion, covariance, step[0], step[1], step[2], noise)
    rows = np.array(path)
    c, s = np.cos(rows[first, 2]), np.sin(rows[first, 2])
    C = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(drift_of(rows, first, NOISE), C @ covariance @ C.T, atol=1e-9)


# --- what was mapped ------------------------------------------------------------------------------


def shifted(dx=0.0, dy=0.0, first=-1, scans=60):
    """A path along x whose part after a scan is moved."""
    before = np.column_stack([0.5 * np.arange(scans), np.zeros(scans), np.zeros(scans)])
    after = before.copy()
    after[first + 1 :, :2] += [dx, dy]
    return PathCorrection(before, after)


@given(seeds)
def test_the_voxels_of_one_trunk_stay_together(seed):
    """Also where the path passed the trunk before with another error."""
    random = np.random.default_rng(seed)
    x = np.concatenate([np.arange(0.0, 60.0, 0.5), np.arange(60.0, 0.0, -0.5)])
    before = np.column_stack([x, 0.5 * (np.arange(240) >= 120), np.zeros(240)])
    after = before + np.linspace(0.0, 1.0, 240)[:, None] * [3.0, -2.0, 0.1]
    trunk = random.uniform([4.0, -4.0], [26.0, 4.0], (1, 2))
    place = trunk + random.uniform(-0.2, 0.2, (40, 2))
    passes = int(2.0 * trunk[0, 0]), 239 - int(2.0 * trunk[0, 0])
    scan = random.choice(passes) + random.integers(-3, 4, 40)
    moved, turn = PathCorrection(before, after).moved(place, scan)
    np.testing.assert_allclose(moved - moved.mean(axis=0), place - place.mean(axis=0), atol=0.1)
    assert np.ptp(turn) < 0.01


@given(seeds)
def test_what_moves_rigidly_keeps_all_distances(seed):
    random = np.random.default_rng(seed)
    path = np.column_stack([0.5 * np.arange(60), np.zeros(60), np.zeros(60)])
    shift, angle = random.uniform(-5.0, 5.0, 2), random.uniform(-3.0, 3.0)
    whole = Pose2(shift[0], shift[1], angle)
    after = composed(whole.as_array()[None].repeat(60, axis=0), path)
    place, scan = random.uniform(-10.0, 40.0, (20, 2)), random.integers(0, 60, 20)
    moved, turn = PathCorrection(path, after).moved(place, scan)
    np.testing.assert_allclose(moved, whole.apply(place), atol=1e-9)
    np.testing.assert_allclose(turn, angle)


def test_of_two_trees_that_were_one_the_older_number_stays_and_two_beside_it_stay_two():
    table = TrackTable.empty(5)
    table.number[:] = [3, 4, 8, 9, 12]
    table.x[:, :2] = [[5.0, 1.0], [5.0, 1.5], [8.05, 1.0], [8.0, 1.5], [14.0, 2.0]]
    table.P[:] = 1e-3 * np.eye(4)
    table.hits[:], table.stamp_ns[:], table.landmark[:] = 5, [1, 2, 3, 4, 5], [3, 4, 8, 9, 12]
    table.first_ns[:] = [2, 2, 40, 40, 40]
    tracker = Tracker(STEMS.tracking)
    tracker.tracks = table
    # The landmarks of trees 8 and 9 were joined with those of 3 and 4.
    place = np.array([[5.0, 1.5], [5.0, 1.0], [11.0, 2.0]])
    landmarks = Landmarks(
        np.array([4, 3, 12]), place, np.tile([1e-4, 0.0, 1e-4], (3, 1)), np.ones(3), 3.5, 1.0
    )
    pose = Pose2(11.0, 0.0, 0.0)
    estimate = PoseEstimate(pose, SURE, pose.as_array()[None], np.ones(1), 1.0, place)
    of_map = np.array([1.0, 2.0, 3.0])[:, None, None] * np.diag([4e-4, 1e-4])
    tracker.correct(shifted(dx=-3.0, first=10), np.arange(60), estimate, landmarks, of_map)
    corrected = tracker.tracks
    assert corrected.number.tolist() == corrected.landmark.tolist() == [3, 4, 12]
    assert corrected.hits.tolist() == [10, 10, 5]
    np.testing.assert_allclose(corrected.x[:, :2], [[5.0, 1.0], [5.0, 1.5], [11.0, 2.0]], atol=0.05)
    np.testing.assert_allclose(corrected.shared, of_map[[1, 0, 2]])  # in place of those of the poses
    np.testing.assert_allclose(corrected.P[:, :2, :2], 1e-3 * np.eye(2) + of_map[[1, 0, 2]])


@given(seeds)
def test_voxels_move_and_no_return_is_lost(seed):
    random = np.random.default_rng(seed)
    memory = VoxelMap.empty()
    for scan in range(0, 60, 3):
        near = 0.5 * scan + random.uniform(-4, 4, (40, 1))
        points = np.column_stack([near, random.uniform(-4, 4, 40), random.uniform(0.0, 5.9, 40)])
        memory.add(points.astype(np.float32), scan, 1 << 12)
    same = corrected_voxels(memory, shifted())
    assert set(same.key[: same.used].tolist()) == set(memory.key[: memory.used].tolist())
    moved = corrected_voxels(memory, shifted(dx=2.0, dy=-3 * SIDE, first=20))
    n, m = memory.used, moved.used
    assert moved.returns[:m].sum() == memory.returns[:n].sum() == moved.tile_returns[: moved.tiles].sum()


@given(seeds)
def test_voxels_move_rigidly_with_the_poses_that_observed_them(seed):
    """Objects around the first part of the path, which did not move, stay where they are."""
    random = np.random.default_rng(seed)
    angle, shift = random.uniform(-3.0, 3.0), random.uniform([195.0, -5.0], [205.0, 5.0])
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    before = np.column_stack([0.5 * np.arange(60), np.zeros(60), np.zeros(60)])
    after = before.copy()
    after[40:, :2] = before[40:, :2] @ rotation.T + shift
    after[40:, 2] += angle
    memory, parts = VoxelMap.empty(), []
    for scans in (range(0, 16), range(50, 60)):  # all points are nearer to their part of the path
        places = [
            random.uniform([0.5 * k - 2.9, -2.9, 0.1], [0.5 * k + 2.9, 2.9, 5.9], (40, 3)) for k in scans
        ]
        for scan, points in zip(scans, places, strict=True):
            memory.add(points.astype(np.float32), scan, 1 << 12)
        parts.append(np.concatenate(places))
    parts[1][:, :2] = parts[1][:, :2] @ rotation.T + shift
    corrected = corrected_voxels(memory, PathCorrection(before, after))
    mean, returns = corrected.mean[: corrected.used], corrected.returns[: corrected.used]
    is_far = mean[:, 0] > 100.0
    for rows, points in ((~is_far, parts[0]), (is_far, parts[1])):
        assert returns[rows].sum() == len(points)
        centre = np.average(mean[rows], axis=0, weights=returns[rows])
        np.testing.assert_allclose(centre, points.mean(axis=0), atol=1e-3)
        spread = np.cov(points.T, bias=True)
        voxels = np.cov(mean[rows].T, fweights=returns[rows].astype(np.int64), bias=True)
        np.testing.assert_allclose(voxels, spread, atol=SIDE)
    kept = set(map(bytes, memory.mean[: memory.used][memory.latest[: memory.used] < 40]))
    assert set(map(bytes, mean[~is_far])) == kept


def test_columns_go_with_their_voxels():
    memory = VoxelMap.empty()
    for scan, x in ((5, 1.0), (50, 25.0)):
        height = np.linspace(0.2, 3.0, 30)
        memory.add(np.column_stack([np.full(30, x), np.ones(30), height]).astype(np.float32), scan, 1 << 12)
    empty = no_columns()
    names = ("viewed", "present", "absent", "figures", "share", "verdict")
    two = {name: np.zeros((2, *getattr(empty, name).shape[1:]), getattr(empty, name).dtype) for name in names}
    axis = np.array([[1.0, 1.0, 0.01, 0.0, 9.0], [25.0, 1.0, 0.01, 0.0, 9.0]])
    columns = replace(empty, tile=np.floor(axis[:, :2] / 4.0).astype(np.int64), axis=axis, **two)
    corrected = corrected_columns(columns, memory, shifted(dx=-6.0, first=20))
    np.testing.assert_allclose(corrected.axis[:, 0], [1.0, 19.0])
    assert corrected.tile.tolist() == [[0, 0], [4, 0]]
    assert corrected_columns(empty, memory, shifted(dx=-6.0)) is empty


def test_the_ground_moves_by_whole_cells_and_keeps_its_views():
    random = np.random.default_rng(0)
    tile = random.uniform(0.5, 1.0, (CELLS, CELLS, COLUMNS)).astype(np.float32)
    tile[..., VIEWS] = 3.0
    tiles = {(0, 0): tile, (1, 0): 2.0 * tile}
    same = corrected_tiles(tiles, shifted())
    assert list(same) == list(tiles)
    np.testing.assert_allclose(same[0, 0], tile, rtol=1e-6)
    moved = corrected_tiles(tiles, shifted(dx=CELLS * CELL, dy=CELL))
    np.testing.assert_allclose(moved[1, 0][:, 1:], tile[:, :-1], rtol=1e-6)
    views = sum(float(one[..., VIEWS].sum()) for one in moved.values())
    assert views == sum(float(one[..., VIEWS].sum()) for one in tiles.values())
    onto = corrected_tiles(tiles, shifted(dx=-CELLS * CELL, first=20))
    weight = sum(float(one[..., WEIGHT].sum()) for one in onto.values())
    assert weight == pytest.approx(sum(float(one[..., WEIGHT].sum()) for one in tiles.values()), rel=1e-5)
    assert corrected_tiles({}, shifted()) == {}


# --- the outcome ----------------------------------------------------------------------------------


@cache
def ring(seed, method="constellation"):
    """A wide ring over a field, back among the first trees."""
    return mapped(WideRing(), seed, STEMS.replace({"relocalisation.method": method}))


@pytest.mark.parametrize("seed", first_of([0, 5]))
def test_a_loop_after_a_long_path_corrects_path_and_map(seed):
    closed, left = ring(seed), ring(seed, "none")
    assert closed.closed()
    assert not left.closed()
    assert closed.told().max() > 10.0, "the wheels drift by more than trees stand apart"
    assert np.sqrt(np.mean(closed.errors() ** 2)) < min(2.5, 0.4 * np.sqrt(np.mean(left.errors() ** 2)))
    assert closed.told()[closed.closed()[0]] < 0.5


@pytest.mark.parametrize("seed", first_of([0, 5]))
def test_every_tree_that_was_seen_stands_once_when_the_loop_is_closed(seed):
    run = ring(seed)
    assert len(run.closed()) == 1, "what is closed is not closed again"
    trees = WideRing().trees(np.random.default_rng([9, seed]))
    near = np.hypot(*(run.truth[:, None, :2] - trees[None]).transpose(2, 0, 1)) < REACH
    seen = np.count_nonzero(near.sum(axis=0) >= 10)
    found = run.frames[-1].trees
    assert abs(np.count_nonzero(found.confirmed) - seen) <= 0.06 * seen


def test_numbers_stay_with_their_trees_over_the_loop():
    run = ring(0)
    at = run.closed()[0]
    before, after = run.frames[at - 1].trees, run.frames[at].trees
    fresh = set(after.number.tolist()) - set(before.number.tolist())
    used = max(max(frame.trees.number.tolist(), default=0) for frame in run.frames[:at])
    assert all(number > used for number in fresh), "no number is given anew"
    known = before.number[before.first_seen_ns < run.frames[60].stamp_ns]
    for number in np.intersect1d(known, after.number):
        was, now = (t.position[t.number == number][0] for t in (before, after))
        assert np.hypot(*(was - now)) < 0.3, "what was known before stands where it stood"
    confirmed = run.frames[-1].trees.position[run.frames[-1].trees.confirmed]
    near = np.hypot(*(confirmed[:, None] - confirmed[None]).transpose(2, 0, 1))
    assert np.count_nonzero(near < 1.0) - len(confirmed) <= 4, "at most two trees stand twice"


@pytest.mark.slow
def test_a_snapshot_taken_before_the_loop_goes_on_to_the_same_bytes():
    run = ring(0)
    at = run.closed()[0]
    mapper = Mapper(STEMS, sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=0)
    steps = [step for step, _ in WideRing().steps(0)]
    for step in steps[: at - 2]:
        mapper.process(step)
    state = mapper.snapshot()
    once = [as_bytes(mapper.process(step)) for step in steps[at - 2 : at + 6]]
    mapper.restore(state)
    assert [as_bytes(mapper.process(step)) for step in steps[at - 2 : at + 6]] == once
    assert once == [as_bytes(frame) for frame in run.frames[at - 2 : at + 6]]


@pytest.mark.parametrize("seed", first_of(range(2)))
def test_who_has_not_come_back_closes_no_loop(seed):
    run = mapped(WideRing(laps=0.9), seed, STEMS)
    assert not run.closed()
    assert run.told()[-1] > 5.0, "however far the wheels drift"
