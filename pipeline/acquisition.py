"""Acquisition (Eq. 1): the returns of one sweep, taken at one instant and turned upright."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float, Pose3
from pipeline.parameters.stages import Acquisition
from pipeline.records import Float32, Int32, Step


def acquire(step: Step, T_base_lidar: Pose3, parameters: Acquisition) -> tuple[Float32, Float]:
    """The points of a step's scan in the level sensor frame.

    That frame has its origin in the sensor, its x axis along the robot's heading and, when the scan
    is levelled, its z axis against gravity. Points are moved to where they would be had the robot
    stood still at the scan's stamp: p' = R(w dt) p + v dt, with dt the point's time offset.

    Returns:
        The points, float32, shape (N, 3) [m], and the sensor's place in the level base frame,
        shape (3,) [m]; point plus place is the point in the level base frame.
    """
    level = parameters.level == "imu" and step.tilt_known
    R_level_base = Pose3.from_euler(np.zeros(3), step.roll, step.pitch, 0.0).R if level else np.eye(3)
    sensor_offset = R_level_base @ T_base_lidar.t
    offset_ns = step.scan.offset_ns
    twist = step.twist
    if parameters.gyro and step.turn_rate is not None:
        twist = (twist[0], twist[1], step.turn_rate)
    moving = parameters.deskew and offset_ns is not None and any(twist)
    points = _take(
        step.scan.points,
        offset_ns if moving and offset_ns is not None else np.zeros(0, np.int32),
        R_level_base @ T_base_lidar.R,
        sensor_offset,
        np.asarray(twist, dtype=np.float64),
        parameters.range_min,
        parameters.range_max,
    )
    return points, sensor_offset


@compiled
def _take(
    points: Float32,
    offset_ns: Int32,
    R: Float,
    sensor: Float,
    twist: Float,
    range_min: float,
    range_max: float,
) -> Float32:
    kept = np.empty((points.shape[0], 3), np.float32)
    n = 0
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        square = x * x + y * y + z * z
        # Written so that a coordinate that is not a number fails it.
        if not (range_min * range_min <= square <= range_max * range_max):
            continue
        u = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
        v = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        w = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        if offset_ns.shape[0] > 0:
            dt = offset_ns[i] * 1e-9
            # A robot turns by less than half a radian within a sweep, where these series are exact
            # to a tenth of a millimetre at 100 m; the library's sine would cost more than all else.
            a = twist[2] * dt
            c = 1.0 - a * a * (0.5 - a * a * (1.0 / 24.0 - a * a / 720.0))
            s = a * (1.0 - a * a * (1.0 / 6.0 - a * a * (1.0 / 120.0 - a * a / 5040.0)))
            bx, by = u + sensor[0], v + sensor[1]
            u = c * bx - s * by + twist[0] * dt - sensor[0]
            v = s * bx + c * by + twist[1] * dt - sensor[1]
        kept[n, 0], kept[n, 1], kept[n, 2] = u, v, w
        n += 1
    return kept[:n].copy()
