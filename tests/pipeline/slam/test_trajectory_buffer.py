"""Buffer of the path: scans are appended to any number of earlier ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose2
from pipeline.slam.particle_ancestry import EstimatedPath, TrajectoryBuffer
from pipeline.types.records import Path


@pytest.mark.parametrize("before", [None, 0, 1, 3, 64])
def test_scans_are_appended_to_a_path_of_any_length(before):
    n = before or 0
    earlier = () if before is None else (np.arange(n), np.full(n, 0.5), np.tile([[1.0, 0.0, 0.0]], (n, 1)))
    path = TrajectoryBuffer(*earlier)
    for k in range(n, n + 130):
        path.append(k, Pose2(0.1 * k, 0.0, 0.0))
        path.set_sigma(np.eye(3))
    assert path.stamp_ns.tolist() == list(range(n + 130))
    np.testing.assert_array_equal(path.motion[n:, 0], 0.1 * np.arange(n, n + 130))
    assert path.sigma_xy.tolist() == [0.5] * n + [1.0] * 130


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 40)), min_size=1, max_size=40))
def test_paths_have_the_poses_of_their_time_and_never_change(moves):
    """A scan with True corrects the path from a row onwards; False goes back to that length."""
    buffer, poses = TrajectoryBuffer(), np.zeros((0, 3))
    given_paths: list[tuple[Path, np.ndarray]] = []
    for number, (is_correction, row) in enumerate(moves):
        if is_correction:
            poses = poses + (np.arange(len(poses)) >= row)[:, None]
        elif row < len(poses):
            buffer.return_to(row)
            poses = poses[:row]
        buffer.append(number, Pose2())
        buffer.set_sigma(number**2 * np.eye(3))
        poses = np.concatenate([poses, [[0.5 * number, 1.0, 2.0]]])
        if number % 3:
            given_paths.append((buffer.path(EstimatedPath.of(poses)), poses))
    for path, expected in given_paths:
        np.testing.assert_array_equal(np.stack([path.x, path.y, path.yaw], axis=1), expected)
        assert path.stamp_ns[-1] == path.sigma_xy[-1]


def test_a_return_forward_has_the_scans_that_were_there():
    buffer, poses = TrajectoryBuffer(), np.zeros((200, 3))
    for number in range(200):
        buffer.append(number, Pose2())
        buffer.set_sigma(number**2 * np.eye(3))
    buffer.path(EstimatedPath.of(poses))
    buffer.return_to(20)
    buffer.append(20, Pose2())
    buffer.set_sigma(20**2 * np.eye(3))
    buffer.path(EstimatedPath.of(poses[:21]))
    buffer.return_to(150)
    path = buffer.path(EstimatedPath.of(poses[:150]))
    assert path.stamp_ns.tolist() == path.sigma_xy.tolist() == list(range(150))
    np.testing.assert_array_equal(path.x, 0.0)


def test_a_scan_takes_64_bytes_and_24_of_the_estimate():
    scans = 3_000
    buffer, estimate = TrajectoryBuffer(), EstimatedPath()
    for number in range(scans):
        estimate = estimate.with_pose(np.array([np.cos(0.01 * number), np.sin(0.01 * number), 0.0]))
        buffer.append(number, Pose2())
        buffer.set_sigma(np.eye(3))
        buffer.path(estimate)
    assert sum(column.nbytes for column in buffer._rows._columns) <= 2 * 64 * scans  # the capacity doubles
    assert sum(block.nbytes for block in (*estimate.blocks, estimate.newest)) == 24 * scans
