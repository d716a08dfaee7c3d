"""Where other sources say the base is, in a recording or live: GNSS fixes, and the poses of another SLAM."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

from pipeline.records import Odometry
from pipeline.sources import gnss, other_slam
from pipeline.sources.base import SourceDescription
from pipeline.sources.container import Container, Message
from pipeline.sources.first_stretch import MOST_MESSAGES, TimesOf, align_fixes
from pipeline.sources.live_stretch import Kind, LiveStretch
from pipeline.sources.ordering import Stamped
from pipeline.sources.ros_records import RecordDecoder
from pipeline.sources.topics import Topics

_NORTH, _THEIRS = "the direction of north", "how their frame lies"
_GNSS, _SLAM = ("GNSS", "GNSS fixes", _NORTH), ("other SLAM", "Poses of another SLAM", _THEIRS)


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
        self._fixes = frozenset[int]() if topics.gnss is None else topics.gnss.numbers
        self._poses = frozenset[int]() if topics.pose is None else topics.pose.numbers
        self._stretches: list[tuple[frozenset[int], tuple[str, str, str], LiveStretch[Any, Any]]] = []
        #: The channels whose messages count, or may yet.
        self.numbers = self._fixes | self._poses
        self.notices: list[str] = []

    def begin(self, known: SourceDescription, *, live: bool) -> SourceDescription:
        """What is known of the source with what is found at its opening."""
        start_ns = known.start_ns or 0
        for numbers, names in ((self._fixes, _GNSS), (self._poses, _SLAM)):
            if not numbers:
                continue
            if not (known.has_odometry if live else self._odometry):
                known = self._refuse(known, numbers, names, f"without odometry nobody tells {names[2]}")
            elif live:
                told = f"{'fixes' if names is _GNSS else 'poses'} count when the robot drove far enough"
                known = _saying(known, names, f"{told} to tell {names[2]}")
                self._stretches.append((numbers, names, self._stretch(names, numbers, start_ns)))
            else:
                found, why = self._ahead(names, numbers, start_ns)
                if found is None:
                    known = self._refuse(known, numbers, names, why)
                else:
                    self._hold(names, found)
                    known = _saying(known, names, found.words)
        return known

    def add(self, stamped: Stamped[Message | Odometry]) -> None:
        """Take what came next of a live run, before it is made a record of."""
        for entry in tuple(self._stretches):
            numbers, names, stretch = entry
            found = stretch.add(stamped)
            if found is not None:
                self._hold(names, found)
                self.notices.append(f"{names[0]}: {found.words}")
            elif stretch.refused:
                self.numbers -= numbers
                self.notices.append(f"{names[1]} are not used: {stretch.refused}")
            else:
                continue
            self._stretches.remove(entry)

    def _hold(self, names: tuple[str, str, str], found: Any) -> None:  # noqa: ANN401 - of either kind
        if names is _GNSS:
            self._decoder.alignment = found
        else:
            self._decoder.relation = found

    def _refuse(
        self, known: SourceDescription, numbers: frozenset[int], names: tuple[str, str, str], why: str
    ) -> SourceDescription:
        self.numbers -= numbers
        return replace(known, warnings=(*known.warnings, f"{names[1]} are not used: {why}"))

    def _stretch(
        self, names: tuple[str, str, str], numbers: frozenset[int], start_ns: int
    ) -> LiveStretch[Any, Any]:
        kind: Kind[Any, Any]
        if names is _GNSS:
            kind = Kind(self._decoder.fix, gnss.align, gnss.SHORTEST, gnss.LONGEST, _NORTH)
        else:
            longest = other_slam.LONGEST
            kind = Kind(self._decoder.placed, other_slam.relate, other_slam.SHORTEST, longest, _THEIRS)
        return LiveStretch(self._decoder, kind, numbers, self._odometry, start_ns)

    def _ahead(self, names: tuple[str, str, str], numbers: frozenset[int], start_ns: int) -> tuple[Any, str]:
        """As `LiveStretch.end`, by the first stretch of a recording."""
        if names is _GNSS:
            return align_fixes(
                self._container, self._decoder, self._times_of, numbers, self._odometry, start_ns
            )
        stretch = self._stretch(names, numbers, start_ns)
        for message in islice(self._container.messages(numbers | self._odometry, None, {}), MOST_MESSAGES):
            for stamped in self._times_of(message, {}):
                found = stretch.add(stamped)
                if found is not None or stretch.refused:
                    return found, stretch.refused
        return stretch.end()


def _saying(known: SourceDescription, names: tuple[str, str, str], words: str) -> SourceDescription:
    return replace(known, gnss=words) if names is _GNSS else replace(known, other_slam=words)
