"""Poses that stand in a text file as the odometry of a source: TUM rows with times, KITTI rows a scan."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.poses_file import TextError, read_any_poses
from pipeline.types.records import Int, Odometry, Record, Scan

#: Rows without times, counted against the scans that could be read.
TOO_MANY = "rows of poses without a scan; if scans are missing between others, later ones have wrong poses"
TOO_FEW = "scans after the last row of the poses"


class PoseTable:
    """Gives each scan the pose that a file tells for it, as Odometry before it.

    Rows with times (TUM) are poses of the LiDAR at those times, in the clock of the source; between two
    of them the pose is interpolated. Rows without times (KITTI) belong to the scans in their order; a scan
    that cannot be read takes no row, so that rows which are left at the end may mean that later scans have
    rows of others: that is told.

    Args:
        path: The file.
        T_base_lidar: Where the LiDAR stands.

    Attributes:
        losses: Rows or scans that are left over at the end, by reason.

    Raises:
        SourceError: It cannot be read.
    """

    def __init__(self, path: Path, T_base_lidar: Pose3) -> None:
        try:
            self._times, self._poses = read_any_poses(path)
        except (TextError, OSError) as error:
            reason = str(error) if isinstance(error, TextError) else error.strerror
            raise SourceError(
                f"no poses can be read: {reason}",
                where=str(path),
                remedy="Rows are t x y z qx qy qz qw (TUM) or the 12 numbers of a 3 x 4 matrix (KITTI).",
            ) from None
        self._T_lidar_base = T_base_lidar.inverse()
        self._row_of: dict[int, int] = {}
        self.losses: dict[str, int] = {}

    def add(self, record: Record) -> Iterator[Record]:
        """The records that stand for one: other odometry is left aside, a scan has its pose before it."""
        if isinstance(record, Odometry):
            return
        if isinstance(record, Scan):
            pose = self._pose_of(record.stamp_ns)
            if pose is not None:
                yield Odometry(record.stamp_ns, pose @ self._T_lidar_base)
        yield record

    def end(self) -> None:
        """Count what is left over of rows without times."""
        left = 0 if self._times is not None else len(self._poses) - len(self._row_of)
        self.losses = {reason: n for reason, n in ((TOO_MANY, left), (TOO_FEW, -left)) if n > 0}

    def _pose_of(self, stamp_ns: int) -> Pose3 | None:
        if self._times is not None:
            return pose_at(self._times, self._poses, stamp_ns)
        row = self._row_of.setdefault(stamp_ns, len(self._row_of))
        return self._poses[row] if row < len(self._poses) else None


#: No pose is told for a time that lies farther from the rows [ns].
_FAR_NS = 1_000_000_000


def pose_at(times: Int, poses: list[Pose3], stamp_ns: int) -> Pose3 | None:
    """The pose at a time between two rows, that of the nearest row at the ends; None far from any.

    Args:
        times: Ascending [ns], shape (N,), N >= 1.
    """
    after = int(np.searchsorted(times, stamp_ns))
    before = max(after - 1, 0)
    after = min(after, len(poses) - 1)
    if min(abs(int(times[before]) - stamp_ns), abs(int(times[after]) - stamp_ns)) > _FAR_NS:
        return None
    span = int(times[after]) - int(times[before])
    if span <= 0 or not int(times[before]) <= stamp_ns <= int(times[after]):
        near = before if abs(int(times[before]) - stamp_ns) <= abs(int(times[after]) - stamp_ns) else after
        return poses[near]
    return between(poses[before], poses[after], (stamp_ns - int(times[before])) / span)


def between(first: Pose3, second: Pose3, fraction: float) -> Pose3:
    """From one pose to another: the position on a line, the attitude on the great arc (slerp)."""
    q, p = first.quaternion(), second.quaternion()
    dot = float(q @ p)
    if dot < 0.0:
        p, dot = -p, -dot
    if dot > 0.9995:
        mixed = (1.0 - fraction) * q + fraction * p
    else:
        angle = np.arccos(min(dot, 1.0))
        mixed = (np.sin((1.0 - fraction) * angle) * q + np.sin(fraction * angle) * p) / np.sin(angle)
    return Pose3.from_quaternion((1.0 - fraction) * first.t + fraction * second.t, mixed)
