"""LiDAR odometry (KISS-ICP, Vizzo et al., RA-L 2023) for sources without odometry, or with slipping wheels.

Each scan is registered to a map of the scans before it, point to point with an adaptive threshold. The
initial guess is the step of the wheels where the source has them, else constant velocity.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers.base import count_loss
from pipeline.types.records import Odometry, Record, Scan

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


class Matcher(Protocol):
    """The used part of `kiss_icp.kiss_icp.KissICP`."""

    last_pose: Float
    last_delta: Float

    def register_frame(self, frame: Float, timestamps: Float) -> object: ...


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


def _matcher() -> Matcher:
    """Return KISS-ICP with an empty map and one thread, because more threads change the order of sums and so
    the result."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    # Every value is set, because KISS-ICP reads missing ones from the environment.
    matcher: Matcher = KissICP(
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
    return matcher
