"""Recordings of stamped messages: the interface, compressed blocks, and chunked files in the order of time.

The readers of MCAP files and ROS 1 bags are our own. rosbags refuses bags without an index and trusts the
sizes in a file; mcap decompresses without a limit and gives up at the first damaged record.
"""

from __future__ import annotations

import bz2
import heapq
import io
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Protocol

import lz4.frame
import zstandard

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss

#: Largest block that is unpacked. Recorders write blocks of 1 to 4 MB; a file of 16 kB can claim 512 MB.
BLOCK_LIMIT = 256 << 20
#: Most messages of one chunk, and the memory that a message takes besides its payload [bytes].
MOST_IN_CHUNK, _MESSAGE_BYTES = 1 << 20, 200
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, slots=True)
class Channel:
    """The messages of one publisher on one topic.

    Attributes:
        number: Number of the channel in the file.
        topic: e.g. "/velodyne_points".
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
        encoding: "cdr" (ROS 2), "ros1", or "" when the file does not name it.
        definition: Text of the message definition, "" when the file has none.
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
    """A recorded message: number of its channel, time of recording, and bytes."""

    channel: int
    log_ns: int
    payload: bytes


class Container(Protocol):
    """A recording that can be read from any time. It does not decode messages."""

    @property
    def kind(self) -> str:
        """Name of the format, e.g. "ROS 2 MCAP"."""

    @property
    def channels(self) -> list[Channel]:
        """All channels."""

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return a time [ns] from which a few messages of some channels are left to read, the last ones of
        the recording.

        Args:
            numbers: Numbers of the channels.
        """

    @property
    def damage(self) -> dict[str, int]:
        """Parts that could not be read when the file was opened, by reason."""

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages in the order of recording. Parts that cannot be read are left out.

        Args:
            numbers: Numbers of the channels that are read.
            start_ns: Time of the first message [ns]; None for all.
            losses: Counts the parts that are left out, by reason.
        """

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of a file attached to the recording, None when there is none of this name.

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
    """Return the error for a file that cannot be read at all.

    Args:
        what: What is wrong with it.
        path: The file.
    """
    return SourceError(what, where=str(path), remedy="Copy the file again, or record it again.")


# --- compressed blocks -----------------------------------------------------------------------------


class UnpackError(Exception):
    """A block is damaged, too large, or has an unknown compression."""


def unpack(block: bytes, compression: str, size: int) -> bytes:
    """Unpack a block to exactly `size` bytes.

    Args:
        block: The packed bytes.
        compression: "", "none", "lz4", "zstd" or "bz2".
        size: Size by the header.

    Raises:
        UnpackError: The size is larger than BLOCK_LIMIT or wrong, or the compression is unknown.
    """
    if size > BLOCK_LIMIT:
        raise UnpackError("a block is too large")
    raw = _unpack_up_to(block, compression, size)
    if len(raw) != size:
        raise UnpackError("a block has another size than in its header")
    return raw


def _unpack_up_to(block: bytes, compression: str, limit: int) -> bytes:
    """Return the first `limit` + 1 unpacked bytes of a block, or all if there are fewer; arguments as in
    `unpack`."""
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
    """Return the bytes of a message that a recorder may have compressed; b"" if they are damaged."""
    if payload[:4] != _ZSTD_MAGIC:
        return payload
    try:
        return _unpack_up_to(payload, "zstd", BLOCK_LIMIT)[:BLOCK_LIMIT]
    except UnpackError:
        return b""


# --- files of chunks -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Chunk:
    """Position of a run of messages in a file.

    Attributes:
        offset, length: Of the packed bytes.
        start_ns, end_ns: Time of recording of the first and the last message.
        compression: As the file names it, "" for none.
        size: Bytes after unpacking.
        crc: CRC-32 of the unpacked bytes, 0 when the file has none.
        counts: Number of messages by channel, None when it is not known yet.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str
    size: int
    crc: int
    counts: dict[int, int] | None


class BrokenChunkError(Exception):
    """Nothing more of a chunk can be read."""


class ChunkedFile:
    """A file with messages in compressed chunks, indexed by reading the headers of its records.

    The index of the file itself is not needed, so a file that was cut during a recording gives all its whole
    chunks, and a wrong index does no harm.

    Attributes:
        damage: Parts that could not be read on opening, by reason.

    Raises:
        SourceError: The file cannot be opened, or holds no messages that can be read.
    """

    def __init__(self, path: Path) -> None:
        self.damage: dict[str, int] = {}
        self._path = path
        self._chunks: list[Chunk] = []
        self._unpacked: tuple[int, bytes] = (-1, b"")  # offset and bytes of the last chunk
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
        try:
            self._read_index()
            self._survey_chunks()
        except BaseException:
            self.close()
            raise

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return the time of the first message of the last chunk with these channels [ns]."""
        last = max(self._needed(frozenset(numbers), None), key=attrgetter("end_ns"), default=None)
        return 0 if last is None else last.start_ns

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages, see `Container.messages`. Chunks may overlap in time; each is unpacked when its
        first message is due."""
        wanted = frozenset(numbers)
        heap: list[tuple[int, int, Message]] = []
        serial = held = 0
        for chunk in sorted(self._needed(wanted, start_ns), key=attrgetter("start_ns", "offset")):
            while heap and (heap[0][0] <= chunk.start_ns or held > BLOCK_LIMIT):
                held -= len(heap[0][2].payload) + _MESSAGE_BYTES
                yield heapq.heappop(heap)[2]
            try:
                for message in self._contents(chunk, define=False):
                    if message.channel in wanted and (start_ns is None or message.log_ns >= start_ns):
                        heapq.heappush(heap, (message.log_ns, serial, message))
                        serial += 1
                        held += len(message.payload) + _MESSAGE_BYTES
            except (UnpackError, BrokenChunkError):
                count_loss(losses, "damaged chunks of the recording")
        while heap:
            yield heapq.heappop(heap)[2]

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    # --- for the formats ---

    def _read_index(self) -> None:
        """Read the headers of the records: chunks, channels, attachments.

        Raises:
            SourceError: The file has another format.
        """
        raise NotImplementedError

    def _known_channels(self) -> Collection[int]:
        """Return the numbers of the channels that are known so far."""
        raise NotImplementedError

    def _parse(self, raw: bytes, *, define: bool) -> Iterator[Message]:
        """Yield the messages of an unpacked chunk; with `define`, keep the channels that it defines.

        Raises:
            BrokenChunkError: The rest cannot be read.
            struct.error, ValueError, KeyError: The same.
        """
        raise NotImplementedError

    # --- shared ---

    def _read(self, offset: int, size: int) -> bytes:
        try:
            self._file.seek(offset)
            return self._file.read(size)
        except OSError as error:
            raise damaged(f"cannot read on: {error.strerror}", self._path) from error

    def _counts(self) -> dict[int, int]:
        """Return the number of messages by channel."""
        total: dict[int, int] = {}
        for chunk in self._chunks:
            for number, count in (chunk.counts or {}).items():
                total[number] = total.get(number, 0) + count
        return total

    def _needed(self, wanted: frozenset[int], start_ns: int | None) -> Iterable[Chunk]:
        for chunk in self._chunks:
            if start_ns is not None and chunk.end_ns < start_ns:
                continue
            if chunk.counts is None or not wanted.isdisjoint(chunk.counts):
                yield chunk

    def _contents(self, chunk: Chunk, *, define: bool) -> Iterator[Message]:
        """Yield the messages of a chunk.

        Raises:
            UnpackError, BrokenChunkError: It is damaged.
        """
        if chunk.offset != self._unpacked[0]:
            if chunk.length > BLOCK_LIMIT:
                raise BrokenChunkError
            raw = unpack(self._read(chunk.offset, chunk.length), chunk.compression, chunk.size)
            if chunk.crc and zlib.crc32(raw) != chunk.crc:
                raise BrokenChunkError
            self._unpacked = (chunk.offset, raw)
        try:
            for number, message in enumerate(self._parse(self._unpacked[1], define=define)):
                if number >= MOST_IN_CHUNK:
                    raise BrokenChunkError
                yield message
        except (struct.error, ValueError, KeyError) as error:
            raise BrokenChunkError from error

    def _survey(self, chunk: Chunk) -> Chunk:
        """Return a chunk with the number and times of its messages, which are counted by unpacking it.
        Channels that it defines are added."""
        counts: dict[int, int] = {}
        first_ns, last_ns = 2**64, -1
        try:
            for message in self._contents(chunk, define=True):
                counts[message.channel] = counts.get(message.channel, 0) + 1
                first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
        except (UnpackError, BrokenChunkError):
            count_loss(self.damage, "chunks of the recording damaged in part")
        if counts:
            chunk = replace(chunk, start_ns=first_ns, end_ns=last_ns)
        return replace(chunk, counts=counts)

    def _survey_chunks(self) -> None:
        """Count the messages of the chunks without an index, and of those with channels that are not defined
        elsewhere."""
        for index, chunk in enumerate(self._chunks):
            if chunk.counts is None or not set(chunk.counts) <= set(self._known_channels()):
                self._chunks[index] = self._survey(chunk)
        if not self._known_channels():
            raise damaged("the recording holds no messages that can be read", self._path)
