"""Recordings that keep their messages in compressed chunks: reading them in the order of time."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter

from pipeline.io.readers.container import Message, count_loss
from pipeline.io.readers.decompression import BLOCK_LIMIT, UnpackError, unpack


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where a run of messages lies in the file.

    Attributes:
        offset, length: Of the packed bytes.
        start_ns, end_ns: When the first and the last message was written.
        compression: As the file names it, "" for none.
        size: Number of bytes once unpacked.
        crc: CRC-32 of the unpacked bytes, 0 when the file has none.
        counts: Number of messages by channel, None when the file does not say.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str
    size: int
    crc: int
    counts: dict[int, int] | None


class LastChunk:
    """Keeps the chunk that was unpacked last: opening a recording looks at its first one several times."""

    def __init__(self) -> None:
        self._offset = -1
        self._raw = b""

    def unpacked(self, chunk: Chunk, read: Callable[[int, int], bytes]) -> bytes:
        """The unpacked bytes of a chunk.

        Args:
            chunk: To be unpacked.
            read: Gives (offset, length) of the file.

        Raises:
            UnpackError, BrokenChunkError: It is damaged.
        """
        if chunk.offset != self._offset:
            if chunk.length > BLOCK_LIMIT:
                raise BrokenChunkError
            raw = unpack(read(chunk.offset, chunk.length), chunk.compression, chunk.size)
            if chunk.crc and zlib.crc32(raw) != chunk.crc:
                raise BrokenChunkError
            self._offset, self._raw = chunk.offset, raw
        return self._raw


class BrokenChunkError(Exception):
    """A chunk of which nothing, or nothing more, can be read."""


def in_order(
    chunks: Iterable[Chunk],
    wanted: frozenset[int],
    start_ns: int | None,
    expand: Callable[[Chunk], Iterable[Message]],
    losses: dict[str, int],
) -> Iterator[Message]:
    """Merge the messages of chunks that may overlap, unpacking each only when its time has come.

    Args:
        chunks: In any order.
        wanted: Numbers of the channels.
        start_ns: Leave out what was written before.
        expand: Gives the messages of one chunk; raises UnpackError or BrokenChunkError.
        losses: Counts chunks that cannot be read.
    """
    heap: list[tuple[int, int, Message]] = []
    serial = held = 0
    for chunk in sorted(_needed(chunks, wanted, start_ns), key=attrgetter("start_ns", "offset")):
        while heap and (heap[0][0] <= chunk.start_ns or held > BLOCK_LIMIT):
            held -= len(heap[0][2].payload)
            yield heapq.heappop(heap)[2]
        try:
            for message in expand(chunk):
                if message.channel in wanted and (start_ns is None or message.log_ns >= start_ns):
                    heapq.heappush(heap, (message.log_ns, serial, message))
                    serial += 1
                    held += len(message.payload)
        except (UnpackError, BrokenChunkError):
            count_loss(losses, "damaged chunks of the recording")
    while heap:
        yield heapq.heappop(heap)[2]


def tail_ns(chunks: Iterable[Chunk], wanted: frozenset[int]) -> int:
    """When the last chunk begins that holds messages of these channels, 0 when there is none."""
    last = max(_needed(chunks, wanted, None), key=attrgetter("end_ns"), default=None)
    return 0 if last is None else last.start_ns


def _needed(chunks: Iterable[Chunk], wanted: frozenset[int], start_ns: int | None) -> Iterator[Chunk]:
    for chunk in chunks:
        if start_ns is not None and chunk.end_ns < start_ns:
            continue
        if chunk.counts is None or not wanted.isdisjoint(chunk.counts):
            yield chunk
