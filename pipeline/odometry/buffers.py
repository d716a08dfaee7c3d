"""Odometry and measured poses of the last seconds, looked up at the time of a scan."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Pose2, Pose3, interpolate, wrap_angle
from pipeline.types.records import Odometry, PoseMeasurement

KEEP_NS = 2_000_000_000
JUMP_SPEED, JUMP_TURN = 15.0, 6.0  # m/s, rad/s; a faster step of the odometry is a jump
STANDSTILL = (0.005, 0.002)  # m, rad; the pose of a robot that does not move varies by less
STILL = (0.0, 0.0, 0.0)

Tilt = tuple[float, float]  # roll, pitch [rad]


@dataclass(frozen=True, slots=True)
class Reading:
    """Planar odometry without jumps; tilt is None for odometry in the plane."""

    stamp_ns: int
    pose: Pose2
    tilt: Tilt | None


class Jump(NamedTuple):
    """A step of the odometry that is impossible for a robot: distance [m] and absolute turn [rad]."""

    distance: float
    turn: float


class Moving(NamedTuple):
    """Motion of the base at a time: T_odom_base, velocity x, y [m/s], yaw [rad/s] in the base frame, and tilt
    (None for odometry in the plane)."""

    pose: Pose2
    twist: tuple[float, float, float]
    tilt: Tilt | None


class OdometryBuffer:
    """The odometry of the last seconds, from which jumps are removed.

    Attributes:
        standing_since: Time [ns] and pose since which the robot has not moved, None before the first reading.
    """

    def __init__(self) -> None:
        """Create an empty buffer."""
        self._readings: deque[Reading] = deque()
        self._T_odom_jumped = Pose2()
        self.standing_since: tuple[int, Pose2] | None = None

    @property
    def newest(self) -> Reading | None:
        """The last reading, None before the first one."""
        return self._readings[-1] if self._readings else None

    def add(self, odometry: Odometry) -> Jump | None:
        """Add a finite reading that is later than the last one; return its jump, None if there is none.

        A step faster than JUMP_SPEED or JUMP_TURN (over at least 0.1 s) is a jump: the reading gets the pose
        of the one before, and later readings continue from there."""
        raw, jump = odometry.T_odom_base.planar(), None
        pose = self._T_odom_jumped @ raw
        if self._readings:
            last = self._readings[-1]
            step = last.pose.inverse() @ pose
            span = max((odometry.stamp_ns - last.stamp_ns) * 1e-9, 0.1)
            distance = float(np.hypot(step.x, step.y))
            if distance > JUMP_SPEED * span or abs(step.yaw) > JUMP_TURN * span:
                jump = Jump(distance, abs(step.yaw))
                self._T_odom_jumped = last.pose @ raw.inverse()
                pose = self._T_odom_jumped @ raw
        reading = Reading(odometry.stamp_ns, pose, _tilt(odometry.T_odom_base))
        self._readings.append(reading)
        self._watch_standing(reading)
        return jump

    def _watch_standing(self, reading: Reading) -> None:
        """Set `standing_since` to a reading if it has moved from there by STANDSTILL or more."""
        if self.standing_since is not None:
            away = self.standing_since[1].inverse() @ reading.pose
            if np.hypot(away.x, away.y) < STANDSTILL[0] and abs(away.yaw) < STANDSTILL[1]:
                return
        self.standing_since = (reading.stamp_ns, reading.pose)

    def forget(self, needed_ns: int) -> None:
        """Remove the readings that are more than KEEP_NS before a time [ns]; at least two readings remain,
        and the last one before that limit."""
        while len(self._readings) > 2 and self._readings[1].stamp_ns < needed_ns - KEEP_NS:
            self._readings.popleft()

    def pose_at(self, stamp_ns: int) -> Pose2:
        """Return T_odom_base at a time [ns]: interpolated, or that of the nearest reading outside of their
        range.

        Raises:
            IndexError: There is no reading.
        """
        before, after = self._around(stamp_ns)
        span = after.stamp_ns - before.stamp_ns
        fraction = (stamp_ns - before.stamp_ns) / span if span > 0 else 1.0
        return interpolate(before.pose, after.pose, min(max(fraction, 0.0), 1.0))

    def motion_at(self, stamp_ns: int) -> Moving:
        """Return the motion of the base at a time [ns]: pose and tilt interpolated, velocity constant between
        two readings. Outside of the readings pose and tilt are those of the nearest one, with the velocity of
        the nearest two. With a single reading the velocity is 0.

        Raises:
            IndexError: There is no reading.
        """
        before, after = self._around(stamp_ns)
        span = (after.stamp_ns - before.stamp_ns) * 1e-9
        if span <= 0.0:
            return Moving(after.pose, STILL, after.tilt)
        fraction = float(np.clip((stamp_ns - before.stamp_ns) * 1e-9 / span, 0.0, 1.0))
        step = before.pose.inverse() @ after.pose
        twist = (step.x / span, step.y / span, step.yaw / span)
        return Moving(
            interpolate(before.pose, after.pose, fraction), twist, _tilt_between(before, after, fraction)
        )

    def _around(self, stamp_ns: int) -> tuple[Reading, Reading]:
        """Return the readings before and after a time [ns], or the two nearest ones outside of their range;
        of a single reading twice this one. IndexError without a reading."""
        readings = self._readings
        after = next((k for k, r in enumerate(readings) if r.stamp_ns >= stamp_ns), len(readings) - 1)
        after = max(after, min(1, len(readings) - 1))
        return readings[max(after - 1, 0)], readings[after]


def _tilt_between(before: Reading, after: Reading, fraction: float) -> Tilt | None:
    """Return roll and pitch between two readings; a reading without a tilt is level. None if neither has a
    tilt.

    Args:
        before, after: The readings.
        fraction: Position between them, from 0 (before) to 1 (after).
    """
    if before.tilt is None and after.tilt is None:
        return None
    (roll, pitch), (roll_after, pitch_after) = before.tilt or (0.0, 0.0), after.tilt or (0.0, 0.0)
    turn = float(wrap_angle(roll_after - roll))
    return roll + fraction * turn, pitch + fraction * (pitch_after - pitch)


def _tilt(T_odom_base: Pose3) -> Tilt | None:
    """Return roll and pitch of a pose [rad]; None if both are 0, as for odometry in the plane."""
    roll, pitch, _ = T_odom_base.euler()
    return None if roll == 0.0 and pitch == 0.0 else (roll, pitch)


SAME_TIME_NS = 50_000_000
CARRIED_NS = 500_000_000  # maximum time over which a pose is predicted by the odometry
CARRIED = 0.05  # standard deviation of that prediction, as a share of the distance and of the turn
NO_HEADING = 1.0  # rad^2; with a larger variance the heading is unknown
MOST = 64


class PoseBuffer:
    """The pose measurements of the last seconds. Positions without a heading, such as GNSS fixes, are kept
    separately, because the odometry cannot predict them."""

    def __init__(self) -> None:
        """Create an empty buffer, which keeps at most MOST positions and MOST poses."""
        self._places: deque[PoseMeasurement] = deque(maxlen=MOST)
        self._poses: deque[PoseMeasurement] = deque(maxlen=MOST)

    def add(self, pose: PoseMeasurement) -> bool:
        """Add a valid pose and return True; return False, and ignore it, if it is not later than the last one
        of its kind (position, with a yaw variance of NO_HEADING or more, or pose). The oldest one of more
        than MOST is removed."""
        kept = self._places if pose.covariance[2, 2] >= NO_HEADING else self._poses
        if kept and pose.stamp_ns <= kept[-1].stamp_ns:
            return False
        kept.append(pose)
        return True

    def at(
        self, stamp_ns: int, T_odom_base: Pose2 | None, odometry_at: Callable[[int], Pose2] | None
    ) -> PoseMeasurement | None:
        """Return the pose measurement for a scan, None if there is none.

        A position within SAME_TIME_NS of the scan is returned as it is. Otherwise the latest pose up to the
        scan is predicted to it by the odometry, if it is at most CARRIED_NS older; without odometry it must
        be within SAME_TIME_NS. That pose and earlier ones are removed.

        Args:
            stamp_ns: Time of the scan [ns].
            T_odom_base: Odometry at the scan, None if unknown.
            odometry_at: Returns T_odom_base at an earlier time [ns]; None without odometry.
        """
        near = min(self._places, key=lambda pose: abs(pose.stamp_ns - stamp_ns), default=None)
        if near is not None and abs(near.stamp_ns - stamp_ns) <= SAME_TIME_NS:
            return near
        latest = None
        while self._poses and self._poses[0].stamp_ns <= stamp_ns:
            latest = self._poses.popleft()
        if latest is None or stamp_ns - latest.stamp_ns > CARRIED_NS:
            return None
        if T_odom_base is None or odometry_at is None:
            return latest if stamp_ns - latest.stamp_ns <= SAME_TIME_NS else None
        return _carried(latest, odometry_at(latest.stamp_ns).inverse() @ T_odom_base, stamp_ns)


def _carried(pose: PoseMeasurement, step: Pose2, stamp_ns: int) -> PoseMeasurement:
    """Return a pose measurement predicted to a later time: P' = F P F^T + Q; Q has the sigma CARRIED times
    the distance and the turn of the step.

    Args:
        pose: The measurement.
        step: Step of the odometry from its time to `stamp_ns`.
        stamp_ns: The later time [ns].
    """
    error = CARRIED * float(np.hypot(step.x, step.y))
    at = pose.T_map_base @ step
    dx, dy = at.x - pose.T_map_base.x, at.y - pose.T_map_base.y
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    Q = np.diag([error**2, error**2, (CARRIED * step.yaw) ** 2])
    covariance = F @ pose.covariance @ F.T + Q
    shared = None if pose.shared is None else F @ pose.shared
    return replace(pose, stamp_ns=stamp_ns, T_map_base=at, covariance=covariance, shared=shared)
