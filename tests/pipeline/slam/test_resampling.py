"""Low-variance resampling: each particle is drawn in proportion to its weight."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.slam.resampling import low_variance_ancestors, normalised
from tests.pipeline.strategies import seeds

offsets = st.floats(0.0, 1.0, exclude_max=True)


def test_weights_on_three_of_a_hundred_particles_give_those_three():
    weights = np.zeros(100)
    weights[[7, 50, 99]] = [0.2, 0.305, 0.495]
    for offset in (0.0, 0.3, 0.999):
        ancestors = low_variance_ancestors(weights, offset)
        drawn = np.bincount(ancestors, minlength=100)
        assert set(np.flatnonzero(drawn)) == {7, 50, 99}
        assert drawn[7] == 20
        assert drawn[50] in (30, 31)
        assert drawn[99] in (49, 50)


@given(seeds, st.integers(1, 200), offsets, st.floats(0.1, 20.0))
def test_each_particle_is_drawn_as_often_as_its_weight_says(seed, particles, offset, contrast):
    weights = normalised(np.random.default_rng(seed).normal(0, contrast, particles))
    ancestors = low_variance_ancestors(weights, offset)
    drawn = np.bincount(ancestors, minlength=particles)
    assert drawn.sum() == particles
    due = particles * weights
    assert np.all(drawn >= np.floor(due - 1e-9))
    assert np.all(drawn <= np.ceil(due + 1e-9))


@given(seeds, offsets)
def test_survivors_keep_their_slot(seed, offset):
    weights = normalised(np.random.default_rng(seed).normal(0, 2, 40))
    ancestors = low_variance_ancestors(weights, offset)
    np.testing.assert_array_equal(ancestors[ancestors], ancestors)


def test_on_average_each_particle_is_drawn_by_its_weight():
    rng = np.random.default_rng(0)
    weights = normalised(rng.normal(0, 1, 20))
    drawn = np.mean(
        [np.bincount(low_variance_ancestors(weights, rng.random()), minlength=20) for _ in range(4000)],
        axis=0,
    )
    np.testing.assert_allclose(drawn, 20 * weights, atol=0.04)


@pytest.mark.parametrize("offset", [0.0, 0.5, np.nextafter(1.0, 0.0)])
def test_equal_weights_with_any_offset_keep_all_but_the_rounded(offset):
    ancestors = low_variance_ancestors(np.full(100, 0.01), offset)
    assert len(set(ancestors.tolist())) >= 95
    assert low_variance_ancestors(np.ones(1), offset).tolist() == [0]


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50))
def test_weights_sum_to_one_and_keep_their_ratios(logs):
    weights = normalised(np.array(logs))
    assert weights.sum() == pytest.approx(1.0)
    shifted = normalised(np.array(logs) + 12345.0)
    np.testing.assert_allclose(weights, shifted, rtol=1e-6, atol=1e-12)
