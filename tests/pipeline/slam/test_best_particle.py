"""Choice of the best particle: one hypothesis is kept while the particles disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam.best_particle import are_apart, best_after_resampling, select_best
from pipeline.slam.resampling import low_variance_ancestors, normalised
from tests.pipeline.strategies import detections, seeds


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

    slam = FastSlam(preset("stems").slam, 0)
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
