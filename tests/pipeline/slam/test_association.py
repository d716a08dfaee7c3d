"""Data association: one to one, by likelihood, within the gate."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.slam.association import associate
from tests.pipeline.strategies import seeds

SMALL = np.array([[1e-3, 0.0, 1e-3]])


def join(centre, mean, *, R=SMALL, P=SMALL, gate=3.0, distance_max=1.0):
    """Associate with the same covariance for all."""
    centre = np.asarray(centre, np.float64).reshape(-1, 2)
    mean = np.asarray(mean, np.float64).reshape(-1, 2)
    return associate(
        centre, np.repeat(R, len(centre), axis=0), mean, np.repeat(P, len(mean), axis=0), gate, distance_max
    )


@given(seeds, st.integers(0, 8), st.integers(0, 8))
def test_pairs_are_one_to_one_and_within_gate_and_reach(seed, detections, landmarks):
    rng = np.random.default_rng(seed)
    centre, mean = rng.uniform(-1, 1, (detections, 2)), rng.uniform(-1, 1, (landmarks, 2))
    row, squared = join(centre, mean, P=np.array([[0.02, 0.005, 0.01]]), distance_max=0.7)
    used = row[row >= 0]
    assert len(set(used.tolist())) == len(used)
    assert np.all(row < landmarks)
    for d in np.flatnonzero(row >= 0):
        y = centre[d] - mean[row[d]]
        S = np.array([[0.021, 0.005], [0.005, 0.011]])
        assert squared[d] == pytest.approx(y @ np.linalg.solve(S, y))
        assert squared[d] <= 9.0
        assert np.hypot(*y) <= 0.7


@given(seeds, st.integers(1, 5))
def test_clear_cases_are_joined_as_the_best_of_all_assignments(seed, n):
    rng = np.random.default_rng(seed)
    mean = np.stack([np.arange(n) * 1.0, rng.uniform(-1, 1, n)], axis=1)
    order = rng.permutation(n)
    centre = mean[order] + rng.normal(0, 0.02, (n, 2))
    row, _ = join(centre, mean)
    np.testing.assert_array_equal(row, order)
    cost = ((centre[:, None] - mean[None]) ** 2).sum(axis=2)
    best = min(itertools.permutations(range(n)), key=lambda p: cost[np.arange(n), p].sum())
    np.testing.assert_array_equal(row, best)


@given(seeds, st.integers(0, 40), st.integers(0, 40), st.floats(0.05, 10.0), st.floats(0.3, 5.0))
def test_every_pair_within_reach_is_weighed(seed, detections, landmarks, distance_max, gate):
    """Against all pairs by brute force, ties by the landmark and then by the detection that comes first."""
    rng = np.random.default_rng(seed)
    centre, mean = (np.round(rng.uniform(-9, 9, (n, 2)), 1) for n in (detections, landmarks))
    R, P = (np.array([[v, 0.2 * v, 1.5 * v]]) for v in (0.02, 0.3))
    row, squared = join(centre, mean, R=R, P=P, gate=gate, distance_max=distance_max)
    (a, b, e), pairs = (R + P)[0], []
    for j, d in itertools.product(range(landmarks), range(detections)):
        y0, y1 = centre[d] - mean[j]
        d2 = (e * y0 * y0 - 2 * b * y0 * y1 + a * y1 * y1) / (a * e - b * b)
        if y0 * y0 + y1 * y1 <= distance_max * distance_max and d2 <= gate * gate:
            pairs.append((d2, j, d))
    wanted, taken = np.full(detections, -1), set()
    for d2, j, d in sorted(pairs, key=lambda pair: pair[0] + np.log(a * e - b * b)):
        if wanted[d] < 0 and j not in taken:
            wanted[d] = j
            taken.add(j)
            assert squared[d] == d2
    assert row.tolist() == wanted.tolist()


def test_the_likelier_landmark_is_the_surer_of_two_as_far():
    P = np.array([[0.1, 0.0, 0.1], [0.001, 0.0, 0.001]])
    row, _ = associate(np.zeros((1, 2)), SMALL, np.array([[0.05, 0.0], [-0.05, 0.0]]), P, 3.0, 1.0)
    assert row.tolist() == [1]


def test_more_pairs_than_first_room_was_made_for():
    centre, mean = np.zeros((3, 2)), np.zeros((200, 2))
    row, _ = join(centre, mean)
    assert len(set(row.tolist())) == 3
    assert row.min() >= 0


@pytest.mark.parametrize(("centre", "mean"), [([], []), ([], [[0, 0]]), ([[0, 0]], [])])
def test_nothing_to_join(centre, mean):
    row, _ = join(centre, mean)
    assert row.tolist() == [-1] * len(centre)
