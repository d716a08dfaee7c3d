"""FastSLAM: motion, landmarks, weights, and particles that share nothing."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry import Pose2, wrap_angle
from pipeline.parameters import preset
from pipeline.slam import FastSlam
from pipeline.slam.fastslam import SlamState, _move
from pipeline.slam.update import VARIANCE_MIN, kalman_update
from tests.pipeline.strategies import ALL_FREE, FEW, LAW, NOTHING_SEEN, detections, seeds

FOREST = preset("forest").slam
TREES = np.array([[5.0, 2.0], [6.0, -2.0], [2.0, 4.0], [-3.0, 3.0], [1.0, -4.0], [8.0, 1.0]])


def fresh(seed=0, **changes: Any):
    """A filter at the origin."""
    return FastSlam(FOREST.model_copy(update=changes), seed)


def seen_from(pose, world=TREES, rng=None, sigma=0.0, reach=8.0):
    """Detections of trees of the world from a pose."""
    centre = pose.inverse().apply(world)
    centre = centre[np.hypot(*centre.T) < reach]
    return detections(centre + (rng.normal(0, sigma, centre.shape) if rng else 0.0), sigma=0.05)


# --- motion ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 4, 25])
def test_the_scatter_does_not_depend_on_how_often_the_odometry_is_read(parts):
    rng = np.random.default_rng(0)
    pose = np.zeros((20_000, 3))
    step = Pose2(2.0 / parts, 0.0, 0.0)
    for _ in range(parts):
        _move(pose, step, rng.standard_normal(pose.shape), FOREST)
    turn = np.radians(FOREST.noise_turn_distance) * np.sqrt(2.0)
    assert pose[:, 0].std() == pytest.approx(FOREST.noise_distance * np.sqrt(2.0), rel=0.05)
    assert pose[:, 2].std() == pytest.approx(turn, rel=0.05)
    assert abs(pose[:, 0].mean() - 2.0) < 2e-3


@pytest.mark.parametrize("parts", [1, 10])
def test_the_scatter_of_a_turn_on_the_spot_grows_with_the_turn(parts):
    rng = np.random.default_rng(0)
    pose = np.zeros((20_000, 3))
    for _ in range(parts):
        _move(pose, Pose2(0.0, 0.0, 1.5 / parts), rng.standard_normal(pose.shape), FOREST)
    assert pose[:, 2].std() == pytest.approx(np.radians(FOREST.noise_turn) * np.sqrt(1.5), rel=0.05)
    assert np.all(pose[:, :2] == 0.0)


@LAW
@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(-2, 2), st.floats(-1, 1))
def test_without_noise_the_motion_is_the_composition_of_poses(yaw, x, y, turn):
    p = FOREST.model_copy(update={"noise_distance": 0.0, "noise_turn": 0.0, "noise_turn_distance": 0.0})
    start, motion = Pose2(1.0, -2.0, yaw), Pose2(x, y, turn)
    pose = start.as_array()[None].copy()
    _move(pose, motion, np.ones((1, 3)), p)
    wanted = (start @ motion).as_array()
    np.testing.assert_allclose(pose[0, :2], wanted[:2], atol=1e-12)
    assert abs(float(wrap_angle(pose[0, 2] - wanted[2] + 1.0)) - 1.0) < 1e-12


def test_standing_still_scatters_nothing():
    pose = np.zeros((50, 3))
    _move(pose, Pose2(), np.ones((50, 3)), FOREST)
    assert np.all(pose == 0.0)


# --- landmarks ------------------------------------------------------------------------------------

covariances = st.tuples(st.floats(0.03, 2.0), st.floats(0.03, 2.0), st.floats(-0.9, 0.9)).map(
    lambda s: np.array([s[0] ** 2, s[2] * s[0] * s[1], s[1] ** 2])
)


def _full(c):
    return np.array([[c[0], c[1]], [c[1], c[2]]])


@LAW
@given(seeds, covariances, covariances)
def test_a_landmark_is_updated_as_the_textbook_says(seed, Sigma, R):
    from filterpy.kalman import update

    rng = np.random.default_rng(seed)
    m, z = rng.normal(size=2), rng.normal(size=2)
    wanted_m, wanted_P = update(m.copy(), _full(Sigma), z, R=_full(R), H=np.eye(2))
    precision = np.linalg.inv(np.linalg.inv(_full(Sigma)) + np.linalg.inv(_full(R)))
    told_m, told = m.copy(), Sigma.copy()
    kalman_update(told_m, told, z, R)
    np.testing.assert_allclose(told_m, wanted_m, atol=1e-9)
    wanted = np.array([max(wanted_P[0, 0], VARIANCE_MIN), wanted_P[0, 1], max(wanted_P[1, 1], VARIANCE_MIN)])
    np.testing.assert_allclose(told, wanted, atol=1e-9)
    np.testing.assert_allclose(wanted_P, precision, atol=1e-9)


@LAW
@given(covariances, covariances, st.integers(1, 400))
def test_a_landmark_s_covariance_stays_positive(Sigma, R, times):
    m, P = np.zeros(2), Sigma.copy()
    for _ in range(times):
        kalman_update(m, P, np.zeros(2), R)
    assert np.all(np.linalg.eigvalsh(_full(P)) > 0)
    assert min(P[0], P[2]) >= VARIANCE_MIN


def test_a_tree_seen_often_is_one_landmark_at_its_place():
    slam = fresh(view_range=0.0)
    told = [slam.process(k, Pose2(), detections([[4.0, 1.0]]), NOTHING_SEEN) for k in range(30)]
    np.testing.assert_array_equal(slam.state.count, 1)
    np.testing.assert_array_equal(slam.state.hits[:, 0], 30)
    np.testing.assert_allclose(told[-1].landmarks, [[4.0, 1.0]], atol=1e-6)


def test_room_grows_with_the_landmarks():
    slam = fresh(particles=5, view_range=0.0)
    for k in range(20):
        rows = [[3.0 * j, 5.0 * k] for j in range(1, 6)]
        slam.process(k, Pose2(), detections(rows), NOTHING_SEEN)
    np.testing.assert_array_equal(slam.state.count, 100)


def test_a_missed_landmark_goes_and_the_others_stay():
    slam = fresh(particles=4, view_range=20.0, misses_per_hit=1)
    both = detections([[4.0, 1.0], [6.0, -3.0], [3.0, 5.0]])
    for k in range(3):
        slam.process(k, Pose2(), both, ALL_FREE)
    np.testing.assert_array_equal(slam.state.count, 3)
    for k in range(3, 7):
        slam.process(k, Pose2(), detections([[6.0, -3.0], [3.0, 5.0]]), ALL_FREE)
    np.testing.assert_array_equal(slam.state.count, 2)
    for p in range(4):
        left = {tuple(row) for row in np.round(slam.state.mean[p, :2], 3).tolist()}
        assert left == {(6.0, -3.0), (3.0, 5.0)}


@pytest.mark.parametrize("hidden", ["where nothing was seen", "out of view range"])
def test_what_could_not_be_seen_is_not_missed(hidden):
    slam = fresh(particles=4, view_range=20.0 if hidden == "where nothing was seen" else 2.0)
    slam.process(0, Pose2(), detections([[4.0, 1.0]]), ALL_FREE)
    free = NOTHING_SEEN if hidden == "where nothing was seen" else ALL_FREE
    for k in range(1, 30):
        slam.process(k, Pose2(), detections([]), free)
    np.testing.assert_array_equal(slam.state.count, 1)


# --- weights --------------------------------------------------------------------------------------


def test_particles_that_agree_with_the_trees_win():
    slam = fresh(particles=400, resample_below=0.0, view_range=0.0, noise_distance=0.2)
    for k in range(5):
        slam.process(k, Pose2(), detections(TREES), NOTHING_SEEN)
    motion = Pose2(1.0, 0.0, 0.0)
    estimate = slam.process(5, motion, detections(motion.inverse().apply(TREES)), NOTHING_SEEN)
    error = np.hypot(estimate.particles[:, 0] - 1.0, estimate.particles[:, 1])
    heavy = np.argsort(estimate.weights)[-20:]
    assert error[heavy].mean() < 0.5 * error.mean()
    assert abs(estimate.T_map_base.x - 1.0) < 0.03
    assert estimate.weights.sum() == pytest.approx(1.0)
    assert estimate.n_eff == pytest.approx(1.0 / np.sum(estimate.weights**2))


def test_a_particle_that_recognises_nothing_does_not_win():
    """Had a new landmark no price, the particle that is lost would see only new ones and win."""
    slam = fresh(particles=2, resample_below=0.0, view_range=0.0)
    for k in range(5):
        slam.process(k, Pose2(), detections(TREES), NOTHING_SEEN)
    slam.state.pose[1] = [30.0, 30.0, 0.0]
    estimate = slam.process(5, Pose2(), detections(TREES), NOTHING_SEEN)
    assert estimate.weights[0] > 0.99


def test_landmarks_seen_too_seldom_do_not_weigh():
    slam = fresh(particles=50, resample_below=0.0, view_range=0.0, hits_to_weigh=10)
    slam.process(0, Pose2(), detections(TREES), NOTHING_SEEN)
    estimate = slam.process(1, Pose2(0.5), detections(TREES - [0.5, 0.0]), NOTHING_SEEN)
    np.testing.assert_allclose(estimate.weights, 0.02)


def test_the_estimate_is_the_weighted_mean_and_its_spread():
    slam = fresh(particles=3, resample_below=0.0)
    slam.state.pose[:] = [[0.0, 0.0, 3.1], [1.0, 0.0, -3.1], [9.0, 9.0, 0.0]]
    slam.state.log_weight[:] = np.log([0.5, 0.5, 1e-300])
    estimate = slam.process(1, Pose2(), detections([]), NOTHING_SEEN)
    assert estimate.T_map_base.x == pytest.approx(0.5)
    assert abs(estimate.T_map_base.yaw) == pytest.approx(np.pi)
    assert estimate.covariance[0, 0] == pytest.approx(0.25)
    assert np.linalg.eigvalsh(estimate.covariance).min() > -1e-12


# --- particles share nothing ----------------------------------------------------------------------


def _columns(state):
    return {f.name: getattr(state, f.name) for f in fields(SlamState) if f.name != "since_update"}


@pytest.mark.parametrize("how", ["process", "with_particles", "copy", "with_room"])
def test_editing_the_map_of_one_particle_changes_no_other(how):
    slam = fresh(particles=100)
    slam.process(0, Pose2(), detections(TREES), NOTHING_SEEN)
    slam.state.log_weight[:] = -1e9
    slam.state.log_weight[[3, 50, 97]] = 0.0
    if how == "process":
        estimate = slam.process(1, Pose2(), detections(TREES), NOTHING_SEEN)
        assert estimate.resampled
        state = slam.state
    else:
        state = getattr(slam.state, how)(*{"with_particles": (150,), "with_room": (300,)}.get(how, ()))
    for column in _columns(state).values():
        before = column.copy()
        column[7] += 1
        changed = np.flatnonzero((column != before).reshape(len(column), -1).any(axis=1))
        assert changed.tolist() == [7]


def test_a_copy_and_its_original_share_nothing():
    slam = fresh(particles=10)
    slam.process(0, Pose2(), detections(TREES), NOTHING_SEEN)
    copy = slam.state.copy()
    before = {name: column.copy() for name, column in _columns(copy).items()}
    slam.process(1, Pose2(0.5, 0.1, 0.1), detections(TREES - 0.5), ALL_FREE)
    for name, column in _columns(copy).items():
        np.testing.assert_array_equal(column, before[name])


@FEW
@given(st.integers(1, 300), st.integers(1, 300))
def test_another_number_of_particles_keeps_the_belief(before, after):
    rng = np.random.default_rng(before)
    state = SlamState.at_origin(before)
    state.pose[:] = rng.normal(size=(before, 3))
    state.log_weight[:] = rng.normal(0, 2, before)
    weights = np.exp(state.log_weight) / np.exp(state.log_weight).sum()
    changed = state.with_particles(after)
    if before == after:
        return
    assert len(changed.pose) == len(changed.count) == after
    for row, weight in enumerate(weights):
        drawn = np.count_nonzero((changed.pose == state.pose[row]).all(axis=1))
        assert np.floor(after * weight - 1e-9) <= drawn <= np.ceil(after * weight + 1e-9)


# --- the whole filter ------------------------------------------------------------------------------


def _drive(slam, *, from_scan=0, scans=160, seed=1, radius=6.0):
    """A loop among trees with biased odometry; yields estimate, truth and odometry of each scan."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    world = np.concatenate([ring * (radius + 2.5), ring[::2] * (radius - 3.0)]) + np.array([0.0, radius])
    step = Pose2(2 * np.pi * radius / 80, 0.0, 2 * np.pi / 80)
    truth, odometry = Pose2(), Pose2()
    for k in range(scans):
        noise = rng.normal(size=3) * [0.02, 0.02, 0.006] + [0.0, 0.0, 0.003]
        wheel = Pose2() if k == 0 else Pose2(step.x + noise[0], step.y + noise[1], step.yaw + noise[2])
        truth, odometry = (truth @ step if k else truth), odometry @ wheel
        seen = seen_from(truth, world, rng, 0.03)
        if k >= from_scan:
            yield slam.process(k, wheel, seen, NOTHING_SEEN), truth, odometry


def test_a_closed_loop_is_mapped_better_than_the_wheels_say():
    slam = fresh(particles=100)
    rows = [
        (np.hypot(e.T_map_base.x - t.x, e.T_map_base.y - t.y), np.hypot(o.x - t.x, o.y - t.y))
        for e, t, o in _drive(slam)
    ]
    ours, wheels = np.sqrt(np.mean(np.square(rows), axis=0))
    assert wheels > 0.5
    assert ours < 0.35 * wheels
    best = int(np.argmax(slam.state.log_weight))
    known = slam.state.hits[best, : slam.state.count[best]] >= FOREST.hits_to_weigh
    assert 21 <= np.count_nonzero(known) <= 25, "21 trees stand there"


def _bytes(estimate):
    return (
        estimate.particles.tobytes(),
        estimate.weights.tobytes(),
        estimate.landmarks.tobytes(),
        estimate.covariance.tobytes(),
    )


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    one = [_bytes(e) for e, _, _ in _drive(fresh(3), scans=30)]
    two = [_bytes(e) for e, _, _ in _drive(fresh(3), scans=30)]
    other = [_bytes(e) for e, _, _ in _drive(fresh(4), scans=30)]
    assert one == two
    assert one != other


def test_from_a_copy_of_the_state_it_goes_on_to_the_same_bytes():
    slam = fresh(3)
    whole, kept = [], slam.state
    for k, (estimate, _, _) in enumerate(_drive(slam, scans=60)):
        whole.append(_bytes(estimate))
        if k == 29:
            kept = slam.state.copy()
    again = fresh(3)
    again.state = kept
    assert [_bytes(e) for e, _, _ in _drive(again, from_scan=30, scans=60)] == whole[30:]


def test_scans_between_two_updates_only_move():
    slam = fresh(particles=10, update_distance=1.0, view_range=0.0)
    for k in range(11):
        motion = Pose2(0.3) if k else Pose2()
        slam.process(k, motion, detections([[4.0 - 0.3 * k, 1.0]]), NOTHING_SEEN)
    assert slam.state.hits[0, 0] == 1 + 2  # at 0, 1.2 and 2.4 m


def test_no_detection_at_all_is_no_harm():
    slam = fresh(particles=1)
    told = [slam.process(k, Pose2(1.0), detections([]), NOTHING_SEEN) for k in range(5)]
    assert np.isfinite(told[-1].covariance).all()
    assert told[-1].landmarks.shape == (0, 2)
