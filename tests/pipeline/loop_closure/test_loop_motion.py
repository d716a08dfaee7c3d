"""Motion and extent of a loop: jumps by earlier corrections are not motion, motion during lost scans is, and
a loop ends where the robot was last placed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.pose_arrays import PathCorrection, composed
from pipeline.geometry.poses import Pose2
from pipeline.loop_closure.detection import RunHistory, loop_to
from pipeline.slam.frame_uncertainty import FrameUncertainty
from pipeline.slam.keyframe_graph import Keyframe, KeyframeGraph, Solution, corrected_landmarks, without_jumps
from pipeline.slam.particle_maps import MapColumns
from pipeline.types.records import PoseEstimate, Trees
from tests.pipeline.loop_closure.test_detection import NOISE, SURE, circle, driven
from tests.pipeline.strategies import seeds


def line(metres=24.0, step=0.4):
    """Along x."""
    x = np.arange(0.0, metres, step)
    return np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])


def trees(place, first_ns, last_ns):
    """Seen first and last at these times."""
    n = len(place)
    ones, full = np.ones(n), np.full(n, 20)
    return Trees(
        np.arange(1, n + 1), place, np.tile(0.01 * np.eye(2), (n, 1, 1)), ones, ones, ones,
        full, ones, np.asarray(first_ns), np.asarray(last_ns), np.ones(n, np.bool_),
    )  # fmt: skip


def mapped(path, motion, known, placed=0):
    """A run of one scan a nanosecond."""
    n = np.zeros(0)
    estimate = PoseEstimate(Pose2(*path[-1]), SURE, path[-1:], np.ones(1), 1.0, n.reshape(0, 2))
    none = lambda _: (n.reshape(0, 2), n.reshape(0, 3))  # noqa: E731
    pose = Pose2(*path[-1])
    return RunHistory(np.arange(len(path)), path, known, none, pose, estimate, NOISE, motion, placed)


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
def test_a_loop_begins_where_the_robot_was_put_last(gap):
    path, motion, known, placed = two_runs()
    at = Pose2(*(path[-1] + gap))
    found = loop_to(mapped(path, motion, known, placed), known.number, at, SURE, len(path) - 1)
    assert found is not None
    assert found.first == placed


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
    moved, turn = PathCorrection(before, after).moved(place, scan)
    np.testing.assert_allclose(moved[:6], place[:6], atol=1e-9)
    np.testing.assert_allclose(moved[6:], place[6:] + np.array([30.0, -40.0]), atol=1e-9)
    assert not turn.any()


# --- landmarks ------------------------------------------------------------------------------------


def test_landmarks_that_are_older_than_all_marks_are_of_the_first_scan():
    memory = (
        FrameUncertainty()
        .with_reference(7, 50, np.zeros(3), np.eye(3))
        .with_reference(9, 80, np.ones(3), np.eye(3))
    )
    assert memory.scan_of(np.array([0, 6, 7, 8, 9, 30])).tolist() == [0, 0, 50, 50, 80, 80]
    assert FrameUncertainty().scan_of(np.array([0, 6])).tolist() == [0, 0]


@pytest.mark.parametrize(
    "angle", [0.5, np.pi / 2.0]
)  # a turn by -90 degrees gives the same covariance as by 90
def test_mean_and_covariance_of_a_landmark_turn_with_the_correction(angle):
    c, s = np.cos(angle), np.sin(angle)
    C = np.array([[c, -s], [s, c]])
    path = line()[[0, 10]]
    none = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
    frames = [Keyframe(k, 10 * k, 4.0 * k, path[k], np.eye(3), *none) for k in range(2)]
    graph = KeyframeGraph(tuple(frames), path)
    turned, zeros = np.column_stack([path[:, :2] @ C.T, np.full(2, angle)]), np.zeros((2, 3, 3))
    solution = Solution(turned, *none[:2], zeros, zeros, np.zeros((3, 3)))
    mean, flat = np.array([[1.0, 1.0], [20.0, 1.0]]), np.array([[0.04, 0.01, 0.01]] * 2)
    known = MapColumns(mean, flat, np.full(2, 5, np.int32), np.full(2, 5.0, np.float32), np.array([0, 15]))
    moved = corrected_landmarks(known, graph, solution, path)
    np.testing.assert_allclose(moved.mean, mean @ C.T, atol=1e-9)
    expected = C @ np.array([[0.04, 0.01], [0.01, 0.01]]) @ C.T
    np.testing.assert_allclose(moved.covariance, np.tile(expected[[0, 0, 1], [0, 1, 1]], (2, 1)), atol=1e-12)
