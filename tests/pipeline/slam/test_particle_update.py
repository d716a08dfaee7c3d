"""Association and correction of one particle: against an extended Kalman filter by the textbook."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.candidate_pairs import candidate_pairs
from pipeline.slam.fastslam import rules_of
from pipeline.slam.landmarks import decide
from pipeline.slam.particle_update import (
    INNOVATION,
    NEW,
    OPEN,
    RECOGNISED,
    STATISTICS,
    choose_clear_pairs,
    gains_for,
    scan_for,
    update_particle,
)
from tests.pipeline.strategies import NOTHING_SEEN, detections, seeds

RULES = rules_of(preset("forest").slam)


def full(rows):
    return np.array([[rows[0], rows[1]], [rows[1], rows[2]]])


def scene(seed, trees=12, spacing=3.0, sigma=0.03):
    """Landmarks in the body frame, detections of most of them and of one new tree, and their covariances."""
    rng = np.random.default_rng(seed)
    grid = spacing * np.stack(np.meshgrid(np.arange(-2, 2), np.arange(-2, 2)), axis=-1).reshape(-1, 2)
    landmarks = grid[rng.permutation(len(grid))[:trees]] + rng.uniform(0.3, 0.9, (trees, 2))
    covariance = np.tile([0.002, 0.0004, 0.003], (trees, 1)) * rng.uniform(0.5, 2.0, (trees, 1))
    A = rng.normal(size=(3, 3)) * [[0.04], [0.04], [0.01]]
    P = A @ A.T + 1e-8 * np.eye(3)
    seen = rng.permutation(trees)[: trees - 3]
    centre = np.vstack([landmarks[seen] + rng.normal(0.0, sigma, (len(seen), 2)), [[40.0, 1.0]]])
    R = np.tile([0.003, -0.0005, 0.002], (len(centre), 1))
    return landmarks, covariance, P, centre, R, np.append(seen, NEW), rng


def updated(given_, well=None, noise=None, copies=1):
    """Update equal particles at the origin; returns likelihoods, poses, pairs, landmarks and statistics."""
    landmarks, covariance, P, centre, R, _, _ = given_
    well = np.ones(len(landmarks), np.bool_) if well is None else well
    pairs = candidate_pairs(
        centre, R, landmarks, np.zeros(len(landmarks)), covariance, well, P, RULES.distance_max
    )
    scan = scan_for(centre, R, P, covariance, well.astype(np.int32), len(pairs.row), len(landmarks))
    gains = gains_for(len(centre))
    pose, pair_of = np.zeros((copies, 3)), np.empty((copies, len(centre)), np.int64)
    statistics = np.empty((copies, STATISTICS))
    noise = np.zeros((copies, 3)) if noise is None else noise
    choose_clear_pairs(0, landmarks, scan, pairs, RULES, pair_of)
    scan.order[:] = np.argsort(scan.best, kind="stable")
    likelihood = [
        update_particle(p, pose, landmarks, scan, pairs, RULES, noise, gains, p == 0, pair_of, statistics)
        for p in range(copies)
    ]
    rows = np.where(pair_of >= 0, pairs.row[np.maximum(pair_of, 0)], NEW)
    return likelihood, pose, rows, statistics, gains


def textbook(given_, well):
    """All well-known pairs in one Kalman update of the pose: mean, squared distance and log determinant."""
    landmarks, covariance, P, centre, R, truth, _ = given_
    used = [d for d in range(len(centre)) if truth[d] >= 0 and well[truth[d]]]
    H = np.vstack([[[1.0, 0.0, -centre[d, 1]], [0.0, 1.0, centre[d, 0]]] for d in used])
    own = np.zeros((2 * len(used), 2 * len(used)))
    for i, d in enumerate(used):
        own[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = full(R[d]) + full(covariance[truth[d]])
    y = np.concatenate([landmarks[truth[d]] - centre[d] for d in used])
    S = H @ P @ H.T + own
    mean = P @ H.T @ np.linalg.solve(S, y)
    posterior = P - P @ H.T @ np.linalg.solve(S, H @ P)
    price = 0.0
    for d in set(range(len(centre))) - set(used):
        J = np.array([[1.0, 0.0, -centre[d, 1]], [0.0, 1.0, centre[d, 0]]])
        price += RULES.gate**2 + np.linalg.slogdet(full(R[d]) + J @ posterior @ J.T)[1]
    return mean, posterior, y @ np.linalg.solve(S, y), np.linalg.slogdet(S)[1], price, len(used)


@given(seeds)
def test_pose_and_likelihood_are_those_of_one_kalman_update_with_all_pairs(seed):
    given_ = scene(seed)
    well = given_[-1].random(12) < 0.8
    well[given_[5][0]] = True
    (likelihood,), pose, rows, statistics, _ = updated(given_, well)
    assert rows[0].tolist() == given_[5].tolist()
    mean, _, square, log_det, price, used = textbook(given_, well)
    np.testing.assert_allclose(pose[0], mean, atol=1e-9)
    assert statistics[0, RECOGNISED] == used
    assert statistics[0, INNOVATION] == pytest.approx(square, rel=1e-6)
    assert likelihood == pytest.approx(-0.5 * (square + log_det + price), rel=1e-6, abs=1e-6)


@given(seeds)
def test_particles_are_drawn_from_the_corrected_pose(seed):
    given_ = scene(seed)
    noise = np.vstack([np.zeros(3), np.eye(3)])
    _, pose, _, _, _ = updated(given_, noise=noise, copies=4)
    mean, posterior, *_ = textbook(given_, np.ones(12, np.bool_))
    np.testing.assert_allclose(pose[0], mean, atol=1e-9)
    root = (pose[1:] - pose[0]).T  # columns of a root of the covariance
    np.testing.assert_allclose(root @ root.T, posterior, rtol=1e-5, atol=1e-12)


@given(seeds)
def test_gains_of_the_best_particle_give_what_own_gains_give(seed):
    given_ = scene(seed, spacing=1.2, sigma=0.06)
    alone, with_gains = updated(given_), updated(given_, copies=2)
    assert with_gains[0][1] == pytest.approx(alone[0][0], rel=1e-9)
    np.testing.assert_allclose(with_gains[1][1], alone[1][0], atol=1e-12)
    np.testing.assert_array_equal(with_gains[2][1], alone[2][0])
    np.testing.assert_allclose(with_gains[3][1], alone[3][0], rtol=1e-9)


@given(seeds)
def test_pairs_are_one_to_one_and_within_the_gate(seed):
    given_ = scene(seed, spacing=0.5, sigma=0.2)
    landmarks, covariance, P, centre, R, _, _ = given_
    _, _, rows, _, _ = updated(given_)
    used = rows[0][rows[0] >= 0]
    assert len(set(used.tolist())) == len(used)
    for d, j in enumerate(rows[0]):
        if j >= 0:
            J = np.array([[1.0, 0.0, -centre[d, 1]], [0.0, 1.0, centre[d, 0]]])
            S, y = full(R[d]) + full(covariance[j]) + J @ P @ J.T, landmarks[j] - centre[d]
            assert np.hypot(*y) <= RULES.distance_max
            assert y @ np.linalg.solve(S, y) <= RULES.gate**2


def test_the_majority_of_the_weight_decides():
    given_ = scene(0)
    landmarks, covariance, P, centre, R, _, _ = given_
    pairs = candidate_pairs(
        centre, R, landmarks, np.full(12, 9.0), covariance, np.ones(12, np.bool_), P, RULES.distance_max
    )
    pair_of = np.tile(pairs.first[:-1], (3, 1))
    pair_of[0, 0] = pair_of[1, 1] = pair_of[2, 2] = NEW
    pair_of[1, 2] = pairs.first[2] + 1
    decided = decide(pair_of, np.array([0.4, 0.35, 0.25]), pairs)
    assert decided[0] == pairs.first[0]
    assert decided[1] == pairs.first[1]
    assert decided[2] == OPEN, "0.4, 0.35 and 0.25 of the weight"
    assert decide(pair_of, np.array([0.6, 0.2, 0.2]), pairs)[0] == NEW


# --- two trees that stand close -----------------------------------------------------------------------


def knows_trees(trees, **changes: Any):
    """A filter that has seen some trees often."""
    slow = {"particles": 30, "view_range": 0.0, "noise_distance": 0.35, "noise_turn_distance": 0.01}
    slam = FastSlam(preset("forest").slam.model_copy(update=slow | changes), 0)
    for k in range(8):
        slam.process(k, Pose2(), detections(trees, sigma=0.05), NOTHING_SEEN)
    return slam


@pytest.mark.parametrize("beyond", [0.0, 0.2, -0.2])
def test_two_trees_half_a_metre_apart_stay_two_while_another_tree_tells_the_shift(beyond):
    trees = np.array([[6.0, 0.0], [6.5, 0.0], [3.0, 2.0], [2.0, -3.0]])
    slam = knows_trees(trees)
    true, told = Pose2(1.0, 0.0, 0.0), Pose2(1.0 + beyond, 0.0, 0.0)
    estimate = slam.process(8, told, detections(true.inverse().apply(trees), sigma=0.05), NOTHING_SEEN)
    assert abs(estimate.T_map_base.x - 1.0) < 0.05
    known = slam.state.map_of(0)
    assert sorted(known.hits.tolist()) == 4 * [9]


def test_of_two_detections_of_one_tree_the_nearer_one_is_it_and_the_other_is_new():
    slam = knows_trees(np.array([[6.0, 0.0], [9.0, 3.0], [5.0, -4.0]]), noise_distance=0.01)
    seen = np.array([[6.0, 0.01], [6.0, 0.14], [9.0, 3.0], [5.0, -4.0]])
    slam.process(8, Pose2(), detections(seen, sigma=0.05), NOTHING_SEEN)
    known = slam.state.map_of(0)
    assert sorted(known.hits.tolist()) == [1, 9, 9, 9]
