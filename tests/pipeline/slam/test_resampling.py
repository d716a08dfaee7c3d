"""Random numbers of a scan, resampling, and the choice of the best particle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam.particle_ancestry import (
    are_apart,
    best_after_resampling,
    draws,
    low_variance_ancestors,
    normalised,
    select_best,
)
from tests.pipeline.strategies import detections, seeds


@given(st.integers(0, 2**70), st.integers(0, 2**40))
def test_seed_and_scan_decide(seed: int, index: int) -> None:
    noise, offset = draws(seed, index, 20)
    again, same = draws(seed, index, 20)
    rng = np.random.default_rng([seed, index])  # numbers of any size are taken alike
    assert noise.tobytes() == again.tobytes() == rng.standard_normal((20, 3)).tobytes()
    assert offset == same == rng.random()
    others = [draws(seed + 1, index, 20), draws(seed, index + 1, 20)]
    assert all(not np.any(np.isin(noise, other)) and offset != at for other, at in others)


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


@given(seeds, st.floats(0.1, 3.0))
def test_while_particles_are_apart_the_best_one_is_kept_until_it_is_not_resampled(seed, power):
    random = np.random.default_rng(seed)
    weights, offset = normalised(power * random.standard_normal(40)), float(random.uniform())
    near, far = random.normal(0.0, 0.2, (40, 3)), random.normal(0.0, 8.0, (40, 3))
    far[weights.argmax(), :2] += 1e3  # however the weights are
    assert (are_apart(near, weights, 1.0), are_apart(far, weights, 1.0)) == (False, True)
    assert select_best(weights, 7, near, 1.0) == weights.argmax()
    assert select_best(weights, 7, far, 1.0) == 7
    ancestors = low_variance_ancestors(weights, offset)
    chosen = best_after_resampling(7, ancestors, weights)
    assert ancestors[chosen] == chosen, "a survivor keeps its slot"
    assert chosen == (7 if 7 in ancestors else weights.argmax())


def test_while_particles_are_apart_the_reported_pose_is_that_of_a_particle():
    from pipeline.slam import FastSlam
    from tests.pipeline.strategies import NOTHING_SEEN

    slam = FastSlam(preset("stems").slam.model_copy(update={"update_distance": 0.0}), 0)
    slam.place(0, Pose2(3.0, 1.0, 0.0), np.diag([25.0, 25.0, 0.01]))
    told = slam.process(1, Pose2(0.1, 0.0, 0.0), detections([]), NOTHING_SEEN)
    assert told.T_map_base.as_array().tobytes() in {row.tobytes() for row in told.particles}
    away = told.particles - told.T_map_base.as_array()
    about_it = (told.weights[:, None] * away).T @ away
    assert told.relative is not None
    for covariance in (told.covariance, told.relative):
        assert np.linalg.eigvalsh(covariance - about_it).min() > -1e-3, "of that pose, not of the mean"
    slam.state = replace(slam.state, pose=np.tile([3.0, 1.0, 0.0], (100, 1)))
    told = slam.process(2, Pose2(), detections([]), NOTHING_SEEN)
    assert told.T_map_base.x == pytest.approx(3.0, abs=0.01)
