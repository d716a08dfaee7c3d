"""Where other sources say the base is, in a recording or live: GNSS fixes, and the poses of another SLAM."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from pipeline.io.readers import gnss, other_slam
from pipeline.io.readers.base import SourceDescription
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.frame_alignment import MOST_MESSAGES, TimesOf, align_fixes
from pipeline.io.readers.live_frame_alignment import Kind, LiveStretch
from pipeline.io.readers.message_time import Stamped
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.topics import Topics
from pipeline.types.records import Odometry


@dataclass(frozen=True, slots=True)
class _Source:
    """One source of measured poses.

    Attributes:
        numbers: Of its channels.
        title, readings, reading: For people: what it is, and what it tells, in full and in a word.
        kind: How its frame is found.
        hold: Tells the decoder how its frame lies.
        said: The field of `SourceDescription` that says so.
        ahead: Of the time of the first scan: how the frame lies by a recording, or why that is not known;
            None where a recording is gone through as a live run is.
    """

    numbers: frozenset[int]
    title: str
    readings: str
    reading: str
    kind: Kind[Any, Any]
    hold: Callable[[Any], None]
    said: str
    ahead: Callable[[int], tuple[Any, str]] | None = None

    def saying(self, known: SourceDescription, words: str) -> SourceDescription:
        """What is known, with what is to be said of this source."""
        told: dict[str, Any] = {self.said: words}
        return replace(known, **told)


class MeasuredPoses:
    """Finds how the frames of measured poses lie in the map; the decoder makes records of them from then on.

    Args:
        container: What is there of the messages when it is opened.
        decoder: Of its messages; is told what is found.
        topics: That are read.
        odometry: Numbers of the channels of odometry.
        times_of: Gives a message its time.

    Attributes:
        notices: What a person should know since somebody emptied the list.
    """

    def __init__(
        self,
        container: Container,
        decoder: RecordDecoder,
        topics: Topics,
        odometry: frozenset[int],
        times_of: TimesOf,
    ) -> None:
        self._container, self._decoder, self._times_of = container, decoder, times_of
        self._odometry = odometry
        self._sources = tuple(source for source in (self._gnss(topics), self._slam(topics)) if source.numbers)
        self._stretches: list[tuple[_Source, LiveStretch[Any, Any]]] = []
        #: The channels whose messages count, or may yet.
        self.numbers = frozenset[int]().union(*(source.numbers for source in self._sources))
        self.notices: list[str] = []

    def begin(self, known: SourceDescription, *, live: bool) -> SourceDescription:
        """What is known of the source with what is found at its opening."""
        start_ns = known.start_ns or 0
        for source in self._sources:
            unknown = source.kind.unknown
            if not (known.has_odometry if live else self._odometry):
                known = self._refuse(known, source, f"without odometry nobody tells {unknown}")
            elif live:
                told = f"{source.reading} count when the robot drove far enough to tell {unknown}"
                known = source.saying(known, told)
                self._stretches.append((source, self._stretch(source, start_ns)))
            else:
                found, why = source.ahead(start_ns) if source.ahead else self._ahead(source, start_ns)
                if found is None:
                    known = self._refuse(known, source, why)
                else:
                    source.hold(found)
                    known = source.saying(known, found.words)
        return known

    def add(self, stamped: Stamped[Message | Odometry]) -> None:
        """Take what came next of a live run, before it is made a record of."""
        for entry in tuple(self._stretches):
            source, stretch = entry
            found = stretch.add(stamped)
            if found is not None:
                source.hold(found)
                self.notices.append(f"{source.title}: {found.words}")
            elif stretch.refused:
                self.numbers -= source.numbers
                self.notices.append(f"{source.readings} are not used: {stretch.refused}")
            else:
                continue
            self._stretches.remove(entry)

    def _gnss(self, topics: Topics) -> _Source:
        numbers = frozenset[int]() if topics.gnss is None else topics.gnss.numbers
        north = "the direction of north"
        kind: Kind[Any, Any] = Kind(self._decoder.fix, gnss.align, gnss.SHORTEST, gnss.LONGEST, north)

        def hold(found: gnss.Alignment) -> None:
            self._decoder.alignment = found

        def ahead(start_ns: int) -> tuple[gnss.Alignment | None, str]:
            parts = self._container, self._decoder, self._times_of
            return align_fixes(*parts, numbers, self._odometry, start_ns)

        return _Source(numbers, "GNSS", "GNSS fixes", "fixes", kind, hold, "gnss", ahead)

    def _slam(self, topics: Topics) -> _Source:
        numbers = frozenset[int]() if topics.pose is None else topics.pose.numbers
        shortest, longest = other_slam.SHORTEST, other_slam.LONGEST
        theirs = "how their frame lies"
        kind: Kind[Any, Any] = Kind(self._decoder.placed, other_slam.relate, shortest, longest, theirs)

        def hold(found: other_slam.Relation) -> None:
            self._decoder.relation = found

        return _Source(numbers, "other SLAM", "Poses of another SLAM", "poses", kind, hold, "other_slam")

    def _refuse(self, known: SourceDescription, source: _Source, why: str) -> SourceDescription:
        self.numbers -= source.numbers
        return replace(known, warnings=(*known.warnings, f"{source.readings} are not used: {why}"))

    def _stretch(self, source: _Source, start_ns: int) -> LiveStretch[Any, Any]:
        return LiveStretch(self._decoder, source.kind, source.numbers, self._odometry, start_ns)

    def _ahead(self, source: _Source, start_ns: int) -> tuple[Any, str]:
        """As `LiveStretch.end`, by the first stretch of a recording."""
        stretch, wanted = self._stretch(source, start_ns), source.numbers | self._odometry
        for message in islice(self._container.messages(wanted, None, {}), MOST_MESSAGES):
            for stamped in self._times_of(message, {}):
                found = stretch.add(stamped)
                if found is not None or stretch.refused:
                    return found, stretch.refused
        return stretch.end()
