"""Motion of the simulated robot, and its wheel odometry and IMU.

The true motion is a smooth course through waypoints, driven with limits on speed, turn rate and their
changes, and the pose of the base on the terrain with a little vibration. Wheels have a wrong radius and track
width, slip on slopes, and noise. The IMU measures turn rates, specific force, and an attitude whose yaw
drifts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from pipeline.geometry.poses import Pose3, euler_rotation
from pipeline.simulation.scenarios import WheelQuality
from pipeline.types.records import Bool, Float, Int

ACCELERATION = 0.5  # m/s^2
YAW_RATE = 0.5  # rad/s
YAW_GAIN = 1.0  # rad/s^2, largest change of the turn rate
CREEP = 0.1  # m/s; where even this speed is too fast for a turn, the robot turns on the spot
_APART = 5  # samples; turns on the spot that are nearer to one another, or to an end, are joined


def sharp_cells(s: Float, yaw: Float) -> Bool:
    """Return for each cell between two of N samples of a line whether the robot rotates on the spot in it,
    shape (N - 1,).

    It does so where the yaw rate at the speed CREEP exceeds YAW_RATE, and in cells between two such cells, or
    between one and an end of the line, that are at most _APART apart. The difference of the yaw is used,
    because a cusp between two samples has no curvature at them.

    Args:
        s: Distances along the line, shape (N,) [m].
        yaw: Directions of the line, not wrapped, shape (N,) [rad].
    """
    sharp = np.abs(np.diff(yaw)) > YAW_RATE / CREEP * np.diff(s)
    if sharp.any():
        rows = np.concatenate([[-1], np.flatnonzero(sharp), [sharp.size]])
        for before, after in pairwise(rows):
            sharp[before + 1 : after] |= after - before <= _APART
    return sharp


def neighbouring_curvature(sharp: Bool, s: Float, yaw: Float, closed: bool) -> Float:
    """Return the curvature at each of N samples of a path, shape (N,) [1/m].

    The curvature of a cell between two samples is the change of yaw per metre. A sample has the mean of its
    two cells, of which sharp cells are left out; 0 if both are sharp. The first and the last sample of an
    open path have one cell; those of a closed path share the first and the last cell.

    Args:
        sharp: Whether the robot rotates on the spot in each cell, see `sharp_cells`, shape (N - 1,).
        s: Distance of each sample along the path, shape (N,) [m].
        yaw: Yaw of each sample, not wrapped, shape (N,) [rad].
        closed: Whether the last sample is the first one.
    """
    slope = np.where(sharp, np.nan, np.diff(yaw) / np.diff(s))
    before = np.concatenate([slope[-1:] if closed else slope[:1], slope])
    after = np.concatenate([slope, slope[:1] if closed else slope[-1:]])
    before, after = np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)
    curvature: Float = np.nan_to_num(0.5 * (before + after))
    return curvature


def runs_of(sharp: Bool) -> Int:
    """Return the first and last sample of each run of sharp cells, shape (K, 2), K may be 0. `sharp` has the
    shape (N - 1,) for N samples."""
    edges = np.diff(np.concatenate([[0], sharp.astype(np.int8), [0]]))
    return np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1)


def within_gains(v: Float, s: Float, curvature: Float) -> Float:
    """Return the highest speeds not above `v` that the robot can reach one after the other: for all samples i

        v_i^2 <= v_(i -+ 1)^2 + 2 a ds  with  a = min(ACCELERATION, YAW_GAIN / (2 |k|))
        v_i^2 |dk / ds| <= YAW_GAIN / 2

    so that the yaw rate k v changes by no more than a |k| + v^2 |dk / ds| <= YAW_GAIN.

    Args:
        v: Limit at each sample, shape (N,) [m/s].
        s: Distance along the line at each sample, shape (N,) [m].
        curvature: Curvature k at each sample, linear between two samples, shape (N,) [1/m].
    """
    ds, k = np.diff(s), np.abs(curvature)
    bend = np.abs(np.diff(curvature)) / ds
    bend = np.maximum(np.append(bend, 0.0), np.append(0.0, bend))
    limit = np.minimum(v, np.sqrt(0.5 * YAW_GAIN / np.maximum(bend, 1e-9)))
    gain = np.minimum(ACCELERATION, 0.5 * YAW_GAIN / np.maximum(np.maximum(k[1:], k[:-1]), 1e-9))
    far = np.append(0.0, np.cumsum(2.0 * gain * ds))
    square = limit * limit
    forth = np.minimum.accumulate(square - far) + far
    back = (np.minimum.accumulate((square + far)[::-1]))[::-1] - far
    reached = np.maximum(np.minimum(forth, back), 0.0)
    # Speeds that need no change keep their bits.
    bounded: Float = np.where(reached < square * (1.0 - 1e-9), np.sqrt(reached), limit)
    return bounded


class Spin(NamedTuple):
    """A rotation on the spot from rest to rest, as a share f of the distance and of the angle with f'' =
    gain, 0, -gain.

    Attributes:
        begin, takes: Begin and duration [s].
        gain, ramp: Second derivative of f [1/s^2] and the duration of the acceleration [s].
        first, way: Begin and length along the line [m].
        yaw, turn: Yaw at the begin and angle of the rotation [rad].
    """

    begin: float
    takes: float
    gain: float
    ramp: float
    first: float
    way: float
    yaw: float
    turn: float

    @classmethod
    def over(cls, first: float, way: float, yaw: float, turn: float) -> Spin:
        """Return the fastest rotation within the limits of speed and acceleration; it begins at time 0.

        Args:
            first: Distance along the course at which the rotation begins [m].
            way: Length of the course on which the rotation is made, above 0 [m].
            yaw: Yaw at the begin [rad].
            turn: Angle of the rotation [rad].
        """
        rate = min(YAW_RATE / max(abs(turn), 1e-9), CREEP / way)
        gain = min(YAW_GAIN / max(abs(turn), 1e-9), ACCELERATION / way)
        ramp = min(rate / gain, gain**-0.5)  # a short turn decelerates before it reaches the rate
        return cls(0.0, 1.0 / (gain * ramp) + ramp, gain, ramp, first, way, yaw, turn)

    def at(self, t: Float) -> tuple[Float, Float]:
        """Return the share f of the turn and f' [1/s] at times of shape (N,) [s]; 0 and 0 before the
        rotation, 1 and 0 after it."""
        up = np.clip(t - self.begin, 0.0, self.takes)
        left = self.takes - up
        even = self.gain * self.ramp * (up - 0.5 * self.ramp)
        part = np.where(up < self.ramp, 0.5 * self.gain * up * up, even)
        part = np.where(left < self.ramp, 1.0 - 0.5 * self.gain * left * left, part)
        return part, self.gain * np.minimum(np.minimum(up, left), self.ramp)


RATE_HZ = 200
_DS = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Planar motion at 200 Hz, as columns of length T.

    Attributes:
        t: Time since the start [s].
        x, y: Position in the world [m]; the first pose is the origin.
        yaw: Yaw [rad], continuous, 0 at the start.
        speed: Speed in the plane [m/s].
        yaw_rate: Yaw rate [rad/s].
    """

    t: Float
    x: Float
    y: Float
    yaw: Float
    speed: Float
    yaw_rate: Float


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """The course in the plane, sampled every 2 cm, as columns of length N: distance s, x, y [m], yaw [rad]
    and curvature [1/m]. It begins at the origin along x; `yaw` is continuous. `heading` is the direction of
    its begin in the frame of the waypoints [rad]."""

    s: Float
    x: Float
    y: Float
    yaw: Float
    curvature: Float
    closed: bool
    heading: float


def lay_course(waypoints: Float, closed: bool) -> Course:
    """Return a smooth course (cubic spline) through waypoints, moved and rotated to begin at the origin along
    x.

    Args:
        waypoints: Waypoints x, y, shape (N, 2) [m], no two in a row equal; the first is not repeated for a
            closed course.
        closed: Whether the course returns to the first waypoint; its last sample is the first one then.
    """
    knots = np.vstack([waypoints, waypoints[:1]]) if closed else waypoints
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(knots, axis=0).T))])
    spline = CubicSpline(chord, knots, bc_type="periodic" if closed else "natural")
    u = np.linspace(0.0, chord[-1], max(int(chord[-1] / (0.25 * _DS)), 100))
    fine = spline(u)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fine, axis=0).T))])
    s = np.linspace(0.0, length[-1], round(length[-1] / _DS) + 1)
    at = np.interp(s, length, u)
    xy, first, second = spline(at), spline(at, 1), spline(at, 2)
    norm = np.hypot(first[:, 0], first[:, 1])
    yaw = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / norm**3
    c, sn = np.cos(yaw[0]), np.sin(yaw[0])
    x, y = (xy - xy[0]).T
    return Course(s, c * x + sn * y, c * y - sn * x, yaw - yaw[0], curvature, closed, float(yaw[0]))


def drive_course(course: Course, speed: float, duration_s: float) -> Drive:
    """Drive a course from rest for `duration_s`: repeatedly when it is closed, else to its end, where the
    robot stops.

    Args:
        course: The course.
        speed: Speed on the straight [m/s]. Turns are driven at 0.5 rad/s at most; where the course reverses,
            the robot stops and rotates on the spot.
        duration_s: Duration of the run [s]; the result is half a second longer.
    """
    until = duration_s + 0.5
    laps = max(1, int(np.ceil(until * speed / course.s[-1])) + 1) if course.closed else 1
    table = _timetable(course, speed, laps)
    s, course = table.s, table.course
    t = np.arange(int(np.ceil(until * RATE_HZ)) + 1) / RATE_HZ
    along = np.interp(t, table.time, s)
    v = np.where(along < s[-1], np.interp(along, s, table.v), 0.0)
    during = [(t >= spin.begin) & (t < spin.begin + spin.takes) for spin in table.spins]
    for rows, spin in zip(during, table.spins, strict=True):
        part, pace = spin.at(t[rows])
        along[rows], v[rows] = spin.first + part * spin.way, pace * spin.way
    drive = on_course(course, t, along, v)
    for rows, spin in zip(during, table.spins, strict=True):
        part, pace = spin.at(t[rows])
        drive.yaw[rows], drive.yaw_rate[rows] = spin.yaw + part * spin.turn, pace * spin.turn
    return drive


def on_course(course: Course, t: Float, along: Float, speed: Float) -> Drive:
    """Return the motion along a course; a closed course is driven any number of times, and the yaw grows with
    each. An open course ends at its last sample.

    Args:
        course: The course.
        t: Times, shape (T,) [s].
        along: Distance driven at these times, shape (T,) [m].
        speed: Speed at these times, shape (T,) [m/s].
    """
    lap, rest = np.divmod(along, course.s[-1]) if course.closed else (np.zeros_like(along), along)
    x, y, yaw, curvature = (
        np.asarray(np.interp(rest, course.s, column))
        for column in (course.x, course.y, course.yaw, course.curvature)
    )
    yaw = yaw + lap * (course.yaw[-1] - course.yaw[0])
    return Drive(t=t, x=x, y=y, yaw=yaw, speed=speed, yaw_rate=speed * curvature)


def lap_time(course: Course, speed: float) -> float:
    """Return the time to drive a course once from rest [s], for a speed on the straight [m/s], see
    `drive_course`."""
    return float(_timetable(course, speed, 1).time[-1])


@dataclass(frozen=True, slots=True, eq=False)
class _Timetable:
    """Distance [m], speed [m/s] and time [s] of samples outside of rotations on the spot, these rotations,
    and the course without their curvature."""

    s: Float
    v: Float
    time: Float
    spins: list[Spin]
    course: Course


def _timetable(course: Course, speed: float, laps: int) -> _Timetable:
    """Return when a robot that starts at rest reaches each sample of a course.

    Args:
        course: The course.
        speed: Speed on the straight [m/s].
        laps: Number of laps, 1 for an open course, which ends at rest.
    """
    sharp = sharp_cells(course.s, course.yaw)
    if sharp.any():
        curvature = neighbouring_curvature(sharp, course.s, course.yaw, course.closed)
        course = replace(course, curvature=curvature)
    limit, curvature = speed_limit(course, speed), course.curvature
    # All laps in a row, so that the joint between two laps needs no special case.
    v, k = (
        np.concatenate([np.tile(c[:-1], laps), c[:1] if course.closed else c[-1:]])
        for c in (limit, curvature)
    )
    s = np.arange(v.size) * (course.s[1] - course.s[0])
    yaw = np.append(0.0, np.cumsum(np.tile(np.diff(course.yaw), laps)))
    runs = runs_of(np.tile(sharp, laps))
    v[runs] = 0.0
    v = np.minimum(v, np.sqrt(2.0 * ACCELERATION * s))
    if not course.closed:
        v = np.minimum(v, np.sqrt(2.0 * ACCELERATION * (s[-1] - s)))
    v = within_gains(v, s, k)
    spins = [Spin.over(s[i], s[j] - s[i], yaw[i], yaw[j] - yaw[i]) for i, j in runs]
    takes = np.zeros(v.size - 1)
    driven = np.ones(v.size, np.bool_)
    for (i, j), spin in zip(runs, spins, strict=True):
        takes[i] = spin.takes
        driven[i + 1 : j] = False
    cells = ~np.tile(sharp, laps)
    takes[cells] = (2.0 * np.diff(s))[cells] / (v[1:] + v[:-1])[cells]
    time = np.concatenate([[0.0], np.cumsum(takes)])
    spins = [spin._replace(begin=time[i]) for (i, _), spin in zip(runs, spins, strict=True)]
    return _Timetable(s[driven], v[driven], time[driven], spins, course)


def speed_limit(course: Course, speed: float) -> Float:
    """Return the highest speed at each sample of a course, shape (N,) [m/s]: turns are driven at 0.5 rad/s at
    most, and the limit is smooth. `speed` is that on the straight [m/s]."""
    mode = "wrap" if course.closed else "nearest"
    limit = np.minimum(speed, YAW_RATE / np.maximum(np.abs(course.curvature), 1e-6))
    window = int(0.6 / _DS)
    slowest: Float = minimum_filter1d(limit, 2 * window + 1, mode=mode)
    smooth: Float = gaussian_filter1d(slowest, window / 3.0, mode=mode)
    return smooth


_VIBRATION_HZ = np.array([1.3, 2.9, 5.3, 8.7])
_VIBRATION_ANGLE = np.radians(np.array([0.20, 0.10, 0.06, 0.03]))


class TerrainModel(Protocol):
    """The ground below the robot."""

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy at positions x, y of shape (N,) each [m]; shape (N, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class TrueMotion:
    """True pose of the base at 200 Hz, as columns of length T. The base is on the ground.

    Attributes:
        drive: Planar part.
        z: Height in the world [m].
        roll, pitch: Tilt of the base [rad], R = Rz(yaw) Ry(pitch) Rx(roll).
    """

    drive: Drive
    z: Float
    roll: Float
    pitch: Float

    def at(self, t: Float) -> tuple[Float, Float]:
        """Return rotations, shape (N, 3, 3), and positions, shape (N, 3) [m], of the base in the world at
        ascending times t since the start, shape (N,) [s], interpolated; N is at least 1, and the first time
        is during the motion. Later times than its end give the last pose."""
        first = max(int(t[0] * RATE_HZ) - 1, 0)
        part = slice(first, int(np.ceil(t[-1] * RATE_HZ)) + 2)
        d = self.drive
        grid = d.t[part]
        x, y, z, roll, pitch, yaw = (
            np.interp(t, grid, column[part]) for column in (d.x, d.y, self.z, self.roll, self.pitch, d.yaw)
        )
        return euler_rotation(roll, pitch, yaw), np.stack([x, y, z], axis=1)

    def sensor_at(self, t: Float, T_base_lidar: Pose3) -> tuple[Float, Float]:
        """Return rotations, shape (T, 3, 3), and positions, shape (T, 3) [m], in the world of a sensor on the
        base at ascending times t since the start, shape (T,) [s], as in `at`; T is at least 1."""
        R, p = self.at(t)
        return np.ascontiguousarray(R @ T_base_lidar.R), p + R @ T_base_lidar.t


def lay_on_terrain(drive: Drive, terrain: TerrainModel, rng: np.random.Generator) -> TrueMotion:
    """Return the motion of a drive on the ground, with the base perpendicular to it, and with random
    vibration of roll and pitch while the robot moves.

    Args:
        drive: Planar motion.
        terrain: The ground.
        rng: Random generator of the phases of the vibration.
    """
    z, gx, gy = terrain.evaluate(drive.x, drive.y).T
    c, s = np.cos(drive.yaw), np.sin(drive.yaw)
    ahead, left = gx * c + gy * s, gy * c - gx * s
    moving = np.clip(drive.speed / 0.5, 0.0, 1.0)
    shake = [_vibration(drive.t, rng) * moving for _ in range(2)]
    return TrueMotion(
        drive=drive,
        z=z,
        roll=np.arcsin(left / np.sqrt(1.0 + ahead**2 + left**2)) + shake[0],
        pitch=-np.arctan(ahead) + shake[1],
    )


def _vibration(t: Float, rng: np.random.Generator) -> Float:
    """Return a vibration angle at times t, shape (T,) [s], as shape (T,) [rad], with random phases."""
    phase = rng.uniform(0.0, 2.0 * np.pi, _VIBRATION_HZ.size)
    waves = np.sin(2.0 * np.pi * np.outer(t, _VIBRATION_HZ) + phase)
    shaken: Float = waves @ _VIBRATION_ANGLE / np.sqrt(2.0)
    return shaken


# --- wheels and IMU ---------------------------------------------------------------------------------

ODOMETRY_HZ = 50
SPIN, SPIN_TURN = (0.02, 0.15), np.radians(1.0)  # m and rad that spinning wheels measure too much


def wheel_odometry(motion: TrueMotion, quality: WheelQuality, rng: np.random.Generator) -> Float:
    """Return x, y [m] and yaw [rad, not wrapped] by the wheels at 50 Hz, shape (N, 3), from the start of the
    motion; the first row is zero.

    The distance is measured along the ground. On a slope it is longer than its projection on the map, so
    planar odometry is wrong there even without noise.

    Args:
        motion: True motion.
        quality: Sizes of the errors.
        rng: Source of the errors.
    """
    step = RATE_HZ // ODOMETRY_HZ
    d = motion.drive
    x, y, z, yaw, pitch = (column[::step] for column in (d.x, d.y, motion.z, d.yaw, motion.pitch))
    distance = np.sqrt(np.diff(x) ** 2 + np.diff(y) ** 2 + np.diff(z) ** 2)
    turn = np.diff(yaw)
    # Each error is within 15 % of its nominal size, so that "poor" is never good by chance.
    signs = rng.choice([-1.0, 1.0], 3) * rng.uniform(0.85, 1.15, 3)
    uphill = -np.sin(0.5 * (pitch[1:] + pitch[:-1]))
    root = np.sqrt(distance)
    measured = distance * (1.0 + signs[0] * quality.scale + quality.slip * uphill)
    measured += quality.distance_noise * root * rng.standard_normal(distance.size)
    turned = turn * (1.0 + signs[1] * quality.turn_scale) + signs[2] * quality.turn_bias * distance
    turned += quality.turn_noise * root * rng.standard_normal(distance.size)
    if quality.spins > 0.0:
        first = np.flatnonzero(rng.random(distance.size) < quality.spins * distance)
        for begin in first:
            during = slice(begin, begin + ODOMETRY_HZ // 2)  # half a second
            measured[during] += rng.uniform(*SPIN) / (ODOMETRY_HZ // 2)
            turned[during] += rng.normal(0.0, SPIN_TURN) / (ODOMETRY_HZ // 2)
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    return np.stack(
        [
            np.concatenate([[0.0], np.cumsum(measured * np.cos(middle))]),
            np.concatenate([[0.0], np.cumsum(measured * np.sin(middle))]),
            heading,
        ],
        axis=1,
    )


IMU_HZ = 100
GRAVITY = 9.81
_GYRO_NOISE, _GYRO_BIAS = 0.004, 0.0008
_FORCE_NOISE, _FORCE_BIAS = 0.06, 0.03
_TILT_BIAS, _TILT_WANDER = np.radians(0.2), np.radians(0.2)
_WANDER_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Readings at 100 Hz in the base frame; columns of length N.

    Attributes:
        angular_velocity: Angular velocity, shape (N, 3) [rad/s].
        linear_acceleration: Specific force, shape (N, 3) [m/s^2]; +9.81 along z at rest on level ground.
        attitude: Roll, pitch and yaw, shape (N, 3) [rad]; yaw starts at 0 and drifts.
    """

    angular_velocity: Float
    linear_acceleration: Float
    attitude: Float

    def orientation(self, n: int) -> Float:
        """Return the measured attitude of reading n as a unit quaternion w, x, y, z, shape (4,): the rotation
        from the base frame to the level frame in which `attitude` is measured."""
        roll, pitch, yaw = self.attitude[n]
        return Pose3.from_euler(np.zeros(3), roll, pitch, yaw).quaternion()


def inertial_readings(motion: TrueMotion, rng: np.random.Generator) -> Inertial:
    """Return rates, forces and attitude of the IMU at 100 Hz from the start of a motion, with bias and noise.

    Args:
        motion: True motion.
        rng: Source of the errors.
    """
    step, dt = RATE_HZ // IMU_HZ, 1.0 / RATE_HZ
    d = motion.drive
    roll, pitch = motion.roll, motion.pitch
    roll_rate, pitch_rate = np.gradient(roll, dt), np.gradient(pitch, dt)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn_rate = np.stack(
        [
            roll_rate - d.yaw_rate * sp,
            pitch_rate * cr + d.yaw_rate * cp * sr,
            -pitch_rate * sr + d.yaw_rate * cp * cr,
        ],
        axis=1,
    )[::step]
    ahead, left = np.gradient(d.speed, dt), d.speed * d.yaw_rate
    up = GRAVITY + np.gradient(np.gradient(motion.z, dt), dt)
    # Rx(roll)^T Ry(pitch)^T of the force in the level frame with x ahead.
    low = ahead * sp + up * cp
    force = np.stack([ahead * cp - up * sp, left * cr + low * sr, low * cr - left * sr], axis=1)[::step]
    count = turn_rate.shape[0]
    gyro_bias = _GYRO_BIAS * rng.standard_normal(3)
    measured_rate = turn_rate + gyro_bias + _GYRO_NOISE * rng.standard_normal((count, 3))
    measured_force = (
        force + _FORCE_BIAS * rng.standard_normal(3) + _FORCE_NOISE * rng.standard_normal((count, 3))
    )
    attitude = np.stack([roll[::step], pitch[::step], d.yaw[::step]], axis=1)
    attitude[:, :2] += _TILT_BIAS * rng.standard_normal(2) + _wander(count, rng)
    walk = _GYRO_NOISE / np.sqrt(IMU_HZ) * np.sqrt(1.0 / IMU_HZ) * np.cumsum(rng.standard_normal(count))
    attitude[:, 2] += gyro_bias[2] * np.arange(count) / IMU_HZ + walk - walk[0]
    return Inertial(measured_rate, measured_force, attitude)


def _wander(count: int, rng: np.random.Generator) -> Float:
    """Return a slow error of roll and pitch, shape (count, 2) [rad]: random knots, smoothly interpolated."""
    knots = int(count / IMU_HZ / _WANDER_S) + 3
    values = _TILT_WANDER * rng.standard_normal((knots, 2))
    at = np.arange(count) / IMU_HZ / _WANDER_S
    low = at.astype(np.int64)
    blend = (0.5 - 0.5 * np.cos(np.pi * (at - low)))[:, None]
    wandered: Float = (1.0 - blend) * values[low] + blend * values[low + 1]
    return wandered
