"""Matching of points: as many pairs as possible with the least total distance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from pipeline.evaluation import match
from pipeline.geometry.poses import Float

REACH = 0.5
SIDES = st.sampled_from([0.7, 3.0, 20.0])


def whole(found: Float, truth: Float) -> tuple[int, float]:
    """How many pairs can be made and how short their sum is, by one matrix of all [m]."""
    distance = np.hypot(*(found[:, None, :] - truth[None, :, :]).transpose(2, 0, 1))
    cost = np.where(distance <= REACH, distance, 1e3)
    rows, columns = linear_sum_assignment(cost)
    good = distance[rows, columns] <= REACH
    return int(good.sum()), float(distance[rows, columns][good].sum())


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), SIDES)
def test_groups_that_share_no_pair_give_what_the_whole_gives(seed: int, n: int, m: int, side: float):
    rng = np.random.default_rng(seed)
    found, truth = rng.uniform(0.0, side, (n, 2)), rng.uniform(0.0, side, (m, 2))
    partner = match(found, truth, REACH)
    taken = partner[partner >= 0]
    assert len(set(taken.tolist())) == len(taken)
    distance = np.hypot(*(found[partner >= 0] - truth[taken]).T)
    count, total = whole(found, truth)
    assert len(taken) == count
    assert np.all(distance <= REACH)
    np.testing.assert_allclose(distance.sum(), total, atol=1e-9)


def test_two_long_pairs_are_better_than_a_short_one():
    found, truth = np.array([[0.0, 0.0], [3.0, 0.0]]), np.array([[0.1, 0.0], [-2.9, 0.0]])
    assert match(found, truth, 3.0).tolist() == [1, 0]
    assert match(0.01 * found, 0.01 * truth, 0.03).tolist() == [1, 0]


@pytest.mark.slow
def test_many_trees_need_no_matrix_of_all_pairs():
    """40,000 squared distances would be 13 GB."""
    rng = np.random.default_rng(1)
    truth = np.stack(np.meshgrid(np.arange(200.0), np.arange(200.0)), axis=-1).reshape(-1, 2)
    order = rng.permutation(len(truth))
    found = truth[order] + rng.uniform(-0.2, 0.2, truth.shape)
    np.testing.assert_array_equal(match(found, truth, REACH), order)


def test_what_is_not_finite_has_no_partner():
    found = np.array([[np.nan, 0.0], [0.0, np.inf], [1.0, 1.0]])
    assert match(found, np.array([[1.0, 1.0], [np.nan, 0.0]]), REACH).tolist() == [-1, -1, 0]
    assert match(found[:2], found[:2], REACH).tolist() == [-1, -1]
    assert match(np.zeros((0, 2)), found, REACH).tolist() == []
    assert match(found, np.zeros((0, 2)), REACH).tolist() == [-1, -1, -1]
