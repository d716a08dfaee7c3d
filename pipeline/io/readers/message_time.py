"""Times of messages: header stamps, clocks of topics and their steps, and sorting by time."""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message
from pipeline.types.units import SECOND_NS

#: Topics whose stamps, after their delays, differ more from each other use different clocks: a message is
#: hardly recorded a second after its stamp.
SAME_CLOCK_NS = SECOND_NS
#: Number of messages of a topic by which its clock is compared with those of others.
OPENING_MESSAGES = 50
#: A smaller step of a clock is hidden in the jitter of stamps and delays [ns].
STEP_NS = 150_000_000
#: Stamps of one publisher are in order up to this [ns].
_JITTER_NS = 20_000_000
#: Number of messages after an unusual gap between stamps, or a step back, in which a step forward may show.
_SUSPECT = 10
#: Two topics show the same step when they show it within this time [ns]; sizes differ by up to STEP_NS.
_SAME_TIME_NS = 2 * SECOND_NS
#: A record is sorted into its place when it is recorded at most this much later than its neighbours.
WINDOW_NS = SECOND_NS
_HELD_LIMIT = 20_000  # records
_LONGEST_NAME = 256  # bytes

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


@dataclass(frozen=True, slots=True)
class Opening:
    """First messages of a topic, by which its clock is known.

    Attributes:
        name: Name of the topic.
        numbers: Numbers of its channels.
        messages: Time of recording [ns] and stamp [ns] of each message; None or 0 for no stamp.
        end_ns: Time after its stamp at which the measurement of a message is complete, so that it can be
            recorded [ns].
    """

    name: str
    numbers: frozenset[int]
    messages: Sequence[tuple[int, int | None]]
    end_ns: int = 0


class _PublisherClock:
    """Stamps of one publisher in the order of arrival, with the steps of its clock removed.

    Args:
        most_ns: Usual largest stamp minus arrival [ns]; None if unknown.
        shift_ns: Correction of the stamps [ns].
    """

    def __init__(self, most_ns: int | None = None, shift_ns: int = 0) -> None:
        """Begin without messages."""
        self.most_ns, self.shift_ns = most_ns, shift_ns
        self._levels: list[tuple[int, int]] = []  # most_ns and shift_ns of earlier times
        self._stamp_ns: int | None = None
        self._gap_ns = 0  # usual time between two stamps; 0 if unknown
        self._suspect = 0

    def step_of(self, stamp_ns: int, log_ns: int) -> int:
        """Process the next stamp, which arrives at `log_ns` [ns]. Return the size of the step of the clock
        before it [ns], 0 for none; the caller then calls `begin`.

        A step back is a stamp before the last one. A step forward is a stamp that is nearer to its arrival
        than any before, after an unusual gap between stamps; messages that were delayed or lost never are.
        Without a message before, it is a step if the stamp is not of the usual clock.
        """
        offset_ns, last_ns, self._stamp_ns = stamp_ns - log_ns, self._stamp_ns, stamp_ns
        if self.most_ns is None:
            self.most_ns = offset_ns
            return 0
        size_ns = offset_ns - self.most_ns
        if last_ns is None:
            return size_ns if abs(size_ns) > SAME_CLOCK_NS else 0
        gap_ns = stamp_ns - last_ns
        if gap_ns < -_JITTER_NS and size_ns < -STEP_NS:
            return size_ns
        if gap_ns > self._gap_ns + (STEP_NS if self._gap_ns else SAME_CLOCK_NS):
            self._suspect = _SUSPECT
        elif gap_ns > 0:
            self._gap_ns = gap_ns
        if self._suspect and (size_ns > STEP_NS or self._is_of_level_before(offset_ns)):
            return size_ns
        self._suspect = max(self._suspect - 1, 0)
        self.most_ns = max(self.most_ns, offset_ns)
        return 0

    def _is_of_level_before(self, offset_ns: int) -> bool:
        """Return whether the last step was back, and stamp minus arrival [ns] is nearer to that before it:
        a single message was late."""
        if not self._levels or self.most_ns is None:
            return False
        before_ns = self._levels[-1][0]
        return self.most_ns < before_ns and abs(offset_ns - before_ns) < abs(offset_ns - self.most_ns)

    def begin(self, size_ns: int, offset_ns: int) -> bool:
        """Correct the stamps after a step of the clock [ns], or as before if the clock is set to an earlier
        time again; return whether the step is a new one.

        Args:
            size_ns: Size of the step [ns].
            offset_ns: Stamp minus arrival of the first message after it [ns].
        """
        again = [level for level in self._levels if abs(offset_ns - level[0]) < STEP_NS]
        self._levels.append((self.most_ns or 0, self.shift_ns))
        # A single late message looks like a step back until the next one.
        self.most_ns, self._suspect = offset_ns, _SUSPECT if size_ns < 0 else 0
        if again:
            self.most_ns, self.shift_ns = again[-1]
            return False
        self.shift_ns -= size_ns
        return True


def header_frame(channel: Channel, payload: bytes) -> str:
    """Return `frame_id` of a message that begins with a std_msgs/Header; "" if it is longer than
    _LONGEST_NAME or cut. The result has no meaning for other types."""
    if len(payload) < 16:
        return ""
    order = "<" if channel.encoding == "ros1" or payload[1] & 1 else ">"
    (length,) = struct.unpack_from(order + "I", payload, 12)
    name = payload[16 : 16 + length] if length <= _LONGEST_NAME else b""
    return name.rstrip(b"\0").decode(errors="replace")


class Clock:
    """Times of the messages of a recording or a live run, in the order of their arrival.

    The time of a message is its stamp. Three things are corrected: a topic with a clock of its own is aligned
    with the others by the messages that were delayed least; a topic without stamps gets the times of
    recording; and when a clock is set, by any amount and in any of the topics, its times go on evenly.

    Args:
        openings: First messages of the topics; topics without messages are ignored. If all share a clock, it
            is that of the result, else the one nearest to the times of recording.
        notices: List to which messages for the user about steps are added.

    Attributes:
        warnings: Messages for the user about topics with other clocks and without stamps.
        offset_ns: Time of a message minus its time of recording [ns], at most.
        window_ns: Largest delay of a topic behind another one, plus WINDOW_NS [ns].
    """

    def __init__(self, openings: Sequence[Opening], notices: list[str] | None = None) -> None:
        """Compare the clocks of the topics."""
        self._openings = [opening for opening in openings if opening.messages]
        self.notices: list[str] = [] if notices is None else notices
        self.warnings: list[str] = []
        offsets = {opening.name: _offset_of(opening) for opening in self._openings}
        # When the measurement was complete minus when it was recorded: a delay, if the clocks are the same.
        known = {o.name: n + o.end_ns for o in self._openings if (n := offsets[o.name]) is not None}
        first = next(iter(known), "")
        spread = max(known.values(), default=0) - min(known.values(), default=0)
        if spread > SAME_CLOCK_NS:
            first = min(known, key=lambda name: abs(known[name]))
        self.offset_ns = known.get(first, 0)
        self._align_ns: dict[int, int] = {}
        self._unstamped: dict[int, int] = {}  # time minus time of recording
        delays = [0]
        for opening in self._openings:
            late_ns = self.offset_ns - known.get(opening.name, self.offset_ns)
            if opening.name not in known:
                self._unstamped |= dict.fromkeys(opening.numbers, self.offset_ns - opening.end_ns)
                self.warnings.append(f"{opening.name} has no time stamps: times of recording are used for it")
            elif abs(late_ns) > SAME_CLOCK_NS:
                self._align_ns |= dict.fromkeys(opening.numbers, late_ns)
                self.warnings.append(
                    f"{opening.name} is stamped by another clock than {first} ({_seconds(-late_ns)}): their "
                    "times are aligned by the least delay between measurement and recording"
                )
            else:
                delays.append(opening.end_ns + abs(late_ns))
        self.window_ns = WINDOW_NS + max(delays)
        self._names = {n: opening.name for opening in self._openings for n in opening.numbers}
        self._usual_ns = offsets
        self._publishers: dict[tuple[int | str, str], _PublisherClock] = {}
        self._steps: list[tuple[int, int]] = []  # arrival and size [ns]

    def again(self, notices: list[str] | None = None) -> Clock:
        """Return a clock of the same topics for another reading from the start."""
        return Clock(self._openings, notices)

    def time_of(self, stamp_ns: int | None, message: Message, frame: str = "") -> int | None:
        """Return the time of a message [ns], with the steps of the clock removed; call it in the order of
        arrival. Without a stamp it is the time of recording plus the known offset. None if the result is not
        in [0, 2^63). A step adds a notice.

        Args:
            stamp_ns: Stamp of the message [ns]; None or 0 for none.
            message: The message.
            frame: Frame of the message, which distinguishes two publishers on one topic.
        """
        number, log_ns = message.channel, message.log_ns
        if number in self._unstamped:
            return _valid(log_ns + self._unstamped[number])
        align_ns, key = self._align_ns.get(number, 0), (self._names.get(number, number), frame)
        known = self._publishers.get(key)
        if not stamp_ns:
            offset_ns = self.offset_ns
            if known is not None and known.most_ns is not None:
                offset_ns = known.most_ns + known.shift_ns + align_ns
            return _valid(log_ns + offset_ns)
        if known is None:
            usual_ns = self._usual_ns.get(self._names.get(number, ""))
            shift_ns = self._shift_at_start(stamp_ns - log_ns) if usual_ns is None else 0
            known = self._publishers[key] = _PublisherClock(usual_ns, shift_ns)
        size_ns = known.step_of(stamp_ns, log_ns)
        if size_ns:
            same = [n for at, n in self._steps if _is_same(at - log_ns, n - size_ns)]
            is_new = known.begin(same[-1] if same else size_ns, stamp_ns - log_ns)
            if is_new and not same:
                self._steps.append((log_ns, size_ns))
                self.notices.append(
                    f"a clock was set by {_seconds(size_ns)} during the run: the times go on evenly"
                )
        return _valid(stamp_ns + known.shift_ns + align_ns)

    def near(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a message that is read apart from others [ns], None if it is impossible: its
        stamp if this `fits`, else its time of recording plus the offset."""
        if stamp_ns and self.fits(stamp_ns, message):
            return _valid(stamp_ns + self._align_ns.get(message.channel, 0))
        return _valid(message.log_ns + self._unstamped.get(message.channel, self.offset_ns))

    def fits(self, stamp_ns: int, message: Message) -> bool:
        """Return whether a stamp [ns] is of the clock of the first messages of its topic: it fits to the time
        of recording within SAME_CLOCK_NS and the delay. False for a topic without stamps."""
        time_ns = stamp_ns + self._align_ns.get(message.channel, 0)
        away_ns = abs(time_ns - message.log_ns - self.offset_ns)
        return message.channel not in self._unstamped and away_ns <= self.window_ns

    def _shift_at_start(self, offset_ns: int) -> int:
        """Return the correction of a channel that begins after steps of the clock of others: the sum of these
        steps if its stamps show them.

        Args:
            offset_ns: Stamp minus arrival of its first message [ns].
        """
        shifts = [0, *(known.shift_ns for known in self._publishers.values())]
        return min(shifts, key=lambda shift_ns: abs(offset_ns + shift_ns - self.offset_ns))


def _offset_of(opening: Opening) -> int | None:
    """Return the largest stamp minus time of recording of a topic [ns]: if its clock was set, that of the
    time with the most messages. None if no message has a stamp."""
    clock, counts = _PublisherClock(), Counter[int]()
    for log_ns, stamp_ns in opening.messages:
        if stamp_ns:
            size_ns = clock.step_of(stamp_ns, log_ns)
            if size_ns:
                clock.begin(size_ns, stamp_ns - log_ns)
            counts[clock.shift_ns] += 1
    if clock.most_ns is None:
        return None
    # Corrected stamps go on evenly, so times of one clock differ from each other by their corrections.
    shift_ns = counts.most_common(1)[0][0]
    return clock.most_ns + clock.shift_ns - shift_ns


def _valid(time_ns: int) -> int | None:
    """Return a time [ns], None if it is not in [0, 2^63)."""
    return time_ns if 0 <= time_ns < 2**63 else None


def _is_same(apart_ns: int, differs_ns: int) -> bool:
    """Return whether two steps that are apart in time and differ in size [ns] are one of a shared clock."""
    return abs(apart_ns) < _SAME_TIME_NS and abs(differs_ns) < STEP_NS


def _seconds(time_ns: int) -> str:
    """Return a time difference [ns] as text, with its sign: seconds, hours or days."""
    seconds = time_ns / SECOND_NS
    if abs(seconds) < 7200.0:
        return f"{seconds:+,.1f} s"
    return f"{seconds / 3600.0:+,.1f} h" if abs(seconds) < 172_800.0 else f"{seconds / 86_400.0:+,.0f} days"


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T_co]):
    """Contents with a time [ns]; of two with the same time the lower rank comes first."""

    stamp_ns: int
    rank: int
    content: T_co


def in_order_of_stamps(
    arrivals: Iterable[Stamped[T]], losses: dict[str, int], window_ns: int = WINDOW_NS
) -> Iterator[Stamped[T]]:
    """Yield contents sorted by time, then by rank, then in the order of arrival. A content waits until one
    that is more than `window_ns` later arrives, or more than _HELD_LIMIT contents wait. Contents that arrive
    with a time before that of the last one yielded are left out and counted.

    After a gap, as when all clocks are set forward or the recording paused, those from before it wait until
    the times have gone on by `window_ns`, or to the next gap: a scan may come that was stamped before it. If
    the times go on before the gap instead, because a single time was wrong, they do not wait for it.

    Args:
        arrivals: Contents in the order of arrival.
        losses: Dict from reasons to numbers of contents that are left out; increased in place.
        window_ns: Longest delay [ns].
    """
    heap: list[tuple[int, int, int, Stamped[T]]] = []
    newest = last = due = -(2**63)
    resumed: int | None = None  # first time after a gap
    for serial, arrival in enumerate(arrivals):
        if arrival.stamp_ns < last:
            count_loss(losses, "records that came too late to be put in order")
            continue
        if heap and arrival.stamp_ns > newest + window_ns:
            resumed, due = arrival.stamp_ns, newest - window_ns
        elif resumed is not None and arrival.stamp_ns < resumed:
            due = max(due, arrival.stamp_ns - window_ns)
        newest = max(newest, arrival.stamp_ns)
        if resumed is None or newest > resumed + window_ns:
            resumed, due = None, newest - window_ns
        heapq.heappush(heap, (arrival.stamp_ns, arrival.rank, serial, arrival))
        while heap[0][0] < due or len(heap) > _HELD_LIMIT:
            last = heap[0][0]
            yield heapq.heappop(heap)[3]
    while heap:
        yield heapq.heappop(heap)[3]
