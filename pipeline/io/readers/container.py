"""Recordings of stamped messages: the interface, compressed blocks, and chunked files in the order of time.

The readers of MCAP files and ROS 1 bags are our own. rosbags refuses bags without an index and trusts the
sizes in a file; mcap decompresses without a limit and gives up at the first damaged record.
"""

from __future__ import annotations

import bz2
import contextlib
import heapq
import struct
import zlib
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import lz4.frame
import zstandard
from mcap.exceptions import McapError

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss

#: Largest block that is unpacked. Recorders write blocks of 1 to 4 MB; a file of 16 kB can claim 512 MB.
BLOCK_LIMIT = 256 << 20
#: Most messages of one chunk, and the memory that a message takes besides its payload [bytes].
MOST_IN_CHUNK, _MESSAGE_BYTES = 1 << 20, 200
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
#: What damaged records raise when they are parsed.
DAMAGE = (McapError, struct.error, ValueError, KeyError, OverflowError)
#: A file with more damaged or unknown records has another format, and would take long to read.
STRANGE_LIMIT = 1000
#: A channel whose times of recording go back by more shows that the clock of the recorder was set [ns].
STEP_BACK_NS = 2_000_000_000
MOST_STEPS = 100


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


class Container:
    """A recording that can be read from any time. It does not decode messages.

    Attributes:
        kind: Name of the format, e.g. "ROS 2 MCAP".
        channels: All channels.
        damage: Parts that could not be read when the file was opened, by reason.
        clock_steps: How often the clock of the recorder was set back. Later times are shifted, so
            that they continue in the order of the file.
    """

    kind: str
    channels: list[Channel]
    damage: dict[str, int]
    clock_steps: int = 0

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return a time of recording [ns] from which a few messages of some channels are left to read, the
        last ones of the recording; 0 if there are none.

        Args:
            numbers: Numbers of the channels.
        """
        raise NotImplementedError

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages in the order of recording. Parts that cannot be read are left out; a payload that
        cannot be unpacked is b"".

        Args:
            numbers: Numbers of the channels that are read.
            start_ns: Earlier times of recording [ns] are left out; None for none.
            losses: Counts the parts that are left out, by reason; changed in place.
        """
        raise NotImplementedError

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of a file attached to the recording, None when there is none of this name.

        Raises:
            SourceError: It is longer than `limit` bytes or damaged.
        """
        del name, limit
        return None

    def close(self) -> None:
        """Close the files; safe to call twice."""


def ros2_type_name(name: str) -> str:
    """Return a message type in the spelling of ROS 2: "sensor_msgs/Imu" becomes "sensor_msgs/msg/Imu"; names
    with other than two parts keep them."""
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
    """Return the first `limit` + 1 unpacked bytes of a block, or all if there are fewer; arguments as in
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


def plain(message: Message) -> Message:
    """Return a message of a ROS 2 recorder without its own compression (zstd): up to BLOCK_LIMIT bytes of
    payload, b"" if it is damaged. Other messages are returned as they are."""
    if message.payload[:4] != _ZSTD_MAGIC:
        return message
    try:
        return replace(message, payload=_unpack_up_to(message.payload, "zstd", BLOCK_LIMIT)[:BLOCK_LIMIT])
    except BrokenChunkError:
        return replace(message, payload=b"")


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
        shifts: What is added to the times of recording [ns], each from a message of the chunk on; `start_ns`
            and `end_ns` include it.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str
    size: int
    crc: int
    counts: dict[int, int] | None
    shifts: tuple[tuple[int, int], ...] = ((0, 0),)


class ChunkedFile(Container):
    """A file with messages in compressed chunks, indexed by reading the headers of its records.

    The index of the file itself is not needed, so a file that was cut during a recording gives all its whole
    chunks, and a wrong index does no harm. A format reads the records (`_read_index`, `_parse`).

    Raises:
        SourceError: The file cannot be opened, has another format, or holds no messages that can be read.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and read its index; chunks without valid counts are unpacked."""
        self.damage = {}
        self._path = path
        self._known: dict[int, Channel] = {}
        self._chunks: list[Chunk] = []
        self._unpacked: tuple[int, bytes] = (-1, b"")  # offset and bytes of the last chunk
        try:
            self._file = path.open("rb", buffering=0)
        except OSError as error:
            raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
        try:
            self._read_index(self._file.seek(0, 2))
            # Chunks without an index, and those with channels that are not defined elsewhere, are unpacked.
            self._chunks = [
                chunk if chunk.counts is not None and chunk.counts.keys() <= self._known.keys()
                else self._survey(chunk)
                for chunk in self._chunks
            ]  # fmt: skip
            if not self._known:
                raise damaged("the recording holds no messages that can be read", path)
            self._shift_after_steps()
        except BaseException:
            self.close()
            raise
        total = Counter[int]()
        for chunk in self._chunks:
            total.update(chunk.counts or {})
        self.channels = [replace(self._known[number], count=total[number]) for number in sorted(self._known)]

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return the start of the last chunk with messages of some channels [ns]; 0 without one."""
        last = max(self._needed(frozenset(numbers), None), key=attrgetter("end_ns"), default=None)
        return 0 if last is None else last.start_ns

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages, see `Container.messages`. Chunks may overlap in time; each is unpacked when its
        first message is due. Damaged chunks are left out and counted."""
        wanted = frozenset(numbers)
        heap: list[tuple[int, int, Message]] = []
        serial = held = 0
        for chunk in sorted(self._needed(wanted, start_ns), key=attrgetter("start_ns", "offset")):
            while heap and (heap[0][0] <= chunk.start_ns or held > BLOCK_LIMIT):
                held -= len(heap[0][2].payload) + _MESSAGE_BYTES
                yield plain(heapq.heappop(heap)[2])
            try:
                for message in self._contents(chunk, define=False):
                    if message.channel in wanted and (start_ns is None or message.log_ns >= start_ns):
                        heapq.heappush(heap, (message.log_ns, serial, message))
                        serial += 1
                        held += len(message.payload) + _MESSAGE_BYTES
            except BrokenChunkError:
                count_loss(losses, "damaged chunks of the recording")
        while heap:
            yield plain(heapq.heappop(heap)[2])

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    # --- for the formats ---

    def _read_index(self, end: int) -> None:
        """Read the headers of the records (chunks, channels, attachments) into `_chunks` and `_known`.
        Subclasses implement it.

        Args:
            end: Length of the file.

        Raises:
            SourceError: The file has another format.
        """
        raise NotImplementedError

    def _parse(self, raw: bytes, *, define: bool) -> Iterator[Message]:
        """Yield the messages of an unpacked chunk; with `define`, add the channels that it defines to
        `_known`. Subclasses implement it.

        Raises:
            BrokenChunkError: The rest cannot be read.
            DAMAGE: The same.
        """
        raise NotImplementedError

    # --- shared ---

    def _read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from a position, fewer at the end of the file.

        Raises:
            SourceError: The disk refuses.
        """
        try:
            self._file.seek(offset)
            return self._file.read(size)
        except OSError as error:
            raise damaged(f"cannot read on: {error.strerror}", self._path) from error

    def _needed(self, wanted: frozenset[int], start_ns: int | None) -> Iterable[Chunk]:
        """Return the chunks with messages of some channels that do not end before a time [ns] (None: all), in
        the order of the file."""
        for chunk in self._chunks:
            if start_ns is not None and chunk.end_ns < start_ns:
                continue
            if chunk.counts is None or not wanted.isdisjoint(chunk.counts):
                yield chunk

    def _bytes_of(self, chunk: Chunk) -> bytes:
        """Return the unpacked bytes of a chunk; the last one is kept in memory.

        Raises:
            BrokenChunkError: It is damaged.
        """
        if chunk.offset != self._unpacked[0]:
            if chunk.length > BLOCK_LIMIT:
                raise BrokenChunkError
            raw = unpack(self._read(chunk.offset, chunk.length), chunk.compression, chunk.size)
            if chunk.crc and zlib.crc32(raw) != chunk.crc:
                raise BrokenChunkError
            self._unpacked = (chunk.offset, raw)
        return self._unpacked[1]

    def _contents(self, chunk: Chunk, *, define: bool) -> Iterator[Message]:
        """Yield the messages of a chunk, at most MOST_IN_CHUNK; with `define`, channels that it defines are
        added. Times of recording include the shifts of the chunk.

        Raises:
            BrokenChunkError: It is damaged, or has more messages; those before the damage were yielded.
        """
        try:
            shifts, shift_ns = deque(chunk.shifts), 0
            for number, message in enumerate(self._parse(self._bytes_of(chunk), define=define)):
                if number >= MOST_IN_CHUNK:
                    raise BrokenChunkError
                while shifts and number >= shifts[0][0]:
                    shift_ns = shifts.popleft()[1]
                yield replace(message, log_ns=message.log_ns + shift_ns) if shift_ns else message
        except DAMAGE as error:
            raise BrokenChunkError from error

    def _shift_after_steps(self) -> None:
        """Shift the times of chunks behind steps back of the recorder's clock, in place, and count the steps
        in `clock_steps`, up to MOST_STEPS. Only chunks that begin earlier than others before them, and their
        predecessors, are unpacked."""
        shift_ns, newest_ns = 0, 0
        before: Chunk | None = None
        for place, chunk in enumerate(self._chunks):
            if not chunk.counts:
                continue
            shifted = chunk
            if shift_ns:
                start_ns, end_ns = chunk.start_ns + shift_ns, chunk.end_ns + shift_ns
                shifted = replace(chunk, start_ns=start_ns, end_ns=end_ns, shifts=((0, shift_ns),))
            # The first chunk is read anyway.
            is_back = shifted.start_ns < (shifted.end_ns if before is None else newest_ns) - STEP_BACK_NS
            if is_back and self.clock_steps < MOST_STEPS:
                shifted = self._after_step(shifted, before)
                shift_ns = shifted.shifts[-1][1]
                self.clock_steps += len(shifted.shifts) - 1
            self._chunks[place] = before = shifted
            newest_ns = max(newest_ns, shifted.end_ns)

    def _after_step(self, chunk: Chunk, before: Chunk | None) -> Chunk:
        """Return a chunk with a further shift from each message on that is STEP_BACK_NS or more earlier than
        one of its channel before; its times then continue behind all messages before. Unchanged if there is
        no such message, as in files that are sorted by topic.

        Args:
            chunk: The chunk.
            before: The chunk with messages before it, None for the first one.
        """
        newest, pause_ns = dict[int, int](), dict[int, int]()

        def note(channel: int, time_ns: int) -> None:
            """Store the newest time of a channel [ns] and the pause before it; an earlier time is ignored."""
            if time_ns > newest.get(channel, -1):
                pause_ns[channel] = time_ns - newest.get(channel, time_ns)
                newest[channel] = time_ns

        with contextlib.suppress(BrokenChunkError):
            for message in self._contents(before, define=False) if before is not None else ():
                note(message.channel, message.log_ns)
        first_shift_ns = chunk.shifts[0][1]
        shifts, further_ns, times = [(0, first_shift_ns)], 0, list[int]()
        with contextlib.suppress(BrokenChunkError):
            for number, message in enumerate(self._contents(chunk, define=False)):
                time_ns = message.log_ns + further_ns
                if time_ns < newest.get(message.channel, 0) - STEP_BACK_NS:
                    due_ns = newest[message.channel] + pause_ns[message.channel]
                    further_ns += max(due_ns, *newest.values()) - time_ns
                    time_ns = message.log_ns + further_ns
                    shifts.append((number, first_shift_ns + further_ns))
                note(message.channel, time_ns)
                times.append(time_ns)
        if not further_ns:
            return chunk
        return replace(chunk, shifts=tuple(shifts), start_ns=min(times), end_ns=max(times))

    def _survey(self, chunk: Chunk) -> Chunk:
        """Return a chunk with the number and times of its messages, which are counted by unpacking it.
        Channels that it defines are added. Of a damaged chunk the messages before the damage count, and the
        damage is counted."""
        counts = Counter[int]()
        first_ns, last_ns = 2**64, -1
        try:
            for message in self._contents(chunk, define=True):
                counts[message.channel] += 1
                first_ns, last_ns = min(first_ns, message.log_ns), max(last_ns, message.log_ns)
        except BrokenChunkError:
            count_loss(self.damage, "chunks of the recording damaged in part")
        if counts:
            chunk = replace(chunk, start_ns=first_ns, end_ns=last_ns)
        return replace(chunk, counts=counts)
