"""ROS messages in the order in which they came: what a live robot sends, and its recording again.

What comes of a row of messages hangs on the messages and their times of arrival alone, so that a
recording of them gives the same records as the live run had.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

from pipeline.errors import SourceError
from pipeline.io.readers.base import SourceDescription, SourceOptions
from pipeline.io.readers.clock_step_filter import SteppingClock
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.message_time import SECOND_NS
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.topics import TYPES_BY_ROLE
from pipeline.types.records import Notice, Record

#: So long after the first scan, or after so many, it is clear which topics speak and where the LiDAR stands.
OPENING_NS = SECOND_NS
OPENING_SCANS = 10
#: So many messages are kept while no scan comes.
OPENING_LIMIT = 4000
_TRIES = 5


class Heard:
    """Some messages that came as a container."""

    damage: dict[str, int]

    def __init__(self, kind: str, channels: Sequence[Channel], messages: Sequence[Message]) -> None:
        self.kind, self.damage = kind, {}
        self._messages = messages
        counts = {channel.number: 0 for channel in channels}
        for message in messages:
            counts[message.channel] += 1
        self.channels = [replace(channel, count=counts[channel.number]) for channel in channels]

    def tail_ns(self, numbers: Collection[int]) -> int:
        """See Container."""
        return max((m.log_ns for m in self._messages if m.channel in numbers), default=0)

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """See Container."""
        del losses
        for message in self._messages:
            if message.channel in numbers and (start_ns is None or message.log_ns >= start_ns):
                yield message

    def attachment(self, name: str, limit: int) -> bytes | None:
        """There is none."""
        del name, limit
        return None

    def close(self) -> None:
        """Nothing is held open."""


class ArrivalReader:
    """Turns messages into records, one by one.

    Args:
        uri, kind: Of the source, for people.
        channels: That may come.
        options: What the user knows better.

    Attributes:
        description: None until a second after the first scan, or ten scans.
        losses: What was left out so far, by reason.
        from_ns: What lies before this time is not decoded; None decodes all.
    """

    def __init__(self, uri: str, kind: str, channels: Sequence[Channel], options: SourceOptions) -> None:
        self._uri, self._kind, self._channels, self._options = uri, kind, channels, options
        self._scans = {c.number for c in channels if c.msgtype in TYPES_BY_ROLE["scan"]}
        self._fixed = {c.number for c in channels if c.topic.endswith("tf_static")}
        self._opening: list[Message] = []
        self._first_ns: int | None = None
        self._scan_ns = 0
        self._heard = 0
        self._failures = 0
        self._source: RosSource | None = None
        self._clock: SteppingClock | None = None
        self.description: SourceDescription | None = None
        self.losses: dict[str, int] = {}
        self.from_ns: int | None = None

    @property
    def offset_ns(self) -> int:
        """Stamp minus arrival of the first scan [ns]; 0 before the description is known."""
        known = self.description
        return 0 if known is None or known.start_ns is None else known.start_ns - self._scan_ns

    @property
    def base(self) -> str:
        """The name of the base frame, "" where nobody says it."""
        return "" if self._source is None else self._source.base

    def add(self, message: Message) -> list[Record]:
        """Take the next message; the records that are known by it.

        Raises:
            SourceError: There are scans and none can be read.
        """
        if self._source is not None:
            return self._records_of(message)
        self._opening.append(message)
        if message.channel in self._scans:
            self._scan_ns = self._scan_ns or message.log_ns
            self._heard += 1
            self._first_ns = message.log_ns if self._first_ns is None else self._first_ns
        if len(self._opening) > OPENING_LIMIT:
            self._forget_oldest()
        if self._first_ns is None:
            return []
        if self._heard < OPENING_SCANS and message.log_ns < self._first_ns + OPENING_NS:
            return []
        return self._open(message.log_ns)

    def finish(self) -> list[Record]:
        """No more messages will come: what the opening held, where it was not over.

        Raises:
            SourceError: As `add`.
        """
        if self._source is not None or self._first_ns is None:
            return []
        self._failures = _TRIES
        return self._open(self._first_ns)

    def _forget_oldest(self) -> None:
        """Of the oldest half only the fixed transforms stay, which are said once, and the scans."""
        half, kept = len(self._opening) // 2, self._fixed | self._scans
        old = [message for message in self._opening[:half] if message.channel in kept]
        self._opening[:half] = old[-half // 2 :]

    def _open(self, now_ns: int) -> list[Record]:
        clocks: list[SteppingClock] = []

        def make_clock(offsets_ns: list[int | None]) -> SteppingClock:
            clocks.append(SteppingClock(offsets_ns))
            return clocks[-1]

        heard = Heard(self._kind, self._channels, self._opening)
        try:
            source = RosSource(self._uri, heard, [], self._options, make_clock, live=True)
        except SourceError:
            self._failures += 1
            if self._failures >= _TRIES:
                raise
            self._first_ns, self._heard = now_ns, 0  # a second more
            return []
        self._source = source
        # What the opening looked at must not count for the run, which begins anew with its first message.
        self._clock = SteppingClock(clocks[-1].offsets_ns)
        source.use_clock(self._clock)
        known = source.description
        self.description = replace(known, scans=None, end_ns=None, digest="", in_order_of_arrival=True)
        opening, self._opening = self._opening, []
        return [record for message in opening for record in self._records_of(message)]

    def _records_of(self, message: Message) -> list[Record]:
        assert self._source is not None  # noqa: S101 - the two callers have looked
        assert self._clock is not None  # noqa: S101 - set with it
        records = list(self._source.records_of(message, self.losses, self.from_ns))
        told = [*self._clock.notices, *self._source.notices]
        if told:
            stamp_ns = records[0].stamp_ns if records else 0
            records = [*(Notice(stamp_ns, text) for text in told), *records]
            self._clock.notices.clear()
            self._source.notices.clear()
        return records
