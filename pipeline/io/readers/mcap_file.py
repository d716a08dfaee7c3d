"""MCAP files (https://mcap.dev/spec)."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    BLOCK_LIMIT,
    DAMAGE,
    STRANGE_LIMIT,
    BrokenChunkError,
    Channel,
    Chunk,
    ChunkedFile,
    Message,
    damaged,
    ros2_type_name,
)  # fmt: skip

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
#: Bytes of the header of a chunk before its packed bytes, without the name of the compression.
_CHUNK_HEAD = 40
#: Messages outside of chunks are read in runs of this many bytes.
LOOSE_RUN = 4 << 20
DEFINITION_LIMIT = 1 << 20
#: A recording whose last record is whole and that has no index: the recorder was ended. Nothing is lost.
NOT_FINISHED = "index at the end of a recording that was not finished"


class McapFile(ChunkedFile):
    """An MCAP file as a container of messages.

    Raises:
        SourceError: The file cannot be opened, is not an MCAP file, or has no channels.
    """

    kind = "ROS 2 MCAP"

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of the first attachment of a name, None if there is none.

        Raises:
            SourceError: The attachment is longer than `limit` bytes, is damaged, or has a wrong checksum.
        """
        for opcode, offset, length in self._further:
            if opcode != Opcode.ATTACHMENT or _attachment_name(self._read(offset, 4096)) != name:
                continue
            raw = self._read(offset, min(length, limit + 4096))
            try:
                found = records.Attachment.read(ReadDataStream(io.BytesIO(raw)))
                if len(found.data) > limit:
                    raise ValueError("too long")
            except DAMAGE as error:
                what = f"the attachment {name} is damaged or longer than {limit >> 20} MB"
                raise damaged(what, self._path) from error
            try:
                _check_crc(raw)
            except ValueError:
                raise damaged(f"the attachment {name} has a wrong checksum", self._path) from None
            return bytes(found.data)
        return None

    def whole_records(self) -> Iterator[records.McapRecord]:
        """Yield all definitions, attachments, metadata and messages that can be read; other chunks and
        records are counted in `damage`. Attachments with a wrong checksum count as damaged. Chunks are
        yielded in the order of the file, with the times that they have there, and with their own definitions,
        which repeat earlier ones. Of a chunk that is damaged in part the records before the damage are
        yielded. SourceError if the file cannot be read."""
        yield from self._schemas.values()
        yield from self._definitions.values()
        for opcode, offset, length in self._further:
            try:
                content = self._read(offset, min(length, BLOCK_LIMIT))
                if opcode == Opcode.ATTACHMENT:
                    _check_crc(content)
                raw = RECORD.pack(opcode, length) + content
                yield next(StreamReader(io.BytesIO(raw), skip_magic=True).records)
            except (*DAMAGE, StopIteration):
                is_file = opcode == Opcode.ATTACHMENT
                count_loss(
                    self.damage, "damaged attachments" if is_file else "damaged records of the recording"
                )
        for chunk in self._chunks:
            try:
                raw = self._bytes_of(chunk)
                if not raw:
                    continue
                stream = io.BytesIO(raw)
                for record in StreamReader(stream, skip_magic=True, emit_chunks=True).records:
                    yield record
                    if stream.tell() >= len(raw):
                        break
            except (*DAMAGE, BrokenChunkError):
                count_loss(self.damage, "damaged chunks")

    # --- index -------------------------------------------------------------------------------------

    def _read_index(self, end: int) -> None:
        """Read the records from the start of the file. If they end before the end of the data, use the
        summary for later chunks and count the bytes in between as damage.

        Raises:
            SourceError: The file is not an MCAP file.
        """
        self._schemas: dict[int, records.Schema] = {}
        self._definitions: dict[int, records.Channel] = {}
        self._further: list[tuple[int, int, int]] = []  # opcode, position and length of other records
        if self._read(0, len(MAGIC)) != MAGIC:
            raise damaged("not an MCAP file", self._path, "Name a file that a ROS 2 recorder wrote.")
        at, strange, whole = len(MAGIC), 0, False
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            body, after = at + RECORD.size, at + RECORD.size + length
            if after > end or opcode == 0 or strange > STRANGE_LIMIT:
                break
            strange += not self._take_or_count(opcode, body, length) or opcode > Opcode.DATA_END
            whole |= opcode in (Opcode.DATA_END, Opcode.FOOTER)
            at = after
            if opcode == Opcode.FOOTER:
                break
        if not whole:
            if self._chunks:
                self._chunks[-1].index_is_whole = False
            read = self._read_summary(at)
            if read:
                count_loss(self.damage, "bytes between damaged records", read - at)
            elif end > at:
                count_loss(self.damage, "bytes at the end of a recording that was cut", end - at)
            else:
                count_loss(self.damage, NOT_FINISHED)

    def _read_summary(self, after: int) -> int:
        """Add the channels of the summary and the chunks after a position [bytes]; return the position
        [bytes] at which the first of these chunks begins, 0 if there is no summary or no such chunk."""
        try:
            with self._path.open("rb") as file:
                summary = SeekingReader(file, record_size_limit=BLOCK_LIMIT).get_summary()
        except (*DAMAGE, OSError, StopIteration, MemoryError):
            return 0
        if summary is None:
            return 0
        for schema in summary.schemas.values():
            self._schemas.setdefault(schema.id, schema)
        for channel in summary.channels.values():
            if channel.id not in self._known:
                self._add_channel(channel)
        starts = sorted((c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes)
        behind = [(start, length) for start, length in starts if start > after and length > RECORD.size]
        for start, length in behind:
            self._take_or_count(Opcode.CHUNK, start + RECORD.size, length - RECORD.size)
        return behind[0][0] if behind else 0

    def _take_or_count(self, opcode: int, body: int, length: int) -> bool:
        """Store the contents of a record, see `_take`, and return True. For a damaged record return False: it
        is counted, and the index of the last chunk, of which it may be a part, counts as incomplete.

        Args:
            opcode: Type of the record.
            body: Position of its contents in the file [bytes].
            length: Length of its contents [bytes].
        """
        try:
            self._take(opcode, body, length)
        except DAMAGE:
            count_loss(self.damage, "damaged records of the recording")
            if self._chunks:
                self._chunks[-1].index_is_whole = False
            return False
        return True

    def _take(self, opcode: int, body: int, length: int) -> None:
        """Store the contents of a record: type, channel, chunk, its index, or message; of an attachment or
        metadata, only the position is stored. Other kinds are ignored.

        Args:
            opcode: Kind of the record.
            body: Position of its contents in the file [bytes].
            length: Length of its contents [bytes].

        Raises:
            DAMAGE: The record is damaged.
        """
        match opcode:
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._define(opcode, self._read(body, min(length, DEFINITION_LIMIT)))
            case Opcode.CHUNK:
                head = records.Chunk.read(ReadDataStream(io.BytesIO(self._read(body, min(length, 128)))))
                before = _CHUNK_HEAD + len(head.compression.encode())
                self._chunks.append(
                    Chunk(
                        body + before,
                        length - before,
                        head.compression,
                        head.uncompressed_size,
                        head.uncompressed_crc,
                    )
                )
            case Opcode.MESSAGE:
                self._add_loose(body - RECORD.size, body + length)
            case Opcode.MESSAGE_INDEX if self._chunks:
                if length > BLOCK_LIMIT:
                    raise ValueError("the index of a chunk is too large")
                content = self._read(body, length)
                (number,) = struct.unpack_from("<H", content)
                times = np.frombuffer(content, "<i8", offset=6).reshape(-1, 2)
                rows = np.column_stack([np.full(len(times), number), times])
                self._chunks[-1].index.append(rows.astype(np.int64))
            case Opcode.ATTACHMENT | Opcode.METADATA:
                self._further.append((opcode, body, length))

    def _define(self, opcode: int, record: bytes) -> None:
        """Add the type or channel in a record; `opcode` is SCHEMA or CHANNEL.

        Raises:
            DAMAGE: The record is damaged.
        """
        stream = ReadDataStream(io.BytesIO(record))
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = schema
        else:
            self._add_channel(records.Channel.read(stream))

    def _add_channel(self, channel: records.Channel) -> None:
        """Add a channel; if its schema is unknown, its type is "". An earlier channel with the same number is
        replaced."""
        schema = self._schemas.get(channel.schema_id)
        msgtype = "" if schema is None else ros2_type_name(schema.name)
        self._definitions[channel.id] = channel
        self._known[channel.id] = Channel(channel.id, channel.topic, msgtype, channel.message_encoding)

    def _add_loose(self, start: int, end: int) -> None:
        """Add a message between two positions [bytes] outside of chunks to a run, which is an uncompressed
        chunk of up to about LOOSE_RUN bytes."""
        last = self._chunks[-1] if self._chunks else None
        is_run = last is not None and last.offset + last.length == start and not (last.index or last.crc)
        if last is not None and is_run and last.length == last.size < LOOSE_RUN:
            last.length = last.size = end - last.offset
        else:
            self._chunks.append(Chunk(start, end - start, "", end - start))

    def _record(self, raw: bytes, at: int) -> tuple[Message | None, int]:
        """Return the message of the record at an offset in an unpacked chunk, None for another record, and
        the offset of its end. A type or channel is added to those of the file.

        Raises:
            BrokenChunkError: The record is longer than the chunk, or its time is impossible.
            DAMAGE: The record cannot be parsed.
        """
        opcode, length = RECORD.unpack_from(raw, at)
        at += RECORD.size
        end = at + length
        if end > len(raw) or opcode == 0:
            raise BrokenChunkError
        if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD.size:
            number, _sequence, log_ns, _publish_ns = MESSAGE_HEAD.unpack_from(raw, at)
            if log_ns >= 1 << 63:
                raise BrokenChunkError
            return Message(number, log_ns, raw[at + MESSAGE_HEAD.size : end]), end
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, raw[at : at + min(length, DEFINITION_LIMIT)])
        return None, end


def _check_crc(attachment: bytes) -> None:
    """Check the sum at the end of an attachment; 0 means that there is none.

    Raises:
        ValueError: The sum is wrong.
    """
    crc = int.from_bytes(attachment[-4:], "little")
    if crc and zlib.crc32(attachment[:-4]) != crc:
        raise ValueError("wrong checksum")


def _attachment_name(head: bytes) -> str:
    """Return the name in the first bytes of an attachment, "" if they are damaged."""
    try:
        return str(ReadDataStream(io.BytesIO(head[16:])).read_prefixed_string())  # behind two times
    except DAMAGE:
        return ""
