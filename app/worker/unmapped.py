"""Scans that are shown while the kernels of the mapper are compiled: their points, and clusters once the
kernels of the front end are there. No kernel is needed for the points."""

from __future__ import annotations

import numpy as np

from pipeline.front_end import SegmentedScan
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Clusters, Float, Float32, Frame, PoseEstimate, Step, Trees, no_detections


def unmapped_frame(step: Step, T_base_lidar: Pose3, scan: SegmentedScan | None = None) -> Frame:
    """Return a scan as a frame without a map: no trees, no detections, and the pose by odometry, the identity
    without it.

    Args:
        step: The scan.
        T_base_lidar: Pose of the LiDAR on the robot, of a scan without extrinsics of its own.
        scan: The segmented scan; None shows only the points.
    """
    pose = step.T_odom_base or Pose2()
    raw, offset = (scan.raw, scan.sensor_offset) if scan is not None else _levelled(step, T_base_lidar)
    return Frame(
        index=step.index,
        stamp_ns=step.scan.stamp_ns,
        raw=raw,
        filtered=np.zeros((0, 3), np.float32) if scan is None else scan.filtered,
        labels=np.zeros(0, np.int32) if scan is None else scan.labels,
        clusters=_no_clusters() if scan is None else scan.clusters,
        detections=no_detections(),
        estimate=PoseEstimate(
            T_map_base=pose,
            covariance=np.zeros((3, 3)),
            particles=np.zeros((0, 3)),
            weights=np.zeros(0),
            n_eff=0.0,
            landmarks=np.zeros((0, 2)),
        ),
        T_odom_base=pose,
        sensor_offset=offset,
        trees=_no_trees(),
    )


def _levelled(step: Step, T_base_lidar: Pose3) -> tuple[Float32, Float]:
    """Return the points in the level sensor frame, float32, shape (N, 3) [m], and the position of the sensor
    in the level base frame, shape (3,) [m]."""
    mount = step.scan.T_base_lidar or T_base_lidar
    R_level_base = Pose3.from_euler(np.zeros(3), step.roll, step.pitch, 0.0).R
    return (step.scan.points @ (R_level_base @ mount.R).T).astype(np.float32), R_level_base @ mount.t


def _no_clusters() -> Clusters:
    """Return a table without rows."""
    none = np.zeros(0)
    return Clusters(
        size=np.zeros(0, np.int64),
        centroid=np.zeros((0, 3)),
        eccentricity=none,
        centre=np.zeros((0, 2)),
        covariance=np.zeros((0, 2, 2)),
        radius=none,
        radius_sigma=none,
        radial_std=none,
        arc=none,
        extent=np.zeros((0, 3)),
        hidden=np.zeros(0, np.bool_),
        cut=np.zeros(0, np.bool_),
        verdict=np.zeros(0, np.int32),
    )


def _no_trees() -> Trees:
    """Return a map without trees."""
    none, no_numbers = np.zeros(0), np.zeros(0, np.int64)
    return Trees(
        number=no_numbers,
        position=np.zeros((0, 2)),
        covariance=np.zeros((0, 2, 2)),
        dbh=none,
        dbh_sigma=none,
        eccentricity=none,
        observations=no_numbers,
        coverage=none,
        first_seen_ns=no_numbers,
        last_seen_ns=no_numbers,
        confirmed=np.zeros(0, np.bool_),
    )
