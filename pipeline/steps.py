"""Steps: each scan joined with the motion and the tilt at its time."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np

from pipeline.geometry import Float, Pose2, Pose3, interpolate, wrap_angle
from pipeline.records import Imu, Odometry, Record, Scan, Step

OdometryChoice = Literal["auto", "wheels", "static"]
WAIT = 5  # scans that wait for the odometry that follows them before they go without
KEEP_NS = 2_000_000_000
JUMP_SPEED = 15.0  # m/s; no forestry robot drives this fast


def steps(
    records: Iterable[Record],
    *,
    odometry: OdometryChoice = "auto",
    first_index: int = 0,
    losses: Counter[str] | None = None,
) -> Iterator[Step]:
    """Join scans with the pose by odometry, interpolated to their time, and the tilt.

    A scan is held back until the first odometry at or after its stamp has come, or until five
    scans wait; then the last pose stands for it. A scan that is not later than the one before it
    is left out, counted in `losses` and said in the warnings of the next step.

    Args:
        records: In the order in which they came.
        odometry: "static" leaves poses aside: the robot stands still.
        first_index: Number of the first step.
        losses: Counts what was left out, by reason.
    """
    counted = Counter[str]() if losses is None else losses
    joiner = _Joiner(use_odometry=odometry != "static", index=first_index, losses=counted)
    for record in records:
        if isinstance(record, Scan):
            joiner.add_scan(record)
        elif isinstance(record, Odometry):
            joiner.add_odometry(record)
        else:
            joiner.add_imu(record)
        yield from joiner.ready()
    yield from joiner.ready(end=True)


class _Joiner:
    def __init__(self, *, use_odometry: bool, index: int, losses: Counter[str]) -> None:
        self._losses = losses
        self._use_odometry = use_odometry
        self._index = index
        self._scans: deque[Scan] = deque()
        self._odometry: deque[Odometry] = deque()
        self._imu: deque[Imu] = deque()
        self._last_stamp: int | None = None
        self._warnings: list[str] = []

    def add_scan(self, scan: Scan) -> None:
        if self._last_stamp is not None and scan.stamp_ns <= self._last_stamp:
            self._leave_out("scans that were not later than the one before")
            return
        self._last_stamp = scan.stamp_ns
        self._scans.append(scan)

    def add_odometry(self, odometry: Odometry) -> None:
        T = odometry.T_odom_base
        if not (np.all(np.isfinite(T.t)) and np.all(np.isfinite(T.R))):
            self._leave_out("odometry readings without finite numbers")
        elif self._odometry and odometry.stamp_ns <= self._odometry[-1].stamp_ns:
            self._leave_out("odometry readings that were not later than the one before")
        elif self._use_odometry:
            self._odometry.append(odometry)
            self._forget(self._odometry, odometry.stamp_ns)

    def add_imu(self, imu: Imu) -> None:
        if imu.orientation is None or not np.all(np.isfinite(imu.orientation)):
            return
        if self._imu and imu.stamp_ns <= self._imu[-1].stamp_ns:
            return
        self._imu.append(imu)
        self._forget(self._imu, imu.stamp_ns)

    def _forget(self, kept: deque[Odometry] | deque[Imu], now_ns: int) -> None:
        oldest = self._scans[0].stamp_ns if self._scans else now_ns
        while len(kept) > 2 and kept[1].stamp_ns < oldest - KEEP_NS:
            kept.popleft()

    def ready(self, *, end: bool = False) -> Iterator[Step]:
        """Steps whose odometry has come, in order."""
        while self._scans and (end or self._is_ready(self._scans[0])):
            yield self._join(self._scans.popleft())

    def _is_ready(self, scan: Scan) -> bool:
        if len(self._scans) > WAIT:
            return True
        if not self._odometry:
            return not self._use_odometry
        return self._odometry[-1].stamp_ns >= scan.stamp_ns

    def _join(self, scan: Scan) -> Step:
        pose, twist, base_tilt = self._motion_at(scan.stamp_ns)
        tilt = self._tilt_at(scan.stamp_ns) or base_tilt
        step = Step(
            index=self._index,
            scan=scan,
            T_odom_base=pose,
            roll=tilt[0] if tilt else 0.0,
            pitch=tilt[1] if tilt else 0.0,
            tilt_known=tilt is not None,
            twist=twist,
            warnings=tuple(self._warnings),
        )
        self._index += 1
        self._warnings.clear()
        return step

    def _motion_at(
        self, stamp_ns: int
    ) -> tuple[Pose2 | None, tuple[float, float, float], tuple[float, float] | None]:
        """Pose, velocity in the base frame, and tilt where the odometry is of the whole pose."""
        if not self._odometry:
            return None, (0.0, 0.0, 0.0), None
        before, after = _around(self._odometry, stamp_ns)
        a, b = before.T_odom_base.planar(), after.T_odom_base.planar()
        span = (after.stamp_ns - before.stamp_ns) * 1e-9
        tilt = _tilt(before.T_odom_base)
        if span <= 0.0:
            return a, (0.0, 0.0, 0.0), tilt
        if np.hypot(b.x - a.x, b.y - a.y) > JUMP_SPEED * max(span, 0.1):
            self._warn(f"the odometry jumped {np.hypot(b.x - a.x, b.y - a.y):.1f} m")
            return (b if stamp_ns >= after.stamp_ns else a), (0.0, 0.0, 0.0), tilt
        fraction = float(np.clip((stamp_ns - before.stamp_ns) * 1e-9 / span, 0.0, 1.0))
        step = a.inverse() @ b
        twist = (step.x / span, step.y / span, float(wrap_angle(step.yaw)) / span)
        return interpolate(a, b, fraction), twist, tilt

    def _tilt_at(self, stamp_ns: int) -> tuple[float, float] | None:
        if not self._imu:
            return None
        nearest = min(self._imu, key=lambda imu: abs(imu.stamp_ns - stamp_ns))
        try:
            roll, pitch, _ = Pose3.from_quaternion(np.zeros(3), _quaternion(nearest)).euler()
        except ValueError:
            return None
        return roll, pitch

    def _leave_out(self, reason: str) -> None:
        self._losses[reason] += 1
        self._warn(f"left out: {reason}")

    def _warn(self, text: str) -> None:
        if text not in self._warnings:
            self._warnings.append(text)


def _around(odometry: deque[Odometry], stamp_ns: int) -> tuple[Odometry, Odometry]:
    """The readings before and after a time; the two nearest ones where it lies outside."""
    after = next((k for k, o in enumerate(odometry) if o.stamp_ns >= stamp_ns), len(odometry) - 1)
    after = max(after, min(1, len(odometry) - 1))
    return odometry[max(after - 1, 0)], odometry[after]


def _tilt(T_odom_base: Pose3) -> tuple[float, float] | None:
    """Roll and pitch of a pose in space; None for wheel odometry, which knows the plane alone."""
    roll, pitch, _ = T_odom_base.euler()
    return None if roll == 0.0 and pitch == 0.0 else (roll, pitch)


def _quaternion(imu: Imu) -> Float:
    assert imu.orientation is not None  # noqa: S101 - add_imu kept only those
    return imu.orientation
