"""Replacement of the odometry of a source by the poses in a file or by LiDAR odometry.

LiDAR odometry (KISS-ICP, Vizzo et al., RA-L 2023) is for sources without odometry or with slipping wheels. It
registers each scan to a map of the scans before it, point to point with an adaptive threshold. The initial
guess is the step of the wheels where the source has them, else constant velocity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers.base import Source, SourceDescription, count_loss
from pipeline.io.readers.pose_files import POSE_ROWS, TextError, pose_at, read_any_poses
from pipeline.types.records import Odometry, Record, Scan, Truth


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


#: Largest and smallest range of a point [m]; farther points are sparse and would take a tenth of the time.
RANGE_MAX, RANGE_MIN = 40.0, 0.5
#: Side of the voxels of the map [m], the default of KISS-ICP for a LiDAR of 100 m.
VOXEL = 1.0
#: Maximum number of iterations; more would align the rings on the ground, which move with the sensor.
ITERATIONS = 20
#: Points lower than this above the ground are not used, because rings on the ground move with the sensor [m].
GROUND = 0.3
#: Fewest points for a registration.
FEWEST = 100
#: Older odometry of the wheels gives no initial guess [ns].
STALE_NS = 300_000_000
#: After a longer pause the previous velocity is not used [ns].
PAUSE_NS = 1_000_000_000


class LidarOdometry:
    """Estimator of odometry: each scan gets the pose of the base as an Odometry record before it.

    A scan keeps its first pose, so reading again gives the same poses.

    Args:
        T_base_lidar: Extrinsics of the LiDAR.

    Attributes:
        losses: Dict from reasons to numbers of scans: those with too few points for a pose, and those whose
            pose is only the initial guess. Late scans, which have no pose either, are not counted.
    """

    def __init__(self, T_base_lidar: Pose3) -> None:
        """Create an estimator without a map; imports KISS-ICP."""
        self._T_base_lidar = T_base_lidar
        self._matcher = _matcher()
        self._known: dict[int, Pose3 | None] = {}
        self._newest_ns: int | None = None
        self._wheels: Odometry | None = None
        self._wheels_before: Odometry | None = None
        self._lowest = GROUND - float(T_base_lidar.t[2]) if T_base_lidar.t[2] > GROUND else -np.inf
        self.losses: dict[str, int] = {}

    def end(self) -> None:
        """Do nothing; nothing is counted at the end."""

    def add(self, record: Record) -> Iterator[Record]:
        """Yield the records that replace one record: nothing for odometry, which is stored as the initial
        guess; the pose (if it is known) and the scan for a scan of points; the record itself for all others.
        The scan is registered when the iterator is consumed."""
        if isinstance(record, Odometry):
            self._wheels = record
            return
        if isinstance(record, Scan) and record.stems is None:
            pose = self._pose_of(record)
            if pose is not None:
                yield Odometry(record.stamp_ns, pose)
        yield record

    def _pose_of(self, scan: Scan) -> Pose3 | None:
        """Return T_odom_base of a scan: the known one for a time that was registered before, else by
        registration. None for a new scan that is not later than the newest one, and where `_match` has none.
        """
        if scan.stamp_ns in self._known:
            return self._known[scan.stamp_ns]
        if self._newest_ns is not None and scan.stamp_ns <= self._newest_ns:
            return None  # late; the synchroniser counts it
        pose = self._match(scan)
        self._known[scan.stamp_ns] = pose
        return pose

    def _match(self, scan: Scan) -> Pose3 | None:
        """Register a scan to the map, add it to the map, and return T_odom_base. None, counted in `losses`,
        with fewer than FEWEST useful points. If the registration is not finite, the initial guess is the
        pose; this is counted too."""
        points, offset_ns = self._useful(scan)
        if len(points) < FEWEST:
            count_loss(self.losses, "scans with too few points for LiDAR odometry")
            return None
        before_ns, self._newest_ns = self._newest_ns, scan.stamp_ns
        k = self._matcher
        if before_ns is not None:
            span_ns = scan.stamp_ns - before_ns
            k.last_delta = self._expected(k.last_delta, span_ns)
            points = undistorted(points, offset_ns, k.last_delta, span_ns)
        self._wheels_before = self._wheels
        guess = k.last_pose @ k.last_delta
        k.register_frame(points, np.zeros(0))
        if not np.isfinite(k.last_pose).all():
            count_loss(self.losses, "scans that LiDAR odometry could not place")
            k.last_pose, k.last_delta = guess, np.eye(4)
        T_odom_lidar = Pose3(k.last_pose[:3, :3].copy(), k.last_pose[:3, 3].copy())
        return self._T_base_lidar @ T_odom_lidar @ self._T_base_lidar.inverse()

    def _useful(self, scan: Scan) -> tuple[Float, Float | None]:
        """Return the points to register in the sensor frame, shape (N, 3) [m], without those too near, too
        far or too low, and their times after the stamp, shape (N,) [s]; the times are None if the scan has
        none."""
        points = scan.points.astype(np.float64)
        reach = np.sqrt(np.einsum("ij,ij->i", points, points))
        up = points @ self._T_base_lidar.R[2]
        keep = (reach > RANGE_MIN) & (reach < RANGE_MAX) & (up > self._lowest)
        offset = None if scan.offset_ns is None else scan.offset_ns[keep] * 1e-9
        return points[keep], offset

    def _expected(self, velocity: Float, span_ns: int) -> Float:
        """Return the predicted step since the last scan in the sensor frame, shape (4, 4): by the wheels if
        their readings at the two scans are less than 2 `span_ns` + STALE_NS apart, else the last step, or no
        motion after a pause (PAUSE_NS).

        Args:
            velocity: Last step in the sensor frame, shape (4, 4).
            span_ns: Time since the last scan [ns].
        """
        now, before = self._wheels, self._wheels_before
        if (
            now is not None
            and before is not None
            and 0 < now.stamp_ns - before.stamp_ns < 2 * span_ns + STALE_NS
        ):
            step = before.T_odom_base.inverse() @ now.T_odom_base
            step = self._T_base_lidar.inverse() @ step @ self._T_base_lidar
            delta = np.eye(4)
            delta[:3, :3], delta[:3, 3] = step.R, step.t
            if np.isfinite(delta).all():
                return delta
        return np.eye(4) if span_ns > PAUSE_NS else velocity


def undistorted(points: Float, offset_s: Float | None, delta: Float, span_ns: int) -> Float:
    """Return the points in the sensor frame at the stamp of the scan, shape (N, 3) [m], with constant
    velocity: p' = p + (w x p + v) dt.

    The linearisation is exact to a centimetre for the rotations of a robot within one sweep.

    Args:
        points: Points in the sensor frame at their own times, shape (N, 3) [m].
        offset_s: Time of each point after the stamp [s], shape (N,); None returns the points unchanged (the
            same array).
        delta: Motion of the sensor in `span_ns`, shape (4, 4).
        span_ns: Duration of the motion, above 0 [ns].
    """
    if offset_s is None:
        return points
    R, span_s = delta[:3, :3], span_ns * 1e-9
    w = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / span_s
    return points + (np.cross(w, points) + delta[:3, 3] / span_s) * offset_s[:, None]


def _matcher() -> Any:  # noqa: ANN401 - kiss_icp has no types
    """Return KISS-ICP with an empty map and one thread, because more threads change the order of sums and so
    the result."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    # Every value is set, because KISS-ICP reads missing ones from the environment.
    return KissICP(
        KISSConfig(
            out_dir="",
            data=DataConfig(max_range=RANGE_MAX, min_range=RANGE_MIN, deskew=False),
            registration=RegistrationConfig(
                max_num_iterations=ITERATIONS, convergence_criterion=1e-3, max_num_threads=1
            ),
            mapping=MappingConfig(voxel_size=VOXEL, max_points_per_voxel=20),
            adaptive_threshold=AdaptiveThresholdConfig(
                fixed_threshold=None, initial_threshold=2.0, min_motion_th=0.1
            ),
        )
    )


OdometryEstimator = FileOdometry | LidarOdometry
