"""Times of messages: header stamps, the choice of the clock, steps of the clock, and sorting by time."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message

SECOND_NS = 1_000_000_000
#: A stamp that differs more from the time of recording, after the offset of the clocks, is damaged, or the
#: clock was set.
STAMP_LIMIT_NS = 4 * SECOND_NS
#: Topics whose stamps differ more from each other use different clocks.
_SAME_CLOCK_NS = 10 * SECOND_NS
#: A channel of a live robot whose offset differs more from those of others has no usable stamps.
_LIVE_LIMIT_NS = 60 * SECOND_NS
#: A record is sorted into its place when it is recorded at most this much later than its neighbours.
WINDOW_NS = SECOND_NS
_HELD_LIMIT = 20_000  # records
#: A larger jump of the stamps of a live robot means that its clock was set.
STEP_NS = 2 * SECOND_NS
#: Two topics show the same step when its sizes differ by less.
SAME_STEP_NS = SECOND_NS

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


def header_stamp(channel: Channel, payload: bytes) -> int | None:
    """Return the stamp [ns] of a message that begins with a std_msgs/Header; None if the payload is too short
    or the stamp is impossible. A stamp of zero is 0. The result has no meaning for other types."""
    if len(payload) < 12:
        return None
    if channel.encoding == "ros1":
        seconds, nanoseconds = struct.unpack_from("<II", payload, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<iI" if payload[1] & 1 else ">iI", payload, 4)
    return seconds * SECOND_NS + nanoseconds if seconds >= 0 and nanoseconds < SECOND_NS else None


class Clock:
    """Chooses between the stamps in the messages and their times of recording.

    A sensor may stamp with a clock of its own if all topics share it. When a topic has stamps of zero, or two
    topics use different clocks, the times of recording are used.

    Args:
        offsets_ns: Stamp minus time of recording of the first message of each topic [ns]; None if it has no
            stamp.

    Attributes:
        by_stamp: Whether stamps are used.
        offset_ns: Approximate time of a message minus its time of recording [ns].
    """

    def __init__(self, offsets_ns: list[int | None]) -> None:
        """Choose the clock: stamps are used if there are topics, all have a stamp, and their offsets differ
        by _SAME_CLOCK_NS at most; `offset_ns` is that of the first topic, 0 if stamps are not used."""
        known = [offset for offset in offsets_ns if offset is not None]
        self.by_stamp = (
            bool(known) and len(known) == len(offsets_ns) and max(known) - min(known) <= _SAME_CLOCK_NS
        )
        self.offset_ns = known[0] if self.by_stamp else 0

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a message [ns]: its stamp, or its time of recording plus `offset_ns` if stamps
        are not used, or the stamp is missing or does not fit (`is_stepped`). None if the result is not in [0,
        2^63)."""
        time_ns = stamp_ns
        if not self.by_stamp or time_ns is None or self.is_stepped(time_ns, message):
            time_ns = message.log_ns + self.offset_ns
        return time_ns if 0 <= time_ns < 2**63 else None

    def is_stepped(self, stamp_ns: int, message: Message) -> bool:
        """Return whether the stamp of a message [ns] differs from its time of recording by more than
        STAMP_LIMIT_NS after the offset of the clocks: it is damaged, or a clock was set."""
        return abs(stamp_ns - message.log_ns - self.offset_ns) > STAMP_LIMIT_NS


@dataclass(slots=True)
class _ChannelClock:
    """Stamps of one channel: the largest stamp minus arrival since the last step [ns], the newest stamp [ns],
    the correction of the stamps [ns], and the number of steps in it."""

    offset_ns: int
    newest_ns: int
    shift_ns: int
    steps: int


class ClockStepFilter(Clock):
    """A clock of a live robot whose times continue evenly when the robot's clock is set (NTP, GNSS, reboot).

    A step forward is a stamp minus arrival that exceeds the maximum of the channel by more than STEP_NS; a
    step back is a stamp that is more than STEP_NS before the newest. The first channel that shows a step
    measures its size; the others use the same size.

    Args:
        offsets_ns: As for Clock.
        notices: List to which messages for the user are added.
    """

    def __init__(self, offsets_ns: list[int | None], notices: list[str] | None = None) -> None:
        """Choose the clock as `Clock` does; messages about steps are appended to `notices`."""
        super().__init__(offsets_ns)
        self.notices: list[str] = [] if notices is None else notices
        self._channels: dict[int, _ChannelClock] = {}
        self._steps: list[int] = []

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a message [ns], with the steps of the clock removed; call it in the order of
        arrival. If stamps are not used it is the time of arrival. A stamp that is missing or zero is replaced
        by the time of arrival plus the known offset. None as long as a channel has had no usable stamp: a
        first stamp is usable if its offset is within _LIVE_LIMIT_NS of that of another channel, or if it is
        the first of all. The result may be negative. A step adds a notice."""
        if not self.by_stamp:
            return message.log_ns
        known = self._channels.get(message.channel)
        if not stamp_ns:  # a stamp of zero after others: the time of arrival is used
            return None if known is None else message.log_ns + known.offset_ns + known.shift_ns
        offset_ns = stamp_ns - message.log_ns
        if known is None:
            known = self._first_of(offset_ns, stamp_ns)
            if known is None:
                return None
            self._channels[message.channel] = known
        elif offset_ns > known.offset_ns + STEP_NS or stamp_ns < known.newest_ns - STEP_NS:
            self._step(known, offset_ns)
            known.offset_ns = offset_ns
            known.newest_ns = stamp_ns
        known.offset_ns = max(known.offset_ns, offset_ns)
        known.newest_ns = max(known.newest_ns, stamp_ns)
        return stamp_ns + known.shift_ns

    def _first_of(self, offset_ns: int, stamp_ns: int) -> _ChannelClock | None:
        """Return the state of a channel that is seen for the first time, with the correction of the channel
        with the nearest offset; None if this differs by more than _LIVE_LIMIT_NS. The state is not stored.

        Args:
            offset_ns: Stamp minus arrival of its first message [ns].
            stamp_ns: Stamp of this message [ns].
        """
        if not self._channels:
            return _ChannelClock(offset_ns, stamp_ns, 0, 0)
        nearest = min(self._channels.values(), key=lambda known: abs(known.offset_ns - offset_ns))
        if abs(nearest.offset_ns - offset_ns) > _LIVE_LIMIT_NS:
            return None
        return _ChannelClock(offset_ns, stamp_ns, nearest.shift_ns, nearest.steps)

    def _step(self, channel: _ChannelClock, offset_ns: int) -> None:
        """Correct the stamps of a channel by a step, whose size is that of a step which another channel has
        shown, or is measured here and adds a notice. `offset_ns` is stamp minus arrival after the step [ns].
        """
        size_ns = offset_ns - channel.offset_ns
        if channel.steps < len(self._steps) and abs(self._steps[channel.steps] - size_ns) < SAME_STEP_NS:
            size_ns = self._steps[channel.steps]
        else:
            self._steps.append(size_ns)
            channel.steps = len(self._steps) - 1
            seconds = f"{size_ns / SECOND_NS:+,.1f} s"
            self.notices.append(f"the robot's clock was set by {seconds}: the run's time goes on evenly")
        channel.steps += 1
        channel.shift_ns -= size_ns


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T_co]):
    """Contents with a time [ns]; of two with the same time the lower rank comes first."""

    stamp_ns: int
    rank: int
    content: T_co


def in_order_of_stamps(arrivals: Iterable[Stamped[T]], losses: dict[str, int]) -> Iterator[Stamped[T]]:
    """Yield contents sorted by time, then by rank, then in the order of arrival. A content waits until one
    that is more than WINDOW_NS later arrives, or more than _HELD_LIMIT contents wait. Contents that arrive
    with a time before that of the last one yielded are left out and counted.

    Args:
        arrivals: Contents in the order of arrival.
        losses: Dict from reasons to numbers of contents that are left out; increased in place.
    """
    heap: list[tuple[int, int, int, Stamped[T]]] = []
    newest = last = -(2**63)
    for serial, arrival in enumerate(arrivals):
        if arrival.stamp_ns < last:
            count_loss(losses, "records that came too late to be put in order")
            continue
        newest = max(newest, arrival.stamp_ns)
        heapq.heappush(heap, (arrival.stamp_ns, arrival.rank, serial, arrival))
        while heap[0][0] < newest - WINDOW_NS or len(heap) > _HELD_LIMIT:
            last = heap[0][0]
            yield heapq.heappop(heap)[3]
    while heap:
        yield heapq.heappop(heap)[3]
