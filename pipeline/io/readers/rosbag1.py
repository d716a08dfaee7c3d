"""ROS 1 bags, version 2.0 (http://wiki.ros.org/Bags/Format/2.0), indexed or not, whole or cut."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    BrokenChunkError,
    Channel,
    Chunk,
    ChunkedFile,
    Message,
    damaged,
    ros2_type_name,
)  # fmt: skip

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_ENTRY, CONNECTION = 2, 3, 4, 5, 6, 7
HEADER_LIMIT = 1 << 20
#: A file with more damaged records has another format, and would take long to read.
STRANGE_LIMIT = 1000
LENGTH = struct.Struct("<I")
Header = dict[bytes, bytes]


class BagFile(ChunkedFile):
    """A ROS 1 bag as a container of messages.

    Raises:
        SourceError: It cannot be opened, is not a bag of version 2.0, is encrypted, or has no connections.
    """

    kind = "ROS 1 bag"

    @property
    def channels(self) -> list[Channel]:
        """All channels (connections)."""
        counts = self._counts()
        return [
            Channel(number, topic, msgtype, "ros1", definition, "ros1msg", counts.get(number, 0))
            for number, (topic, msgtype, definition) in sorted(self._connections.items())
        ]

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return None: a bag has no attachments."""
        del name, limit
        return None

    # --- index -------------------------------------------------------------------------------------

    def _known_channels(self) -> Collection[int]:
        return self._connections

    def _read_index(self) -> None:
        self._connections: dict[int, tuple[str, str, str]] = {}  # topic, type, definition
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
        """Take times and number of messages of a connection from an index record behind its chunk."""
        times = np.frombuffer(table[: len(table) // 12 * 12], "<u4").reshape(-1, 3).astype(np.int64)
        if not len(times):
            return
        stamps = times[:, 0] * 1_000_000_000 + times[:, 1]
        first, last = int(stamps.min()), int(stamps.max())
        chunk = self._chunks[-1]
        if chunk.counts is not None:
            first, last = min(first, chunk.start_ns), max(last, chunk.end_ns)
        counts = {**(chunk.counts or {}), number: len(times)}
        self._chunks[-1] = replace(chunk, start_ns=first, end_ns=last, counts=counts)

    # --- chunks ------------------------------------------------------------------------------------

    def _parse(self, raw: bytes, *, define: bool) -> Iterator[Message]:
        at = 0
        while at < len(raw):
            (header_size,) = LENGTH.unpack_from(raw, at)
            (length,) = LENGTH.unpack_from(raw, at + 4 + header_size)
            body = at + 8 + header_size
            header = _fields(raw[at + 4 : body - 4])
            if body + length > len(raw) or not header:
                raise BrokenChunkError
            opcode = header.get(b"op")
            if opcode == bytes([MESSAGE]):
                (number,) = LENGTH.unpack(header[b"conn"])
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                yield Message(number, seconds * 1_000_000_000 + nanoseconds, raw[body : body + length])
            elif define and opcode == bytes([CONNECTION]):
                self._define(header, raw[body : body + length])
            at = body + length


def _fields(header: bytes) -> Header:
    """Parse the name=value fields of the header of a record.

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
