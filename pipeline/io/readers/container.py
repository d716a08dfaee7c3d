"""Recordings of stamped messages: the interface, an index of all messages, and files of compressed chunks.

The readers of MCAP files and ROS 1 bags are our own. rosbags refuses bags without an index and trusts the
sizes in a file; mcap decompresses without a limit and gives up at the first damaged record.
"""

from __future__ import annotations

import bz2
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss
from pipeline.types.records import Int

#: Largest block that is unpacked. Recorders write blocks of 1 to 4 MB; a file of 16 kB can claim 512 MB.
BLOCK_LIMIT = 256 << 20
#: Most records of a chunk without an index, which are counted one by one.
MOST_IN_CHUNK = 1 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: What damaged records raise when they are parsed.
DAMAGE = (McapError, struct.error, ValueError, KeyError, OverflowError)
#: A file with more damaged or unknown records has another format, and would take long to read.
STRANGE_LIMIT = 1000
#: Times of recording of a topic that go back by more show that the clock of the recorder was set [ns].
#: Threads of a recorder change the order of messages by less.
STEP_BACK_NS = 50_000_000
MOST_STEPS = 100
#: Message types of transforms of ROS 2 and ROS 1.
TRANSFORM_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: Remedy for a damaged file.
COMPARE = "Compare its size with that of the original: if they are equal, the damage is from the recording."
#: Number of messages that are left behind `Container.tail_ns`.
TAIL = 3


@dataclass(frozen=True, slots=True)
class Channel:
    """The messages of one publisher on one topic.

    Attributes:
        number: Number of the channel in the file.
        topic: Name of the topic, e.g. "/velodyne_points".
        msgtype: Message type in the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
        encoding: Encoding: "cdr" (ROS 2), "ros1", or "" if the file does not name it.
        count: Number of messages.
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    count: int = 0


@dataclass(frozen=True, slots=True)
class Message:
    """A recorded message: number of its channel, time of recording [ns], and bytes."""

    channel: int
    log_ns: int
    payload: bytes


class Container:
    """A recording of messages, which are not decoded, with an index of all of them. A format calls
    `_set_index` and implements `_message`.

    Attributes:
        kind: Name of the format, e.g. "ROS 2 MCAP".
        channels: All channels.
        damage: Dict from reasons to numbers of parts that could not be read when the file was opened.
        clock_steps: Number of times that the clock of the recorder was set back. Later times are shifted, so
            that they continue in the order of the file.
    """

    kind: str
    channels: list[Channel]
    damage: dict[str, int]
    clock_steps: int = 0
    #: What is counted for a message whose bytes cannot be read.
    unreadable = "messages that cannot be read"

    @property
    def by_number(self) -> dict[int, Channel]:
        """New dict from numbers to channels."""
        return {channel.number: channel for channel in self.channels}

    def first(self, numbers: Collection[int], most: int) -> Iterator[Message]:
        """Yield the first messages of some channels, at most `most`; those that cannot be read are left out.
        SourceError if the file cannot be read."""
        return islice(self.messages(numbers, None, {}), most)

    def last(self, numbers: Collection[int], count: int = TAIL) -> Iterator[Message]:
        """Yield the messages of some channels from `tail_ns` on, about the last `count`; those that cannot be
        read are left out. SourceError if the file cannot be read."""
        return self.messages(numbers, self.tail_ns(numbers, count), {})

    def spread(self, numbers: Collection[int], most: int) -> Iterator[Message]:
        """Yield messages of some channels, evenly spaced by their number, at most `most`; those that cannot
        be read are left out. SourceError if the file cannot be read."""
        times_ns = self.index[np.isin(self.index[:, 0], list(numbers)), 1]
        rows = np.linspace(0, max(len(times_ns) - 1, 0), min(most, len(times_ns))).astype(np.int64)
        for start_ns in np.unique(times_ns[rows]).tolist():
            yield from islice(self.messages(numbers, start_ns, {}), 1)

    def tail_ns(self, numbers: Collection[int], last: int = TAIL) -> int:
        """Return the time of recording [ns] of the `last` message from the end of some channels, of the first
        one if there are fewer; 0 if there is none."""
        rows = np.flatnonzero(np.isin(self.index[:, 0], list(numbers)))
        return int(self.index[rows[-last:][0], 1]) if len(rows) else 0

    def rate_hz(self, numbers: Collection[int]) -> float | None:
        """Return the mean rate of the messages of some channels by their times of recording [Hz]; None for
        fewer than two."""
        times = self.index[np.isin(self.index[:, 0], list(numbers)), 1]
        span_ns = int(times[-1] - times[0]) if len(times) > 1 else 0
        return round((len(times) - 1) / span_ns * 1e9, 1) if span_ns > 0 else None

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages in the order of their times of recording. Messages that cannot be read are left out;
        a payload that cannot be unpacked is b"".

        Args:
            numbers: Numbers of the channels that are read.
            start_ns: Earlier times of recording [ns] are left out; None for none.
            losses: Dict from reasons to numbers; messages that cannot be read are added as `unreadable`.

        Raises:
            SourceError: The file cannot be read.
        """
        first = 0 if start_ns is None else int(np.searchsorted(self.index[:, 1], start_ns))
        for row in first + np.flatnonzero(np.isin(self.index[first:, 0], list(numbers))):
            number, log_ns, place = self.index[row].tolist()
            message = self._message(number, log_ns, place)
            if message is None:
                count_loss(losses, self.unreadable)
            else:
                yield replace(message, payload=plain(message.payload))

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of a file attached to the recording, None when there is none of this name.

        Raises:
            SourceError: The attachment is longer than `limit` bytes or damaged.
        """
        del name, limit
        return None

    def close(self) -> None:
        """Close the files; safe to call twice."""

    def _set_index(self, channels: Iterable[Channel], index: Int) -> None:
        """Store the channels, with their numbers of messages, and the index, sorted by time.

        Args:
            channels: All channels.
            index: Channel, time of recording [ns] and location (see `ChunkedFile`) of each message in the
                order of the file, int64, shape (N, 3).
        """
        self.index = index[np.argsort(index[:, 1], kind="stable")]
        counts = dict(
            zip(*(each.tolist() for each in np.unique(index[:, 0], return_counts=True)), strict=True)
        )
        self.channels = [replace(channel, count=counts.get(channel.number, 0)) for channel in channels]

    def _message(self, number: int, log_ns: int, place: int) -> Message | None:
        """Return the message of a row of the index, as it is stored; None if it cannot be read. Subclasses
        implement it.

        Args:
            number: Number of the channel of the message.
            log_ns: Time of recording by the index [ns].
            place: Location of the message, the third column of the index.
        """
        raise NotImplementedError


def shift_after_steps(index: Int, channels: Mapping[int, Channel]) -> int:
    """Shift times behind steps back of the recorder's clock, see `Container.clock_steps`; return the number
    of steps, at most MOST_STEPS.

    A step is a time that is more than STEP_BACK_NS earlier than one of its topic before, as is the next time
    of the topic: a single one is out of order. The times then continue behind all messages before. Topics of
    transforms show no steps: their publishers may add times in the future.

    Args:
        index: As in `Container._set_index`; its times are changed in place.
        channels: Dict from numbers to channels; others show no steps.
    """
    time, topic = index[:, 1], np.full(len(index), -1, np.int64)
    names = sorted({channel.topic for channel in channels.values() if channel.msgtype not in TRANSFORM_TYPES})
    for number, channel in channels.items():
        if channel.topic in names:
            topic[index[:, 0] == number] = names.index(channel.topic)
    rows = [np.flatnonzero(topic == k) for k in range(len(names))]
    for steps in range(MOST_STEPS):
        first = len(time)
        for own in rows:
            early = time[own] < np.maximum.accumulate(time[own]) - STEP_BACK_NS
            early[:-1] &= early[1:]
            if early.any():
                first = min(first, int(own[np.argmax(early)]))
        if first == len(time):
            return steps
        own = time[:first][topic[:first] == topic[first]]
        due_ns = 2 * own[-1] - own[-2] if len(own) > 1 else own[-1]
        time[first:] += max(due_ns, time[:first].max()) - time[first]
    return MOST_STEPS


def ros2_type_name(name: str) -> str:
    """Return a message type in the spelling of ROS 2: "sensor_msgs/Imu" becomes "sensor_msgs/msg/Imu"; names
    with other than two parts keep them."""
    parts = [part for part in name.split("/") if part]
    return "/".join([parts[0], "msg", parts[1]]) if len(parts) == 2 else "/".join(parts)


def damaged(what: str, path: object, remedy: str = COMPARE) -> SourceError:
    """Return the error for a file that cannot be read at all.

    Args:
        what: Description of the damage.
        path: The file.
        remedy: What helps.
    """
    return SourceError(what, where=str(path), remedy=remedy)


# --- compressed blocks -----------------------------------------------------------------------------


class BrokenChunkError(Exception):
    """A chunk, or the rest of it, cannot be read: it is damaged, too large, or has an unknown compression."""


def unpack(block: bytes, compression: str, size: int) -> bytes:
    """Unpack a block to exactly `size` bytes.

    Args:
        block: The packed bytes.
        compression: "", "none", "lz4", "zstd" or "bz2".
        size: Size by the header.

    Raises:
        BrokenChunkError: The block is damaged, the size is larger than BLOCK_LIMIT or wrong, or the
            compression is unknown.
    """
    if size > BLOCK_LIMIT:
        raise BrokenChunkError("a block is too large")
    raw = _unpack_up_to(block, compression, size)
    if len(raw) != size:
        raise BrokenChunkError("a block has another size than in its header")
    return raw


def _unpack_up_to(block: bytes, compression: str, limit: int) -> bytes:
    """Return the first `limit` + 1 unpacked bytes of a block; all if there are fewer, and the whole block if
    it is not compressed. Of a truncated block the bytes before its end are returned. Arguments as in
    `unpack`.

    Raises:
        BrokenChunkError: The block is damaged, or the compression is unknown.
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
                return window.stream_reader(block).read(limit + 1)
            case _:
                raise BrokenChunkError(f"unknown compression {compression[:20]!r}")
    except (RuntimeError, OSError, EOFError, ValueError, MemoryError, zstandard.ZstdError) as error:
        raise BrokenChunkError(str(error)) from error


def plain(payload: bytes) -> bytes:
    """Return a payload without the compression of ROS 2 recorders by message (zstd): up to BLOCK_LIMIT bytes,
    b"" if it is damaged or shorter than its header states. Other payloads are returned as they are."""
    if payload[:4] != _ZSTD_MAGIC:
        return payload
    try:
        raw, size = _unpack_up_to(payload, "zstd", BLOCK_LIMIT), zstandard.frame_content_size(payload)
    except (BrokenChunkError, zstandard.ZstdError):
        return b""
    return raw[:BLOCK_LIMIT] if len(raw) >= min(size, BLOCK_LIMIT) else b""


# --- files of chunks -------------------------------------------------------------------------------


@dataclass(slots=True)
class Chunk:
    """A run of records in a file.

    Attributes:
        offset, length: Offset in the file and length of the packed bytes.
        compression: Name of the compression in the file; "" for none.
        size: Number of bytes after unpacking.
        crc: CRC-32 of the unpacked bytes, 0 when the file has none.
        index: List of arrays, int64, shape (N, 3), of channel, time of recording [ns] and offset in the
            unpacked bytes of the messages; empty if the file has no index of the chunk.
        index_is_whole: False if a part of the index may be missing.
    """

    offset: int
    length: int
    compression: str
    size: int
    crc: int = 0
    index: list[Int] = field(default_factory=list)
    index_is_whole: bool = True


class ChunkedFile(Container):
    """A file with messages in compressed chunks.

    The headers of all records are read, so a file that was cut during a recording gives all its whole chunks.
    A format reads the records (`_read_index`, `_record`). The location of a message in the index is the
    number of its chunk (upper 32 bits) and its offset in the unpacked chunk (lower 32 bits).

    Raises:
        SourceError: The file cannot be opened, has another format, or holds no messages that can be read.
    """

    unreadable = "messages in damaged chunks of the recording"

    def __init__(self, path: Path) -> None:
        """Open the file and read its index; chunks without a valid index are unpacked. Times after steps back
        of the recorder's clock are shifted.

        Raises:
            SourceError: The file cannot be opened, has another format, or defines no channel.
        """
        self.damage = {}
        self._path = path
        self._known: dict[int, Channel] = {}
        self._chunks: list[Chunk] = []
        # By offset, None for damaged chunks; the chunk that was read last is the last one.
        self._unpacked: dict[int, bytes | None] = {}
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
        try:
            self._read_index(self._file.seek(0, 2))
            index = [np.zeros((0, 3), np.int64)]
            for number, chunk in enumerate(self._chunks):
                rows = self._rows_of(chunk)
                rows[:, 2] += number << 32
                index.append(rows)
            if not self._known:
                raise damaged(
                    "the recording holds no messages that can be read",
                    path,
                    "Nothing was written to it: look at the topics of the recorder, and at its disk.",
                )
            table = np.concatenate(index)
            recorded_ns = table[:, 1].copy()
            self.clock_steps = shift_after_steps(table, self._known)
            self._places, self._shifts_ns = table[:, 2], table[:, 1] - recorded_ns
            self._set_index((self._known[number] for number in sorted(self._known)), table)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    # --- for the formats ---

    def _read_index(self, end: int) -> None:
        """Read the headers of the records (chunks, channels, attachments) into `_chunks` and `_known`.
        Subclasses implement it.

        Args:
            end: Length of the file [bytes].

        Raises:
            SourceError: The file has another format.
        """
        raise NotImplementedError

    def _record(self, raw: bytes, at: int) -> tuple[Message | None, int]:
        """Return the message of the record at an offset in an unpacked chunk and the end of the record. Of
        other records the message is None; channels that they define are added to `_known`. Subclasses
        implement it.

        Raises:
            BrokenChunkError: The record cannot be read.
            DAMAGE: The record cannot be parsed.
        """
        raise NotImplementedError

    # --- shared ---

    def _read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from the byte `offset` of the file on, fewer at the end of the file.

        Raises:
            SourceError: The file cannot be read.
        """
        try:
            self._file.seek(offset)
            return self._file.read(size)
        except OSError as error:
            raise damaged(f"cannot read on: {error.strerror}", self._path, "Look at the disk.") from error

    def _bytes_of(self, chunk: Chunk) -> bytes:
        """Return the unpacked bytes of a chunk. The last chunks stay in memory, up to BLOCK_LIMIT bytes,
        because chunks may overlap in time.

        Raises:
            BrokenChunkError: The chunk is damaged.
            SourceError: The file cannot be read.
        """
        if chunk.offset in self._unpacked:
            raw = self._unpacked.pop(chunk.offset)
        else:
            raw = self._unpack(chunk)
            while self._unpacked and self._unpacked_size() + len(raw or b"") > BLOCK_LIMIT:
                del self._unpacked[next(iter(self._unpacked))]
        self._unpacked[chunk.offset] = raw
        if raw is None:
            raise BrokenChunkError
        return raw

    def _unpacked_size(self) -> int:
        """Return the size of the unpacked chunks that are kept in memory [bytes]."""
        return sum(len(raw or b"") for raw in self._unpacked.values())

    def _unpack(self, chunk: Chunk) -> bytes | None:
        """Return the unpacked bytes of a chunk, None if it is damaged; SourceError if the file cannot be
        read."""
        try:
            packed = self._read(chunk.offset, chunk.length) if chunk.length <= BLOCK_LIMIT else b""
            raw = unpack(packed, chunk.compression, chunk.size)
        except BrokenChunkError:
            return None
        return raw if not chunk.crc or zlib.crc32(raw) == chunk.crc else None

    def _message(self, number: int, log_ns: int, place: int) -> Message | None:
        """Return the message at the location `place` (see `ChunkedFile`), with its payload as it is stored;
        None if it cannot be read or is not of the channel `number`. Its time is that of its own record,
        shifted behind steps of the clock, not that in the index. SourceError if the file cannot be read."""
        del log_ns
        try:
            message, _ = self._record(self._bytes_of(self._chunks[place >> 32]), place & 0xFFFFFFFF)
        except (BrokenChunkError, *DAMAGE):
            return None
        if message is None or message.channel != number:
            return None
        shift_ns = int(self._shifts_ns[np.searchsorted(self._places, place)])
        return replace(message, log_ns=message.log_ns + shift_ns)

    def _rows_of(self, chunk: Chunk) -> Int:
        """Return the index of a chunk in the order of the file, int64, shape (N, 3); it is built from the
        messages of the chunk if the file has no complete one, or an impossible one. Then it ends at the first
        damaged record, or after MOST_IN_CHUNK messages, which is counted in `damage`. SourceError if the file
        cannot be read."""
        if chunk.index and chunk.index_is_whole:
            rows = np.concatenate(chunk.index)
            rows = rows[np.argsort(rows[:, 2], kind="stable")]
            known = np.isin(rows[:, 0], list(self._known)).all()
            if known and (rows >= 0).all() and (rows[:, 2] < chunk.size).all():
                return rows
        found, at = list[tuple[int, int, int]](), 0
        try:
            raw = self._bytes_of(chunk)
            while at < len(raw):
                if len(found) >= MOST_IN_CHUNK:
                    raise BrokenChunkError
                message, end = self._record(raw, at)
                if message is not None:
                    found.append((message.channel, message.log_ns, at))
                at = end
        except (BrokenChunkError, *DAMAGE):
            count_loss(self.damage, "chunks of the recording damaged in part")
        return np.array(found, np.int64).reshape(-1, 3)
