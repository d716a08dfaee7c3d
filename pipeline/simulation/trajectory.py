"""How the robot drives: a smooth path through waypoints, with limits on speed, turning and gain of speed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from pipeline.simulation.speed_profile import (
    ACCELERATION,
    YAW_RATE,
    Spin,
    curvature_beside,
    runs_of,
    sharp_cells,
    within_gains,
)
from pipeline.types.records import Float

RATE_HZ = 200
_DS = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The planar motion at 200 Hz; columns of length T.

    Attributes:
        t: Time since the start [s].
        x, y: [m]; the first pose is the origin.
        yaw: [rad], continuous, 0 at the start.
        speed: [m/s] in the plane.
        yaw_rate: [rad/s].
    """

    t: Float
    x: Float
    y: Float
    yaw: Float
    speed: Float
    yaw_rate: Float


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """The line on the ground that is driven, sampled each 2 cm; the first point is the origin, and it
    leaves along x. `yaw` is continuous, `curvature` is in 1/m."""

    s: Float
    x: Float
    y: Float
    yaw: Float
    curvature: Float
    closed: bool


def lay_course(waypoints: Float, closed: bool) -> Course:
    """A smooth line through waypoints of shape (N, 2) [m], moved and turned to begin at the origin."""
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
    return Course(s, c * x + sn * y, c * y - sn * x, yaw - yaw[0], curvature, closed)


def drive_course(course: Course, speed: float, duration_s: float) -> Drive:
    """Drive a course from standing still for `duration_s`: lap after lap when it is closed, else to its end.

    Args:
        course: Where to drive.
        speed: On the straight [m/s]; turns are driven at 0.5 rad/s at most, and where the way goes back on
            itself the robot stops and turns on the spot.
        duration_s: Length of the run [s]; the table reaches a little beyond.
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
    lap, rest = np.divmod(along, course.s[-1]) if course.closed else (np.zeros_like(along), along)
    x, y = (np.asarray(np.interp(rest, course.s, line)) for line in (course.x, course.y))
    yaw = np.interp(rest, course.s, course.yaw) + lap * (course.yaw[-1] - course.yaw[0])
    yaw_rate = v * np.interp(rest, course.s, course.curvature)
    for rows, spin in zip(during, table.spins, strict=True):
        part, pace = spin.at(t[rows])
        yaw[rows], yaw_rate[rows] = spin.yaw + part * spin.turn, pace * spin.turn
    return Drive(t=t, x=x, y=y, yaw=yaw, speed=v, yaw_rate=yaw_rate)


def lap_time(course: Course, speed: float) -> float:
    """How long it takes to drive a course once, from standing still; see `drive_course` [s]."""
    return float(_timetable(course, speed, 1).time[-1])


@dataclass(frozen=True, slots=True, eq=False)
class _Timetable:
    """Way [m], speed [m/s] and time [s] where the robot does not turn on the spot, the turns that it does
    there, and the course without their curvature."""

    s: Float
    v: Float
    time: Float
    spins: list[Spin]
    course: Course


def _timetable(course: Course, speed: float, laps: int) -> _Timetable:
    sharp = sharp_cells(course.s, course.yaw)
    if sharp.any():
        beside = curvature_beside(sharp, course.s, course.yaw, course.closed)
        course = replace(course, curvature=beside)
    limit, curvature = speed_limit(course, speed), course.curvature
    # All laps in a row, so that the seam between two is a place as any other.
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
    """How fast each place of a course may be driven [m/s]: turns at 0.5 rad/s at most."""
    mode = "wrap" if course.closed else "nearest"
    limit = np.minimum(speed, YAW_RATE / np.maximum(np.abs(course.curvature), 1e-6))
    window = int(0.6 / _DS)
    slowest: Float = minimum_filter1d(limit, 2 * window + 1, mode=mode)
    smooth: Float = gaussian_filter1d(slowest, window / 3.0, mode=mode)
    return smooth
