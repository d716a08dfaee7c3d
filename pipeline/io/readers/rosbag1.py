"""ROS 1 bags, version 2.0 (http://wiki.ros.org/Bags/Format/2.0), indexed or not, cut or whole.

As with MCAP the index is made by walking over the record headers, so the bag's own index at its end
is not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

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

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_ENTRY, CONNECTION = 2, 3, 4, 5, 6, 7
HEADER_LIMIT = 1 << 20
#: A file with more damaged records is something else, and would take long to walk over.
STRANGE_LIMIT = 1000
LENGTH = struct.Struct("<I")
Header = dict[bytes, bytes]


class BagFile:
    """One ROS 1 bag as a container of messages.

    Raises:
        SourceError: It is no bag of version 2.0, is encrypted, or holds no channel at all.
    """

    kind = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb", buffering=0)
        self.damage: dict[str, int] = {}
        self._connections: dict[int, tuple[str, str, str]] = {}
        self._chunks: list[Chunk] = []
        self._last = LastChunk()
        try:
            self._walk()
            self._learn_connections()
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> list[Channel]:
        """All channels (connections)."""
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            for number, count in (chunk.counts or {}).items():
                counts[number] = counts.get(number, 0) + count
        return [
            Channel(number, topic, msgtype, "ros1", definition, "ros1msg", counts.get(number, 0))
            for number, (topic, msgtype, definition) in sorted(self._connections.items())
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
        """A bag has no attachments."""
        del name, limit
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
        if self._read(0, len(MAGIC)) != MAGIC:
            raise damaged("not a ROS 1 bag of version 2.0", self._path)
        at, strange = len(MAGIC), 0
        while at + 8 <= end:
            (header_size,) = LENGTH.unpack(self._read(at, 4))
            body = at + 4 + header_size + 4
            if header_size > HEADER_LIMIT or body > end:
                break
            record = self._read(at + 4, header_size + 4)
            (length,) = LENGTH.unpack_from(record, header_size)
            if body + length > end or strange > STRANGE_LIMIT:
                break
            try:
                self._take(_fields(record[:header_size]), body, length)
            except (struct.error, ValueError, KeyError):
                count_loss(self.damage, "damaged records of the recording")
                strange += 1
            at = body + length
        if at < end:
            count_loss(self.damage, "bytes at the end of a recording that was cut", end - at)

    def _take(self, header: Header, body: int, length: int) -> None:
        opcode = header[b"op"][0] if header[b"op"] else 0
        if opcode == BAG_HEADER and header.get(b"encryptor"):
            raise damaged("the bag is encrypted", self._path)
        if opcode == CONNECTION:
            self._define(header, self._read(body, min(length, HEADER_LIMIT)))
        elif opcode == CHUNK:
            size = LENGTH.unpack(header[b"size"])[0]
            method = header[b"compression"].decode()
            self._chunks.append(Chunk(body, length, 0, 0, method, size, 0, None))
        elif opcode == INDEX and self._chunks:
            self._count(LENGTH.unpack(header[b"conn"])[0], self._read(body, length))

    def _define(self, header: Header, content: bytes) -> None:
        fields = _fields(content)
        (number,) = LENGTH.unpack(header[b"conn"])
        topic = header.get(b"topic", fields.get(b"topic", b"")).decode()
        msgtype = ros2_type_name(fields[b"type"].decode())
        self._connections[number] = (topic, msgtype, fields.get(b"message_definition", b"").decode())

    def _count(self, number: int, table: bytes) -> None:
        """Take times and number of messages from the index that follows a chunk."""
        times = np.frombuffer(table[: len(table) // 12 * 12], "<u4").reshape(-1, 3).astype(np.int64)
        if not len(times):
            return
        stamps = times[:, 0] * 1_000_000_000 + times[:, 1]
        first, last = int(stamps.min()), int(stamps.max())
        chunk = self._chunks[-1]
        if chunk.counts is None:
            chunk = replace(chunk, start_ns=first, end_ns=last, counts={})
        counts = {**(chunk.counts or {}), number: len(times)}
        self._chunks[-1] = replace(
            chunk, start_ns=min(first, chunk.start_ns), end_ns=max(last, chunk.end_ns), counts=counts
        )

    # --- what lies in the chunks -----------------------------------------------------------------

    def _records(self, chunk: Chunk) -> Iterator[tuple[Header, bytes]]:
        """The records inside of a chunk as (header, content)."""
        raw = self._last.unpacked(chunk, self._read)
        at = 0
        while at < len(raw):
            try:
                (header_size,) = LENGTH.unpack_from(raw, at)
                (length,) = LENGTH.unpack_from(raw, at + 4 + header_size)
                body = at + 8 + header_size
                header = _fields(raw[at + 4 : body - 4])
            except (struct.error, ValueError) as error:
                raise BrokenChunkError from error
            if body + length > len(raw) or not header:
                raise BrokenChunkError
            yield header, raw[body : body + length]
            at = body + length

    def _expand(self, chunk: Chunk) -> Iterable[Message]:
        for header, content in self._records(chunk):
            if header.get(b"op") == bytes([MESSAGE]):
                try:
                    (number,) = LENGTH.unpack(header[b"conn"])
                    seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                except (struct.error, KeyError) as error:
                    raise BrokenChunkError from error
                yield Message(number, seconds * 1_000_000_000 + nanoseconds, content)

    def _survey(self, chunk: Chunk) -> Chunk:
        """Count a chunk's messages and take its connections."""
        counts: dict[int, int] = {}
        times: list[int] = []
        try:
            for header, content in self._records(chunk):
                if header.get(b"op") == bytes([CONNECTION]):
                    self._define(header, content)
            for message in self._expand(chunk):
                counts[message.channel] = counts.get(message.channel, 0) + 1
                times.append(message.log_ns)
        except (UnpackError, BrokenChunkError, struct.error, ValueError, KeyError):
            count_loss(self.damage, "chunks of the recording damaged in part")
        return replace(chunk, start_ns=min(times, default=0), end_ns=max(times, default=0), counts=counts)

    def _learn_connections(self) -> None:
        """Look into the chunks that no index describes or whose connections are not known yet."""
        for index, chunk in enumerate(self._chunks):
            if chunk.counts is None or not chunk.counts.keys() <= self._connections.keys():
                self._chunks[index] = self._survey(chunk)
        if not self._connections:
            raise damaged("the bag holds no messages that can be read", self._path)


def _fields(header: bytes) -> Header:
    """The name=value fields of a record's header.

    Raises:
        ValueError: A field is longer than the header or has no name.
    """
    fields: Header = {}
    at = 0
    while at < len(header):
        if at + 4 > len(header):
            raise ValueError("the header of a record is cut")
        (size,) = LENGTH.unpack_from(header, at)
        name, equals, content = header[at + 4 : at + 4 + size].partition(b"=")
        if at + 4 + size > len(header) or not equals:
            raise ValueError("the header of a record is damaged")
        fields[name] = content
        at += 4 + size
    return fields


def open_bag(path: Path) -> BagFile:
    """Open a ROS 1 bag.

    Raises:
        SourceError: It cannot be opened or read.
    """
    try:
        return BagFile(path)
    except OSError as error:
        raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
