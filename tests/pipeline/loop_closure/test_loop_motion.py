"""What a loop bends was driven: a jump of the path is no motion, lost scans are, and no bend goes over a
place where the robot was put."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose2
from pipeline.loop_closure.detection import TIE_APART, TIE_NEAR, RunHistory, loop_to
from pipeline.loop_closure.map_correction import Bend
from pipeline.slam.frame_uncertainty import FrameMemory
from pipeline.slam.loop_correction import bent_landmarks, bent_path, without_jumps
from pipeline.slam.particle_maps import MapColumns
from pipeline.slam.poses import composed
from pipeline.types.records import PoseEstimate, Trees
from tests.pipeline.loop_closure.test_detection import NOISE, SURE, circle, driven, loop
from tests.pipeline.strategies import seeds

STRIDE = 0.15  # m


def square(side=60.0):
    """Around a square, back to the start; x, y [m], yaw [rad]."""
    way = np.arange(0.0, 4.0 * side, STRIDE)
    k, rest = (way // side).astype(int), way % side
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * side
    along = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    return np.column_stack([corner[k] + along[k] * rest[:, None], k * np.pi / 2.0])


def line(metres=24.0, step=0.4):
    """Along x."""
    x = np.arange(0.0, metres, step)
    return np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])


def trees(place, first_ns, last_ns):
    """Seen first and last at these times."""
    n = len(place)
    ones, full = np.ones(n), np.full(n, 20)
    return Trees(
        np.arange(1, n + 1), place, np.tile(0.01 * np.eye(2), (n, 1, 1)), np.zeros((n, 2)), ones, ones, ones,
        full, ones, np.asarray(first_ns), np.asarray(last_ns), np.ones(n, np.bool_),
    )  # fmt: skip


def mapped(path, motion, known, placed=0):
    """A run of one scan a nanosecond."""
    n = np.zeros(0)
    estimate = PoseEstimate(Pose2(*path[-1]), SURE, path[-1:], np.ones(1), 1.0, n.reshape(0, 2), False)
    none = lambda _: (n.reshape(0, 2), n.reshape(0, 3))  # noqa: E731
    return RunHistory(np.arange(len(path)), path, known, none, estimate, NOISE, motion, placed)


# --- what was driven ------------------------------------------------------------------------------


def test_a_jump_that_a_correction_made_is_no_motion():
    path = line()
    jumped = path.copy()
    jumped[40:, 1] += 8.0
    straight, jumps = without_jumps(jumped, driven(path))
    np.testing.assert_allclose(straight, path, atol=1e-9)
    assert jumps == 1
    assert without_jumps(path, driven(path))[0].tobytes() == path.tobytes()


def test_a_heading_that_a_correction_turned_on_the_spot_is_no_turn():
    path = line()
    flipped = path.copy()
    flipped[40:] = composed(np.tile([path[40, 0], 0.0, np.pi], (len(path) - 40, 1)), path[40:] - path[40])
    straight, jumps = without_jumps(flipped, driven(path))
    np.testing.assert_allclose(straight, path, atol=1e-9)
    assert jumps == 1
    around = path.copy()
    around[40:] = flipped[40:]
    assert without_jumps(around, driven(around))[1] == 0, "the wheels told of the turn"


@given(seeds, st.integers(1, 40))
def test_a_step_that_the_odometry_tells_of_is_driven_however_far_it_leads(seed, lost):
    random = np.random.default_rng(seed)
    path = np.cumsum(random.normal(0.0, [0.4, 0.4, 0.1], (200, 3)), axis=0)
    path = np.delete(path, np.arange(80, 80 + lost), axis=0)
    same, jumps = without_jumps(path, driven(path))
    assert (same.tobytes(), jumps) == (path.tobytes(), 0)


@pytest.mark.parametrize("lost", [0, 20])
def test_over_lost_scans_the_path_leads_on_as_far_as_it_was_driven(lost):
    path = np.delete(square(), np.arange(600, 600 + lost), axis=0)
    bent = bent_path(path, loop(path, path[-1] + [0.6, 0.5, 0.0], 10), NOISE)
    moved = np.hypot(*(bent - path)[:, :2].T)
    assert moved.max() < 1.0, "no scan moves by much more than what the loop lacks"
    step = np.hypot(*np.diff(bent[:, :2], axis=0).T)
    assert step[599] == pytest.approx((1 + lost) * STRIDE, rel=0.05)


def test_a_jump_before_the_loop_begins_leaves_what_was_known_alone():
    path, motion = square(), driven(square())
    path[100:, :2] += [3.0, -4.0]
    bent = bent_path(path, loop(path, path[-1] + [0.6, 0.5, 0.0], 200, motion=motion), NOISE)
    assert bent[:201].tobytes() == path[:201].tobytes()
    assert np.hypot(*(bent - path)[:, :2].T).max() < 1.0


def test_scans_that_saw_the_same_trees_stay_together_over_a_jump():
    """Out and back: before the jump the path has drifted aside, behind it the known trees are met again."""
    n = 150
    x = np.concatenate([np.arange(n) * 0.4, np.arange(n)[::-1] * 0.4])
    yaw = np.repeat([0.0, np.pi], n)
    true = np.column_stack([x, np.zeros(2 * n), yaw])
    path = true.copy()
    path[30:220, 1] = 0.02 * np.arange(190)
    motion = driven(path)
    motion[220] = driven(true)[220]
    ties = np.array([[2 * n - 1 - k, k] for k in range(225, 290, 10)])
    bent = bent_path(path, loop(path, true[-1] + [0.0, 0.6, 0.0], 20, ties, motion=motion), NOISE)
    held = ties[ties[:, 0] <= 20]
    assert len(held) > 0
    assert np.abs((bent - path)[held[:, 1], 1]).max() < 0.7
    assert np.abs(np.diff(bent[:, :2], axis=0)).max() < 0.7, "the jump is spread over the way"


# --- which loop is one ----------------------------------------------------------------------------


def two_runs():
    """A run along x, and one that was put at its start, drove around and came back to the middle of it."""
    n, m = 400, 600
    s = np.linspace(0.0, 1.0, m)
    around = np.column_stack([50.0 * s, 60.0 * np.sin(np.pi * s), np.zeros(m)])
    d = np.gradient(around[:, :2], axis=0)
    around[:, 2] = np.arctan2(d[:, 1], d[:, 0])
    path = np.concatenate([np.column_stack([np.linspace(0.0, 100.0, n), np.zeros((n, 2))]), around])
    motion = driven(path)
    motion[n] = 0.0
    place = np.array([[48.0, 3.0], [50.0, -3.0], [52.0, 3.0], [47.0, -4.0], [53.0, -2.0]])
    return path, motion, trees(place, [190] * 5, [210] * 5), n


@pytest.mark.parametrize("gap", [[0.3, 0.8, 0.0], [-0.6, 0.3, 0.02]])
def test_no_loop_bends_what_was_driven_before_the_robot_was_put_elsewhere(gap):
    path, motion, known, placed = two_runs()
    at = Pose2(*(path[-1] + gap))
    found = loop_to(mapped(path, motion, known, placed), known.number, at, SURE, len(path) - 1)
    assert found is not None
    assert found.first == placed
    bent = bent_path(path, found, NOISE)
    assert bent[: placed + 1].tobytes() == path[: placed + 1].tobytes(), "the finished run stays"
    assert np.hypot(*(bent - path)[:, :2].T).max() < 3.0 * np.hypot(*gap[:2])


def test_who_was_just_put_in_place_closes_no_loop():
    path, motion, known, _ = two_runs()
    at = Pose2(*(path[-1] + [0.3, 0.8, 0.0]))
    assert loop_to(mapped(path, motion, known, len(path)), known.number, at, SURE, len(path) - 1) is None


def test_a_small_gap_behind_a_jump_that_no_drift_explains_is_no_loop():
    path, motion, known, _ = two_runs()
    at = Pose2(*(path[-1] + [0.3, 0.8, 0.0]))
    run = mapped(path, motion, known)
    assert loop_to(run, known.number, at, SURE, len(path) - 1) is None


@pytest.mark.parametrize(("closed", "is_loop"), [(0, True), (280, False), (299, False)])
def test_what_a_loop_has_bent_has_drifted_no_more(closed, is_loop):
    """Trees that still stand twice lie as far apart as the path had drifted; they close no loop again."""
    path = circle()
    place = np.array([[1.0, 3.0], [2.0, -3.0], [3.0, 2.0], [0.0, -4.0], [1.0, -2.0]])
    known = trees(place, [0] * 5, [10] * 5)
    run = replace(mapped(path, driven(path), known), closed=closed)
    at = Pose2(*(path[-1] + [3.0, -2.0, 0.05]))
    assert (loop_to(run, known.number, at, SURE, 299) is not None) == is_loop


@given(seeds)
def test_a_scan_is_tied_to_the_earliest_one_of_its_place(seed):
    random = np.random.default_rng(seed)
    path = circle(n=360, radius=9.0, laps=3.6)
    # Some were left early, and by them the loop is found; the others were seen all the time.
    place = random.uniform([-1.0, 8.0], [1.0, 10.0], (7, 2))
    known = trees(place, [0] * 7, [20] * 4 + [359] * 3)
    run = mapped(path, driven(path), known)
    at = Pose2(*(path[-1] + [0.6, 0.3, 0.0]))
    found = loop_to(run, known.number[:4], at, SURE, 359)
    assert found is not None
    assert len(found.ties) > 5
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    nodes = np.flatnonzero(np.diff(np.floor(way / 2.0), prepend=-1.0) > 0)
    for early, late in found.ties.tolist():
        near = np.hypot(*(path[nodes, :2] - path[late, :2]).T) <= TIE_NEAR
        assert early == nodes[near & (way[late] - way[nodes] > TIE_APART)].min()


@given(seeds)
def test_trees_seen_at_different_times_move_with_their_own_scans(seed):
    """The path went astray and led past the first trees again, as it seemed."""
    random = np.random.default_rng(seed)
    before = np.concatenate([line(60.0), line(60.0) + np.array([0.0, 1.0, 0.0])])
    after = before.copy()
    n = len(before) // 2
    after[n:, :2] += [30.0, -40.0]
    place = random.uniform([2.0, -3.0], [58.0, 4.0], (12, 2))
    scan = np.minimum(1 + (place[:, 0] / 0.4).astype(np.int64), n - 60)
    scan[6:] += n
    moved, turn = Bend(before, after, 0, len(before) - 1).of_trees(place, scan)
    np.testing.assert_allclose(moved[:6], place[:6], atol=1e-9)
    np.testing.assert_allclose(moved[6:], place[6:] + np.array([30.0, -40.0]), atol=1e-9)
    assert not turn.any()
    same, _ = Bend(before, after, len(before), len(before) - 1).of_trees(place, scan)
    assert same.tobytes() == place.tobytes()


# --- landmarks ------------------------------------------------------------------------------------


def test_landmarks_that_are_older_than_all_marks_are_of_the_first_scan():
    memory = FrameMemory().marked(7, 50, np.zeros(3), np.eye(3)).marked(9, 80, np.ones(3), np.eye(3))
    assert memory.scan_of(np.array([0, 6, 7, 8, 9, 30])).tolist() == [0, 0, 50, 50, 80, 80]
    assert FrameMemory().scan_of(np.array([0, 6])).tolist() == [0, 0]


@pytest.mark.parametrize(
    "angle", [0.5, np.pi / 2.0]
)  # a turn by -90 degrees gives the same covariance as by 90
def test_mean_and_covariance_of_a_landmark_turn_with_the_correction(angle):
    before = line()
    c, s = np.cos(angle), np.sin(angle)
    C = np.array([[c, -s], [s, c]])
    after = np.column_stack([before[:, :2] @ C.T, np.full(len(before), angle)])
    mean = np.array([[1.0, 1.0], [20.0, 1.0]])
    flat = np.array([[0.04, 0.01, 0.01]] * 2)
    known = MapColumns(mean, flat, np.full(2, 5, np.int32), np.full(2, 5.0, np.float32), np.arange(2))
    bent = bent_landmarks(known, np.array([0, 50]), Bend(before, after, 5, len(before) - 1))
    np.testing.assert_allclose(bent.mean, [mean[0], C @ mean[1]], atol=1e-9)
    turned = C @ np.array([[0.04, 0.01], [0.01, 0.01]]) @ C.T
    np.testing.assert_allclose(bent.covariance[1], turned[[0, 0, 1], [0, 1, 1]], atol=1e-12)
    assert bent.covariance[0].tobytes() == flat[0].tobytes()
