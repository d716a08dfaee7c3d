"""Shared errors of measured poses: estimated, reported consistently, and not averaged out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from pipeline.config import preset
from pipeline.geometry.pose_arrays import composed
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.slam import FastSlam, Motion
from pipeline.slam.measured_pose import MeasuredPose, SharedErrors, correct_by_measured, update_shared_errors
from pipeline.slam.motion import inverted, noise_of, step_variances
from pipeline.slam.state import SlamState
from pipeline.types.records import SHARED, SOURCES, PoseMeasurement
from tests.benchmarks.stands import RING
from tests.pipeline.strategies import NOTHING_SEEN, detections, seeds

FOREST = preset("forest").slam.model_copy(update={"update_distance": 0.0})
STEPS, STRIDE = 160, 0.5
AWAY = (Pose2(STRIDE, 0.0, np.pi / 4 / STEPS),) * STEPS  # an eighth of a circle
OWN = np.array([0.1, 0.1, 0.02])  # m, m, rad: what a pose errs by alone
SHIFT, TURN, HEADING = 0.3, 0.02, 0.02  # m, rad, rad: what all of a source err by
SEEN = 9.0


def shared_at(x, y):
    """Return `PoseMeasurement.shared` at a position, for a frame that was aligned around the origin."""
    return np.array([[SHIFT, 0.0, -y * TURN, 0.0], [0.0, SHIFT, x * TURN, 0.0], [0.0, 0.0, 0.0, HEADING]])


def spd(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def drive(seed, strides, trees=None, *, poses=True, heading=True, bias=0.0, blind=()):
    """Return the normalised error squared, the error [m] and the sigma [m] of each scan, shape (N, 3); and
    the filter.

    Args:
        seed: Seed of all errors.
        strides: True motion to each scan but the first.
        trees: Positions of trees, shape (N, 2); None for none.
        poses: Whether another source measures the pose.
        heading: Whether it also measures the heading, unlike GNSS.
        bias: Error of the odometry heading [rad/m].
        blind: Numbers of the scans without detections.
    """
    rng = np.random.default_rng([11, seed])
    slam, truth, rows = FastSlam(FOREST, seed), Pose2(), []
    e, own = rng.standard_normal(SHARED), OWN if heading else np.array([*OWN[:2], 100.0])
    for k, stride in enumerate((None, *strides)):
        told, measured = Pose2(), None
        if stride is not None:
            truth = truth @ stride
            along, turn = step_variances(stride.x, stride.y, stride.yaw, noise_of(FOREST))
            told = Pose2(*(stride.as_array() + np.sqrt([along, along, turn]) * rng.standard_normal(3)))
            told = Pose2(told.x, told.y, told.yaw + bias * stride.x)
        if poses and k > 10:
            H = shared_at(truth.x, truth.y)
            if not heading:
                H[2] = 0.0
            z = truth.as_array() + H @ e + own * rng.standard_normal(3)
            measured = PoseMeasurement(k, Pose2(*z), np.diag(own**2) + H @ H.T, shared=H)
        found = np.zeros((0, 2)) if trees is None else truth.inverse().apply(trees)
        found = found[np.hypot(*found.T) < SEEN]
        found = found + rng.normal(0.0, 0.05, found.shape)
        found = found[:0] if k in blind else found
        at = slam.process(k, Motion(told, measured=measured), detections(found, sigma=0.05), NOTHING_SEEN)
        error = at.T_map_base.as_array() - truth.as_array()
        error[2] = wrap_angle(error[2])
        if k:
            nees = float(error @ np.linalg.solve(at.covariance, error))
            sigma = float(np.sqrt(np.trace(at.covariance[:2, :2])))
            rows.append((nees, float(np.hypot(*error[:2])), sigma))
    return np.array(rows), slam


@pytest.mark.slow
def test_repeated_poses_of_one_source_are_consistent():
    """Sixteen runs: three sigma of the mean of chi-square; with independent errors the value was 45."""
    nees = np.mean([drive(seed, AWAY)[0][STEPS // 2 :, 0] for seed in range(16)], axis=0)
    assert 1.3 < np.mean(nees) < 4.9


@pytest.mark.slow
def test_the_drift_is_bounded_by_the_error_of_the_source():
    alone = np.mean([drive(seed, AWAY, poses=False)[0][-1, 1] for seed in range(8)])
    with_it, told = np.mean([drive(seed, AWAY)[0][-1, 1:] for seed in range(8)], axis=0)
    assert with_it < 0.5 * alone
    assert told < 2.0


@pytest.mark.slow
def test_poses_do_not_degrade_a_pose_among_better_known_trees():
    """With independent errors the value was 7.5, and the error 0.14 m instead of 0.10 m."""
    rows = []
    for seed in range(6):
        trees = RING.trees(np.random.default_rng([7, seed]))
        rows.append(drive(seed, RING.strides, trees)[0][20:])
    nees, error, _ = np.moveaxis(np.array(rows), 2, 0)
    assert nees.mean() < 6.0
    assert np.sqrt(np.square(error).mean()) < 0.12


@pytest.mark.slow
def test_a_long_drift_of_the_heading_stays_consistent():
    """600 m on a circle: when the covariance followed only the odometry, it turned away from the path, and
    the value was 26 instead of 3.5."""
    ring = (Pose2(1.0, 0.0, 1.0 / 60.0),) * 600
    nees = [drive(seed, ring, heading=False, bias=np.radians(0.05))[0][450:, 0].mean() for seed in range(4)]
    assert np.mean(nees) < 6.0


def test_a_scan_without_trees_keeps_the_covariance_by_trees():
    """Before, the sigma rose to that of the other source and fell again one scan later."""
    along = np.stack(np.meshgrid(np.arange(-8.0, 40.0, 4.0), [-5.0, -2.0, 2.0, 5.0]), axis=-1)
    rows, _ = drive(0, (Pose2(0.25),) * 60, along.reshape(-1, 2) + 0.3, blind=(40, 50))
    sigma = dict(enumerate(rows[:, 2], start=1))
    for k in (40, 50):
        assert sigma[k] < 1.3 * max(sigma[k - 1], sigma[k + 1])


@given(seeds)
def test_the_update_of_a_particle_equals_the_joint_gaussian(seed):
    rng = np.random.default_rng(seed)
    P, E, own, H = spd(rng, 3), spd(rng, SHARED), spd(rng, 3), rng.normal(size=(3, SHARED))
    mu, e, z = rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.3, SHARED), rng.normal(0.0, 0.3, 3)
    joint = np.zeros((3 + SHARED, 3 + SHARED))
    joint[:3, :3], joint[3:, 3:] = P, E
    G = np.concatenate([np.eye(3), H], axis=1)
    S = G @ joint @ G.T + own
    K = joint @ G.T @ np.linalg.inv(S)
    y = z - mu - H @ e
    mean, after = np.concatenate([mu, e]) + K @ y, joint - K @ S @ K.T
    measured = MeasuredPose(z, own, H, e[None].copy(), E[None].copy())
    told_mu, told_P = mu.copy(), P.copy()
    likelihood = correct_by_measured(told_mu, told_P, measured, 0)
    np.testing.assert_allclose(told_mu, mean[:3], atol=1e-9)
    np.testing.assert_allclose(told_P, after[:3, :3], atol=1e-8)
    assert likelihood == pytest.approx(-0.5 * y @ np.linalg.solve(S, y) - 0.5 * np.log(np.linalg.det(S)))
    x = told_mu + rng.normal(0.0, 0.1, 3)  # the pose that is drawn
    update_shared_errors(x[None], measured, 0)
    gain = after[3:, :3] @ np.linalg.inv(after[:3, :3])
    np.testing.assert_allclose(measured.mean[0], mean[3:] + gain @ (x - mean[:3]), atol=1e-6)
    np.testing.assert_allclose(measured.covariance[0], after[3:, 3:] - gain @ after[:3, 3:], atol=1e-6)


@given(seeds)
def test_a_motion_moves_the_joint_covariance_by_the_jacobians_of_the_composition(seed):
    rng = np.random.default_rng(seed)
    at, step, Q = rng.uniform(-1.0, 1.0, 3), rng.uniform(-1.0, 1.0, 3), spd(rng, 3)
    joint, by_trees = spd(rng, 3 + SOURCES * SHARED), spd(rng, 3)
    begun = replace(SharedErrors.begun_at(2, at, np.eye(3)), joint=joint, by_trees=by_trees)
    moved = begun.moved(step, Q)
    wanted = composed(at[None], step[None])[0]
    h = 1e-6 * np.eye(3)
    F = np.stack([composed((at + d)[None], step[None])[0] - wanted for d in h], axis=1) / 1e-6
    G = np.stack([composed(at[None], (step + d)[None])[0] - wanted for d in h], axis=1) / 1e-6
    J = np.eye(len(joint))
    J[:3, :3] = F
    after = J @ joint @ J.T
    after[:3, :3] += G @ Q @ G.T
    np.testing.assert_allclose(moved.at, wanted, atol=1e-12)
    np.testing.assert_allclose(moved.joint, after, atol=1e-3)
    np.testing.assert_allclose(moved.by_trees, F @ by_trees @ F.T + G @ Q @ G.T, atol=1e-3)


@given(seeds)
def test_an_inverse_by_cofactors_is_the_inverse(seed):
    S = spd(np.random.default_rng(seed), 3)
    inverse, det = inverted(S)
    np.testing.assert_allclose(inverse @ S, np.eye(3), atol=1e-9)
    assert det == pytest.approx(np.linalg.det(S))


def test_poses_of_one_source_do_not_reduce_its_shared_error():
    shared = SharedErrors.begun_at(2, np.zeros(3), np.diag([1e4, 1e4, 1.0]))
    H = shared_at(0.0, 0.0)
    for k in range(1000):
        shared = shared.measured(PoseMeasurement(k, Pose2(), np.diag(OWN**2) + H @ H.T, shared=H))
    np.testing.assert_allclose(np.sqrt(np.diag(shared.joint)[:3]), [SHIFT, SHIFT, HEADING], rtol=0.02)
    other = PoseMeasurement(0, Pose2(), np.diag(OWN**2) + H @ H.T, shared=H, source=1)
    by_both = shared.measured(other)
    assert by_both.joint[0, 0] < 0.6 * shared.joint[0, 0], "another source errs by something else"


def test_the_estimated_shared_error_is_subtracted_for_the_gate():
    H = shared_at(0.0, 0.0)
    z = PoseMeasurement(0, Pose2(1.0, 0.0, 0.0), np.diag(OWN**2) + H @ H.T, shared=H)
    begun = SharedErrors.begun_at(2, np.zeros(3), np.eye(3))
    weights = np.array([0.5, 0.5])
    same = begun.without_shared_error(z, weights)
    np.testing.assert_allclose(same.covariance, z.covariance, atol=1e-12)
    begun.mean[0, :, 0], begun.covariance[0, :, 0, 0] = 2.0, 0.01
    seen = begun.without_shared_error(z, weights)
    assert seen.T_map_base.x == pytest.approx(1.0 - 2.0 * SHIFT)
    assert seen.covariance[0, 0] == pytest.approx(OWN[0] ** 2 + 0.01 * SHIFT**2)
    assert seen.shared is None
    np.testing.assert_array_equal(seen.own, seen.covariance)


def test_resampled_particles_keep_independent_copies_of_their_errors():
    rng = np.random.default_rng(0)
    begun = SharedErrors.begun_at(5, np.zeros(3), np.eye(3))
    begun.mean[:] = rng.normal(size=begun.mean.shape)
    rows = np.array([3, 3, 0])
    drawn = begun.drawn(rows)
    np.testing.assert_array_equal(drawn.mean, begun.mean[:, rows])
    drawn.mean[0, 0] = 9.0
    assert not np.any(begun.mean == 9.0)
    assert drawn.mean.shape == (SOURCES, 3, SHARED)
    assert drawn.mean[1].flags.c_contiguous
    assert drawn.covariance[1].flags.c_contiguous


def test_a_copied_state_continues_identically_and_placing_resets_the_errors():
    _, slam = drive(4, AWAY)
    state = slam.state.copy()
    again = FastSlam(slam.parameters, 4)
    again.state = state
    H = shared_at(1.0, 2.0)
    z = PoseMeasurement(0, Pose2(*slam.state.pose[0]), np.diag(OWN**2) + H @ H.T, shared=H)
    told = [
        s.process(STEPS + 1, Motion(Pose2(STRIDE), measured=z), detections(np.zeros((0, 2))), NOTHING_SEEN)
        for s in (slam, again)
    ]
    assert told[0].covariance.tobytes() == told[1].covariance.tobytes()
    assert told[0].particles.tobytes() == told[1].particles.tobytes()
    slam.place(STEPS + 2, Pose2(), np.eye(3) * 0.01)
    assert not slam.state.shared.begun
    assert not SlamState.at_origin(3).shared.begun
