"""Obstacle detection in the path of the robot, from one scan.

The path is the arc that results from the current velocities. With the forward velocity v and the yaw rate
omega, its centre is (0, R) in the base frame, R = v / omega. A point (x, y) has the angle theta = atan2(x,
sign(R) (R - y)), the arc length s = |R| theta and the lateral distance |R| - |(x, y - R)|.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.config.stages import Obstacles
from pipeline.geometry.ordering import ascending
from pipeline.ground.scan_ground import Terrain, ground_at
from pipeline.jit import compiled
from pipeline.types.records import Clearance, Float, Float32, Zone

#: Below this speed [m/s] the robot counts as standing and its path is straight ahead.
STANDING = 0.05
#: Minimum radius of the path [m], for robots that turn on the spot.
TIGHTEST = 0.5
#: Returns within this depth form one obstacle [m].
DEPTH = 0.5
#: Maximum lateral distance that is searched [m].
BESIDE = 3.0
#: The sensor covers the path if there are returns within 30 degrees of its beginning.
_LOOKING = math.tan(math.radians(30.0))
STRAIGHT = 1e-6  # 1/m; a smaller curvature counts as straight
_NO_GROUND = np.zeros((0, 0))


def find_clearance(
    points: Float32,
    near: Float32,
    terrain: Terrain | None,
    sensor_offset: Float,
    twist: tuple[float, float, float],
    parameters: Obstacles,
) -> Clearance | None:
    """Return the clearance of the path of the robot, or None if obstacle detection is off (`method` is
    "none"). If the robot drives backwards, it is the path behind the robot.

    An obstacle within the path width beside the robot has the distance 0. The zone CLEAR becomes UNKNOWN with
    fewer than `min_points` returns within 30 degrees of the direction of driving. If `terrain` is None and
    the sensor is below the minimum obstacle height, each zone except STOP becomes UNKNOWN.

    Args:
        points: The whole scan beyond `acquisition.range_min`, float32, shape (N, 3) [m], level sensor frame;
            rows with NaN are ignored.
        near: Returns within `acquisition.range_min`, float32, shape (M, 3) [m], same frame; those inside the
            robot are removed.
        terrain: Terrain of the scan; without it, heights are relative to the base.
        sensor_offset: Position of the sensor in the level base frame, shape (3,) [m].
        twist: Velocity of the base: forward, left [m/s], yaw rate [rad/s]; the velocity to the left is not
            used.
        parameters: Path width, zones and thresholds. Fewer than `min_points` returns within DEPTH are no
            obstacle.
    """
    if parameters.method == "none":
        return None
    backward = twist[0] < -STANDING
    reach = _reach(sensor_offset, backward, parameters)
    beyond = _beyond_the_robot(near, sensor_offset, parameters)
    curvature = path_curvature(twist)
    zone, ahead, beside, x, y = _find_obstacles(
        np.vstack([points, beyond]) if len(beyond) else points,
        _NO_GROUND if terrain is None else terrain.height,
        sensor_offset,
        curvature,
        backward,
        np.array([parameters.height_min, parameters.height_max]),
        np.array([*reach, 0.5 * parameters.width]),
        np.array([parameters.stop_distance, parameters.slow_distance]),
        parameters.min_points,
    )
    if terrain is None and sensor_offset[2] < parameters.height_min and zone != Zone.STOP:
        zone = Zone.UNKNOWN
    return Clearance(
        Zone(zone), ahead, beside, x, y, curvature, backward, parameters.slow_distance, begins=reach[0]
    )


def _reach(sensor_offset: Float, backward: bool, parameters: Obstacles) -> tuple[float, float]:
    """Return the extent of the robot from its base in the direction in which it drives and in the other one
    [m]; each is at least that of its sensor.

    Args:
        sensor_offset: Position of the sensor in the base frame, x first [m].
        backward: Whether the robot drives backwards.
        parameters: `reach` is the extent in both directions.
    """
    along = -float(sensor_offset[0]) if backward else float(sensor_offset[0])
    return max(parameters.reach, along), max(parameters.reach, -along)


def _beyond_the_robot(near: Float32, sensor_offset: Float, parameters: Obstacles) -> Float32:
    """Return the points outside of the box of the robot, which contains its base and its sensor, float32,
    shape (M, 3) [m], in the frame of the points. Points with NaN are kept.

    Args:
        near: Points, shape (N, 3) [m], level frame at the sensor.
        sensor_offset: Position of the sensor in the base frame, x, y first [m].
        parameters: Reach and width of the robot.
    """
    half = np.array([parameters.reach, 0.5 * parameters.width])
    place = near[:, :2] + sensor_offset[:2]
    own = (np.minimum(-half, sensor_offset[:2]) <= place) & (place <= np.maximum(half, sensor_offset[:2]))
    beyond: Float32 = near[~own.all(axis=1)]
    return beyond


def path_curvature(twist: tuple[float, float, float]) -> float:
    """Return the curvature [1/m] of the path that results from the velocities forward, left [m/s] and the yaw
    rate [rad/s], positive to the left, at most 1 / TIGHTEST in size. It is yaw rate / forward velocity, also
    when driving backwards. It is 0 if the forward speed is below STANDING or the ratio is not finite."""
    forward, _, turn = twist
    if abs(forward) < STANDING or not math.isfinite(turn / forward):
        return 0.0
    return min(max(turn / forward, -1.0 / TIGHTEST), 1.0 / TIGHTEST)


@compiled
def _find_obstacles(
    points: Float32,
    ground: Float,
    sensor: Float,
    curvature: float,
    backward: bool,
    band: Float,
    robot: Float,
    zones: Float,
    least: int,
) -> tuple[int, float, float, float, float]:
    """Find the obstacles along the path of the robot.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m]; rows with NaN are ignored.
        ground: `Terrain.height`; shape (0, 0) if unknown: then heights are relative to the base.
        sensor: Position of the sensor in the level base frame, shape (3,) [m].
        curvature: Curvature of the path [1/m].
        backward: Whether the robot drives backwards.
        band: Lowest and highest height of obstacles, inclusive, shape (2,) [m].
        robot: Extent of the robot in and against the direction of driving and half of its width, shape (3,)
            [m].
        zones: Lengths of the zones STOP and SLOW from the end of the robot, shape (2,) [m].
        least: Minimum number of returns within DEPTH that form an obstacle.

    Returns:
        Zone as an integer (CLEAR becomes UNKNOWN with fewer than `least` returns within 30 degrees of the
        direction of driving); distance along the path from the end of the robot, and minimum lateral distance
        [m] from its sides up to BESIDE, infinite if there is no obstacle; x, y [m] of a return of the nearest
        obstacle on the path in the level base frame, NaN if there is none.
    """
    reach, behind, half = robot[0], robot[1], robot[2]
    stop, slow = zones[0], zones[1]
    most = reach + slow
    farthest = (most + half + BESIDE) ** 2
    way = -1.0 if backward else 1.0
    s, place, aside = np.empty(points.shape[0]), np.empty((points.shape[0], 2)), np.empty(points.shape[0])
    n = near = looks = 0
    for i in range(points.shape[0]):
        x, y = points[i, 0] + sensor[0], points[i, 1] + sensor[1]
        looks += abs(y) < way * x * _LOOKING
        if not x * x + y * y < farthest:  # also false for NaN
            continue
        off = _lateral_distance(way * x, y, curvature)
        if off > half + BESIDE:  # checked first: most ground returns fail here
            continue
        along = _arc_length(way * x, y, curvature)
        if along <= -behind or along > most:
            continue
        height = points[i, 2] + sensor[2]
        if ground.shape[0] > 0:
            height = points[i, 2] - ground_at(ground, points[i, 0], points[i, 1])
        if not band[0] <= height <= band[1]:
            continue
        aside[near] = max(off - half, 0.0)
        near += 1
        if off <= half:
            s[n], place[n, 0], place[n, 1] = max(along - reach, 0.0), x, y
            n += 1
    beside = _nearest(aside[:near], least)
    ahead = _nearest(s[:n], least)
    at_x = at_y = np.nan
    for i in range(n):
        if s[i] == ahead:
            at_x, at_y = place[i, 0], place[i, 1]
    zone = 2 if ahead < stop else (1 if ahead < slow else 0)
    if zone == 0 and looks < least:
        zone = 3
    return zone, ahead, beside, at_x, at_y


@compiled
def _lateral_distance(x: float, y: float, curvature: float) -> float:
    """Return the lateral distance [m] of a point x, y [m] from the arc through the origin that begins along
    +x with a curvature [1/m], positive to the left."""
    if abs(curvature) < STRAIGHT:
        return abs(y)
    radius = 1.0 / abs(curvature)
    to_centre = radius - (y if curvature > 0.0 else -y)
    return float(abs(radius - np.sqrt(x * x + to_centre * to_centre)))


@compiled
def _arc_length(x: float, y: float, curvature: float) -> float:
    """Return the arc length [m] from the origin to the foot point of a point x, y [m] on the arc through the
    origin that begins along +x with a curvature [1/m], positive to the left; up to half a turn is in front of
    the robot, the rest is negative."""
    if abs(curvature) < STRAIGHT:
        return x
    radius = 1.0 / abs(curvature)
    return float(radius * np.arctan2(x, radius - (y if curvature > 0.0 else -y)))


@compiled
def _nearest(values: Float, least: int) -> float:
    """Return the smallest of the values, shape (N,) [m], that starts a group of `least` values within DEPTH,
    or infinity if there is no such group.

    Fewer returns, such as rain or an insect, are not an obstacle.
    """
    ordered = ascending(values)
    for i in range(ordered.shape[0] - least + 1):
        if ordered[i + least - 1] - ordered[i] <= DEPTH:
            return float(ordered[i])
    return np.inf
