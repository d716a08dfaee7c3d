"""A merged map: what is known of the second map's frame is known of its landmarks."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints.merged_map import merge_maps
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.types.records import Columns
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


def test_the_marks_of_both_frames_are_kept_and_the_second_s_are_as_sure_as_its_place():
    m = mapper()
    fed(m, run()[0][:6])
    state = SavedMap.of(m)
    assert len(state.slam.frame.serial)
    T, sigma = Pose2(50.0, -30.0, 0.7), 0.01
    covariance = np.diag([0.2, 0.3, sigma]) ** 2
    merged = merge_maps(state, state, T, covariance, 10**12, m.parameters).map
    merged.state()  # it can be gone on from
    assert merged.placed == len(state.stamp_ns), "no odometry leads from one run to the other"
    assert len(merged.motion) == 2 * len(state.stamp_ns)
    was, now = state.slam.frame, merged.slam.frame
    n = len(was.serial)
    assert now.serial.tolist() == [*was.serial, *(was.serial + state.slam.detections)]
    np.testing.assert_allclose(now.pose[n:, :2], T.apply(was.pose[:, :2]))
    grown = np.trace(now.covariance[n:, :2, :2], axis1=1, axis2=2)
    before = np.trace(was.covariance[:, :2, :2], axis1=1, axis2=2)
    lever = np.sum(was.pose[:, :2] ** 2, axis=1)
    np.testing.assert_allclose(grown - before, 0.13 + sigma**2 * lever, rtol=1e-9)


def test_all_that_is_known_of_the_columns_of_both_is_kept():
    m = mapper()
    fed(m, run()[0][:12])
    state = SavedMap.of(m)
    assert len(state.columns.verdict)
    merged = merge_maps(state, state, Pose2(200.0, 0.0, 0.3), np.eye(3) * 1e-4, 10**12, m.parameters).map
    for field in fields(Columns):
        if field.name not in ("tile", "axis"):
            once = getattr(state.columns, field.name)
            np.testing.assert_array_equal(getattr(merged.columns, field.name), np.concatenate([once, once]))
    assert merged.search is None
