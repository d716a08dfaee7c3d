"""Rigid-shift test and slip detection: recovered in closed form, and no detection without a motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.free_space import BINS
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.slam.motion import Noise, OdometryTrust
from pipeline.slam.rigid_shift_test import AGREE, FEWEST, MANY, SEVERAL, estimate_rigid_shift
from pipeline.slam.slip_detection import (
    FITTED,
    MISREGISTERED,
    OWN,
    SLIPPED,
    STUCK,
    UNSURE,
    motion_by_trees,
    slip_message,
)
from tests.pipeline.strategies import seeds

SIGMA = 0.03
SURE = Noise(0.03, np.radians(0.4), np.radians(2.0))


def scene(seed, trees=14):
    """Return landmarks around the origin with a distance of two metres or more, and the random generator."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < trees:
        place = rng.uniform(-9.0, 9.0, 2)
        if all(np.hypot(*(place - other)) > 2.0 for other in places):
            places.append(place)
    return np.array(places), rng


def clear_of(seen):
    """Return the free distance by azimuth of a scan that shows only points, shape (N, 2) [m]."""
    free = np.full(BINS, np.inf)
    for x, y in seen:
        k = direction_bin(x, y, BINS)
        for bin_ in (k - 1, k, k + 1):
            free[bin_ % BINS] = min(free[bin_ % BINS], np.hypot(x, y))
    return free


def shift_test(
    known, seen, *, pose=(0.0, 0.0, 0.0), position=0.0, heading=0.0, distrust=0.0, familiar=1.0, well=None
):
    """Return the results of `estimate_rigid_shift` but the second, with circular covariances: whether the
    shift is significant, the pose, and its covariance."""
    rows = np.array([SIGMA**2, 0.0, SIGMA**2])
    R, spread = np.tile(rows, (len(seen), 1)), np.tile(rows, (len(known), 1))
    well = np.ones(len(known), np.bool_) if well is None else well
    wheels = OdometryTrust(SURE, distrust, 0.0, familiar)
    moved, unsure, place, C = estimate_rigid_shift(
        np.array(pose), position, heading, wheels, seen, R, known, spread, well, clear_of(seen)
    )
    assert not (moved and unsure)
    return moved, place, C


@given(seeds, st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.02, 0.02), st.floats(-3.0, 3.0))
def test_a_rigid_motion_is_recovered(seed, x, y, turn, yaw):
    known, _ = scene(seed)
    before = Pose2(2.0, -1.0, yaw)
    true = Pose2(before.x + x, before.y + y, yaw + turn)
    known = before.apply(known)
    moved, place, C = shift_test(known, true.inverse().apply(known), pose=before.as_array())
    way = np.sqrt(x * x + y * y + (5.0 * turn) ** 2)
    assert moved or way < 0.1
    assert not moved or way > 0.04
    if not moved:
        return
    away = place - true.as_array()
    assert np.hypot(away[0], away[1]) < 0.01, "to the square of the turn"
    assert abs(wrap_angle(away[2])) < 1e-3
    assert np.all(np.linalg.eigvalsh(C) > 0.0)


@given(seeds)
def test_noise_is_no_motion(seed):
    known, rng = scene(seed)
    assert not shift_test(known, known + rng.normal(0.0, SIGMA, known.shape))[0]


@given(seeds, st.integers(1, 3))
def test_outliers_are_removed(seed, others):
    known, rng = scene(seed)
    true = Pose2(0.2, 0.1, 0.01)
    seen = true.inverse().apply(known) + rng.normal(0.0, 0.3 * SIGMA, known.shape)
    seen[:others] += np.array([0.3, -0.5])
    moved, place, _ = shift_test(known, seen)
    assert moved
    np.testing.assert_allclose(place, true.as_array(), atol=0.05)


def test_the_covariance_is_consistent():
    """Normalised error squared of 300 fits: three degrees of freedom."""
    true, squares = Pose2(0.25, -0.1, 0.015), []
    for seed in range(300):
        known, rng = scene(seed)
        noise = rng.normal(0.0, SIGMA * np.sqrt(2.0), known.shape)
        moved, place, C = shift_test(known, true.inverse().apply(known) + noise)
        if moved:
            error = place - true.as_array()
            squares.append(error @ np.linalg.solve(C, error))
    assert len(squares) > 295, "a distant tree may agree with the odometry by chance"
    assert 2.0 < np.mean(squares) < 3.5


@pytest.mark.parametrize("pairs", range(FEWEST))
def test_too_few_pairs_give_no_motion(pairs):
    known, _ = scene(3)
    assert not shift_test(known[:pairs], known[:pairs] - [0.3, 0.0])[0]


def test_a_motion_within_the_odometry_noise_is_not_significant():
    known, _ = scene(4)
    seen = known - [0.3, 0.0]
    assert shift_test(known, seen)[0]
    assert not shift_test(known, seen, position=0.3**2)[0]


def test_distrust_lowers_the_limit():
    known, _ = scene(5)
    seen = known - [0.048, 0.0]
    assert not shift_test(known, seen)[0]
    assert shift_test(known, seen, distrust=1.0)[0]


def test_opposite_motions_are_rejected():
    known, _ = scene(6)
    seen = known.copy()
    seen[::2, 0] += 0.35
    seen[1::2, 0] -= 0.35
    assert not shift_test(known, seen)[0]


@pytest.mark.parametrize(("well", "familiar"), [(MANY - 1, 0.2), (FEWEST - 1, 1.0)])
def test_new_landmarks_need_more_pairs(well, familiar):
    """People who walk side by side are new landmarks."""
    known, _ = scene(12, trees=MANY)
    first = np.arange(MANY) < well
    assert not shift_test(known[1:], known[1:] - [0.3, 0.0], familiar=familiar, well=first[1:])[0]
    assert shift_test(known, known - [0.3, 0.0], familiar=familiar, well=first)[0]
    assert shift_test(known[1:], known[1:] - [0.3, 0.0])[0]


@pytest.mark.parametrize("pairs", range(FEWEST, SEVERAL))
def test_few_known_landmarks_count_only_after_a_fault_of_the_odometry(pairs):
    """Otherwise they may be people who stood for long and walk off: a message is given, and nothing moves."""
    known, _ = scene(16, trees=pairs)
    seen = known - [0.3, 0.0]
    assert not shift_test(known, seen)[0]
    assert shift_test(known, seen, distrust=0.5)[0]
    known, seen = known[:FEWEST], seen[:FEWEST]
    result = tree_motion([0.0, 0.0, 0.0], known, seen)
    assert not result.slipped
    assert result.unsure
    np.testing.assert_array_equal(result.motion, 0.0)
    assert slip_message(result.motion, result.slipped, result.unsure) == UNSURE
    again = tree_motion([0.0, 0.0, 0.0], known, seen, distrust=0.5)
    assert again.slipped
    assert not again.unsure


@pytest.mark.parametrize("moving", [SEVERAL, MANY, 15])
def test_one_pair_that_agrees_with_the_odometry_refutes_the_motion(moving):
    known, _ = scene(13, trees=moving + 1)
    seen = known - [0.3, 0.0]
    assert shift_test(known[1:], seen[1:])[0]
    seen[0] = known[0]
    assert not shift_test(known, seen)[0]


def test_a_tree_within_the_gate_of_slow_people_refutes_their_motion():
    known, _ = scene(17, trees=SEVERAL + 1)
    seen = known - [0.09, 0.0]
    assert shift_test(known, seen)[0]
    seen[0] = known[0]
    assert AGREE * SIGMA * np.sqrt(2.0) > 0.09
    assert not shift_test(known, seen)[0]


def test_unmatched_detections_count_against_the_motion_if_landmarks_are_expected():
    known, rng = scene(14, trees=SEVERAL + 8)
    seen = known - [0.3, 0.0]
    others = seen[:SEVERAL] + rng.uniform(0.9, 1.1, (SEVERAL, 2))
    assert shift_test(known[:SEVERAL], np.concatenate([seen[:SEVERAL], others]))[0], "no more are known"
    assert not shift_test(known, np.concatenate([seen[:FEWEST], others[:5]]))[0]


def tree_motion(
    motion, known, seen, *, before=(0.0, 0.0, 0.0), covariance=1e-4, alone=0.0, driven=0.0, distrust=0.0
):
    """Return `motion_by_trees` for a robot at `before`, with `known` in its frame; all landmarks have ten
    hits."""
    rows = np.array([SIGMA**2, 0.0, SIGMA**2])
    return motion_by_trees(
        np.array(before), np.array(motion), covariance * np.eye(3), driven,
        OdometryTrust(SURE, distrust, alone, 1.0), seen,
        np.tile(rows, (len(seen), 1)), Pose2(*before).apply(known), np.tile(rows, (len(known), 1)),
        np.full(len(known), 10, np.int32), 3, 3.5, clear_of(seen),
    )  # fmt: skip


@pytest.mark.parametrize("before", [(0.0, 0.0, 0.0), (4.0, -7.0, 2.0)])
@pytest.mark.parametrize("true", [Pose2(0.1), Pose2(0.3, 0.0, 0.02), Pose2(3.0, 2.0, 0.1), Pose2(-6.0, 1.0)])
def test_the_motion_of_stuck_wheels_is_recovered_at_any_distance(true, before):
    known, _ = scene(7)
    result = tree_motion([0.0, 0.0, 0.0], known, true.inverse().apply(known), before=before)
    assert result.slipped
    np.testing.assert_allclose(result.motion, true.as_array(), atol=0.15)
    assert slip_message(np.zeros(3), result.slipped, False) == STUCK
    assert slip_message(np.array([0.1, 0.0, 0.0]), result.slipped, False) == SLIPPED
    assert slip_message(np.zeros(3), False, False) == ""
    assert slip_message(np.zeros(3), result.slipped, False, registered=True) == MISREGISTERED


@pytest.mark.parametrize("bearing", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_the_covariance_of_a_motion_by_trees_is_that_of_least_squares(bearing):
    """Trees on one side, as by their bearing: their distance makes the position across it uncertain."""
    rows = np.stack(np.meshgrid([8.0, 11.0, 14.0, 17.0], [-3.0, 0.0, 3.0]), axis=-1).reshape(-1, 2)
    seen = Pose2(0.0, 0.0, bearing).apply(rows)
    result = tree_motion([0.0, 0.0, 0.0], Pose2(0.2, 0.3).apply(seen), seen)
    J = np.zeros((len(seen), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -seen[:, 1], seen[:, 0]
    C = np.linalg.inv(np.einsum("nij,nik->jk", J, J) / (2.0 * SIGMA**2))
    position, heading = max(C[0, 0], C[1, 1]), C[2, 2]
    assert result.slipped
    np.testing.assert_allclose(
        result.covariance, np.diag(FITTED**2 + OWN**2 * np.array([position, position, heading])), rtol=1e-6
    )


@pytest.mark.parametrize("turn", [0.1, -0.1])
@pytest.mark.parametrize("yaw", [np.pi - 0.05, -np.pi + 0.05, np.pi / 2])
def test_a_motion_by_trees_does_not_depend_on_the_frame_of_the_map(yaw, turn):
    known, _ = scene(7)
    seen = Pose2(0.3, 0.1, turn + 0.02).inverse().apply(known)
    here = tree_motion([0.0, 0.0, turn], known, seen)
    there = tree_motion([0.0, 0.0, turn], known, seen, before=(4.0, -7.0, yaw))
    assert here.slipped
    assert there.slipped
    np.testing.assert_allclose(there.motion, here.motion, atol=1e-9)


def test_matching_trees_reduce_the_covariance_of_a_doubtful_motion():
    """The robot may have moved by metres during a gap; matching trees show that it has not."""
    known, _ = scene(8)
    result = tree_motion([0.1, 0.0, 0.0], known, Pose2(0.1).inverse().apply(known), covariance=4.0)
    assert not result.slipped
    assert result.covariance[0, 0] < 0.2**2


def test_distance_without_trees_raises_the_limit():
    known, _ = scene(9)
    seen = Pose2(0.35).inverse().apply(known)
    assert tree_motion([0.0, 0.0, 0.0], known, seen).slipped
    assert not tree_motion([0.0, 0.0, 0.0], known, seen, alone=20.0).slipped
    assert not tree_motion([0.0, 0.0, 0.0], known, seen, driven=20.0).slipped, "there and back"


def test_another_place_gives_no_motion():
    known, _ = scene(10, trees=30)
    elsewhere, _ = scene(11)
    result = tree_motion([0.0, 0.0, 0.0], known, elsewhere)
    assert not result.slipped
    np.testing.assert_array_equal(result.motion, 0.0)


def test_a_large_motion_of_some_detections_is_rejected():
    known, _ = scene(15, trees=12)
    seen = known - [3.0, 1.0]
    assert tree_motion([0.0, 0.0, 0.0], known, seen).slipped
    seen[:3] = known[:3]
    assert not tree_motion([0.0, 0.0, 0.0], known, seen).slipped


@pytest.mark.parametrize("turn", [1.2, 3.0, 5.0])
def test_a_turn_is_recovered_from_distant_trees(turn):
    """Trees beyond 0.8 m / turn are farther from their detections than a pair may be."""
    rng = np.random.default_rng(3)
    angle, distance = rng.uniform(-np.pi, np.pi, 40), rng.uniform(4.0, 30.0, 40)
    known = np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])
    true = Pose2(0.1, 0.0, np.radians(turn))
    seen = true.inverse().apply(known) + rng.normal(0.0, 0.01, known.shape)
    result = tree_motion([0.0, 0.0, 0.0], known, seen, distrust=0.9)
    assert result.slipped
    np.testing.assert_allclose(result.motion, true.as_array(), atol=0.02)


def test_hidden_landmarks_are_not_expected():
    known, _ = scene(14, trees=SEVERAL + 8)
    seen = (known - [0.3, 0.0])[:SEVERAL]
    behind = 2.0 * known[:SEVERAL]
    assert shift_test(np.concatenate([known[:SEVERAL], behind]), seen)[0]
