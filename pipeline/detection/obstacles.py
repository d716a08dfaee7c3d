"""Obstacle detection in the path of the robot, from one scan.

The path is the arc that results from the current velocities. With the forward velocity v and the yaw rate
omega, its centre is (0, R) in the base frame, R = v / omega. A point (x, y) has the angle theta = atan2(x,
sign(R) (R - y)), the arc length s = |R| theta and the lateral distance |R| - |(x, y - R)|.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.config.stages import Obstacles
from pipeline.ground.scan_ground import Terrain, heights_of_places
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
    reach, behind, half = robot.tolist()
    stop, slow = zones.tolist()
    way = -1.0 if backward else 1.0
    place = points[:, :2] + sensor[:2]
    looks = np.count_nonzero(np.abs(place[:, 1]) < way * _LOOKING * place[:, 0])
    rows = np.flatnonzero((place * place).sum(axis=1) < (reach + slow + half + BESIDE) ** 2)  # not NaN
    off = _lateral_distance(way * place[rows, 0], place[rows, 1], curvature)
    rows, off = rows[off <= half + BESIDE], off[off <= half + BESIDE]  # most ground returns fail here
    along = _arc_length(way * place[rows, 0], place[rows, 1], curvature)
    on_way = (along > -behind) & (along <= reach + slow)
    rows, off, along = rows[on_way], off[on_way], along[on_way]
    height = points[rows, 2] + sensor[2]
    if len(ground):
        height = heights_of_places(points[rows].astype(np.float64), ground)
    tall = (band[0] <= height) & (height <= band[1])
    rows, off, along = rows[tall], off[tall], along[tall]
    beside = _nearest(np.maximum(off - half, 0.0), least)
    rows, along = rows[off <= half], np.maximum(along[off <= half] - reach, 0.0)
    ahead = _nearest(along, least)
    x, y = place[rows[along == ahead]][-1].tolist() if np.isfinite(ahead) else (math.nan, math.nan)
    zone = 2 if ahead < stop else (1 if ahead < slow else 0)
    return 3 if zone == 0 and looks < least else zone, ahead, beside, x, y


def _lateral_distance(x: Float, y: Float, curvature: float) -> Float:
    """Return the lateral distances, shape (N,) [m], of points x, y [m] from the arc through the origin that
    begins along +x with a curvature [1/m], positive to the left."""
    if abs(curvature) < STRAIGHT:
        return np.abs(y)
    radius = 1.0 / abs(curvature)
    to_centre = radius - math.copysign(1.0, curvature) * y
    return np.abs(radius - np.sqrt(x * x + to_centre * to_centre))


def _arc_length(x: Float, y: Float, curvature: float) -> Float:
    """Return the arc lengths, shape (N,) [m], from the origin to the foot points of points x, y [m] on the
    arc through the origin that begins along +x with a curvature [1/m], positive to the left; up to half a
    turn is in front of the robot, the rest is negative."""
    if abs(curvature) < STRAIGHT:
        return x
    radius = 1.0 / abs(curvature)
    along: Float = radius * np.arctan2(x, radius - math.copysign(1.0, curvature) * y)
    return along


def _nearest(values: Float, least: int) -> float:
    """Return the smallest of the values, shape (N,) [m], that starts a group of `least` values within DEPTH,
    or infinity if there is no such group.

    Fewer returns, such as rain or an insect, are not an obstacle.
    """
    ordered = np.sort(values)
    starts = ordered[: max(len(ordered) - least + 1, 0)]
    starts = starts[ordered[least - 1 :] - starts <= DEPTH]
    return float(starts[0]) if len(starts) else math.inf
