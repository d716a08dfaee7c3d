"""Merged maps: the second map is moved into the frame of the first one with its uncertainty."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from app.extensions.maps.merged_map import merge_maps
from pipeline.geometry.pose_arrays import composed
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.tracking.observation import SECTORS
from pipeline.types.records import Columns
from tests.pipeline.test_mapper import fed, mapper, run

T = Pose2(1000.0, -300.0, 0.7)
# Of T, with correlations; the lever arms in the map are a few metres.
COVARIANCE = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 4e-4]])


def expected(covariance, mean):
    """Covariances of places of the second map in the first one, by a numerical Jacobian.

    Args:
        covariance: In the frame of the second map, shape (N, 2, 2).
        mean: In the same frame, shape (N, 2) [m].
    """
    h = 1e-4
    shifted = [Pose2(T.x + dx, T.y + dy, T.yaw + dyaw) for dx, dy, dyaw in h * np.eye(3)]
    J = np.stack([(pose.apply(mean) - T.apply(mean)) / h for pose in shifted], axis=-1)
    c, s = np.cos(T.yaw), np.sin(T.yaw)
    C = np.array([[c, -s], [s, c]])
    return C @ covariance @ C.T + J @ COVARIANCE @ J.transpose(0, 2, 1)


def full(flat):
    """Matrices of rows xx, xy, yy."""
    return flat[:, [[0, 1], [1, 2]]]


def test_landmarks_and_tracks_of_the_second_map_are_moved_with_their_full_covariances():
    m = mapper()
    fed(m, run()[0][:4])
    state = SavedMap.of(m)
    merged = merge_maps(state, state, T, COVARIANCE, 10**12, m.parameters)
    before = state.slam.map_of(state.slam.best)
    after = merged.map.slam.map_of(merged.map.slam.best)
    n = len(before.hits)
    assert n >= 3
    np.testing.assert_allclose(after.mean[n:], T.apply(before.mean))
    wanted = expected(full(before.covariance), before.mean)
    np.testing.assert_allclose(full(after.covariance)[n:], wanted, rtol=1e-2, atol=1e-5)
    was = state.tracks
    track = merged.map.tracks.take(np.arange(len(merged.map.tracks)) >= len(was))
    np.testing.assert_allclose(track.x[:, :2], T.apply(was.x[:, :2]))
    np.testing.assert_allclose(
        track.P[:, :2, :2], expected(was.P[:, :2, :2], was.x[:, :2]), rtol=1e-2, atol=1e-5
    )
    np.testing.assert_allclose(track.shared, expected(was.shared, was.x[:, :2]), rtol=1e-2, atol=1e-5)


def test_path_keyframes_and_columns_of_the_second_map_turn_with_it():
    m = mapper()
    fed(m, run()[0][:6])
    state = SavedMap.of(m)
    state.slam.frame.pose[:, 2] = 0.3
    n = len(state.columns.axis)
    lean = np.array([0.0, 0.0, 0.05, 0.02])
    axis = np.vstack([state.columns.axis, np.pad(lean, (0, state.columns.axis.shape[1] - 4))])[-1:]
    columns = {f.name: getattr(state.columns, f.name) for f in fields(Columns)}
    empty = {name: np.zeros((1, *column.shape[1:]), column.dtype) for name, column in columns.items()}
    one = replace(state, columns=Columns(**{**empty, "axis": axis}))
    merged = merge_maps(state, one, T, COVARIANCE, 10**12, m.parameters).map
    path = state.slam.path.poses()
    moved = merged.slam.path.poses()[len(path) :]
    np.testing.assert_allclose(moved, composed(np.tile(T.as_array(), (len(path), 1)), path), atol=1e-9)
    of_second = merged.slam.frame.pose[-len(state.slam.frame.serial) :]
    np.testing.assert_allclose(of_second[:, 2], 0.3 + T.yaw)
    assert len(merged.columns.axis) == n + 1
    np.testing.assert_allclose(merged.columns.axis[-1, :2], [T.x, T.y])
    np.testing.assert_allclose(merged.columns.axis[-1, 2:4], T.rotation() @ lean[2:4])


def test_the_sides_from_which_a_tree_was_seen_turn_with_the_second_map():
    m = mapper()
    fed(m, run()[0][:4])
    state = SavedMap.of(m)
    state.tracks.sides[:] = 0b11  # the first two sectors from the x axis of the map on
    quarter = Pose2(500.0, 0.0, np.pi / 2.0)
    merged = merge_maps(state, state, quarter, COVARIANCE, 10**12, m.parameters).map.tracks
    assert set(merged.sides[len(state.tracks) :].tolist()) == {0b11 << (SECTORS // 4)}


def test_keyframes_of_both_maps_are_kept_and_those_of_the_second_have_the_covariance_of_its_place():
    m = mapper()
    fed(m, run()[0][:6])
    state = SavedMap.of(m)
    assert len(state.slam.frame.serial)
    state.slam.frame.covariance[:] = COVARIANCE
    merged = merge_maps(state, state, T, COVARIANCE, 10**12, m.parameters).map
    merged.state()  # mapping can continue from it
    assert merged.placed == len(state.stamp_ns), "no odometry connects the two runs"
    assert len(merged.motion) == 2 * len(state.stamp_ns)
    was, now = state.slam.frame, merged.slam.frame
    n = len(was.serial)
    assert now.serial.tolist() == [*was.serial, *(was.serial + state.slam.detections)]
    np.testing.assert_allclose(now.pose[n:, :2], T.apply(was.pose[:, :2]))
    wanted = expected(was.covariance[:, :2, :2], was.pose[:, :2])
    np.testing.assert_allclose(now.covariance[n:, :2, :2], wanted, rtol=1e-2, atol=1e-5)


def test_all_fields_of_the_columns_of_both_maps_are_kept():
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
