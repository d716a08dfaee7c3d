"""Buffer of the path: scans are appended to any number of earlier ones."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.poses import Pose2
from pipeline.slam.trajectory_buffer import TrajectoryBuffer


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
