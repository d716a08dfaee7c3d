"""MCAP files (https://mcap.dev/spec): the index is made by walking over the record headers.

The file's own summary is not needed, so a file that was cut in the middle of a recording gives all
its whole chunks, and a summary that contradicts the data does no harm.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    BrokenChunkError,
    Channel,
    Chunk,
    LastChunk,
    Message,
    UnpackError,
    damaged,
    in_order,
    ros2_type_name,
    tail_ns,
)

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT = 0x03, 0x04, 0x05, 0x06, 0x07, 0x09
DATA_END, FOOTER = 0x0F, 0x02
RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
CHUNK_HEAD = struct.Struct("<QQQI")
LOOSE_RUN = 4 << 20
#: A file with more records of no known kind is something else, and would take long to walk over.
STRANGE_LIMIT = 1000
DEFINITION_LIMIT = 1 << 20


class McapFile:
    """One MCAP file as a container of messages.

    Raises:
        SourceError: It is no MCAP file or holds no channel at all.
    """

    kind = "ROS 2 MCAP"

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb", buffering=0)
        self.damage: dict[str, int] = {}
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._chunks: list[Chunk] = []
        self._attachments: list[tuple[int, int]] = []
        self._last = LastChunk()
        try:
            self._walk()
            self._learn_channels()
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> list[Channel]:
        """All channels whose schema is known."""
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            for number, count in (chunk.counts or {}).items():
                counts[number] = counts.get(number, 0) + count
        return [
            Channel(
                number,
                topic,
                ros2_type_name(self._schemas[schema][0]) if schema in self._schemas else "",
                encoding,
                self._schemas[schema][2] if schema in self._schemas else "",
                self._schemas[schema][1] if schema in self._schemas else "",
                counts.get(number, 0),
            )
            for number, (schema, topic, encoding) in sorted(self._channels.items())
        ]

    def tail_ns(self, numbers: Collection[int]) -> int:
        """See Container."""
        return tail_ns(self._chunks, frozenset(numbers))

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """See Container."""
        return in_order(self._chunks, frozenset(numbers), start_ns, self._expand, losses)

    def attachment(self, name: str, limit: int) -> bytes | None:
        """See Container."""
        for offset, length in self._attachments:
            head = self._read(offset + 16, min(length - 16, 4096))
            try:
                found, after = _text(head, 0)
                _media, after = _text(head, after)
                (size,) = struct.unpack_from("<Q", head, after)
            except (struct.error, ValueError):
                continue
            if found != name:
                continue
            start = 16 + after + 8
            if size > limit or start + size + 4 > length:
                raise damaged(f"the attachment {name} is damaged or longer than {limit >> 20} MB", self._path)
            content = self._read(offset + start, size)
            (crc,) = struct.unpack("<I", self._read(offset + start + size, 4))
            if crc and zlib.crc32(self._read(offset, start + size)) != crc:
                raise damaged(f"the attachment {name} has a wrong checksum", self._path)
            return content
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # --- the walk over the records ---------------------------------------------------------------

    def _read(self, offset: int, size: int) -> bytes:
        try:
            self._file.seek(offset)
            return self._file.read(size)
        except OSError as error:
            raise damaged(f"cannot read on: {error.strerror}", self._path) from error

    def _walk(self) -> None:
        end = self._file.seek(0, 2)
        if self._read(0, 8) != MAGIC:
            raise damaged("not an MCAP file", self._path)
        at = 8
        loose: list[int] = []
        whole = False
        strange = 0
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            body, after = at + RECORD.size, at + RECORD.size + length
            if after > end or opcode == 0 or strange > STRANGE_LIMIT:
                break
            if loose and (opcode != MESSAGE or at - loose[0] > LOOSE_RUN):
                self._close_run(loose.pop(), at)
            if opcode == MESSAGE:
                loose = loose or [at]
            elif opcode in (FOOTER, DATA_END):
                whole = True
                if opcode == FOOTER:
                    break
            else:
                strange += not self._take(opcode, body, length)
            at = after
        if loose:
            self._close_run(loose.pop(), at)
        if not whole:
            count_loss(self.damage, "bytes at the end of a recording that was cut", max(end - at, 1))

    def _take(self, opcode: int, body: int, length: int) -> bool:
        """Keep what a record says; False when it is damaged or of no known kind."""
        try:
            if opcode in (SCHEMA, CHANNEL):
                self._define(opcode, self._read(body, min(length, DEFINITION_LIMIT)))
            elif opcode == CHUNK:
                self._add_chunk(body, length)
            elif opcode == MESSAGE_INDEX:
                self._count(body, length)
            elif opcode == ATTACHMENT:
                self._attachments.append((body, length))
        except (struct.error, ValueError):
            count_loss(self.damage, "damaged records of the recording")
            return False
        return 0 < opcode <= DATA_END

    def _define(self, opcode: int, record: bytes) -> None:
        (number,) = struct.unpack_from("<H", record)
        if opcode == SCHEMA:
            name, at = _text(record, 2)
            encoding, at = _text(record, at)
            self._schemas[number] = (name, encoding, _text(record, at)[0])
        else:
            (schema,) = struct.unpack_from("<H", record, 2)
            topic, at = _text(record, 4)
            self._channels[number] = (schema, topic, _text(record, at)[0])

    def _add_chunk(self, body: int, length: int) -> None:
        head = self._read(body, min(length, 128))
        start_ns, end_ns, size, crc = CHUNK_HEAD.unpack_from(head)
        compression, at = _text(head, CHUNK_HEAD.size)
        (packed,) = struct.unpack_from("<Q", head, at)
        if at + 8 + packed > length:
            raise ValueError("the chunk is shorter than it says")
        self._chunks.append(Chunk(body + at + 8, packed, start_ns, end_ns, compression, size, crc, None))

    def _count(self, body: int, length: int) -> None:
        number, size = struct.unpack_from("<HI", self._read(body, 6))
        if not self._chunks or size + 6 > length:
            return
        chunk = self._chunks[-1]
        if chunk.counts is None:
            chunk = replace(chunk, counts={})
            self._chunks[-1] = chunk
        if chunk.counts is not None and size:
            chunk.counts[number] = size // 16

    def _close_run(self, start: int, end: int) -> None:
        """Keep messages that stand outside of chunks as if they were a chunk that is not packed."""
        run = Chunk(start, end - start, 0, 0, "", end - start, 0, None)
        counts, first, last = self._survey(run)
        self._chunks.append(replace(run, start_ns=first, end_ns=last, counts=counts))

    # --- what lies in the chunks -----------------------------------------------------------------

    def _records(self, chunk: Chunk) -> Iterator[tuple[int, memoryview]]:
        """The records inside of a chunk as (opcode, content)."""
        raw = self._last.unpacked(chunk, self._read)
        view, at = memoryview(raw), 0
        while at < len(raw):
            if at + RECORD.size > len(raw):
                raise BrokenChunkError
            opcode, length = RECORD.unpack_from(raw, at)
            at += RECORD.size
            if at + length > len(raw) or opcode == 0:
                raise BrokenChunkError
            yield opcode, view[at : at + length]
            at += length

    def _expand(self, chunk: Chunk) -> Iterable[Message]:
        for opcode, record in self._records(chunk):
            if opcode == MESSAGE and len(record) >= MESSAGE_HEAD.size:
                number, _sequence, log_ns, _publish_ns = MESSAGE_HEAD.unpack_from(record)
                yield Message(number, log_ns, bytes(record[MESSAGE_HEAD.size :]))

    def _survey(self, chunk: Chunk) -> tuple[dict[int, int], int, int]:
        """Count a chunk's messages and take its definitions: (counts, first_ns, last_ns)."""
        counts: dict[int, int] = {}
        times: list[int] = []
        try:
            for opcode, record in self._records(chunk):
                if opcode in (SCHEMA, CHANNEL):
                    self._define(opcode, bytes(record[:DEFINITION_LIMIT]))
                elif opcode == MESSAGE and len(record) >= MESSAGE_HEAD.size:
                    number, _sequence, log_ns, _publish_ns = MESSAGE_HEAD.unpack_from(record)
                    counts[number] = counts.get(number, 0) + 1
                    times.append(log_ns)
        except (UnpackError, BrokenChunkError, struct.error, ValueError):
            count_loss(self.damage, "chunks of the recording damaged in part")
        return counts, min(times, default=chunk.start_ns), max(times, default=chunk.end_ns)

    def _learn_channels(self) -> None:
        """Look into the chunks when no summary names the channels or no index counts the messages."""
        missing = {n for chunk in self._chunks for n in chunk.counts or ()} - self._channels.keys()
        for index, chunk in enumerate(self._chunks):
            if chunk.counts is None or not missing.isdisjoint(chunk.counts):
                counts, _first, _last = self._survey(chunk)
                self._chunks[index] = replace(chunk, counts=counts)
                missing -= self._channels.keys()
        if not self._channels:
            raise damaged("the MCAP file holds no messages that can be read", self._path)


def _text(record: bytes, at: int) -> tuple[str, int]:
    """A string with its length before it, and where the next field begins."""
    (size,) = struct.unpack_from("<I", record, at)
    if at + 4 + size > len(record):
        raise ValueError("the text is longer than its record")
    return record[at + 4 : at + 4 + size].decode(), at + 4 + size


def open_mcap(path: Path) -> McapFile:
    """Open an MCAP file.

    Raises:
        SourceError: It cannot be opened or read.
    """
    try:
        return McapFile(path)
    except OSError as error:
        raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
