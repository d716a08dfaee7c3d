"""Replacement of the odometry of a source by the poses in a file or by LiDAR odometry (`lidar_odometry`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import Source, SourceDescription, count_loss
from pipeline.io.readers.pose_files import POSE_ROWS, TextError, pose_at, read_any_poses
from pipeline.types.records import Odometry, Record, Scan, Truth


class OdometryEstimator(Protocol):
    """Estimates the motion between the records of a source."""

    @property
    def losses(self) -> dict[str, int]:
        """Dict from reasons to numbers of records without a pose."""

    @property
    def poses(self) -> list[tuple[int, Pose3]]:
        """Times [ns] and poses of the LiDAR so far, T_odom_lidar, by registration; [] for other motion."""

    def add(self, record: Record) -> Iterator[Record]:
        """Yield the records that replace one record."""

    def end(self) -> None:
        """Finish after the last record."""


class OdometryOverride:
    """A source whose odometry is replaced (see `pipeline.io.readers.base.Source`).

    Args:
        source: The source; it is closed with this one.
        motion: Estimator of the odometry.
        digest: Digest of the file that the estimator reads, "" for none.

    Attributes:
        source: The source without replacement.
    """

    def __init__(self, source: Source, motion: OdometryEstimator, digest: str = "") -> None:
        """Wrap a source; nothing is read."""
        self.source, self._motion = source, motion
        self._digest = digest

    @property
    def description(self) -> SourceDescription:
        """Description of the source with `has_odometry` True. If the digest of the file is not empty,
        `digest` is that of the source, "+" and that of the file."""
        known = self.source.description
        digest = f"{known.digest}+{self._digest}" if self._digest else known.digest
        return replace(known, has_odometry=True, digest=digest)

    @property
    def losses(self) -> dict[str, int]:
        """New dict from reasons to numbers of records that the source left out and of scans without a
        pose."""
        total = dict(self.source.losses)
        for reason, count in self._motion.losses.items():
            count_loss(total, reason, count)
        return total

    @property
    def lidar_poses(self) -> list[tuple[int, Pose3]]:
        """Times [ns] and poses of the LiDAR so far, T_odom_lidar, by LiDAR odometry; [] for a file."""
        return self._motion.poses

    def records(self) -> Iterator[Record]:
        """Yield the records of the source in the order of time, each replaced by the estimator. After the
        last record the estimator is finished."""
        for record in self.source.records():
            yield from self._motion.add(record)
        self._motion.end()

    def pass_on(self, record: Record) -> Iterator[Record]:
        """Yield the records by which the estimator replaces one record; for a live source, whose records are
        read by the caller."""
        return self._motion.add(record)

    def truth(self) -> Truth | None:
        """Return the ground truth of the source; None if there is none."""
        return self.source.truth()

    def close(self) -> None:
        """Close the source."""
        self.source.close()


#: Losses when the rows without times are not as many as the scans.
TOO_MANY = "rows of poses without a scan; if scans are missing between others, later ones have wrong poses"
TOO_FEW = "scans after the last row of the poses"


class FileOdometry:
    """Odometry from the poses in a text file: each scan gets its pose as an Odometry record before it.

    Rows with times (TUM) are poses of the LiDAR in the clock of the source and are interpolated. Rows without
    times (KITTI) belong to the scans in their order. A scan that cannot be read uses no row, so surplus rows
    can mean that later scans have wrong poses; this is counted as a loss.

    Args:
        path: The file.
        T_base_lidar: Extrinsics of the LiDAR.

    Attributes:
        losses: Dict from reasons to numbers of rows without a scan, or of scans without a row; set by `end`.
        poses: Empty: the poses of the file are no registration.

    Raises:
        SourceError: The file cannot be read, or has another format.
    """

    def __init__(self, path: Path, T_base_lidar: Pose3) -> None:
        """Read the file of poses.

        Raises:
            SourceError: The file cannot be read, or has another format.
        """
        try:
            self._times, self._poses = read_any_poses(path)
        except (TextError, OSError) as error:
            reason = str(error) if isinstance(error, TextError) else error.strerror or str(error)
            raise SourceError(
                f"no poses can be read: {reason}",
                where=str(path),
                remedy="" if POSE_ROWS in reason else f"Rows are {POSE_ROWS}.",
            ) from None
        self._T_lidar_base = T_base_lidar.inverse()
        self._row_of: dict[int, int] = {}
        self.losses: dict[str, int] = {}
        self.poses: list[tuple[int, Pose3]] = []

    def add(self, record: Record) -> Iterator[Record]:
        """Yield the records that replace one record: nothing for odometry; the pose of the base (if the file
        has one) and the scan for a scan; the record itself for all others. A scan uses the next row when the
        iterator is consumed; if it is read again, it gets the same row."""
        if isinstance(record, Odometry):
            return
        if isinstance(record, Scan):
            pose = self._pose_of(record.stamp_ns)
            if pose is not None:
                yield Odometry(record.stamp_ns, pose @ self._T_lidar_base)
        yield record

    def end(self) -> None:
        """Set `losses` to the number of rows without a scan, or of scans without a row. Empty for rows with
        times."""
        left = 0 if self._times is not None else len(self._poses) - len(self._row_of)
        self.losses = {reason: n for reason, n in ((TOO_MANY, left), (TOO_FEW, -left)) if n > 0}

    def _pose_of(self, stamp_ns: int) -> Pose3 | None:
        """Return the pose of the LiDAR at a scan [ns], T_odom_lidar: that of the next row, the same again for
        a scan that was asked before, or interpolated between rows with times. None for a scan after the last
        row, or more than a second from all rows with times."""
        if self._times is not None:
            return pose_at(self._times, self._poses, stamp_ns)
        row = self._row_of.setdefault(stamp_ns, len(self._row_of))
        return self._poses[row] if row < len(self._poses) else None
