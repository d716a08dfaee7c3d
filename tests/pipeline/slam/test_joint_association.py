"""Joint association of ambiguous detections against all assignments, and where the most likely single pair is
wrong."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from pipeline.config import preset
from pipeline.geometry.gaussian import pose_of
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.joint_association import CHOICES, MOST, choose_jointly, search_for
from tests.pipeline.strategies import NOTHING_SEEN, detections, seeds

GATE2 = 12.25
WELL = 3  # hits


def scene(seed, n, trees=6):
    """A pose that is known badly among trees that stand close, and what is seen from it."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-1.0, 1.0, (trees, 2)) + np.array([4.0, 1.0])
    covariance = np.tile([0.004, 0.001, 0.006], (trees, 1)) * rng.uniform(0.5, 2.0, (trees, 1))
    A = rng.normal(size=(3, 3)) * [[0.3], [0.3], [0.05]]
    mu, P = np.array([*rng.normal(0.0, 0.3, 2), rng.normal(0.0, 0.05)]), A @ A.T + 1e-6 * np.eye(3)
    centre = mean[rng.permutation(trees)[:n]] + rng.normal(0.0, 0.1, (n, 2))
    R = np.tile([0.005, -0.001, 0.003], (n, 1))
    hits = rng.choice([1, 5], trees).astype(np.int32)
    return mu, P, centre, R, mean, covariance, hits, rng


def filled(scene_, n, choices, rng):
    """Levels of the search, with random landmarks that are no more likely for standing first."""
    search, trees = search_for(), len(scene_[4])
    for i in range(n):
        search.detection[i], search.choices[i] = i, choices
        search.landmark[i, :choices] = rng.permutation(trees)[:choices]
    return search


def full(rows):
    return np.array([[rows[0], rows[1]], [rows[1], rows[2]]])


def innovation(mu, P, z, R, m, Sigma):
    """y, S and the Jacobian of the expected place, by the textbook."""
    c, s = np.cos(mu[2]), np.sin(mu[2])
    C = np.array([[c, -s], [s, c]])
    a = C @ z
    J = np.array([[1.0, 0.0, -a[1]], [0.0, 1.0, a[0]]])
    return m - mu[:2] - a, J @ P @ J.T + C @ full(R) @ C.T + full(Sigma), J


def cost_of(choice, mu, P, centre, R, mean, covariance, hits):
    """-2 log likelihood of one choice for each detection, pair by pair; infinite beyond the gate."""
    new = [
        GATE2 + np.log(np.linalg.det(innovation(mu, P, z, r, np.zeros(2), np.zeros(3))[1]))
        for z, r in zip(centre, R, strict=True)
    ]
    total = 0.0
    for d, j in enumerate(choice):
        if j < 0:
            total += new[d]
            continue
        y, S, J = innovation(mu, P, centre[d], R[d], mean[j], covariance[j])
        d2 = y @ np.linalg.solve(S, y)
        if d2 > GATE2:
            return np.inf
        total += d2 + np.log(np.linalg.det(S))
        if hits[j] >= WELL:
            K = P @ J.T @ np.linalg.inv(S)
            mu, P = mu + K @ y, P - K @ J @ P
    return total


def searched(scene_, n, search, gate2=GATE2):
    mu, P, centre, R, mean, covariance, hits, _ = scene_
    taken = np.zeros(len(mean), np.bool_)
    cost = choose_jointly(pose_of(mu, P), centre, R, mean, covariance, hits, gate2, WELL, taken, n, search)
    assert not taken.any()
    return cost, search.best[:n].tolist()


@pytest.mark.parametrize(("n", "choices"), [(1, 4), (3, 2), (4, 3)])
@given(seed=seeds)
def test_the_choice_is_the_likeliest_of_all(n, choices, seed):
    given_ = scene(seed, n)
    search = filled(given_, n, choices, given_[-1])
    cost, chosen = searched(given_, n, search)
    all_choices = product(*[[*search.landmark[i, :choices].tolist(), -1] for i in range(n)])
    one_to_one = [c for c in all_choices if len({j for j in c if j >= 0}) == sum(j >= 0 for j in c)]
    costs = [cost_of(c, *given_[:7]) for c in one_to_one]
    assert cost == pytest.approx(min(costs), abs=1e-6)
    assert cost_of(chosen, *given_[:7]) == pytest.approx(cost, abs=1e-6)


@given(seeds)
def test_pair_by_pair_is_the_likelihood_of_all_pairs_together(seed):
    """One Gaussian of all innovations, which share the error of the pose, linearised at one place."""
    n = 3
    given_ = scene(seed, n, trees=n)
    mu, P, centre, R, mean, covariance, hits, _ = given_
    hits[:] = WELL
    P[:] = 1e-4 * P  # so that the place of linearising is no matter
    search = filled(given_, n, 1, np.random.default_rng(seed))
    search.landmark[:n, 0] = np.arange(n)
    cost, chosen = searched(given_, n, search, gate2=1e9)
    assert chosen == [0, 1, 2]
    y, S = np.zeros(2 * n), np.zeros((2 * n, 2 * n))
    J = []
    for d in range(n):
        y[2 * d : 2 * d + 2], own, jacobian = innovation(
            mu, np.zeros((3, 3)), centre[d], R[d], mean[d], covariance[d]
        )
        S[2 * d : 2 * d + 2, 2 * d : 2 * d + 2] = own
        J.append(jacobian)
    H = np.vstack(J)
    S += H @ P @ H.T
    assert cost == pytest.approx(y @ np.linalg.solve(S, y) + np.linalg.slogdet(S)[1], rel=0.02, abs=0.2)


@pytest.mark.parametrize("scale", [0.02, 50.0])
@given(seed=seeds)
def test_the_choice_does_not_depend_on_the_unit_of_length(scale, seed):
    n, (mu, P, centre, R, mean, covariance, hits, rng) = 4, scene(seed, 4)
    search = filled((mu, P, centre, R, mean, covariance, hits), n, 4, rng)
    cost, chosen = searched((mu, P, centre, R, mean, covariance, hits, rng), n, search)
    unit, squared = np.array([scale, scale, 1.0]), scale * scale
    scaled = (
        mu * unit, P * np.outer(unit, unit), centre * scale, R * squared, mean * scale,
        covariance * squared, hits, rng,
    )  # fmt: skip
    cost_scaled, chosen_scaled = searched(scaled, n, search)
    assert chosen_scaled == chosen
    assert cost_scaled == pytest.approx(cost + n * np.log(squared**2), abs=1e-6), "log |S| of each detection"


@given(seeds)
def test_many_ambiguous_detections_end_and_are_never_worse_than_no_landmark_at_all(seed):
    given_ = scene(seed, MOST, trees=MOST)
    search = filled(given_, MOST, CHOICES, given_[-1])
    cost, chosen = searched(given_, MOST, search)
    known = [j for j in chosen if j >= 0]
    assert len(set(known)) == len(known)
    assert cost <= cost_of([-1] * MOST, *given_[:7]) + 1e-6
    assert cost == pytest.approx(cost_of(chosen, *given_[:7]), abs=1e-6)


def knows_two_trees(trees, **changes: Any):
    """A filter that has seen two trees often, and then takes a step with poor odometry."""
    slow = {
        "particles": 30,
        "view_range": 0.0,
        "noise_distance": 0.35,
        "noise_turn_distance": 0.01,
        "update_distance": 0.0,
    }
    slam = FastSlam(preset("forest").slam.model_copy(update=slow | changes), 0)
    for k in range(8):
        slam.process(k, Pose2(), detections(trees, sigma=0.05), NOTHING_SEEN)
    return slam


@pytest.mark.parametrize("beyond", [0.0, 0.3, -0.3])
def test_two_trees_half_a_metre_apart_stay_two_whatever_the_shift_of_the_pose(beyond):
    """The first tree is seen nearer to the place of the second than to its own: taken alone it would be that
    one, and the second a new tree."""
    trees = np.array([[6.0, 0.0], [6.5, 0.0]])
    slam = knows_two_trees(trees)
    true, told = Pose2(1.0, 0.0, 0.0), Pose2(1.0 + beyond, 0.0, 0.0)
    estimate = slam.process(8, told, detections(true.inverse().apply(trees), sigma=0.05), NOTHING_SEEN)
    assert abs(estimate.T_map_base.x - 1.0) < 0.05
    assert {len(slam.state.map_of(p).hits) for p in range(30)} == {2}
    np.testing.assert_allclose(np.sort(slam.state.map_of(0).mean[:, 0]), [6.0, 6.5], atol=0.05)


def test_of_two_detections_of_one_tree_the_nearer_one_is_it_and_the_other_is_new():
    slam = knows_two_trees(np.array([[6.0, 0.0], [9.0, 3.0], [5.0, -4.0]]), noise_distance=0.01)
    seen = np.array([[6.0, 0.01], [6.0, 0.14], [9.0, 3.0], [5.0, -4.0]])
    slam.process(8, Pose2(), detections(seen, sigma=0.05), NOTHING_SEEN)
    known = slam.state.map_of(0)
    assert sorted(known.hits.tolist()) == [1, 9, 9, 9]
