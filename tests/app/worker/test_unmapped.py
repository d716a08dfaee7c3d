"""A scan that is shown before it is mapped."""

from __future__ import annotations

import numpy as np

from app.worker.unmapped import unmapped_frame
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Scan, Step

MOUNT = Pose3.from_euler(np.array([0.2, 0.0, 1.0]), 0.0, 0.0, 0.5 * np.pi)


def test_its_points_are_levelled_and_stand_at_the_odometry():
    step = Step(3, Scan(7, np.array([[1.0, 0.0, 0.0]], np.float32)), Pose2(4.0, 5.0, 0.1), pitch=0.5 * np.pi)
    frame = unmapped_frame(step, MOUNT)
    assert (frame.index, frame.stamp_ns, frame.estimate.T_map_base) == (3, 7, Pose2(4.0, 5.0, 0.1))
    np.testing.assert_allclose(frame.raw, [[0.0, 1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(frame.sensor_offset, [1.0, 0.0, -0.2], atol=1e-9)
    assert len(frame.filtered) == len(frame.clusters.size) == len(frame.trees.number) == 0
