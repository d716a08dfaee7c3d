"""A merged map: what is known of the second map's frame is known of its landmarks."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Pose2
from pipeline.merged_map import merge_maps
from pipeline.saved_map import SavedMap
from tests.pipeline.test_mapper import fed, mapper, run


def test_an_unsure_heading_makes_far_landmarks_unsure_across():
    """sigma^2 d^2 is added across the line to the frame's origin: no sum of variances of x and y alone."""
    m = mapper()
    fed(m, run()[0][:4])
    state = SavedMap.of(m)
    T, sigma = Pose2(1000.0, -300.0, 0.7), 0.01
    merged = merge_maps(state, state, T, np.diag([0.0, 0.0, sigma]) ** 2, 10**12, m.parameters)
    before = state.slam.map_of(state.slam.best)
    after = merged.map.slam.map_of(merged.map.slam.best)
    n = len(before.hits)
    assert n >= 3
    np.testing.assert_allclose(after.mean[n:], T.apply(before.mean))
    d2 = np.sum(before.mean**2, axis=1)
    gained = after.covariance[n:][:, [0, 2]].sum(axis=1) - before.covariance[:, [0, 2]].sum(axis=1)
    np.testing.assert_allclose(gained, sigma**2 * d2, rtol=1e-9)
    track = merged.map.tracks.take(np.arange(len(merged.map.tracks)) >= len(state.tracks))
    own = np.sum(state.tracks.x[:, :2] ** 2, axis=1)
    grown = np.trace(track.P[:, :2, :2], axis1=1, axis2=2)
    was = np.trace(state.tracks.P[:, :2, :2], axis1=1, axis2=2)
    np.testing.assert_allclose(grown - was, sigma**2 * own, rtol=1e-9)
