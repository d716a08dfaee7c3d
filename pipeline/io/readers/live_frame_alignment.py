"""Measured poses laid over the way while it is driven, until it is known well enough how their frame lies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers.container import Message
from pipeline.io.readers.frame_alignment import lever_of
from pipeline.io.readers.message_time import Stamped
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.types.records import Odometry

#: A frame is held from when its turn is known to this [rad]; after the longest stretch it must do as it is.
NORTH_SIGMA = math.radians(2.0)
#: It is tried again when the robot is farther away by this factor.
_FARTHER = 1.2
#: Readings closer in time tell nothing new of where the way went [ns]; and so many are kept.
_APART_NS = 100_000_000
_MOST = 60_000
#: So many that cannot be used, and none that can, and no more are waited for.
_HOPELESS = 200


class _Timed(Protocol):
    @property
    def stamp_ns(self) -> int:
        """When."""


class _Aligned(Protocol):
    @property
    def yaw_sigma(self) -> float:
        """Of the turn of the frame [rad]."""


R = TypeVar("R", bound=_Timed)
A = TypeVar("A", bound=_Aligned)


@dataclass(frozen=True, slots=True)
class Kind(Generic[R, A]):
    """What is laid over the way.

    Attributes:
        read: Of a message with its time: the reading, None where there is none in it, and its frame.
        align: Of readings, the stamps of the way, the way and the lever: how they lie, or why not.
        shortest, longest: Stretch of the way from which on it is tried, and at which it must do [m].
        unknown: For people: what too short a way does not tell.
    """

    read: Callable[[Message, int], tuple[R | None, str]]
    align: Callable[[Sequence[R], Sequence[int], Float, float], tuple[A | None, str]]
    shortest: float
    longest: float
    unknown: str


class LiveStretch(Generic[R, A]):
    """Gathers odometry and readings as they come; what comes of it hangs on them alone, as in a replay.

    Args:
        decoder: Of the messages.
        kind: Of the readings; numbers: of their channels.
        odometry: Numbers of the channels of odometry.
        start_ns: Time of the first scan, where the map begins.

    Attributes:
        refused: Why the readings will not be used, "" while that is open.
    """

    def __init__(
        self,
        decoder: RecordDecoder,
        kind: Kind[R, A],
        numbers: frozenset[int],
        odometry: frozenset[int],
        start_ns: int,
    ) -> None:
        self._decoder, self._kind, self._numbers = decoder, kind, numbers
        self._odometry, self._start_ns = odometry, start_ns
        self._seen: list[R] = []
        self._way: list[tuple[int, Pose3]] = []
        self._origin: tuple[int, Pose3] | None = None
        self._frame = ""
        self._try_at = kind.shortest
        self._unusable, self._fault = 0, ""
        self.refused = ""

    def add(self, stamped: Stamped[Message | Odometry]) -> A | None:
        """Take what came next; how the frame lies, once it is known."""
        told = stamped.content
        if isinstance(told, Odometry):
            self._add_pose(told)
        elif told.channel in self._numbers:
            return self._add_message(told, stamped.stamp_ns)
        elif told.channel in self._odometry:
            record = self._decoder.record(told, stamped.stamp_ns, {})
            if isinstance(record, Odometry):
                self._add_pose(record)
        return None

    def end(self) -> tuple[A | None, str]:
        """Nothing more comes: how the frame lies by what there is, or why that is not known."""
        if self._origin is None:
            return None, "no odometry can be read"
        found, why = self._align()
        if self._unusable:
            why += f" ({self._unusable:,} more cannot be used: {self._fault})"
        return found, why

    def _add_message(self, message: Message, stamp_ns: int) -> A | None:
        try:
            with np.errstate(all="ignore"):
                reading, self._frame = self._kind.read(message, stamp_ns)
        except Exception as error:  # as in RecordDecoder.record; it is counted when it is read
            self._unusable, self._fault = self._unusable + 1, str(error)[:200]
            if self._unusable >= _HOPELESS and not self._seen:
                self.refused = f"none of the first {self._unusable} can be used: {self._fault}"
            return None
        return None if reading is None else self._add_reading(reading)

    def _add_pose(self, odometry: Odometry) -> None:
        off_ns = abs(odometry.stamp_ns - self._start_ns)
        if self._origin is None or off_ns < abs(self._origin[0] - self._start_ns):
            self._origin = (odometry.stamp_ns, odometry.T_odom_base)
        if not self._way or odometry.stamp_ns >= self._way[-1][0] + _APART_NS:
            self._way.append((odometry.stamp_ns, odometry.T_odom_base))

    def _add_reading(self, reading: R) -> A | None:
        if self._seen and reading.stamp_ns < self._seen[-1].stamp_ns + _APART_NS:
            return None
        self._seen.append(reading)
        if len(self._seen) + len(self._way) > _MOST:
            self.refused = f"the robot did not drive far enough to tell {self._kind.unknown}"
        if self._origin is None or self.refused:
            return None
        away = float(np.hypot(*(self._way[-1][1].t - self._way[0][1].t)[:2]))
        if away < self._try_at:
            return None
        self._try_at = _FARTHER * away
        found, why = self._align()
        if away >= self._kind.longest:
            self.refused = why
            return found
        return found if found is not None and found.yaw_sigma <= NORTH_SIGMA else None

    def _align(self) -> tuple[A | None, str]:
        assert self._origin is not None  # noqa: S101 - the callers have looked
        start = self._origin[1].planar()
        there = np.array([(start.inverse() @ pose.planar()).as_array() for _, pose in self._way])
        lever = lever_of(self._decoder, self._frame)
        return self._kind.align(self._seen, [stamp_ns for stamp_ns, _ in self._way], there, lever)
