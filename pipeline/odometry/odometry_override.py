"""Odometry that replaces that of a source: poses from a text file, or another estimator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import Source, SourceDescription, count_loss
from pipeline.io.readers.pose_files import TextError, pose_at, read_any_poses
from pipeline.types.records import Odometry, Record, Scan, Truth


class OdometryEstimator(Protocol):
    """Tells the motion of a source whose records it is given one by one.

    Attributes:
        losses: What got no pose, by reason.
    """

    losses: dict[str, int]

    def add(self, record: Record) -> Iterator[Record]:
        """The records that stand for one."""

    def end(self) -> None:
        """Every record from the first to the last was given."""


class OdometryOverride:
    """A source (see `Source`) through which the records of another go on their way.

    Args:
        source: Closed with this one.
        motion: Tells the odometry.
        digest: Of what else is read; "" for nothing.

    Attributes:
        source: As given.
    """

    def __init__(self, source: Source, motion: OdometryEstimator, digest: str = "") -> None:
        self.source, self._motion = source, motion
        self._digest = digest

    @property
    def description(self) -> SourceDescription:
        """As the source's own, with odometry."""
        known = self.source.description
        digest = f"{known.digest}+{self._digest}" if self._digest else known.digest
        return replace(known, has_odometry=True, digest=digest)

    @property
    def losses(self) -> dict[str, int]:
        """What was left out, by reason."""
        total = dict(self.source.losses)
        for reason, count in self._motion.losses.items():
            count_loss(total, reason, count)
        return total

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield records in the order of time."""
        for record in self.source.records(start_ns):
            yield from self._motion.add(record)
        if start_ns is None:
            self._motion.end()

    def pass_on(self, record: Record) -> Iterator[Record]:
        """The records that stand for one of the source, where somebody else reads it (live)."""
        return self._motion.add(record)

    def truth(self) -> Truth | None:
        """That of the source."""
        return self.source.truth()

    def close(self) -> None:
        """Close the source."""
        self.source.close()


#: Rows without times, counted against the scans that could be read.
TOO_MANY = "rows of poses without a scan; if scans are missing between others, later ones have wrong poses"
TOO_FEW = "scans after the last row of the poses"


class FileOdometry:
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
