"""Recordings of stamped messages: the interface, compressed blocks, and chunks read in the order of time."""

from __future__ import annotations

import bz2
import heapq
import io
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Protocol

import lz4.frame
import zstandard

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss


@dataclass(frozen=True, slots=True)
class Channel:
    """One publisher's messages of one topic.

    Attributes:
        number: The file's own number of it.
        topic: e.g. "/velodyne_points".
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
        encoding: "cdr" (ROS 2) or "ros1".
        definition: The text of the message's definition, "" when the file has none.
        definition_format: "ros2msg", "ros1msg", "ros2idl" or "".
        count: Number of messages.
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    definition: str
    definition_format: str
    count: int


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it was recorded: its channel's number, when it was written, its bytes."""

    channel: int
    log_ns: int
    payload: bytes


class Container(Protocol):
    """A recording that can be read from any time. Nothing is decoded here."""

    @property
    def kind(self) -> str:
        """The format in words, e.g. "ROS 2 MCAP"."""

    @property
    def channels(self) -> list[Channel]:
        """All channels."""

    def tail_ns(self, numbers: Collection[int]) -> int:
        """A time from which on reading meets the last message of these channels, soon after."""

    @property
    def damage(self) -> dict[str, int]:
        """What could not be read when the file was opened, by reason."""

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield the messages of these channels in the order of writing, from `start_ns` on.

        Parts that cannot be read are counted in `losses` and left out.
        """

    def attachment(self, name: str, limit: int) -> bytes | None:
        """The bytes of a file attached to the recording, None when there is none of this name.

        Raises:
            SourceError: It is longer than `limit` bytes or damaged.
        """

    def close(self) -> None:
        """Close the file; safe to call twice."""


def ros2_type_name(name: str) -> str:
    """Spell a message type as ROS 2 does: "sensor_msgs/Imu" becomes "sensor_msgs/msg/Imu"."""
    parts = [part for part in name.split("/") if part]
    return "/".join([parts[0], "msg", parts[1]]) if len(parts) == 2 else "/".join(parts)


def damaged(what: str, path: object) -> SourceError:
    """The error for a file that cannot be read at all."""
    return SourceError(what, where=str(path), remedy="Copy the file again, or record it again.")


#: Largest block that is unpacked. Recorders write blocks of 1 to 4 MB; a file of 16 kB can claim 512 MB.
BLOCK_LIMIT = 256 << 20
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class UnpackError(Exception):
    """A block that is damaged, too large, or packed in a way that is not known."""


def unpack(block: bytes, compression: str, size: int) -> bytes:
    """Unpack a block that must have exactly `size` bytes afterwards.

    Args:
        block: The packed bytes.
        compression: "", "none", "lz4", "zstd" or "bz2".
        size: The size that the file promises.

    Raises:
        UnpackError: The promise is broken, larger than BLOCK_LIMIT, or the method is unknown.
    """
    if size > BLOCK_LIMIT:
        raise UnpackError("a block is too large")
    raw = unpack_up_to(block, compression, size)
    if len(raw) != size:
        raise UnpackError("a block has another size than it says")
    return raw


def unpack_up_to(block: bytes, compression: str, limit: int) -> bytes:
    """Unpack a block, but no more than one byte over `limit`.

    Raises:
        UnpackError: The block is damaged or the method is unknown.
    """
    try:
        match compression:
            case "" | "none":
                return block
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(block, max_length=limit + 1))
            case "bz2":
                return bz2.BZ2Decompressor().decompress(block, max_length=limit + 1)
            case "zstd":
                window = zstandard.ZstdDecompressor(max_window_size=1 << 27)
                return window.stream_reader(io.BytesIO(block)).read(limit + 1)
            case _:
                raise UnpackError(f"unknown compression {compression[:20]!r}")
    except (RuntimeError, OSError, EOFError, ValueError, MemoryError, zstandard.ZstdError) as error:
        raise UnpackError(str(error)) from error


def plain_message(payload: bytes) -> bytes:
    """A message as it was sent: recorders can compress each by itself. Empty when it is damaged."""
    if payload[:4] != ZSTD_MAGIC:
        return payload
    try:
        return unpack_up_to(payload, "zstd", BLOCK_LIMIT)[:BLOCK_LIMIT]
    except UnpackError:
        return b""


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
