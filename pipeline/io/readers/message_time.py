"""Times of messages: header stamps, the choice of the clock, steps of the clock, and the order of time."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message

#: Stamps farther than this from the time of writing, once the clocks are compared, are damaged.
STAMP_LIMIT_NS = 60_000_000_000
SECOND_NS = 1_000_000_000


def header_stamp(channel: Channel, payload: bytes) -> int | None:
    """The stamp [ns] of a message that begins with a std_msgs/Header, None when there is none."""
    if len(payload) < 12:
        return None
    if channel.encoding == "ros1":
        seconds, nanoseconds = struct.unpack_from("<II", payload, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<iI" if payload[1] & 1 else ">iI", payload, 4)
    return seconds * SECOND_NS + nanoseconds if seconds >= 0 and nanoseconds < SECOND_NS else None


class Clock:
    """Chooses between the stamps in the messages and the times at which they were written.

    A sensor may stamp with its own clock, which is fine as long as all topics share it. When one
    topic stamps with zeros, or two topics stamp with different clocks, the times of writing are used.

    Args:
        offsets_ns: Stamp minus time of writing of the first message of each topic, None without stamp.
    """

    def __init__(self, offsets_ns: list[int | None]) -> None:
        self.offsets_ns = offsets_ns
        known = [offset for offset in offsets_ns if offset is not None]
        self.by_stamp = (
            bool(known) and len(known) == len(offsets_ns) and max(known) - min(known) <= STAMP_LIMIT_NS // 6
        )
        self.offset_ns = known[0] if self.by_stamp else 0

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """The time of a message [ns], None when its stamp cannot be true."""
        if not self.by_stamp:
            return message.log_ns if message.log_ns < 2**63 else None
        if stamp_ns is None or abs(stamp_ns - message.log_ns - self.offset_ns) > STAMP_LIMIT_NS:
            return None
        return stamp_ns


T = TypeVar("T")

#: How much later than its neighbours a record may have been written and still find its place.
WINDOW_NS = 1_000_000_000
_HELD_LIMIT = 20_000


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T]):
    """Something with a time; of two with the same time the lower rank comes first."""

    stamp_ns: int
    rank: int
    content: T


def by_stamp(arrivals: Iterable[Stamped[T]], losses: dict[str, int]) -> Iterator[Stamped[T]]:
    """Sort a stream in which nothing arrives more than WINDOW_NS late; what does is counted and left out."""
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


#: A stamp that leaves its place by more than this was made by a clock that was set meanwhile.
STEP_NS = 2 * SECOND_NS
#: Two topics saw the same step when they disagree by less about its size.
SAME_STEP_NS = SECOND_NS


@dataclass(slots=True)
class _Topic:
    """What is known of one channel's stamps: the largest stamp minus arrival since the last step, the
    newest stamp, what is added to the stamps, and how many steps are in it."""

    offset_ns: int
    newest_ns: int
    shift_ns: int
    steps: int


class SteppingClock(Clock):
    """As Clock, but times go on evenly where the robot's clock was set (NTP, GNSS, a reboot into 1970).

    Messages that come late lower stamp minus arrival and are nothing odd; so a step forward is a stamp
    further ahead of its arrival than any before, and a step back is one that is earlier than the
    newest. The first topic that shows a step measures it, the others take over its size.

    Args:
        offsets_ns: As of Clock.

    Attributes:
        notices: What happened, in words; whoever tells people of them empties the list.
    """

    def __init__(self, offsets_ns: list[int | None]) -> None:
        super().__init__(offsets_ns)
        self.notices: list[str] = []
        self._topics: dict[int, _Topic] = {}
        self._steps: list[int] = []

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """The time of a message [ns], None when its stamp cannot be true."""
        if not self.by_stamp:
            return message.log_ns
        topic = self._topics.get(message.channel)
        if not stamp_ns:  # zeros where there were stamps before: the time of arrival stands for it
            return None if topic is None else message.log_ns + topic.offset_ns + topic.shift_ns
        offset_ns = stamp_ns - message.log_ns
        if topic is None:
            topic = self._first_of(offset_ns, stamp_ns)
            if topic is None:
                return None
            self._topics[message.channel] = topic
        elif offset_ns > topic.offset_ns + STEP_NS or stamp_ns < topic.newest_ns - STEP_NS:
            self._step(topic, offset_ns)
            topic.offset_ns = offset_ns
            topic.newest_ns = stamp_ns
        topic.offset_ns = max(topic.offset_ns, offset_ns)
        topic.newest_ns = max(topic.newest_ns, stamp_ns)
        return stamp_ns + topic.shift_ns

    def _first_of(self, offset_ns: int, stamp_ns: int) -> _Topic | None:
        """A topic that was not heard before shares the shift of those whose clock it has."""
        if not self._topics:
            return _Topic(offset_ns, stamp_ns, 0, 0)
        nearest = min(self._topics.values(), key=lambda known: abs(known.offset_ns - offset_ns))
        if abs(nearest.offset_ns - offset_ns) > STAMP_LIMIT_NS:
            return None
        return _Topic(offset_ns, stamp_ns, nearest.shift_ns, nearest.steps)

    def _step(self, topic: _Topic, offset_ns: int) -> None:
        size_ns = offset_ns - topic.offset_ns
        if topic.steps < len(self._steps) and abs(self._steps[topic.steps] - size_ns) < SAME_STEP_NS:
            size_ns = self._steps[topic.steps]
        else:
            self._steps.append(size_ns)
            topic.steps = len(self._steps) - 1
            seconds = f"{size_ns / SECOND_NS:+,.1f} s"
            self.notices.append(f"the robot's clock was set by {seconds}: the run's time goes on evenly")
        topic.steps += 1
        topic.shift_ns -= size_ns
