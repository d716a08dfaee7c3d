"""Yaw of a LiDAR on its robot, by its motion beside the odometry (hand-eye calibration in the plane).

The motion of the LiDAR is that of LiDAR odometry. While the robot drives, the
direction of both motions gives the yaw; in turns, the place of the LiDAR shows too, and is solved for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Float, Pose3, wrap_angle
from pipeline.odometry.lidar_odometry import LidarOdometry
from pipeline.types.records import Float32, Odometry, Scan

#: Length of the steps that are compared [m]: long against the error of a registration.
STEP = 1.0
#: Fewest steps for a yaw.
FEWEST = 2
#: Sum of turns in the steps from which the place of the LiDAR is solved for [rad].
_TURNS = 1.0
#: The motions contradict each other if their lengths differ by more than this factor, or their residual is
#: larger than this share of a step.
_LENGTHS, _RESIDUAL = 1.5, 0.35
#: They also do if their turns in a step differ by more (RMS): both are the same for any mounting, and wheels
#: err by a fifth of it [rad].
_TURN = 0.1
#: Mountings are built at right angles: a yaw that is nearer to one than this is taken as it [rad].
_RIGHT_ANGLE = math.radians(4.0)
#: Points lower than this above the lowest one of their cell move with the sensor, as rings on the ground do
# [m].
_GROUND, _CELL = 0.4, 2.0
_POINTS = 100
#: Distance from the points of a map within which a point is one of it [m].
_ON = 0.3
#: The motion of a LiDAR that sees little of each side errs by up to this in its direction [rad].
_YAW_ERROR = math.radians(12.0)
#: A yaw is better if this share of the points more lie on others.
_BETTER = 0.05
#: Largest turn of the robot for which the place of a LiDAR, up to 1 m from the base, may be left out [rad]:
#: it moves the points by less than _ON.
_STRAIGHT = 0.3
_REACH = (0.5, 40.0)  # m


@dataclass(frozen=True, slots=True)
class MountingYaw:
    """Yaw of a LiDAR by its motion.

    Attributes:
        yaw: Yaw of the LiDAR on the robot [rad].
        length: Length of the compared motion [m].
        contradicts: Whether no mounting explains both motions.
    """

    yaw: float
    length: float
    contradicts: bool


def lidar_path(scans: Sequence[Scan], T_level_lidar: Pose3) -> tuple[Float, list[Float]]:
    """Return the pose x, y [m], yaw [rad] of the level LiDAR at each scan, in its frame at the first one,
    shape (N, 3), and the points that were registered, shape (M, 3) each [m]. Scans with few points repeat the
    last pose.

    Args:
        scans: Consecutive scans.
        T_level_lidar: Tilt of the LiDAR.
    """
    motion = LidarOdometry(T_level_lidar, height_above_ground=_height_above_cell)
    path, used = np.zeros((len(scans), 3)), []
    for k, scan in enumerate(scans):
        path[k] = path[max(k - 1, 0)]
        for record in motion.add(replace(scan, T_base_lidar=None)):
            if isinstance(record, Odometry):
                path[k] = record.T_odom_base.planar().as_array()
        points = _standing_points(scan.points.astype(np.float64) @ T_level_lidar.R.T)
        used.append(points)
    return path, used


def standing_height(points: Float) -> tuple[Float, Float32]:
    """Return the points within _REACH, shape (M, 3) [m], and their heights above the lowest one of their
    cell, shape (M,) [m]. It needs no compiled kernel."""
    reach = np.linalg.norm(points, axis=1)
    points = points[(reach > _REACH[0]) & (reach < _REACH[1])]
    return points, _height_above_cell(points)


def _standing_points(points: Float) -> Float:
    """Return the points within _REACH that are not on the ground, shape (M, 3) [m]."""
    points, height = standing_height(points)
    return points[height > _GROUND]


def _height_above_cell(points: Float | Float32) -> Float32:
    """Return the height of points above the lowest one of their cell, shape (N,) [m]. It needs no kernel,
    which would be compiled in the process that opens a recording."""
    if not len(points):
        return np.zeros(0, np.float32)
    cell = np.floor(points[:, :2] / _CELL).astype(np.int64)
    _, which = np.unique((cell[:, 0] << 32) + cell[:, 1], return_inverse=True)
    lowest = np.full(int(which.max()) + 1, np.inf)
    np.minimum.at(lowest, which, points[:, 2])
    height: Float32 = (points[:, 2] - lowest[which]).astype(np.float32)
    return height


def overlap(path: Float, points: Sequence[Float]) -> float:
    """Return the share of the points of the last scan that lie on those of the first half of a path, to _ON:
    about 1 if the registration is right, and little if the scans do not show one world.

    Args:
        path, points: From `lidar_path`.
    """
    from scipy.spatial import cKDTree

    placed = []
    for (x, y, yaw), cloud in zip(path, points, strict=True):
        c, s = math.cos(yaw), math.sin(yaw)
        placed.append(cloud[:, :2] @ np.array([[c, s], [-s, c]]) + [x, y])
    before, last = np.concatenate(placed[: max(len(placed) // 2, 1)]), placed[-1]
    if len(before) < _POINTS or len(last) < _POINTS:
        return 0.0
    return float(np.mean(cKDTree(before).query(last, distance_upper_bound=_ON)[0] < _ON))


def yaw_of_mounting(lidar: Float, odometry: Float) -> MountingYaw | None:
    """Return the yaw of a LiDAR from its path and that of the robot; None if neither of them has moved by
    FEWEST steps.

    With the pose (R, t) of the LiDAR on the robot, its step (R_l, t_l) and that of the robot (R_o, t_o)
    fulfil R t_l - (R_o - 1) t = t_o, which is linear in the cosine and the sine of the yaw and in t.

    Args:
        lidar: Poses x, y [m], yaw [rad] of the level LiDAR in its own frame, shape (N, 3).
        odometry: Poses of the base by the odometry at the same times, shape (N, 3).
    """
    rows, right, lengths, turns = list[Float](), list[Float](), list[tuple[float, float]](), 0.0
    differs = list[float]()
    start = 0
    for k in range(1, len(lidar)):
        by_lidar, by_odometry = _step(lidar[start], lidar[k]), _step(odometry[start], odometry[k])
        far = float(np.hypot(*by_lidar[:2])), float(np.hypot(*by_odometry[:2]))
        if max(far) < STEP:
            continue
        c, s = math.cos(by_odometry[2]) - 1.0, math.sin(by_odometry[2])
        x, y = by_lidar[:2]
        rows.append(np.array([[x, -y, -c, s], [y, x, -s, -c]]))
        right.append(by_odometry[:2])
        lengths.append(far)
        turns += abs(by_odometry[2])
        differs.append(float(wrap_angle(by_lidar[2] - by_odometry[2])))
        start = k
    if len(rows) < FEWEST:
        return None
    columns = 4 if turns > _TURNS else 2
    A, b = np.concatenate(rows)[:, :columns], np.concatenate(right)
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    total = np.sum(lengths, axis=0)
    residual = float(np.sqrt(np.mean((A @ found - b) ** 2) * 2.0)) / STEP
    apart = max(total) / max(min(total), 1e-9)
    yaw = math.atan2(found[1], found[0])
    square = round(yaw / (math.pi / 2.0)) * (math.pi / 2.0)
    yaw = square if abs(yaw - square) < _RIGHT_ANGLE else yaw
    turn = float(np.sqrt(np.mean(np.square(differs))))
    contradicts = apart > _LENGTHS or residual > _RESIDUAL or turn > _TURN
    return MountingYaw(float(wrap_angle(yaw)), float(max(total)), contradicts)


def better_yaw(yaw: float, odometry: Float, points: Sequence[Float]) -> float:
    """Return the nearest right angle [rad] instead of the yaw, if the scans overlap more along the odometry
    by it. The registration of a tilted LiDAR, which sees little of each side, may miss a quarter of the
    motion, and its direction by ten degrees.

    The yaw stays if it is more than _YAW_ERROR from a right angle, or the robot turned by more than
    _STRAIGHT.

    Args:
        yaw: Yaw of the LiDAR by its registered motion [rad].
        odometry: Poses of the base x, y [m], yaw [rad] at each scan, shape (N, 3).
        points: From `lidar_path`.
    """
    square = round(yaw / (math.pi / 2.0)) * (math.pi / 2.0)
    if abs(yaw - square) > _YAW_ERROR or np.ptp(np.unwrap(odometry[:, 2])) > _STRAIGHT:
        return yaw
    by_yaw, by_square = (overlap(odometry + np.array([0.0, 0.0, turn]), points) for turn in (yaw, square))
    return float(wrap_angle(square)) if by_square > by_yaw + _BETTER else yaw


def _step(start: Float, end: Float) -> Float:
    """Return the pose `end` in the frame of `start`: x, y [m], yaw [rad], shape (3,)."""
    c, s = math.cos(start[2]), math.sin(start[2])
    x, y = end[:2] - start[:2]
    return np.array([c * x + s * y, -s * x + c * y, float(wrap_angle(end[2] - start[2]))])
