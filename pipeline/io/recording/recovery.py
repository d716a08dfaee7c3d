"""Repairs a recording that was cut or damaged: writes all complete messages to a new MCAP file with an
index."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from pipeline.errors import SourceError
from pipeline.io.atomic_files import write_beside
from pipeline.io.readers.container import BLOCK_LIMIT, UnpackError, unpack

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_DAMAGED = (McapError, struct.error, ValueError, EOFError, OverflowError, MemoryError)


@dataclass(slots=True)
class Mended:
    """Result of a repair.

    Attributes:
        messages: Number of messages in the new file.
        losses: Parts that are lost, by reason.
    """

    messages: int = 0
    losses: Counter[str] = field(default_factory=Counter)


def mend(path: Path, out: Path) -> Mended:
    """Write all complete messages of a recording to a new file, which appears when it is complete; return
    what was written and lost.

    Args:
        path: The recording, which does not change.
        out: The new file.

    Raises:
        SourceError: It cannot be read, is not an MCAP file, or has no complete message.
        StemmapError: The new file cannot be written.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise SourceError("not an MCAP file", where=str(path), remedy="Name a recording.")
            end = _end_of_whole_records(stream, path.stat().st_size)
            stream.seek(0)
            with write_beside(out) as partial, partial.open("wb") as target:
                work = _Work(target)
                work.take_all(_Until(stream, end))
                if not work.mended.messages:
                    raise SourceError("nothing in the recording is whole", where=str(path))
                work.finish(path.stat().st_size)
    except OSError as error:
        raise SourceError(f"cannot read the file: {error.strerror}", where=str(path)) from error
    return work.mended


def _end_of_whole_records(stream: BinaryIO, size: int) -> int:
    """Return the end of the last complete record of a file of `size` bytes; the library does not notice
    incomplete records."""
    at = len(MAGIC)
    while at + _RECORD.size <= size:
        stream.seek(at)
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size or at + _RECORD.size + _RECORD.unpack(head)[1] > size:
            break
        at += _RECORD.size + _RECORD.unpack(head)[1]
    return at


class _Until:
    """A stream that ends at a given position."""

    def __init__(self, stream: BinaryIO, end: int) -> None:
        self._stream, self._end = stream, end

    def read(self, size: int = -1) -> bytes:
        """Read at most `size` bytes before the end."""
        left = max(0, self._end - self._stream.tell())
        return self._stream.read(left if size < 0 else min(size, left))

    def tell(self) -> int:
        """Return the position."""
        return self._stream.tell()


class _Work:
    """A repair."""

    def __init__(self, target: BinaryIO) -> None:
        self.mended = Mended()
        self._writer = Writer(target, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="stemmap")
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._whole = False
        self._good_until = 0

    def take_all(self, stream: _Until) -> None:
        """Read records until the end, or until the framing is broken."""
        reader = StreamReader(stream, emit_chunks=True, validate_crcs=False, record_size_limit=BLOCK_LIMIT)
        try:
            for record in reader.records:
                self._good_until = stream.tell()
                if isinstance(record, Chunk):
                    self._take_chunk(record)
                elif isinstance(record, DataEnd):
                    self._whole = True
                    return
                else:
                    self._take(record)
        except _DAMAGED:
            return  # the rest has no record boundaries; `finish` counts it

    def finish(self, size: int) -> None:
        """Write the index and count what is missing at the end."""
        if not self._whole:
            self.mended.losses["bytes at the end"] += max(size - self._good_until, 1)
        self._writer.finish()

    def _take_chunk(self, chunk: Chunk) -> None:
        try:
            raw = unpack(chunk.data, chunk.compression, chunk.uncompressed_size)
            plain = Chunk(
                "", raw, chunk.message_end_time, chunk.message_start_time, chunk.uncompressed_crc, len(raw)
            )
            records = breakup_chunk(plain, validate_crc=True)
        except (UnpackError, *_DAMAGED):
            self.mended.losses["damaged chunks"] += 1
            return
        for record in records:
            self._take(record)

    def _take(self, record: object) -> None:
        if isinstance(record, Schema):
            if record.id not in self._schemas:
                self._schemas[record.id] = self._writer.register_schema(
                    record.name, record.encoding, record.data
                )
        elif isinstance(record, Channel):
            if record.id not in self._channels and record.schema_id in self._schemas:
                self._channels[record.id] = self._writer.register_channel(
                    record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
                )
        elif isinstance(record, Message):
            if record.channel_id not in self._channels:
                self.mended.losses["messages of an unknown topic"] += 1
                return
            number = self._channels[record.channel_id]
            self._writer.add_message(
                number, record.log_time, record.data, record.publish_time, record.sequence
            )
            self.mended.messages += 1
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
