"""Synchroniser: joins each scan with the odometry, tilt and pose measurement at its time into a step.
Odometry and measured poses of the last seconds are kept, to be looked up at the time of a scan."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pipeline.geometry.poses import Float, Pose2, Pose3, interpolate, wrap_angle
from pipeline.map_faults import DOUBTFUL
from pipeline.odometry.gyro import MIRRORED, Gyro
from pipeline.types.records import (
    Bool,
    Imu,
    Notice,
    Odometry,
    PoseMeasurement,
    Record,
    Scan,
    Step,
    Turn,
)

KEEP_NS = 2_000_000_000
JUMP_SPEED, JUMP_TURN = 15.0, 6.0  # m/s, rad/s; a faster step of the odometry is a jump
STANDSTILL = (0.005, 0.002)  # m, rad; the pose of a robot that does not move varies by less
STILL = (0.0, 0.0, 0.0)

Tilt = tuple[float, float]  # roll, pitch [rad]


@dataclass(frozen=True, slots=True)
class Reading:
    """Planar odometry T_odom_base without jumps at a time [ns]; tilt: roll, pitch [rad], None for odometry in
    the plane; and the sum of the covariances of all steps, see Odometry, None if they are unknown."""

    stamp_ns: int
    pose: Pose2
    tilt: Tilt | None
    drift: Float | None


class Jump(NamedTuple):
    """A step of the odometry that is impossible for a robot: distance [m] and absolute rotation [rad]."""

    distance: float
    turn: float


class Moving(NamedTuple):
    """Motion of the base at a time: T_odom_base, velocity x, y [m/s], yaw [rad/s] in the base frame, and tilt
    (roll, pitch [rad]; None for odometry in the plane) and sum of the covariances of all steps, see
    Reading."""

    pose: Pose2
    twist: tuple[float, float, float]
    tilt: Tilt | None
    drift: Float | None


class OdometryBuffer:
    """The odometry of the last seconds, from which jumps are removed.

    Attributes:
        standing_since: Time [ns] and pose T_odom_base since which the robot has not moved by STANDSTILL or
            more; None before the first reading.
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
        drift = odometry.covariance
        if drift is not None and self._readings and (earlier := self._readings[-1].drift) is not None:
            drift = earlier + drift
        reading = Reading(odometry.stamp_ns, pose, _tilt(odometry.T_odom_base), drift)
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
            return Moving(after.pose, STILL, after.tilt, after.drift)
        fraction = float(np.clip((stamp_ns - before.stamp_ns) * 1e-9 / span, 0.0, 1.0))
        step = before.pose.inverse() @ after.pose
        twist = (step.x / span, step.y / span, step.yaw / span)
        drift = None
        if before.drift is not None and after.drift is not None:
            drift = before.drift + fraction * (after.drift - before.drift)
        pose = interpolate(before.pose, after.pose, fraction)
        return Moving(pose, twist, _tilt_between(before, after, fraction), drift)

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
        be within SAME_TIME_NS. That pose and earlier ones are removed, also if they are too old; positions
        are not removed.

        Args:
            stamp_ns: Time of the scan [ns].
            T_odom_base: Odometry at the scan, None if unknown.
            odometry_at: Returns T_odom_base at an earlier time [ns]; None if there is no odometry.
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
    """Return a pose measurement predicted to a later time: P' = F P F^T + Q, shared' = F shared, with the
    Jacobian F of the step by the pose; the diagonal of Q is the square of CARRIED times the distance (x and
    y) and times the rotation (yaw) of the step.

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


OdometryChoice = Literal["auto", "wheels", "static"]
WAIT_NS = 500_000_000  # time for which a scan waits for later odometry
#: Scans that wait at most. It bounds the memory where damaged stamps are nearly equal: a scan of 100,000
#: points takes about 3 MB. Sensors of up to 100 Hz send fewer within WAIT_NS.
MOST_WAITING = 64
STALE_NS = 250_000_000  # readings farther in time from a scan are not used
JUMP_SLACK = (0.2, 0.05)  # m, rad; one sigma of the motion during a jump of the odometry
VIEW_NS = 80_000_000  # minimum time between two views: all scans of a sensor of 10 Hz with a jitter of 20 %
#: Number of sectors around a LiDAR, and of points from which the sectors of a scan are determined.
_DIRECTIONS, _SIGHT_POINTS = 36, 1000
PAUSE_NS = 10_000_000_000  # a longer time without a scan is reported
WALK_SPEED, WALK_TURN = 0.5, 0.2  # m/s, rad/s; one sigma of the motion without odometry
SETTLES_NS = 300_000_000
AHEAD_NS = 1_000_000_000
TILTS_NS = 90_000_000
NO_ODOMETRY = (
    "there is no odometry for some scans: the robot is assumed to stand still, unless trees show its motion"
)
FASTEST = 20.0  # rad/s; faster readings of the gyroscope are damaged


def steps(
    records: Iterable[Record],
    *,
    odometry: OdometryChoice = "auto",
    losses: Counter[str] | None = None,
) -> Iterator[Step]:
    """Yield a step for each scan: the scan with odometry and tilt interpolated to its time, the measured
    pose, and the rotation by the gyroscope since the last step.

    A scan waits for the first odometry at or after its stamp, until a scan is WAIT_NS later or more than
    MOST_WAITING scans wait; then the last pose is used. A scan that is not later than the last one is left
    out, counted in `losses`, and reported in the warnings of the next step. Without any odometry the step has
    no pose.

    Args:
        records: Records in the order of arrival.
        odometry: "static" ignores odometry, so that no step has a pose and no scan waits; the other choices
            use it.
        losses: Counter from reasons to numbers of records that were left out, increased in place; None to
            discard them.
    """
    counted = Counter[str]() if losses is None else losses
    joiner = Synchroniser(use_odometry=odometry != "static", losses=counted)
    for record in records:
        joiner.add(record)
        yield from joiner.ready()
    yield from joiner.ready(end=True)


class _Sights:
    """Times at which one LiDAR observed each sector. A driver may write half a turn or less per scan: two
    successive scans then cover different sectors."""

    def __init__(self) -> None:
        """Begin without scans."""
        self._seen_ns = np.full(_DIRECTIONS, -1, np.int64)
        self._viewed_ns = np.full(_DIRECTIONS, -1, np.int64)

    def add(self, scan: Scan) -> tuple[int | None, bool]:
        """Return the time since the previous scan of the same sectors [ns], None without one, and whether the
        scan is a view, see `Step`. Both follow from the median over the sectors of the scan."""
        looks = _directions_of(scan)
        seen_ns, viewed_ns = (int(np.median(ns[looks])) for ns in (self._seen_ns, self._viewed_ns))
        is_view = viewed_ns < 0 or scan.stamp_ns - viewed_ns >= VIEW_NS
        self._seen_ns[looks] = scan.stamp_ns
        if is_view:
            self._viewed_ns[looks] = scan.stamp_ns
        return (None if seen_ns < 0 else scan.stamp_ns - seen_ns), is_view


def _directions_of(scan: Scan) -> Bool:
    """Return the sectors that a scan covers, shape (_DIRECTIONS,): all but a gap of a quarter turn or more
    without a return. A scan with fewer than _SIGHT_POINTS sampled points covers all."""
    looks = np.ones(_DIRECTIONS, np.bool_)
    points = scan.points[:: max(len(scan.points) // _SIGHT_POINTS, 1)].astype(np.float64)
    if len(points) < _SIGHT_POINTS:
        return looks
    turn = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi)
    found = np.unique((turn * _DIRECTIONS).astype(np.int64) % _DIRECTIONS)
    gaps = np.diff(found, append=found[0] + _DIRECTIONS) - 1
    widest = int(np.argmax(gaps))
    if 4 * gaps[widest] >= _DIRECTIONS:
        looks[(found[widest] + 1 + np.arange(gaps[widest])) % _DIRECTIONS] = False
    return looks


class Synchroniser:
    """Takes records one by one in the order of arrival, and yields the steps that are ready.

    Args:
        use_odometry: Whether odometry is used; without it no scan waits.
        losses: Counter from reasons to numbers of records that were left out, increased in place.
    """

    def __init__(self, *, use_odometry: bool, losses: Counter[str]) -> None:
        """Create a synchroniser without records."""
        self._losses = losses
        self._use_odometry = use_odometry
        self._index = 0
        self._scans: deque[Scan] = deque()
        self._odometry = OdometryBuffer()
        self._imu: deque[Imu] = deque()
        self._gyro = Gyro()
        self._stepped: Pose2 | None = None  # odometry of the last step
        self._drifted: Float | None = None  # sum of its covariances at the last step, see Reading
        self._was_bridged = False  # whether the odometry was missing at the last step
        self._turned_ns: int | None = None
        self._gyro_tilt = (0, 0.0, 0.0)  # time [ns], roll and pitch [rad]
        self._measured = PoseBuffer()
        self._slack = (0.0, 0.0)
        self._doubt = ""
        self._stepped_ns: int | None = None
        self._elapsed_ns = 0  # since the first scan
        self._sights: dict[tuple[bytes, bytes] | None, _Sights] = {}  # of each LiDAR
        self._last_stamp: int | None = None
        self._warnings: list[str] = []

    def add(self, record: Record) -> None:
        """Add a record of any kind. A record that cannot be used (see the reasons in `losses`) is counted and
        reported in the next step; a notice becomes a warning of the next step; other kinds are ignored."""
        match record:
            case Scan():
                self._add_scan(record)
            case Odometry():
                self._add_odometry(record)
            case PoseMeasurement():
                self._add_pose(record)
            case Imu():
                self._add_imu(record)
            case Notice():
                self._warn(record.text)

    def _add_scan(self, scan: Scan) -> None:
        """Append a scan to the waiting ones; one that is not later than the last one is left out and
        counted."""
        if self._last_stamp is not None and scan.stamp_ns <= self._last_stamp:
            self._leave_out("scans that were not later than the one before")
            return
        self._last_stamp = scan.stamp_ns
        self._scans.append(scan)

    def _add_odometry(self, odometry: Odometry) -> None:
        """Add a reading of the odometry. Without finite numbers, or not later than the last one, it is left
        out and counted; without `use_odometry` all others are ignored. A jump is reported and makes the
        odometry doubtful. Old readings are removed."""
        T = odometry.T_odom_base
        if not (np.all(np.isfinite(T.t)) and np.all(np.isfinite(T.R))):
            self._leave_out("odometry readings without finite numbers")
        elif (newest := self._odometry.newest) is not None and odometry.stamp_ns <= newest.stamp_ns:
            self._leave_out("odometry readings that were not later than the one before")
        elif self._use_odometry:
            jump = self._odometry.add(odometry)
            if jump is not None:
                self._report_jump(jump)
            self._odometry.forget(self._needed_ns(odometry.stamp_ns))

    def _report_jump(self, jump: Jump) -> None:
        """Add a warning about a jump of the odometry, and make the motion to the next step doubtful by
        JUMP_SLACK."""
        self._warn(
            f"the odometry jumped by {jump.distance:.1f} m and {np.degrees(jump.turn):.0f} degrees; "
            "the jump is not used as motion"
        )
        self._suspect("the odometry jumped", JUMP_SLACK)

    def _add_pose(self, pose: PoseMeasurement) -> None:
        """Add a measured pose; an unsound one (`PoseMeasurement.is_sound`), or one that is not later than the
        last one of its kind, is left out."""
        if not pose.is_sound():
            self._leave_out("measured poses without finite numbers or a positive definite covariance")
        elif not self._measured.add(pose):
            self._leave_out("measured poses that were not later than the one before")

    def _suspect(self, why: str, slack: tuple[float, float]) -> None:
        """Set the message of doubt of the next step (the last one wins), and add the sigmas of position [m]
        and heading [rad] to its slack as independent errors."""
        self._doubt = why
        self._slack = (float(np.hypot(self._slack[0], slack[0])), float(np.hypot(self._slack[1], slack[1])))

    def _add_imu(self, imu: Imu) -> None:
        """Add a reading of the IMU: its turn rate, and its orientation if that is known and finite. One that
        is not later than the last one is left out and counted, unless earlier ones were ahead of their time
        (`_was_ahead`)."""
        if (
            self._turned_ns is not None
            and imu.stamp_ns <= self._turned_ns
            and not self._was_ahead(imu.stamp_ns)
        ):
            self._leave_out("IMU readings that were not later than the one before")
            return
        self._turned_ns = imu.stamp_ns
        self._add_turn_rate(imu)
        if imu.orientation is None or not np.all(np.isfinite(imu.orientation)):
            return
        if self._imu and imu.stamp_ns <= self._imu[-1].stamp_ns:
            return
        self._imu.append(imu)
        while len(self._imu) > 2 and self._imu[1].stamp_ns < self._needed_ns(imu.stamp_ns) - KEEP_NS:
            self._imu.popleft()

    def _was_ahead(self, stamp_ns: int) -> bool:
        """Return whether the last IMU readings were ahead of their time; then those at `stamp_ns` or later
        are removed, which is counted once and reported.

        They were ahead if the new reading, at `stamp_ns`, is AHEAD_NS or more before the last one, and is
        nearer to the newest scan or odometry. False if there is no scan or odometry.
        """
        last = self._turned_ns
        newest = self._odometry.newest
        others = [s.stamp_ns for s in self._scans] + ([] if newest is None else [newest.stamp_ns])
        if last is None or last - stamp_ns < AHEAD_NS or not others:
            return False
        if abs(stamp_ns - max(others)) >= abs(last - max(others)):
            return False
        self._gyro.forget_since(stamp_ns)
        while self._imu and self._imu[-1].stamp_ns >= stamp_ns:
            self._imu.pop()
        self._leave_out("IMU readings that were ahead of their time")
        return True

    def _add_turn_rate(self, imu: Imu) -> None:
        """Add the turn rate of an IMU reading to the gyroscope. It is ignored if it is not finite, and left
        out if it exceeds FASTEST. The bias is estimated only while the odometry is recent and at rest for
        more than SETTLES_NS."""
        if not np.all(np.isfinite(imu.angular_velocity)):
            return
        if np.abs(imu.angular_velocity).max() > FASTEST:
            self._leave_out("readings of the gyroscope that no robot turns as fast as")
            return
        since, newest = self._odometry.standing_since, self._odometry.newest
        settled = since is not None and imu.stamp_ns - since[0] > SETTLES_NS
        fresh = newest is not None and imu.stamp_ns - newest.stamp_ns < STALE_NS
        still = settled and fresh
        oldest = self._needed_ns(imu.stamp_ns)
        # The rate depends on the tilt by its square only, so the tilt is updated in fixed intervals of time.
        if imu.stamp_ns // TILTS_NS != self._gyro_tilt[0] // TILTS_NS:
            self._gyro_tilt = (imu.stamp_ns, *(_tilt_of(imu) or (0.0, 0.0)))
        self._gyro.add(imu, self._gyro_tilt[1:], standing=still, needed_ns=oldest)

    def _needed_ns(self, now_ns: int) -> int:
        """Return the time from which readings are still needed [ns]: the stamp of the oldest waiting scan,
        `now_ns` without one."""
        return self._scans[0].stamp_ns if self._scans else now_ns

    def ready(self, *, end: bool = False) -> Iterator[Step]:
        """Yield the steps of waiting scans in the order of time, as far as their odometry has arrived
        (`_is_ready`); with `end`, all remaining steps."""
        while self._scans and (end or self._is_ready(self._scans[0])):
            yield self._join(self._scans.popleft())

    def _is_ready(self, scan: Scan) -> bool:
        """Return whether a waiting scan can be joined: its odometry has arrived, a waiting scan is WAIT_NS
        later, more than MOST_WAITING scans wait, or odometry is not used."""
        if self._scans[-1].stamp_ns - scan.stamp_ns >= WAIT_NS or len(self._scans) > MOST_WAITING:
            return True
        newest = self._odometry.newest
        return not self._use_odometry if newest is None else newest.stamp_ns >= scan.stamp_ns

    def _join(self, scan: Scan) -> Step:
        """Return the step of a scan, with the warnings and doubts since the last step, which are reset."""
        self._report_pause(scan.stamp_ns)
        period_ns = 0 if self._stepped_ns is None else scan.stamp_ns - self._stepped_ns
        self._elapsed_ns += period_ns
        T = scan.T_base_lidar
        lidar = None if T is None else (T.t.tobytes(), T.R.tobytes())
        again_ns, is_view = self._sights.setdefault(lidar, _Sights()).add(scan)
        pose, twist, base_tilt, drift = self._motion_at(scan.stamp_ns)
        covariance = None if drift is None or self._drifted is None else drift - self._drifted
        tilt = self._tilt_at(scan.stamp_ns) or base_tilt
        unreported = self._unreported(scan.stamp_ns)
        turn = self._turn_to(scan.stamp_ns, pose, unreported)
        if drift is not None and self._gyro.is_opposite:  # wheels may have the wrong sign themselves
            self._warn(f"{DOUBTFUL} in the whole run: {MIRRORED}")
        odometry_at = None if self._odometry.newest is None else self._odometry.pose_at
        step = Step(
            index=self._index,
            scan=scan,
            T_odom_base=pose,
            roll=tilt[0] if tilt else 0.0,
            pitch=tilt[1] if tilt else 0.0,
            tilt_known=tilt is not None,
            twist=twist,
            warnings=tuple(self._warnings),
            doubt=self._doubt,
            slack=self._slack,
            covariance=covariance,
            unreported=unreported,
            measured=self._measured.at(scan.stamp_ns, pose, odometry_at),
            turn=turn if self._gyro.proven else None,
            turn_rate=self._gyro.rate(scan.stamp_ns) if self._gyro.proven or pose is None else None,
            elapsed_ns=self._elapsed_ns,
            period_ns=period_ns,
            is_view=is_view,
            again_ns=again_ns,
        )
        newest = self._odometry.newest
        self._was_bridged = newest is not None and scan.stamp_ns > newest.stamp_ns + STALE_NS
        self._stepped_ns, self._slack, self._doubt = scan.stamp_ns, (0.0, 0.0), ""
        self._stepped, self._drifted = pose, drift
        self._index += 1
        self._warnings.clear()
        return step

    def _unreported(self, stamp_ns: int) -> Pose2 | None:
        """Return the motion by the odometry up to the last step that the pose of that step does not contain,
        because the odometry was missing at that step and has returned by `stamp_ns` [ns]; None otherwise.

        The pose at the last step is interpolated between the readings before and after the gap.
        """
        newest = self._odometry.newest
        if newest is None or self._stepped is None or self._stepped_ns is None:
            return None
        if stamp_ns > newest.stamp_ns + STALE_NS or not self._was_bridged:
            return None
        return self._stepped.inverse() @ self._odometry.pose_at(self._stepped_ns)

    def _turn_to(self, stamp_ns: int, pose: Pose2 | None, unreported: Pose2 | None) -> Turn | None:
        """Return the rotation since the last step by the gyroscope, None if unknown. It is compared with the
        odometry (`Gyro.compare`) if both are known and the odometry is not doubted.

        Args:
            stamp_ns: Time of the scan [ns].
            pose: Pose by the odometry at that time, or None.
            unreported: See Step.
        """
        turn = None if self._stepped_ns is None else self._gyro.turn(self._stepped_ns, stamp_ns)
        if turn is None or pose is None or self._stepped is None or self._doubt:
            return turn
        earlier = 0.0 if unreported is None else unreported.yaw
        self._gyro.compare(float(wrap_angle(pose.yaw - self._stepped.yaw - earlier)), turn)
        return turn

    def _motion_at(
        self, stamp_ns: int
    ) -> tuple[Pose2 | None, tuple[float, float, float], Tilt | None, Float | None]:
        """Return the motion by the odometry at a time [ns], see Moving.

        More than STALE_NS after the last reading the last pose is returned, without motion and tilt; without
        any reading the pose is None. Both add a warning and a doubt (`_bridge`), except for None without
        `use_odometry`."""
        newest = self._odometry.newest
        if newest is None:
            if self._use_odometry:
                self._bridge(stamp_ns)
            return None, STILL, None, None
        if stamp_ns > newest.stamp_ns + STALE_NS:
            self._bridge(stamp_ns)
            return newest.pose, STILL, None, newest.drift
        return self._odometry.motion_at(stamp_ns)

    def _report_pause(self, stamp_ns: int) -> None:
        """Add a warning and a doubt without sigmas if more than PAUSE_NS have passed since the last step."""
        seconds = 0.0 if self._stepped_ns is None else (stamp_ns - self._stepped_ns) * 1e-9
        if seconds * 1e9 > PAUSE_NS:
            self._warn(f"no scan for {seconds:.0f} s: no tree corrects the pose meanwhile")
            self._suspect(f"no scan for {seconds:.0f} s", (0.0, 0.0))

    def _bridge(self, stamp_ns: int) -> None:
        """Add a warning, a doubt and the uncertainty of an unknown motion since the last step; zero before
        the first step."""
        self._warn(NO_ODOMETRY)
        since = self._stepped_ns if self._stepped_ns is not None else stamp_ns
        seconds = (stamp_ns - since) * 1e-9
        self._suspect("there is no odometry", (WALK_SPEED * seconds, WALK_TURN * seconds))

    def _tilt_at(self, stamp_ns: int) -> tuple[float, float] | None:
        """Return roll and pitch [rad] of the IMU orientation nearest to a time [ns]; None if there is none,
        if it is not a valid quaternion, and, with a warning, if it is more than STALE_NS away."""
        if not self._imu:
            return None
        nearest = min(self._imu, key=lambda imu: abs(imu.stamp_ns - stamp_ns))
        if abs(nearest.stamp_ns - stamp_ns) > STALE_NS:
            self._warn("there is no IMU reading for some scans: they are not levelled by it")
            return None
        return _tilt_of(nearest)

    def _leave_out(self, reason: str) -> None:
        """Count a record that is left out for a reason, and add a warning."""
        self._losses[reason] += 1
        self._warn(f"left out: {reason}")

    def _warn(self, text: str) -> None:
        """Add a warning to the next step, unless it has the same one."""
        if text not in self._warnings:
            self._warnings.append(text)


def _tilt_of(imu: Imu) -> tuple[float, float] | None:
    """Return roll and pitch [rad] by the orientation of a reading; None if there is none, or if it is not
    finite or not a valid quaternion."""
    if imu.orientation is None or not np.all(np.isfinite(imu.orientation)):
        return None
    try:
        roll, pitch, _ = Pose3.from_quaternion(np.zeros(3), imu.orientation).euler()
    except ValueError:
        return None
    return roll, pitch
