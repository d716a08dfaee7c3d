"""Consistency of reported covariances: shared errors of views, lost spread of particles, simulated runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.gaussian import spread_by_pose
from pipeline.geometry.poses import Pose2
from pipeline.slam.frame_uncertainty import FrameUncertainty, at_least, transported_covariance
from pipeline.tracking import Tracker
from pipeline.tracking.kalman import process_noise, split, transition, weight
from tests.benchmarks.cases.consistency import Errors, one_run
from tests.benchmarks.stands import STRAIGHT
from tests.pipeline.strategies import detections, seeds, track

POSE = np.diag([0.1, 0.1, 0.0]) ** 2
MANY = 1e12  # particles, of which no sampling noise is left


def spd(rng, n, scale=1.0):
    A = rng.normal(size=(n, n))
    return scale * (A @ A.T + 0.1 * np.eye(n))


# --- a tree ---------------------------------------------------------------------------------------


def joined(own, shared, R, B, x, z):
    """One update of a still tree: its place, whole covariance and shared part afterwards."""
    P = np.zeros((1, 4, 4))
    P[0, :2, :2] = own + shared
    part = shared[None].copy()
    P2 = split(P, part, np.zeros(1, np.int64), R[None], B[None], np.zeros(1), 0.0)[0]
    K = P[0, :2, :2] @ np.linalg.inv(P[0, :2, :2] + P2)
    return x + K @ (z - x), (np.eye(2) - K) @ P[0, :2, :2], part[0], K


@given(seeds, st.floats(-1.0, 1.0))
def test_the_fused_covariance_bounds_the_true_one_for_any_correlation(seed, r):
    rng = np.random.default_rng(seed)
    own, shared, R, B = spd(rng, 2), spd(rng, 2, 3.0), spd(rng, 2), spd(rng, 2, 3.0)
    _, result, part, K = joined(own, shared, R, B, np.zeros(2), np.zeros(2))
    cross = r * np.linalg.cholesky(shared) @ np.linalg.cholesky(B).T  # of the shared errors, as strong as r
    rest = np.eye(2) - K
    true = rest @ (own + shared) @ rest.T + K @ (R + B) @ K.T + rest @ cross @ K.T + K @ cross.T @ rest.T
    assert np.linalg.eigvalsh(result - true).min() > -1e-9
    own_after = rest @ own @ rest.T + K @ R @ K.T
    np.testing.assert_allclose(result, own_after + part, atol=1e-9)


@given(seeds)
def test_without_a_shared_part_it_is_the_kalman_filter(seed):
    rng = np.random.default_rng(seed)
    own, R, nothing = spd(rng, 2), spd(rng, 2), np.zeros((2, 2))
    x, z = rng.normal(size=2), rng.normal(size=2)
    place, result, part, _ = joined(own, nothing, R, nothing, x, z)
    A, B = np.linalg.inv(own), np.linalg.inv(R)
    np.testing.assert_allclose(result, np.linalg.inv(A + B), atol=1e-9)
    np.testing.assert_allclose(place, np.linalg.solve(A + B, A @ x + B @ z), atol=1e-9)
    np.testing.assert_array_equal(part, 0.0)


@given(seeds, st.floats(0.0, 5.0), st.floats(0.0, 1.0))
def test_a_moving_tree_is_split_at_the_time_of_its_measurement(seed, dt, acceleration):
    """The weight and the shared part follow from the covariance that F P F^T + Q predicts."""
    rng = np.random.default_rng(seed)
    shared, R, B = spd(rng, 2), spd(rng, 2), spd(rng, 2)
    P = spd(rng, 4)
    P[:2, :2] += shared
    states, part = P[None].copy(), shared[None].copy()
    P2 = split(states, part, np.zeros(1, np.int64), R[None], B[None], np.array([dt]), acceleration)[0]
    F, Q = transition(dt), process_noise(dt, acceleration)
    own = (F @ P @ F.T + Q)[:2, :2] - shared
    w = weight(*(0.5 * np.trace(C) for C in (own, shared, R, B)))
    np.testing.assert_allclose(P2, R + B / (1.0 - w), rtol=1e-9)
    P1 = (F @ states[0] @ F.T + Q)[:2, :2]
    np.testing.assert_allclose(P1, own + shared / w, rtol=1e-9)
    K = P1 @ np.linalg.inv(P1 + P2)
    rest = np.eye(2) - K
    after = rest @ shared @ rest.T / w + K @ B @ K.T / (1.0 - w)
    np.testing.assert_allclose(part[0], after, rtol=1e-6, atol=1e-9)


@given(*[st.floats(1e-4, 1.0)] * 4)
def test_the_weight_minimises_the_variance(own, shared, R, B):
    def variance(w):
        return 1.0 / (1.0 / (own + shared / w) + 1.0 / (R + B / (1.0 - w)))

    best = min(variance(w) for w in np.linspace(0.001, 0.999, 999))
    assert variance(weight(own, shared, R, B)) <= best * (1.0 + 1e-9)


def test_views_from_one_uncertain_pose_average_out_only_their_own_noise():
    t = Tracker(preset("forest").tracking)
    for k in range(400):
        track(t, k, Pose2(), POSE, detections([[5.0, 0.0]], sigma=0.05))
    P = t.tracks.P[0, :2, :2]
    np.testing.assert_allclose(P, np.eye(2) * (0.1**2 + 0.05**2 / 400), rtol=1e-6, atol=1e-9)


def test_a_view_from_a_certain_pose_outweighs_uncertain_ones():
    t = Tracker(preset("forest").tracking)
    for k in range(50):
        track(t, k, Pose2(0.1, 0.0, 0.0), POSE, detections([[5.0, 0.0]], sigma=0.02))
    sure = POSE / 100.0
    for k in range(50, 60):
        track(t, k, Pose2(), sure, detections([[5.0, 0.0]], sigma=0.02))
    assert abs(t.tracks.x[0, 0] - 5.0) < 0.02
    assert np.sqrt(t.tracks.P[0, 0, 0]) < 0.03


# --- a pose ---------------------------------------------------------------------------------------


@given(seeds)
def test_the_result_of_at_least_bounds_both_covariances(seed):
    rng = np.random.default_rng(seed)
    A, B = spd(rng, 3), spd(rng, 3)
    both = at_least(A, B)
    assert np.linalg.eigvalsh(both - A).min() > -1e-7
    assert np.linalg.eigvalsh(both - B).min() > -1e-7
    np.testing.assert_allclose(at_least(A, 0.5 * A), A, atol=1e-7)
    np.testing.assert_allclose(at_least(A, 2.0 * A), 2.0 * A, atol=1e-7)


def test_a_transported_heading_error_displaces_distant_poses():
    C = transported_covariance(np.diag([0.0, 0.0, 0.01**2]), 20.0, 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(C)), [0.0, 0.2, 0.01])


def test_the_covariance_at_known_landmarks_is_that_of_their_reference_pose():
    wide, thin = np.eye(3) * 0.04, np.eye(3) * 1e-4
    here = np.zeros(3)
    memory = FrameUncertainty().with_reference(0, 0, here, wide)
    landmarks = (np.array([[2.0, 0.0]]), np.array([3]), np.array([5], np.int32), 3)
    result, memory = memory.with_pose(here, thin, MANY, *landmarks, 10.0)
    np.testing.assert_allclose(result, wide, atol=1e-9)
    away = np.array([5.0, 0.0, 0.0])
    result, _ = memory.with_pose(
        away, thin, MANY, *landmarks, 1.0
    )  # no landmark near: what was hidden stays hidden
    np.testing.assert_allclose(result, thin + transported_covariance(wide - thin, 5.0, 0.0), atol=1e-9)
    older = (np.array([[2.0, 0.0]]), np.array([-1]), np.array([5], np.int32), 3)
    result, _ = FrameUncertainty().with_pose(here, thin, MANY, *older, 10.0)
    np.testing.assert_allclose(result, thin)


def test_the_error_of_a_smoothed_map_is_added_to_the_spread():
    """All particles share the map of a solution, so that their spread does not show its error."""
    thin, of_map, here = np.eye(3) * 1e-4, np.diag([4e-4, 4e-4, 1e-6]), np.zeros(3)
    memory = FrameUncertainty().with_reference(0, 0, here, np.eye(3))
    memory = replace(memory, covariance=of_map[None], smoothed=np.ones(1, np.bool_))
    landmarks = (np.array([[2.0, 0.0]]), np.array([3]), np.array([5], np.int32), 3)
    for n_eff in (20.0, MANY):
        result, _ = memory.with_pose(np.array([5.0, 0.0, 0.0]), thin, n_eff, *landmarks, 10.0)
        np.testing.assert_allclose(result, thin + transported_covariance(of_map, 5.0, 0.0), atol=1e-12)


@given(seeds)
def test_the_error_of_the_map_at_a_landmark_is_that_of_its_reference_pose(seed):
    rng = np.random.default_rng(seed)
    poses, covariances, position = (
        rng.normal(size=(3, 3)),
        [spd(rng, 3) for _ in range(3)],
        rng.normal(size=(5, 2)),
    )
    memory = replace(
        FrameUncertainty(), serial=np.array([10, 20, 30]), pose=poses, covariance=np.array(covariances)
    )
    birth, of = np.array([5, 10, 19, 20, 99]), [0, 0, 0, 1, 2]
    found = memory.at_landmarks(birth, position)
    for landmark, m in enumerate(of):
        wanted = spread_by_pose(position[landmark, None], poses[m], covariances[m])[0]
        np.testing.assert_allclose(found[landmark], wanted, atol=1e-9)
    assert not FrameUncertainty().at_landmarks(birth, position).any()


@given(seeds, st.floats(1e-3, 1e3))
def test_of_landmarks_and_measured_poses_the_better_position_counts_whatever_the_heading(seed, turn):
    rng = np.random.default_rng(seed)
    spread, least, by_landmarks = spd(rng, 3), spd(rng, 3), spd(rng, 3)
    by_landmarks[2] *= turn
    by_landmarks[:, 2] *= turn
    state = FrameUncertainty()
    measured, _ = state.with_measured_pose(spread, MANY, least, None)
    np.testing.assert_allclose(measured, at_least(spread, least, 4.0 / np.sqrt(MANY)))
    better = by_landmarks[0, 0] + by_landmarks[1, 1] < measured[0, 0] + measured[1, 1]
    both, after = state.with_measured_pose(spread, MANY, least, by_landmarks)
    np.testing.assert_array_equal(both, by_landmarks if better else measured)
    np.testing.assert_allclose(after.hidden, both - spread)


@given(seeds, st.sampled_from([1.0, 30.0, 1000.0]))
def test_an_excess_below_the_sampling_noise_is_ignored_and_a_large_one_is_kept(seed, n_eff):
    rng = np.random.default_rng(seed)
    A, noise = spd(rng, 3), 4.0 / np.sqrt(n_eff)
    np.testing.assert_allclose(at_least(A, A * (1.0 + 0.9 * noise), noise), A, rtol=1e-6, atol=1e-9)
    much = 1.0 + 100.0 * noise
    both = at_least(A, A * much, noise)
    np.testing.assert_allclose(both, A * much, rtol=1e-3, atol=1e-6)
    assert np.linalg.eigvalsh(both - at_least(A, A * (1.0 + 50.0 * noise), noise)).min() > 0.0


def test_repeated_bounds_by_noisy_covariances_do_not_grow():
    """A hundred bounds of one covariance, each estimated from particles."""
    rng, n = np.random.default_rng(0), 80
    kept = np.eye(3)
    for _ in range(100):
        drawn = rng.normal(size=(n, 3))
        kept = at_least(drawn.T @ drawn / n, kept, 4.0 / np.sqrt(n))
    assert np.trace(kept) / 3.0 < 1.25


def test_a_degenerate_spread_of_kilometres_is_accepted():
    rng = np.random.default_rng(0)
    for _ in range(50):
        away = rng.normal(size=3) * [1e3, 1e3, 1.0]
        line = np.outer(away, away)
        both = at_least(line, np.eye(3) * 0.01)
        assert np.all(np.isfinite(both))
        assert np.linalg.eigvalsh(both - line).min() > -1e-6


def test_a_standing_robot_at_the_seam_of_angles_adds_no_reference_poses():
    memory = FrameUncertainty()
    for k in range(10):
        yaw = (np.pi - 0.001) * (-1.0) ** k
        memory = memory.with_reference(k, k, np.array([0.0, 0.0, yaw]), np.eye(3))
    assert len(memory.serial) == 1


def test_reference_poses_have_a_minimum_distance():
    memory = FrameUncertainty()
    for k in range(100):
        memory = memory.with_reference(k, k, np.array([0.1 * k, 0.0, 0.0]), np.eye(3))
    assert 15 <= len(memory.serial) <= 20
    assert np.all(np.diff(memory.pose[:, 0]) > 0.49)


# --- the outcome ----------------------------------------------------------------------------------


def test_normalised_errors_of_simulated_runs_are_consistent():
    errors = Errors()
    for seed in range(100, 108):
        one_run(seed, 60, errors)
    # Eight runs: three sigma of the means of chi-square, a run's views and trees not being independent.
    assert 1.0 < np.mean(errors.pose) < 5.6
    assert 0.4 < np.mean(errors.trees) < 4.2
    assert 0.7 < np.mean(errors.innovations) < 1.3


@pytest.mark.slow
def test_a_straight_drive_past_few_trees_stays_consistent_without_loops():
    errors = Errors()
    for seed in range(200, 205):
        one_run(seed, 60, errors, STRAIGHT)
    assert errors.astray == 0
    assert 0.8 < np.mean(errors.pose) < 6.0
