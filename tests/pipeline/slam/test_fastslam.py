"""FastSLAM: motion, landmarks, weights, resampling, and independence of the particles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.detection.free_space import BEHIND
from pipeline.geometry.pose_arrays import composed
from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.slam import FastSlam, Loop, Motion
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.slam.motion import compound, compounded, moved_poses, noise_of, step_variances
from pipeline.slam.particle_ancestry import low_variance_ancestors, normalised
from pipeline.slam.particle_maps import (
    ROOM,
    VARIANCE_MIN,
    kalman_update,
    own_block,
    take_ancestors,
    with_room,
)
from pipeline.slam.state import SlamState
from tests.pipeline.strategies import ALL_FREE, NOTHING_SEEN, detections, seeds

FOREST = preset("forest").slam.model_copy(update={"update_distance": 0.0})
TREES = np.array([[5.0, 2.0], [6.0, -2.0], [2.0, 4.0], [-3.0, 3.0], [1.0, -4.0], [8.0, 1.0]])


def fresh(seed=0, **changes: Any):
    """A filter at the origin."""
    return FastSlam(FOREST.model_copy(update=changes), seed)


def maps_of(slam):
    """The landmarks of each particle."""
    return [slam.state.map_of(p) for p in range(len(slam.state.pose))]


def landmarks_of(slam):
    """How many landmarks each particle has."""
    return [len(m.hits) for m in maps_of(slam)]


def seen_from(pose, world=TREES, rng=None, sigma=0.0, reach=8.0):
    """Detections of trees of the world from a pose."""
    centre = pose.inverse().apply(world)
    centre = centre[np.hypot(*centre.T) < reach]
    return detections(centre + (rng.normal(0, sigma, centre.shape) if rng else 0.0), sigma=0.05)


# --- motion ---------------------------------------------------------------------------------------


def _noise(step, p):
    """Covariance of one step."""
    position, yaw = step_variances(step.x, step.y, step.yaw, noise_of(p))
    return np.diag([position, position, yaw])


def moved_in(parts, step, p=FOREST):
    """A motion of equal parts, with its covariance."""
    motion, covariance = np.zeros(3), np.zeros((3, 3))
    for _ in range(parts):
        motion, covariance = compound(motion, covariance, step, _noise(step, p))
    return motion, covariance


@pytest.mark.parametrize("parts", [1, 4, 25])
def test_the_scatter_does_not_depend_on_how_often_the_odometry_is_read(parts):
    motion, covariance = moved_in(parts, Pose2(2.0 / parts, 0.0, 0.0))
    turn = np.radians(FOREST.noise_turn_distance) ** 2 * 2.0
    np.testing.assert_allclose(motion, [2.0, 0.0, 0.0], atol=1e-12)
    assert covariance[0, 0] == pytest.approx(FOREST.noise_distance**2 * 2.0)
    assert covariance[2, 2] == pytest.approx(turn)


@pytest.mark.parametrize("parts", [1, 10])
def test_the_scatter_of_a_turn_on_the_spot_grows_with_the_turn(parts):
    _, covariance = moved_in(parts, Pose2(0.0, 0.0, 1.5 / parts))
    assert covariance[2, 2] == pytest.approx(np.radians(FOREST.noise_turn) ** 2 * 1.5)
    assert np.all(covariance[:2] == 0.0)


def test_the_covariance_of_a_motion_is_the_scatter_of_drawn_motions():
    rng = np.random.default_rng(0)
    step = Pose2(0.3, 0.05, 0.2)
    p = FOREST.model_copy(update={"noise_turn_distance": 3.0})
    sigma = np.sqrt(np.diag(_noise(step, p)))
    drawn = np.zeros((40_000, 3))
    for _ in range(6):
        noisy = np.array([step.x, step.y, step.yaw]) + sigma * rng.standard_normal(drawn.shape)
        c, s = np.cos(drawn[:, 2]), np.sin(drawn[:, 2])
        drawn += np.stack(
            [c * noisy[:, 0] - s * noisy[:, 1], s * noisy[:, 0] + c * noisy[:, 1], noisy[:, 2]], 1
        )
    motion, covariance = moved_in(6, step, p)
    np.testing.assert_allclose(drawn.mean(axis=0), motion, atol=0.01)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.05 * covariance.max())


def test_noise_that_differs_along_and_across_turns_with_the_motion():
    motion, P = np.array([1.0, 2.0, 0.8]), np.diag([0.04, 0.01, 0.002])
    step, Q = np.array([0.5, 0.2, 0.1]), np.array([[0.09, 0.01, 0.0], [0.01, 0.01, 0.0], [0.0, 0.0, 0.001]])
    h = 1e-6
    whole = composed(motion[None], step[None])[0]
    F = np.stack([(composed((motion + d)[None], step[None])[0] - whole) / h for d in h * np.eye(3)], axis=1)
    G = np.stack([(composed(motion[None], (step + d)[None])[0] - whole) / h for d in h * np.eye(3)], axis=1)
    told, covariance = compounded(motion, P, 0.5, 0.2, 0.1, Q)
    np.testing.assert_allclose(told, whole, atol=1e-12)
    np.testing.assert_allclose(covariance, F @ P @ F.T + G @ Q @ G.T, atol=1e-6)


@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(-2, 2), st.floats(-1, 1))
def test_the_motion_is_the_composition_of_poses(yaw, x, y, turn):
    start, step = Pose2(1.0, -2.0, yaw), Pose2(x, y, turn)
    motion, _ = moved_in(1, step)
    wanted = (start @ step).as_array()
    pose = moved_poses(start.as_array()[None], motion)[0]
    np.testing.assert_allclose(pose[:2], wanted[:2], atol=1e-12)
    assert abs(float(wrap_angle(pose[2] - wanted[2] + 1.0)) - 1.0) < 1e-12


def test_standing_still_scatters_nothing():
    motion, covariance = moved_in(5, Pose2())
    assert np.all(motion == 0.0)
    assert np.all(covariance == 0.0)


# --- landmarks ------------------------------------------------------------------------------------

covariances = st.tuples(st.floats(0.03, 2.0), st.floats(0.03, 2.0), st.floats(-0.9, 0.9)).map(
    lambda s: np.array([s[0] ** 2, s[2] * s[0] * s[1], s[1] ** 2])
)


def _full(c):
    return np.array([[c[0], c[1]], [c[1], c[2]]])


@given(seeds, covariances, covariances)
def test_a_landmark_is_updated_as_the_textbook_says(seed, Sigma, R):
    from filterpy.kalman import update

    rng = np.random.default_rng(seed)
    m, z = rng.normal(size=2), rng.normal(size=2)
    wanted_m, wanted_P = update(m.copy(), _full(Sigma), z, R=_full(R), H=np.eye(2))
    precision = np.linalg.inv(np.linalg.inv(_full(Sigma)) + np.linalg.inv(_full(R)))
    rows_m, rows = np.stack([m, m]), np.stack([Sigma, Sigma])
    kalman_update(rows_m, rows, 1, z[0], z[1], R[0], R[1], R[2])
    np.testing.assert_array_equal(rows[0], Sigma)
    np.testing.assert_allclose(rows_m[1], wanted_m, atol=1e-9)
    lacking = max(VARIANCE_MIN - np.linalg.eigvalsh(wanted_P)[0], 0.0)
    np.testing.assert_allclose(_full(rows[1]), wanted_P + lacking * np.eye(2), atol=1e-9)
    np.testing.assert_allclose(wanted_P, precision, atol=1e-9)


def test_many_views_of_a_landmark_share_an_error_that_no_view_removes():
    m, rows = np.zeros((1, 2)), np.array([[0.3, 0.02, 0.2]])
    for _ in range(3000):
        kalman_update(m, rows, 0, 0.0, 0.0, 0.04, 0.01, 0.09)
    assert np.linalg.eigvalsh(_full(rows[0]))[0] == pytest.approx(VARIANCE_MIN, rel=1e-6)


@given(covariances, covariances, st.floats(-np.pi, np.pi), st.integers(1, 400))
def test_a_landmark_s_covariance_turns_with_the_map(Sigma, R, angle, times):
    C = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def updated(P, noise):
        rows = np.array([[P[0, 0], P[0, 1], P[1, 1]]])
        for _ in range(times):
            kalman_update(np.zeros((1, 2)), rows, 0, 0.0, 0.0, noise[0, 0], noise[0, 1], noise[1, 1])
        return _full(rows[0])

    turned = updated(C @ _full(Sigma) @ C.T, C @ _full(R) @ C.T)
    np.testing.assert_allclose(turned, C @ updated(_full(Sigma), _full(R)) @ C.T, atol=1e-12, rtol=1e-9)


@given(covariances, covariances, st.integers(1, 400))
def test_a_landmark_s_covariance_stays_positive(Sigma, R, times):
    m, rows = np.zeros((1, 2)), Sigma[None].copy()
    for _ in range(times):
        kalman_update(m, rows, 0, 0.0, 0.0, R[0], R[1], R[2])
    P = rows[0]
    assert np.linalg.eigvalsh(_full(P))[0] >= VARIANCE_MIN * (1.0 - 1e-9)


def test_an_estimate_keeps_no_memory_of_all_particles():
    slam = fresh()
    for k in range(3):
        estimate = slam.process(k, Pose2(), detections([[4.0, 1.0], [2.0, 5.0]]), NOTHING_SEEN)
        assert estimate.landmark_of.base is None


def test_a_tree_seen_often_is_one_landmark_at_its_place():
    slam = fresh(view_range=0.0)
    told = [slam.process(k, Pose2(), detections([[4.0, 1.0]]), NOTHING_SEEN) for k in range(30)]
    assert [m.hits.tolist() for m in maps_of(slam)] == 100 * [[30]]
    np.testing.assert_allclose(told[-1].landmarks, [[4.0, 1.0]], atol=1e-6)


def test_room_grows_with_the_landmarks():
    slam = fresh(particles=5, view_range=0.0)
    for k in range(20):
        rows = [[3.0 * j, 5.0 * k] for j in range(1, 6)]
        slam.process(k, Pose2(), detections(rows), NOTHING_SEEN)
    assert landmarks_of(slam) == 5 * [100]


def test_a_missed_landmark_goes_and_the_others_stay():
    slam = fresh(particles=4, view_range=20.0, misses_per_hit=1)
    both = detections([[4.0, 1.0], [6.0, -3.0], [3.0, 5.0]])
    for k in range(3):
        slam.process(k, Pose2(), both, ALL_FREE)
    assert landmarks_of(slam) == 4 * [3]
    for k in range(3, 7):
        slam.process(k, Pose2(), detections([[6.0, -3.0], [3.0, 5.0]]), ALL_FREE)
    assert landmarks_of(slam) == 4 * [2]
    for landmarks in maps_of(slam):
        left = {tuple(row) for row in np.round(landmarks.mean, 3).tolist()}
        assert left == {(6.0, -3.0), (3.0, 5.0)}


def test_trees_are_missed_by_their_distance_from_the_robot():
    """The view is free as far as between the second and the third tree from a robot off the origin."""
    start = Pose2(2.0, -1.5, 0.7)
    away = np.hypot(*(TREES - [start.x, start.y]).T)
    between = np.sort(away)[1:3].mean()
    slam = fresh(particles=4, view_range=20.0, misses_per_hit=1)
    for k in range(3):
        slam.process(k, Pose2(), detections(TREES), NOTHING_SEEN)
    slam.state.pose[:] = start.as_array()
    farther = TREES[away > between]
    for k in range(3, 8):
        seen = detections(start.inverse().apply(farther))
        slam.process(k, Pose2(), seen, np.full_like(ALL_FREE, between + BEHIND))
    for landmarks in maps_of(slam):
        np.testing.assert_allclose(sorted(landmarks.mean.tolist()), sorted(farther.tolist()), atol=0.1)


@pytest.mark.parametrize("hidden", ["where nothing was seen", "out of view range"])
def test_what_could_not_be_seen_is_not_missed(hidden):
    slam = fresh(particles=4, view_range=20.0 if hidden == "where nothing was seen" else 2.0)
    slam.process(0, Pose2(), detections([[4.0, 1.0]]), ALL_FREE)
    free = NOTHING_SEEN if hidden == "where nothing was seen" else ALL_FREE
    for k in range(1, 30):
        slam.process(k, Pose2(), detections([]), free)
    assert landmarks_of(slam) == 4 * [1]


def test_a_particle_that_misses_a_tree_loses_weight_by_the_weight_of_a_miss():
    """The tree at (0, -7) is gone. It is in view of particle 0, and out of view of particle 1."""
    weights = []
    for miss_weight in (0.0, 1.0):
        slam = fresh(
            method="fastslam1", particles=2, resample_below=0.0, view_range=7.05, weight_power=1.0,
            miss_weight=miss_weight,
        )  # fmt: skip
        for k in range(10):
            slam.process(k, Pose2(), detections([*TREES, [0.0, -7.0]]), ALL_FREE)
        slam.state.pose[1] = [0.0, 0.1, 0.0]
        estimate = slam.process(10, Pose2(), detections(TREES), ALL_FREE)
        weights.append(np.log(estimate.weights[1]) - np.log(estimate.weights[0]))
    assert weights[1] - weights[0] == pytest.approx(1.0)


# --- weights --------------------------------------------------------------------------------------


def a_step_on(method):
    """400 particles that know the trees well, after a step of a metre with poor odometry."""
    slam = fresh(
        method=method, particles=400, resample_below=0.0, view_range=0.0, noise_distance=0.2, weight_power=1.0
    )
    for k in range(5):
        slam.process(k, Pose2(), detections(TREES), NOTHING_SEEN)
    motion = Pose2(1.0, 0.0, 0.0)
    return slam.process(5, motion, detections(motion.inverse().apply(TREES)), NOTHING_SEEN)


def test_particles_drawn_from_odometry_and_scan_all_stand_where_both_agree():
    poor, good = a_step_on("fastslam1"), a_step_on("fastslam2")
    assert np.hypot(good.particles[:, 0] - 1.0, good.particles[:, 1]).max() < 0.15
    assert np.hypot(poor.particles[:, 0] - 1.0, poor.particles[:, 1]).max() > 0.3
    assert good.n_eff > 3 * poor.n_eff


def test_particles_that_agree_with_the_trees_win():
    estimate = a_step_on("fastslam1")
    error = np.hypot(estimate.particles[:, 0] - 1.0, estimate.particles[:, 1])
    heavy = np.argsort(estimate.weights)[-20:]
    assert error[heavy].mean() < 0.5 * error.mean()
    assert abs(estimate.T_map_base.x - 1.0) < 0.03
    assert estimate.weights.sum() == pytest.approx(1.0)
    assert estimate.n_eff == pytest.approx(1.0 / np.sum(estimate.weights**2))


def test_a_particle_that_recognises_nothing_does_not_win():
    """Had a new landmark no price, the particle that is lost would see only new ones and win."""
    slam = fresh(particles=2, resample_below=0.0, view_range=0.0, weight_power=1.0)
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


def frozen(state):
    """All that each particle knows, as bytes."""
    return [
        (state.pose[p].tobytes(), *(column.tobytes() for column in state.map_of(p)))
        for p in range(len(state.pose))
    ]


def resampled():
    """A filter of 100 particles that all come from 3."""
    slam = fresh(particles=100)
    slam.process(0, Pose2(), detections(TREES), NOTHING_SEEN)
    slam.state.log_weight[:] = -1e9
    slam.state.log_weight[[3, 50, 97]] = 0.0
    assert slam.process(1, Pose2(), detections(TREES), NOTHING_SEEN).n_eff < 5.0
    assert not slam.state.log_weight.any()
    return slam


def held_well(maps):
    """Whether the pool knows who holds what, and no row is free and held."""
    held = np.bincount(maps.block[maps.block >= 0], minlength=len(maps.owners))
    free = maps.free[: maps.free_count[0]].tolist()
    return (
        np.array_equal(held, maps.owners)
        and len(set(free)) == len(free)
        and set(free) == set(np.flatnonzero(held == 0).tolist())
    )


@pytest.mark.parametrize("how", ["process", "with_particles", "copy"])
def test_editing_the_map_of_one_particle_changes_no_other(how):
    slam = resampled()
    state = {
        "process": lambda: slam.state,
        "with_particles": lambda: slam.state.with_particles(150),
        "copy": slam.state.copy,
    }[how]()
    assert state.maps.owners.max() > 1, "they are shared until one writes"
    before = frozen(state)
    maps = with_room(state.maps, 0, 1)
    maps.mean[own_block(maps, 7, 0)] += 1.0
    after = frozen(replace(state, maps=maps))
    assert [p for p, (a, b) in enumerate(zip(before, after, strict=True)) if a != b] == [7]


def test_what_particles_share_changes_nothing_of_what_they_learn():
    rng = np.random.default_rng(4)
    shared = resampled()
    apart = fresh(particles=100)
    for k in range(2, 12):
        maps = with_room(shared.state.copy().maps, 0, 5000)
        for p in range(100):
            for b in range(-(-maps.places[p] // ROOM)):
                own_block(maps, p, b)
        apart.state = replace(shared.state.copy(), maps=maps)
        scan = detections(TREES + rng.normal(0, 0.03, TREES.shape) - [0.2 * (k - 1), 0.0])
        for slam in (shared, apart):
            slam.process(k, Pose2(0.2), scan, ALL_FREE)
        assert held_well(shared.state.maps)
        assert held_well(apart.state.maps)
        assert frozen(shared.state) == frozen(apart.state)


@given(seeds)
def test_resampling_gives_each_particle_its_ancestor_s_map_and_loses_no_row(seed):
    rng = np.random.default_rng(seed)
    slam = resampled()
    for k in range(2, 6):
        scan = detections(rng.uniform(-9.0, 9.0, (rng.integers(0, 8), 2)))
        slam.process(k, Pose2(0.3), scan, ALL_FREE)
        before = frozen(slam.state)
        ancestors = low_variance_ancestors(normalised(rng.normal(0, 3, 100)), rng.random())
        take_ancestors(ancestors, slam.state.pose, slam.state.maps)
        assert frozen(slam.state) == [before[a] for a in ancestors]
        assert held_well(slam.state.maps)


def test_a_known_map_is_the_start_of_every_particle():
    slam = resampled()
    known = slam.state.map_of(slam.state.best)
    started = SlamState.in_map(np.zeros((5, 3)), known)
    assert held_well(started.maps)
    for p in range(5):
        for told, wanted in zip(started.map_of(p), known, strict=True):
            np.testing.assert_array_equal(told, wanted)
    again = fresh(particles=5)
    again.state = started
    assert again.process(1, Pose2(), detections(TREES), NOTHING_SEEN).health.detections == len(TREES)
    assert landmarks_of(again) == 5 * [len(TREES)], "all of them are known"


def test_a_copy_and_its_original_share_nothing():
    slam = fresh(particles=10)
    slam.process(0, Pose2(), detections(TREES), NOTHING_SEEN)
    copy = slam.state.copy()
    before = frozen(copy)
    slam.process(1, Pose2(0.5, 0.1, 0.1), detections(TREES - 0.5), ALL_FREE)
    assert frozen(copy) == before


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
    assert len(changed.pose) == len(changed.maps.places) == after
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
    known = slam.state.map_of(best).hits >= FOREST.hits_to_weigh
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
    assert slam.state.map_of(0).hits[0] == 1 + 2  # at 0, 1.2 and 2.4 m


def test_a_scan_that_is_due_updates_a_robot_that_stands():
    slam = fresh(particles=10, update_distance=1.0, view_range=0.0)
    for k in range(5):
        told = slam.process(k, Motion(Pose2(), due=k == 3), detections([[4.0, 1.0]]), NOTHING_SEEN)
        assert told.health.detections == 1
        assert told.landmark_of.tolist() == [0]
    assert slam.state.map_of(0).hits[0] == 2


def test_while_scans_are_strange_each_of_them_updates():
    """The robot was carried: each scan misses all known trees."""
    slam = fresh(update_distance=1.0)
    for k in range(6):
        slam.process(k, Motion(Pose2(), due=True), detections(TREES), ALL_FREE)
    used = slam.state.detections
    for k in range(6, 10):
        slam.process(k, Motion(Pose2(), due=k == 6), detections(np.add(TREES, [1.3, 1.1])), ALL_FREE)
    assert slam.state.detections == used + 4 * len(TREES)


def test_no_detection_at_all_is_no_harm():
    slam = fresh(particles=1)
    told = [slam.process(k, Pose2(1.0), detections([]), NOTHING_SEEN) for k in range(5)]
    assert np.isfinite(told[-1].covariance).all()
    assert told[-1].landmarks.shape == (0, 2)


def test_two_landmarks_that_are_one_tree_become_one():
    """A tree was begun twice; both lie within each other's uncertainty and only one is seen now."""
    slam = fresh(particles=3, view_range=0.0, merge_gate=1.0)
    slam.process(0, Pose2(), detections([[4.0, 1.0], [4.04, 1.0]], sigma=0.05), NOTHING_SEEN)
    assert landmarks_of(slam) == [2, 2, 2]
    slam.process(1, Pose2(), detections([[4.0, 1.0]], sigma=0.05), NOTHING_SEEN)
    assert landmarks_of(slam) == [1, 1, 1]
    assert [m.birth.tolist() for m in maps_of(slam)] == 3 * [[0]], "the older one stays"


def test_two_trees_seen_in_one_scan_stay_two():
    slam = fresh(particles=3, view_range=0.0, merge_gate=5.0)
    for k in range(9):
        slam.process(k, Pose2(), detections([[4.0, 1.0], [4.1, 1.0]]), NOTHING_SEEN)
    assert landmarks_of(slam) == [2, 2, 2]


@pytest.mark.parametrize("update_distance", [0.0, 5.0])
def test_the_path_contains_the_estimate_of_each_scan(update_distance):
    slam = fresh(particles=30, update_distance=update_distance)
    estimates = [estimate for estimate, _, _ in _drive(slam, scans=120)]
    reported = np.array([estimate.T_map_base.as_array() for estimate in estimates])
    np.testing.assert_array_equal(slam.path(), reported)
    best = estimates[-1].particles[slam.state.best]
    np.testing.assert_allclose(slam.best_pose.as_array(), best, atol=1e-9)
    assert (slam.state.since_update > 0.0) == (update_distance > 0.0)


def test_the_power_of_the_weights_is_that_of_the_likelihood():
    """Two particles that disagree: their weights' ratio to this power, and to no other."""
    ratios = {}
    for power in (1.0, 0.25):
        slam = fresh(particles=2, resample_below=0.0, view_range=0.0, weight_power=power)
        for k in range(5):
            slam.process(k, Pose2(), detections(TREES), NOTHING_SEEN)
        slam.state.pose[1] = [0.03, 0.0, 0.0]
        slam.state.log_weight[:] = 0.0
        slam.process(5, Pose2(), detections(TREES), NOTHING_SEEN)
        ratios[power] = slam.state.log_weight[1] - slam.state.log_weight[0]
    assert ratios[1.0] < -0.5
    assert ratios[0.25] == pytest.approx(0.25 * ratios[1.0])


@pytest.mark.parametrize("step", [0.125, 0.5, 2.0, 25.0])
def test_keyframes_at_multiples_of_a_distance_do_not_depend_on_the_number_of_scans(step):
    slam = fresh()
    due = []
    for k in range(round(100.0 / step) + 1):
        slam.process(k, Pose2(step if k else 0.0), detections(TREES[:0]), NOTHING_SEEN)
        within = step * (k - slam.first_scan_within(20.0))
        assert min(step * k, 20.0) - max(step, 1.0) < within <= 20.0
        if slam.is_keyframe_every(10.0):
            due.append(step * k)
    np.testing.assert_allclose(due, np.arange(1, 1 + 100.0 / max(step, 10.0)) * max(step, 10.0))


def test_the_first_keyframe_has_the_detections_of_the_scans_nearest_to_it():
    sigma, step = 0.05, FOREST.keyframe_distance / 20
    error, variance = [], []
    for seed in range(8):
        slam, rng = fresh(seed, particles=20), np.random.default_rng(seed)
        for k in range(21):
            seen = seen_from(Pose2(k * step), rng=rng, sigma=sigma, reach=20.0)
            slam.process(k, Pose2(step if k else 0.0), seen, NOTHING_SEEN)
        first, _ = slam.state.graph.keyframes
        apart = first.centre[:, None] - TREES
        nearest = np.argmin(np.hypot(*np.moveaxis(apart, -1, 0)), axis=1)
        assert sorted(nearest) == list(range(len(TREES))), "each tree once, in the frame of the first scan"
        error.append(apart[np.arange(len(TREES)), nearest])
        variance.append(first.R[:, 0])
    # The first scan and those of the first half of the way, with the errors of their poses.
    assert np.std(error) < 0.5 * sigma
    assert np.max(variance) < 0.2 * sigma**2


def test_the_second_keyframe_has_detections_if_there_were_any_since_the_first():
    slam, step = fresh(particles=5), FOREST.keyframe_distance / 10
    for k in range(12):
        seen = TREES - [k * step, 0.0] if k in (0, 2, 3) else TREES[:0]
        slam.process(k, Pose2(step if k else 0.0), detections(seen), NOTHING_SEEN)
    first, second = slam.state.graph.keyframes
    assert len(first.birth) == len(second.birth) == len(TREES)


def test_a_loop_between_two_used_scans_has_the_whole_motion(monkeypatch):
    slam = fresh(particles=5, update_distance=5.0)
    for k in range(4):
        slam.process(k, Pose2(0.5 if k else 0.0, 0.0, 0.1), detections(TREES[:0]), NOTHING_SEEN)
    graphs = list[KeyframeGraph]()
    monkeypatch.setattr(KeyframeGraph, "solve", lambda graph, **_: graphs.append(graph))
    assert slam.close(3, Loop(0, 0, Pose2(), np.eye(3))) is None
    newest = graphs[0].keyframes[-1]
    assert newest.scan == 3
    # The last used scan is the first one; the robot turned at it and has moved since.
    expected = Pose2()
    for _ in range(3):
        expected = expected @ Pose2(0.5, 0.0, 0.1)
    np.testing.assert_allclose(newest.motion, expected.as_array(), atol=1e-9)
    assert np.all(np.diag(newest.covariance) > 0.0)


def test_the_covariance_after_smoothing_is_that_of_the_graph():
    """All particles are drawn given the map, whose own error they share."""
    rng = np.random.default_rng(1)
    world = rng.uniform([-5.0, -12.0], [40.0, 12.0], (60, 2))
    slam = FastSlam(preset("forest").slam.model_copy(update={"particles": 30}), 2)
    k, estimate = 0, slam.process(0, Pose2(), seen_from(Pose2(), world, rng, sigma=0.04), NOTHING_SEEN)
    while not (k > 40 and slam.state.graph.newest_scan == k):
        k += 1
        step = Pose2(0.5 + rng.normal(0, 0.02), rng.normal(0, 0.02), rng.normal(0, 0.005))
        shown = seen_from(Pose2(0.5 * k, 0.0, 0.0), world, rng, sigma=0.04, reach=12.0)
        estimate = slam.process(k, step, shown, NOTHING_SEEN)
    solution = slam.state.graph.solve()
    assert solution is not None
    marginal = solution.covariance[-1]
    assert slam.smooth(k) is not None
    after, spread = slam.estimate(estimate).covariance, slam.estimate(estimate).relative
    assert np.trace(after[:2, :2]) >= 0.7 * np.trace(marginal[:2, :2])
    assert spread is not None
    assert np.trace(spread[:2, :2]) < 0.5 * np.trace(marginal[:2, :2]), "else this test shows nothing"


def test_a_placed_filter_begins_a_new_step_and_keeps_the_driven_distance():
    slam = fresh(update_distance=1.0)
    slam.process(0, Pose2(), seen_from(Pose2()), ALL_FREE)
    slam.process(1, Pose2(0.4, 0.0, 0.0), seen_from(Pose2(0.4)), ALL_FREE)
    assert slam.state.since_update == pytest.approx(0.4)
    slam.place(2, Pose2(5.0, 0.0, 0.0), np.eye(3) * 1e-4)
    assert slam.state.since_update == 0.0
    assert slam.state.distance == pytest.approx(0.4)


@pytest.mark.parametrize("scans", [0, 2])
def test_after_placing_the_motion_since_the_keyframe_is_that_since_the_pose(scans):
    """With and without a graph: what was driven before is no part of the next keyframe."""
    slam, step = fresh(keyframe_distance=9.0), Pose2(0.4, 0.1, 0.2)
    for k in range(scans):
        slam.process(k, Pose2(0.3 * k), seen_from(Pose2(0.3 * k)), ALL_FREE)
    assert bool(slam.state.graph.keyframes) == bool(slam.state.keyframe_motion.any()) == (scans > 0)
    slam.place(scans, Pose2(5.0, 0.0, 1.0), np.eye(3) * 1e-4)
    np.testing.assert_array_equal(slam.state.keyframe_motion, np.zeros(3))
    np.testing.assert_array_equal(slam.state.keyframe_covariance, np.zeros((3, 3)))
    if scans:  # without a graph, the next scan is the first keyframe
        slam.process(scans, step, detections(TREES[:0]), NOTHING_SEEN)
        np.testing.assert_allclose(slam.state.keyframe_motion, step.as_array(), atol=1e-12)
        np.testing.assert_allclose(slam.state.keyframe_covariance, _noise(step, FOREST), atol=1e-12)
