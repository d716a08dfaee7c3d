"""Measured poses beside scans: which of them, if any, tells where the base was when a scan was taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.geometry.poses import Pose2
from pipeline.types.records import PoseMeasurement

SAME_TIME_NS = 50_000_000
CARRIED_NS = 500_000_000  # a whole pose this old is carried on by the odometry, which errs by
CARRIED = 0.05  # of the way and of the turn
NO_HEADING = 1.0  # rad^2; who says no more of the heading than this says nothing
MOST = 64


class MeasuredInTime:
    """The newest measured poses, and apart from them the newest places: poses without a heading, as GNSS
    fixes are, which no odometry can carry on."""

    def __init__(self) -> None:
        self._places: deque[PoseMeasurement] = deque(maxlen=MOST)
        self._poses: deque[PoseMeasurement] = deque(maxlen=MOST)

    def add(self, pose: PoseMeasurement) -> bool:
        """Keep a sound pose; whether it is later than the one before of its kind, else it is not kept."""
        kept = self._places if pose.covariance[2, 2] >= NO_HEADING else self._poses
        if kept and pose.stamp_ns <= kept[-1].stamp_ns:
            return False
        kept.append(pose)
        return True

    def at(
        self, stamp_ns: int, T_odom_base: Pose2 | None, odometry_at: Callable[[int], Pose2] | None
    ) -> PoseMeasurement | None:
        """The measured pose of a scan. A place that lies farther away in time is of another place; a whole
        pose is carried on by the odometry, and used once.

        Args:
            stamp_ns: Of the scan.
            T_odom_base: The odometry then, None where it is not known.
            odometry_at: Gives T_odom_base at an earlier time, None where there is no odometry.
        """
        near = min(self._places, key=lambda pose: abs(pose.stamp_ns - stamp_ns), default=None)
        if near is not None and abs(near.stamp_ns - stamp_ns) <= SAME_TIME_NS:
            return near
        latest = None
        while self._poses and self._poses[0].stamp_ns <= stamp_ns:
            latest = self._poses.popleft()
        if latest is None or stamp_ns - latest.stamp_ns > CARRIED_NS:
            return None
        if T_odom_base is None or odometry_at is None:
            return latest if stamp_ns - latest.stamp_ns <= SAME_TIME_NS else None
        return _carried(latest, odometry_at(latest.stamp_ns).inverse() @ T_odom_base, stamp_ns)


def _carried(pose: PoseMeasurement, step: Pose2, stamp_ns: int) -> PoseMeasurement:
    """A measured pose, moved by a step of the odometry to a later time: P' = F P F^T + Q."""
    error = CARRIED * float(np.hypot(step.x, step.y))
    at = pose.T_map_base @ step
    dx, dy = at.x - pose.T_map_base.x, at.y - pose.T_map_base.y
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    Q = np.diag([error**2, error**2, (CARRIED * step.yaw) ** 2])
    covariance = F @ pose.covariance @ F.T + Q
    shared = None if pose.shared is None else F @ pose.shared
    return replace(pose, stamp_ns=stamp_ns, T_map_base=at, covariance=covariance, shared=shared)
