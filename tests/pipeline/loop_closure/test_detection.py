"""Loops: the path and all that was mapped from it are bent, and nothing is bent where no loop is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification.column_classifier import bent as bent_memory
from pipeline.classification.column_classifier import bent_columns, no_columns
from pipeline.classification.voxel_map import SIDE, VoxelMap
from pipeline.config import preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground.terrain_map import CELL, COLUMNS, VIEWS, WEIGHT
from pipeline.ground.terrain_map import SIDE as CELLS
from pipeline.ground.terrain_map import bent as bent_tiles
from pipeline.loop_closure.map_correction import TILE, Bend
from pipeline.mapper import Mapper
from pipeline.slam import BackEnd, Loop
from pipeline.slam.loop_correction import bent_path, drift_of
from pipeline.slam.motion import Noise, compounded
from pipeline.slam.poses import composed, inverse
from pipeline.tracking import Tracker
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Landmarks, PoseEstimate
from tests.benchmarks.wide_ring import REACH, SENSOR, WideRing, mapped
from tests.pipeline.strategies import NOTHING_SEEN, detections, first_of, seeds
from tests.pipeline.test_mapper import as_bytes

NOISE = Noise(0.05, 0.01, 0.03)
NO_TIES = np.zeros((0, 2), np.int64)
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


def driven(path):
    """The odometry of a path without jumps."""
    return np.concatenate([np.zeros((1, 3)), composed(inverse(path[:-1]), path[1:])])


def loop(path, at, first=0, ties=NO_TIES, sigma=SURE, motion=None):
    """A loop that ends at a pose."""
    motion = driven(path) if motion is None else motion
    return Loop(first, len(path) - 1, first, Pose2(*at), sigma, ties, motion)


# --- the path -------------------------------------------------------------------------------------


@given(st.floats(-1e-3, 1e-3), st.floats(0.97, 1.03), st.integers(0, 100))
def test_a_path_with_a_steady_error_is_bent_back_onto_the_truth(turn, longer, first):
    truth, told = circle(), circle(turn=turn, longer=longer)
    at = composed(told[first][None], composed(inverse(truth[first][None]), truth[-1][None]))[0]
    bent = bent_path(told, loop(told, at, first), NOISE)
    assert bent[: first + 1].tobytes() == told[: first + 1].tobytes(), "what was known stays"
    np.testing.assert_allclose(bent[-1, :2], at[:2], atol=0.05)
    wanted = composed(told[first][None], composed(inverse(truth[first][None]).repeat(300, 0), truth))
    before = np.hypot(*(told - wanted)[first:, :2].T).max()
    # A circle that is too large comes back by itself: nothing tells how large it was.
    assert (
        np.hypot(*(bent - wanted)[first:, :2].T).max() <= max(0.5 * before, abs(longer - 1.0) * 62.0) + 0.05
    )


def test_the_bend_is_spread_evenly_over_a_straight_way_that_is_too_long():
    told = np.column_stack([np.arange(101.0), np.zeros(101), np.zeros(101)])
    bent = bent_path(told, loop(told, [90.0, 0.0, 0.0]), NOISE)
    np.testing.assert_allclose(bent[:, 0], 0.9 * told[:, 0], atol=0.05)
    np.testing.assert_allclose(bent[:, 1:], 0.0, atol=1e-6)


def test_a_loop_that_fits_bends_nothing():
    path = circle(laps=0.9)
    np.testing.assert_allclose(bent_path(path, loop(path, path[-1]), NOISE), path, atol=1e-6)


def test_a_scan_that_known_trees_held_stays_where_it_is():
    told = np.column_stack([np.arange(101.0), np.zeros(101), np.zeros(101)])
    held = np.array([[10, 50]])
    bent = bent_path(told, loop(told, [100.0, 5.0, 0.1], 20, ties=held), NOISE)
    free = bent_path(told, loop(told, [100.0, 5.0, 0.1], 20), NOISE)
    assert abs(bent[50, 1]) < 0.15 < abs(free[50, 1])


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
    """A way along x that is moved as a whole after a scan."""
    before = np.column_stack([0.5 * np.arange(scans), np.zeros(scans), np.zeros(scans)])
    after = before.copy()
    after[first + 1 :, :2] += [dx, dy]
    return Bend(before, after, first, scans - 1)


@given(seeds)
def test_what_stands_in_one_tile_moves_as_one_piece_and_what_was_known_stays(seed):
    random = np.random.default_rng(seed)
    path = circle(turn=1e-3)
    bend = Bend(path, circle(), 40, len(path) - 1)
    tile = TILE * np.floor(random.uniform(-8, 8, 2))
    place = tile + random.uniform(0.0, TILE, (12, 2))
    scan = np.full(12, 200)
    moved = bend.moved(place, scan)
    apart = lambda p: np.hypot(*(p[:, None] - p[None]).transpose(2, 0, 1))  # noqa: E731
    np.testing.assert_allclose(apart(moved), apart(place), atol=1e-9)
    assert bend.moved(place, np.full(12, 40)).tobytes() == place.tobytes()
    assert np.all(bend.turned(place, np.full(12, 40)) == 0.0)


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
    estimate = PoseEstimate(pose, SURE, pose.as_array()[None], np.ones(1), 1.0, place, False)
    tracker.bend(shifted(dx=-3.0, first=10), np.arange(60), estimate, landmarks)
    bent = tracker.tracks
    assert bent.number.tolist() == bent.landmark.tolist() == [3, 4, 12]
    assert bent.hits.tolist() == [10, 10, 5]
    np.testing.assert_allclose(bent.x[:, :2], [[5.0, 1.0], [5.0, 1.5], [11.0, 2.0]], atol=0.05)


@given(seeds)
def test_voxels_move_and_no_return_is_lost(seed):
    random = np.random.default_rng(seed)
    memory = VoxelMap.empty()
    for scan in range(0, 60, 3):
        near = 0.5 * scan + random.uniform(-4, 4, (40, 1))
        points = np.column_stack([near, random.uniform(-4, 4, 40), random.uniform(0.0, 5.9, 40)])
        memory.add(points.astype(np.float32), scan, 1 << 12)
    same = bent_memory(memory, shifted())
    assert set(same.key[: same.used].tolist()) == set(memory.key[: memory.used].tolist())
    moved = bent_memory(memory, shifted(dx=2.0, dy=-3 * SIDE, first=20))
    n, m = memory.used, moved.used
    assert moved.returns[:m].sum() == memory.returns[:n].sum() == moved.tile_returns[: moved.tiles].sum()
    late = memory.latest[:n] > 20
    wanted = memory.mean[:n] + np.where(late, 1.0, 0.0)[:, None] * [2.0, -3 * SIDE, 0.0]
    centre = np.average(wanted, axis=0, weights=memory.returns[:n])
    np.testing.assert_allclose(
        np.average(moved.mean[:m], axis=0, weights=moved.returns[:m]), centre, atol=1e-3
    )


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
    bent = bent_columns(columns, memory, shifted(dx=-6.0, first=20))
    np.testing.assert_allclose(bent.axis[:, 0], [1.0, 19.0])
    assert bent.tile.tolist() == [[0, 0], [4, 0]]
    assert bent_columns(empty, memory, shifted(dx=-6.0)) is empty


def test_the_ground_moves_by_whole_cells_and_keeps_its_views():
    random = np.random.default_rng(0)
    tile = random.uniform(0.5, 1.0, (CELLS, CELLS, COLUMNS)).astype(np.float32)
    tile[..., VIEWS] = 3.0
    tiles = {(0, 0): tile, (1, 0): 2.0 * tile}
    same = bent_tiles(tiles, shifted())
    assert list(same) == list(tiles)
    np.testing.assert_allclose(same[0, 0], tile, rtol=1e-6)
    moved = bent_tiles(tiles, shifted(dx=CELLS * CELL, dy=CELL))
    np.testing.assert_allclose(moved[1, 0][:, 1:], tile[:, :-1], rtol=1e-6)
    views = sum(float(one[..., VIEWS].sum()) for one in moved.values())
    assert views == sum(float(one[..., VIEWS].sum()) for one in tiles.values())
    onto = bent_tiles(tiles, shifted(dx=-CELLS * CELL, first=20))
    weight = sum(float(one[..., WEIGHT].sum()) for one in onto.values())
    assert weight == pytest.approx(sum(float(one[..., WEIGHT].sum()) for one in tiles.values()), rel=1e-5)
    assert bent_tiles({}, shifted()) == {}


# --- the outcome ----------------------------------------------------------------------------------


@cache
def ring(seed, method="constellation"):
    """A wide ring over a field, back among the first trees."""
    return mapped(WideRing(), seed, STEMS.replace({"relocalisation.method": method}))


@pytest.mark.parametrize("seed", first_of([0, 5]))
def test_back_after_a_long_way_path_and_map_are_bent(seed):
    bent, left = ring(seed), ring(seed, "none")
    assert bent.closed()
    assert not left.closed()
    assert bent.told().max() > 10.0, "the wheels drift by more than trees stand apart"
    assert np.sqrt(np.mean(bent.errors() ** 2)) < min(2.5, 0.4 * np.sqrt(np.mean(left.errors() ** 2)))
    assert bent.told()[bent.closed()[0]] < 0.5


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


def test_the_pose_graph_closes_it_too():
    pytest.importorskip("gtsam", reason="the pose graph needs the extra `graph`")
    slam = BackEnd(STEMS.slam.model_copy(update={"method": "graph"}), 0)
    trees = np.array([[2.0, 3.0], [4.0, -3.0], [-1.0, 4.0], [6.0, 2.5], [0.5, -4.0]])
    true, told, n = circle(60, radius=8.0), circle(60, radius=8.0, turn=0.01), 60
    for k in range(n):
        step = Pose2(*(composed(inverse(told[k - 1][None]), told[k][None])[0] if k else np.zeros(3)))
        near = Pose2(*true[k]).inverse().apply(trees)
        slam.process(k, step, detections(near if k < 8 else near[:0]), NOTHING_SEEN)
    before = slam.path()
    assert np.hypot(*(before - true)[-1, :2]) > 1.0
    bend = slam.close(n - 1, Loop(8, n - 1, 4, Pose2(*true[-1]), SURE, NO_TIES, driven(told)))
    assert bend.before.tobytes() == before.tobytes()
    assert bend.after.tobytes() == slam.path().tobytes()
    assert np.hypot(*(bend.after - true)[-1, :2]) < 0.15
    assert np.hypot(*(bend.after - true)[:, :2].T).max() < 0.5 * np.hypot(*(before - true)[:, :2].T).max()
    np.testing.assert_allclose(bend.after[:8], before[:8], atol=0.05)
    place = slam.landmarks().position
    assert np.hypot(*(place[:, None] - trees).transpose(2, 0, 1)).min(axis=1).max() < 0.2
    assert len(slam.begun_since(30)[0]) == 0 < len(slam.begun_since(0)[0])
