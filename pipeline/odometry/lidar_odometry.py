"""LiDAR odometry (KISS-ICP, Vizzo et al., RA-L 2023) for sources that tell no motion, or whose wheels slip.

Each scan is laid over a map of the scans before it, point to point with an adaptive gate. Where a source
has wheels too, their step is where the search begins, in place of a constant velocity.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers.base import count_loss
from pipeline.types.records import Odometry, Record, Scan

#: What is farther is thin, and one scan in ten would be spent on it [m].
RANGE_MAX, RANGE_MIN = 40.0, 0.5
#: As KISS-ICP takes it for a LiDAR of 100 m: the side of the map's voxels [m].
VOXEL = 1.0
#: More iterations follow the rings on the ground, which move with the sensor, and find nothing new.
ITERATIONS = 20
#: Rings on the ground hold a scan back; what is lower than this above the robot's feet is left aside [m].
GROUND = 0.3
#: Fewer points than this tell no motion.
FEWEST = 100
#: Wheels that were silent for longer say nothing of where to begin [ns].
STALE_NS = 300_000_000
#: A pause after which the velocity before it says nothing [ns].
PAUSE_NS = 1_000_000_000


class Matcher(Protocol):
    """What is used of `kiss_icp.kiss_icp.KissICP`."""

    last_pose: Float
    last_delta: Float

    def register_frame(self, frame: Float, timestamps: Float) -> object: ...


class LidarOdometry:
    """Gives each scan the pose of the base, so that it comes as Odometry before it.

    A scan that was matched once keeps its pose: who reads again from an earlier time gets the same.

    Args:
        T_base_lidar: Where the LiDAR stands.

    Attributes:
        losses: Scans that gave no pose, by reason.
    """

    def __init__(self, T_base_lidar: Pose3) -> None:
        self._T_base_lidar = T_base_lidar
        self._matcher = _matcher()
        self._known: dict[int, Pose3 | None] = {}
        self._newest_ns: int | None = None
        self._wheels: Odometry | None = None
        self._wheels_before: Odometry | None = None
        self._lowest = GROUND - float(T_base_lidar.t[2]) if T_base_lidar.t[2] > GROUND else -np.inf
        self.losses: dict[str, int] = {}

    def end(self) -> None:
        """Nothing waits for the end."""

    def add(self, record: Record) -> Iterator[Record]:
        """The records that stand for one: wheels are used up, a scan has its pose before it."""
        if isinstance(record, Odometry):
            self._wheels = record
            return
        if isinstance(record, Scan) and record.stems is None:
            pose = self._pose_of(record)
            if pose is not None:
                yield Odometry(record.stamp_ns, pose)
        yield record

    def _pose_of(self, scan: Scan) -> Pose3 | None:
        if scan.stamp_ns in self._known:
            return self._known[scan.stamp_ns]
        if self._newest_ns is not None and scan.stamp_ns <= self._newest_ns:
            return None  # late; the synchroniser counts it
        pose = self._match(scan)
        self._known[scan.stamp_ns] = pose
        return pose

    def _match(self, scan: Scan) -> Pose3 | None:
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
        """The points to be matched, sensor frame, and their times after the stamp [s]."""
        points = scan.points.astype(np.float64)
        reach = np.sqrt(np.einsum("ij,ij->i", points, points))
        up = points @ self._T_base_lidar.R[2]
        keep = (reach > RANGE_MIN) & (reach < RANGE_MAX) & (up > self._lowest)
        offset = None if scan.offset_ns is None else scan.offset_ns[keep] * 1e-9
        return points[keep], offset

    def _expected(self, velocity: Float, span_ns: int) -> Float:
        """The step since the scan before, in the sensor's frame: by the wheels, else as the step before."""
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
    """Points of shape (N, 3) as if all were seen at the scan's stamp: p' = p + (w x p + v) dt, exact to a
    centimetre for the turns of a robot within one sweep.

    Args:
        points: Sensor frame [m].
        offset_s: Time of each after the stamp [s], shape (N,); None leaves them as they are.
        delta: The step that the sensor makes in `span_ns`, shape (4, 4).
    """
    if offset_s is None:
        return points
    R, span_s = delta[:3, :3], span_ns * 1e-9
    w = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / span_s
    return points + (np.cross(w, points) + delta[:3, 3] / span_s) * offset_s[:, None]


def _matcher() -> Matcher:
    """KISS-ICP on one thread: with more, sums come in another order and the bytes of a map with them."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import AdaptiveThresholdConfig, DataConfig, MappingConfig, RegistrationConfig
    from kiss_icp.kiss_icp import KissICP

    # Every value is named: KISS-ICP would take others from the environment.
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
