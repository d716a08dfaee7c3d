"""MCAP files (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import replace

from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    BLOCK_LIMIT,
    BrokenChunkError,
    Channel,
    Chunk,
    ChunkedFile,
    Message,
    damaged,
    ros2_type_name,
)  # fmt: skip

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, DATA_END = 2, 3, 4, 5, 6, 7, 9, 0x0F
RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
CHUNK_HEAD = struct.Struct("<QQQI")
#: Messages outside of chunks are read in runs of this many bytes.
LOOSE_RUN = 4 << 20
#: A file with more records of unknown kinds has another format, and would take long to read.
STRANGE_LIMIT = 1000
DEFINITION_LIMIT = 1 << 20


class McapFile(ChunkedFile):
    """An MCAP file as a container of messages.

    Raises:
        SourceError: It cannot be opened, is not an MCAP file, or has no channels.
    """

    kind = "ROS 2 MCAP"

    @property
    def channels(self) -> list[Channel]:
        """All channels."""
        counts, unknown = self._counts(), ("", "", "")
        channels = []
        for number, (schema, topic, encoding) in sorted(self._channels.items()):
            name, form, definition = self._schemas.get(schema, unknown)
            count = counts.get(number, 0)
            channels.append(Channel(number, topic, ros2_type_name(name), encoding, definition, form, count))
        return channels

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of an attachment, see `Container.attachment`."""
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

    # --- index -------------------------------------------------------------------------------------

    def _known_channels(self) -> Collection[int]:
        return self._channels

    def _read_index(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}  # name, encoding, definition
        self._channels: dict[int, tuple[int, str, str]] = {}  # schema, topic, encoding
        self._attachments: list[tuple[int, int]] = []
        end = self._file.seek(0, 2)
        if self._read(0, 8) != MAGIC:
            raise damaged("not an MCAP file", self._path)
        at, run, strange, whole = 8, -1, 0, False
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            body, after = at + RECORD.size, at + RECORD.size + length
            if after > end or opcode == 0 or strange > STRANGE_LIMIT:
                break
            if run >= 0 and (opcode != MESSAGE or at - run > LOOSE_RUN):
                self._add_run(run, at)
                run = -1
            if opcode == MESSAGE:
                run = at if run < 0 else run
            elif opcode in (FOOTER, DATA_END):
                whole = True
                if opcode == FOOTER:
                    break
            else:
                strange += not self._take(opcode, body, length)
            at = after
        if run >= 0:
            self._add_run(run, at)
        if not whole:
            read = self._read_summary(at)
            what = "bytes between damaged records" if read else "bytes at the end of a recording that was cut"
            count_loss(self.damage, what, max((read or end) - at, 1))

    def _read_summary(self, after: int) -> int:
        """Add the chunks behind a damaged record by the summary; return where they begin, 0 for none."""
        try:
            with self._path.open("rb") as file:
                summary = SeekingReader(file, record_size_limit=BLOCK_LIMIT).get_summary()
        except (McapError, struct.error, ValueError, OSError, StopIteration, MemoryError):
            return 0
        if summary is None:
            return 0
        for schema in summary.schemas.values():
            text = schema.data[:DEFINITION_LIMIT].decode(errors="replace")
            self._schemas.setdefault(schema.id, (schema.name, schema.encoding, text))
        for channel in summary.channels.values():
            known = (channel.schema_id, channel.topic, channel.message_encoding)
            self._channels.setdefault(channel.id, known)
        chunks = sorted((c for c in summary.chunk_indexes if c.chunk_start_offset > after),
                        key=lambda chunk: chunk.chunk_start_offset)  # fmt: skip
        for chunk in chunks:
            self._take(CHUNK, chunk.chunk_start_offset + RECORD.size, chunk.chunk_length - RECORD.size)
        return chunks[0].chunk_start_offset if chunks else 0

    def _take(self, opcode: int, body: int, length: int) -> bool:
        """Store the contents of a record; return False if it is damaged or of an unknown kind.

        Args:
            opcode: Kind of the record.
            body: Position of its contents in the file.
            length: Length of its contents [bytes].
        """
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
            raise ValueError("the chunk is shorter than in its header")
        self._chunks.append(Chunk(body + at + 8, packed, start_ns, end_ns, compression, size, crc, None))

    def _add_run(self, start: int, end: int) -> None:
        """Add the messages between two positions outside of chunks as an uncompressed chunk."""
        self._chunks.append(self._survey(Chunk(start, end - start, 0, 0, "", end - start, 0, None)))

    def _count(self, body: int, length: int) -> None:
        """Store the number of messages of a channel in the chunk before, from an index record."""
        number, size = struct.unpack_from("<HI", self._read(body, 6))
        if self._chunks and size + 6 <= length:
            chunk = self._chunks[-1]
            counts = {**(chunk.counts or {}), **({number: size // 16} if size else {})}
            self._chunks[-1] = replace(chunk, counts=counts)

    # --- chunks ------------------------------------------------------------------------------------

    def _parse(self, raw: bytes, *, define: bool) -> Iterator[Message]:
        view, at = memoryview(raw), 0
        while at < len(raw):
            opcode, length = RECORD.unpack_from(raw, at)
            at += RECORD.size
            if at + length > len(raw) or opcode == 0:
                raise BrokenChunkError
            if opcode == MESSAGE and length >= MESSAGE_HEAD.size:
                number, _sequence, log_ns, _publish_ns = MESSAGE_HEAD.unpack_from(raw, at)
                yield Message(number, log_ns, bytes(view[at + MESSAGE_HEAD.size : at + length]))
            elif define and opcode in (SCHEMA, CHANNEL):
                self._define(opcode, bytes(view[at : at + min(length, DEFINITION_LIMIT)]))
            at += length


def _text(record: bytes, at: int) -> tuple[str, int]:
    """Return a string that begins with its length, and the position after it.

    Args:
        record: Bytes of a record.
        at: Position of the length.
    """
    (size,) = struct.unpack_from("<I", record, at)
    if at + 4 + size > len(record):
        raise ValueError("the text is longer than its record")
    return record[at + 4 : at + 4 + size].decode(), at + 4 + size
