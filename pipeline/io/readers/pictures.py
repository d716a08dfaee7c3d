"""Pictures of a recording: which there are, and the one of a time. Their pixels are not decoded here."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from typing import Protocol, runtime_checkable

from pipeline.io.readers.camera import SAME_TIME_NS, Camera, Picture, picture_of
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.decompression import plain_message
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.rostypes import MessageDecoder

#: A picture may be written so long before a scan of its time is stamped, and so long after.
_EARLY_NS, _LATE_NS = 300_000_000, 1_000_000_000
#: A stamp that is farther from its arrival than that of the scans was made by a clock that was set meanwhile.
_OTHER_CLOCK_NS = 2_000_000_000


@runtime_checkable
class WithPictures(Protocol):
    """A source that may have pictures."""

    def camera(self) -> tuple[Camera | None, str]:
        """How the camera stands; None and why where nobody tells, or there is none ("")."""

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The picture that was taken nearest to a time, None where none is within `within_ns` of it."""

    def picture_stamps(self) -> list[int]:
        """When pictures were taken that can still be had, ascending [ns]."""

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """The pictures that were taken at some of `picture_stamps`, each once."""


def time_beside(stamp_ns: int | None, log_ns: int, offset_ns: int) -> int:
    """The time of a picture of a live run [ns].

    Args:
        stamp_ns: In its message, if any.
        log_ns: When it came.
        offset_ns: Stamp minus arrival of the run's first scan.
    """
    if stamp_ns and abs(stamp_ns - log_ns - offset_ns) < _OTHER_CLOCK_NS:
        return stamp_ns
    return log_ns + offset_ns


class RecordedPictures:
    """The pictures of some channels.

    Args:
        container, decoder: The recording and what reads its messages.
        channels: Of the recording, by number.
        numbers: Of the channels of pictures.
        time_of: A message's time [ns] from its stamp, None where that is impossible.
        offset_ns: Times minus times of writing, roughly.
    """

    def __init__(
        self,
        container: Container,
        decoder: MessageDecoder,
        channels: Mapping[int, Channel],
        numbers: frozenset[int],
        time_of: Callable[[int | None, Message], int | None],
        offset_ns: int,
    ) -> None:
        self._container, self._decoder, self._channels = container, decoder, channels
        self._numbers, self._time_of, self._offset_ns = numbers, time_of, offset_ns

    def stamps(self) -> list[int]:
        """When they were taken, ascending [ns]."""
        return sorted(stamp_ns for stamp_ns, _ in self._stamped(None))

    def at(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Those that were taken at some of `stamps`, each once."""
        left = set(wanted_ns)
        for stamp_ns, message in self._stamped(None) if left else ():
            if stamp_ns in left:
                left.discard(stamp_ns)
                picture = picture_of(message, self._channels, self._decoder, stamp_ns)
                if picture is not None:
                    yield picture

    def near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The one that was taken nearest to a time, None where that is farther from it than `within_ns`."""
        # Of a fast camera only the pictures around the time are read: they can be a megabyte each.
        best = self._nearest(stamp_ns, min(within_ns, SAME_TIME_NS)) or self._nearest(stamp_ns, within_ns)
        return None if best is None else picture_of(best[1], self._channels, self._decoder, best[0])

    def _nearest(self, stamp_ns: int, within_ns: int) -> tuple[int, Message] | None:
        """Time [ns] and message of the nearest picture within a time."""
        log_ns, best = stamp_ns - self._offset_ns, None
        wider_ns = within_ns - SAME_TIME_NS
        for taken_ns, message in self._stamped(log_ns - _EARLY_NS - wider_ns):
            if message.log_ns > log_ns + _LATE_NS + wider_ns:
                break
            off_ns = abs(taken_ns - stamp_ns)
            if off_ns <= within_ns and (best is None or off_ns < abs(best[0] - stamp_ns)):
                best = taken_ns, message
        return best

    def _stamped(self, from_log_ns: int | None) -> Iterator[tuple[int, Message]]:
        """Messages with their times, in the order of writing."""
        for message in self._container.messages(self._numbers, from_log_ns, {}) if self._numbers else ():
            plain = replace(message, payload=plain_message(message.payload))
            stamp_ns = self._time_of(header_stamp(self._channels[message.channel], plain.payload), plain)
            if stamp_ns is not None:
                yield stamp_ns, plain
