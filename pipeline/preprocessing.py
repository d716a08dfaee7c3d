"""Preprocessing of one sweep: acquisition (Eq. 1: de-skewing and levelling), and the pass-through and voxel
grid filters (section 3.1 of the paper, Eq. 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.config.stages import Acquisition, Filters
from pipeline.geometry.hash_grid import AXIS_CELLS, add_to_voxels
from pipeline.geometry.poses import Float, Pose3
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int32, Step

CHUNK = 512  # points per block, so that intermediate results stay in the first-level cache
#: Closer returns are the housing of the sensor or beams without a return [m].
HOUSING = 0.1
Bytes = NDArray[np.uint8]


def acquire(step: Step, T_base_lidar: Pose3, parameters: Acquisition) -> tuple[Float32, Float]:
    """Return the points of a scan in the level sensor frame, de-skewed, in their order.

    The level sensor frame has its origin in the sensor, x along the heading of the robot and, if the scan is
    levelled, z against gravity. De-skewing moves each point to its position at the stamp of the scan: p' =
    R(w dt) p + v dt in the base frame, where dt is the time offset of the point. It is omitted if `deskew` is
    off, the scan has no time offsets or the velocity is zero.

    Args:
        step: Scan with tilt and velocity of the robot.
        T_base_lidar: Pose of the LiDAR on the robot, unless the scan has its own.
        parameters: Range limits (inclusive, before de-skewing), levelling and de-skewing.

    Returns:
        Points within the range limits, without points with NaN, float32, shape (N, 3) [m]; and the position
        of the sensor in the level base frame, shape (3,) [m]. Their sum is the point in the level base frame.
    """
    R_level_lidar, sensor_offset = _level_rotation(step, T_base_lidar, parameters)
    offset_ns = step.scan.offset_ns
    twist = base_velocity(step, parameters)
    moving = parameters.deskew and offset_ns is not None and any(twist)
    points = _transformed_points(
        step.scan.points,
        offset_ns if moving and offset_ns is not None else np.zeros(0, np.int32),
        R_level_lidar,
        sensor_offset,
        np.asarray(twist, dtype=np.float64),
        parameters.range_min,
        parameters.range_max,
    )
    return points, sensor_offset


def acquire_near(step: Step, T_base_lidar: Pose3, parameters: Acquisition) -> Float32:
    """Return the points from HOUSING to below `range_min` from the sensor, in the level sensor frame,
    float32, shape (N, 3) [m], in their order.

    These returns are from the robot itself or from objects close to it; still closer ones are returns of the
    housing. They are not de-skewed, since the robot does not move relative to itself. Empty if `range_min` is
    not above HOUSING.
    """
    points = step.scan.points
    below = np.nextafter(parameters.range_min**2, 0.0)
    rows = _rows_in_range(points, min(HOUSING, parameters.range_min) ** 2, below)
    R_level_lidar, _ = _level_rotation(step, T_base_lidar, parameters)
    near: Float32 = (points[rows] @ R_level_lidar.T).astype(np.float32)
    return near


def acquired_rows(step: Step, parameters: Acquisition) -> Int32:
    """Return the rows of the points of a scan that `acquire` keeps, int32, shape (N,), ascending."""
    return _rows_in_range(step.scan.points, parameters.range_min**2, parameters.range_max**2)


def _level_rotation(step: Step, T_base_lidar: Pose3, parameters: Acquisition) -> tuple[Float, Float]:
    """Return R_level_lidar, shape (3, 3), of the LiDAR that made the scan, and the position of the sensor in
    the level base frame, shape (3,) [m], by the tilt of the step and the pose of the LiDAR on the robot. If
    `level` is not "imu" or the tilt of the step is unknown, the level frame has the axes of the base.
    """
    level = parameters.level == "imu" and step.tilt_known
    R_level_base = Pose3.from_euler(np.zeros(3), step.roll, step.pitch, 0.0).R if level else np.eye(3)
    mounted = step.scan.T_base_lidar or T_base_lidar
    return R_level_base @ mounted.R, R_level_base @ mounted.t


def base_velocity(step: Step, parameters: Acquisition) -> tuple[float, float, float]:
    """Return the velocity of the base at a scan: forward, left [m/s], yaw rate [rad/s].

    Args:
        step: Scan with the velocity by odometry (zero if unknown) and, if available, the yaw rate of a
            gyroscope.
        parameters: `gyro` selects the yaw rate of the gyroscope if it is available; otherwise that of the
            odometry is returned.
    """
    if parameters.gyro and step.turn_rate is not None:
        return (step.twist[0], step.twist[1], step.turn_rate)
    return step.twist


@compiled
def _rows_in_range(points: Float32, square_min: float, square_max: float) -> Int32:
    """Return the ascending rows, int32, shape (M,), of the points (shape (N, 3) [m]) with a squared range
    from `square_min` to `square_max` [m^2], both inclusive; without rows of NaN."""
    rows = np.empty(points.shape[0], np.int32)
    n = 0
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if square_min <= x * x + y * y + z * z <= square_max:
            rows[n] = i
            n += 1
    return rows[:n].copy()


@compiled
def _transformed_points(
    points: Float32,
    offset_ns: Int32,
    R: Float,
    sensor: Float,
    twist: Float,
    range_min: float,
    range_max: float,
) -> Float32:
    """Return the points within the range limits, rotated by R and de-skewed, float32, shape (M, 3) [m]; see
    `acquire`.

    Args:
        points: float32, shape (N, 3) [m], sensor frame.
        offset_ns: Time of each point relative to the scan [ns], shape (N,); empty for no de-skewing.
        R: R_level_lidar, shape (3, 3).
        sensor: Position of the sensor in the level base frame, shape (3,) [m].
        twist: Forward and left velocity [m/s], yaw rate [rad/s], shape (3,).
        range_min, range_max: Limits, both inclusive [m]; points with NaN are removed.
    """
    kept = np.empty((points.shape[0], 3), np.float32)
    n = np.int64(0)
    # Blocks of contiguous rows and simple loops, which the compiler vectorises.
    u, v, w = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    dt, inside = np.empty(CHUNK), np.empty(CHUNK, np.uint8)
    for start in range(0, points.shape[0], CHUNK):
        m = min(CHUNK, points.shape[0] - start)
        for i in range(m):
            u[i], v[i], w[i] = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        _rotate_block(u, v, w, inside, R, range_min * range_min, range_max * range_max)
        if offset_ns.shape[0] > 0:
            for i in range(m):
                dt[i] = offset_ns[start + i] * 1e-9
            _deskew_block(u, v, dt, sensor, twist)
        for i in range(m):
            kept[n, 0], kept[n, 1], kept[n, 2] = u[i], v[i], w[i]
            n += np.int64(inside[i])  # NumPy alone would keep the sum in a uint8
    return kept[:n].copy()


@compiled
def _rotate_block(
    u: Float, v: Float, w: Float, inside: Bytes, R: Float, square_min: float, square_max: float
) -> None:
    """Rotate a block of points, in place, and mark those within the range limits.

    Args:
        u, v, w: Coordinates of the points, shape (CHUNK,) [m]; all CHUNK rows are rotated.
        inside: Receives 1 where the squared range before the rotation is in [square_min, square_max], else 0
            (also for NaN), shape (CHUNK,).
        R: Rotation matrix, shape (3, 3).
        square_min, square_max: Squares of the range limits [m^2].
    """
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    for i in range(CHUNK):
        x, y, z = u[i], v[i], w[i]
        square = x * x + y * y + z * z
        # A NaN coordinate fails these comparisons.
        inside[i] = (square_min <= square) & (square <= square_max)
        u[i] = r00 * x + r01 * y + r02 * z
        v[i] = r10 * x + r11 * y + r12 * z
        w[i] = r20 * x + r21 * y + r22 * z


@compiled
def _deskew_block(u: Float, v: Float, dt: Float, sensor: Float, twist: Float) -> None:
    """De-skew x and y of the points of a block, in place; see `acquire`.

    The rotation within a sweep is less than 0.5 rad; there, the series of sine and cosine are accurate to 0.1
    mm at 100 m and faster than the library functions.

    Args:
        u, v: x and y in the level sensor frame [m], shape (CHUNK,).
        dt: Time offset of each point [s], shape (CHUNK,).
        sensor: Position of the sensor in the level base frame, shape (3,) [m].
        twist: Forward and left velocity [m/s], yaw rate [rad/s], shape (3,).
    """
    at_x, at_y, vx, vy, turning = sensor[0], sensor[1], twist[0], twist[1], twist[2]
    for i in range(CHUNK):
        a = turning * dt[i]
        c = 1.0 - a * a * (0.5 - a * a * (1.0 / 24.0 - a * a / 720.0))
        s = a * (1.0 - a * a * (1.0 / 6.0 - a * a * (1.0 / 120.0 - a * a / 5040.0)))
        x, y = u[i] + at_x, v[i] + at_y
        u[i] = c * x - s * y + vx * dt[i] - at_x
        v[i] = s * x + c * y + vy * dt[i] - at_y


def pass_through(points: Float32, parameters: Filters) -> Float32:
    """Return the points inside the box including its faces, float32, shape (M, 3) [m], in their order; points
    with NaN are removed.

    Args:
        points: float32, shape (N, 3) [m].
        parameters: Limits of the box in the frame of the points; they are compared in float32.
    """
    p = parameters
    low = np.array([p.x_min, p.y_min, p.z_min], np.float32)
    high = np.array([p.x_max, p.y_max, p.z_max], np.float32)
    return _box(points, low, high)


@compiled
def _box(points: Float32, low: Float32, high: Float32) -> Float32:
    """Return the points, float32, shape (M, 3) [m], with low <= point <= high on each axis; low and high have
    the shape (3,) [m]. Points with NaN are removed."""
    inside = np.empty_like(points)
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
            inside[n, 0], inside[n, 1], inside[n, 2] = x, y, z
            n += 1
    return inside[:n].copy()


def voxel_grid(points: Float32, parameters: Filters) -> Float32:
    """Replace the points of each voxel by their mean, in the order of the first point of each voxel.

    The borders of the voxels are multiples of their size in the frame of the points. The points are returned
    unchanged (the same array) if the voxel size is 0, if there are none, or if a coordinate is farther than
    about a million voxels from the origin.

    Args:
        points: float32, shape (N, 3) [m], finite.
        parameters: `voxel_size` is the edge length of a voxel [m].

    Returns:
        Means, float32, shape (M, 3) [m].
    """
    size = parameters.voxel_size
    if size == 0.0 or len(points) == 0 or float(np.abs(points).max()) / size >= AXIS_CELLS // 2 - 1:
        return points  # voxels this small contain one point each
    n = len(points)
    sums, counts = np.zeros((n, 3)), np.zeros(n, np.int64)
    slots = np.full(2 << (n - 1).bit_length(), -1, np.int32)
    of = np.ones(n, np.int64)
    _, rows = add_to_voxels(points, of, 0, size, np.empty(n, np.int64), sums, counts, slots, 0)
    return (sums[:rows] / counts[:rows, None]).astype(np.float32)
