"""ROS 2 bags in SQLite (.db3), folders that a ROS 2 recorder writes, and ROS 1 bags, version 2.0
(http://wiki.ros.org/Bags/Format/2.0), indexed or not, complete or cut."""

from __future__ import annotations

import heapq
import sqlite3
import struct
from collections.abc import Collection, Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from urllib.parse import quote

import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    DAMAGE,
    MOST_STEPS,
    STEP_BACK_NS,
    STRANGE_LIMIT,
    BrokenChunkError,
    Channel,
    Chunk,
    ChunkedFile,
    Container,
    Message,
    damaged,
    plain,
    ros2_type_name,
)  # fmt: skip
from pipeline.io.readers.mcap_file import McapFile
from pipeline.types.records import Int

MESSAGE_LIMIT = 256 << 20


class Db3File(Container):
    """A SQLite bag as a container of messages. The file is opened for reading only.

    Raises:
        SourceError: It is not a bag, or its tables cannot be read.
    """

    kind = "ROS 2 bag (db3)"

    def __init__(self, path: Path) -> None:
        """Open the database and read the index of all messages."""
        self._path = path
        self.damage = {}
        # `immutable` keeps SQLite from writing a journal, which fails on a read-only disk.
        try:
            self._database = sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)
        except sqlite3.Error as error:
            raise SourceError(f"cannot open the file: {error}", where=str(path)) from error
        try:
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MESSAGE_LIMIT)
            self._database.execute("PRAGMA trusted_schema = OFF")
            self._tables = self._plain_tables()
            self._row, self._topic, self._stamp = self._read_index()
            self.channels = self._read_channels()
        except (sqlite3.Error, OverflowError, UnicodeDecodeError, ValueError, TypeError) as error:
            self.close()
            raise damaged(f"the database cannot be read: {error}", path) from error
        except BaseException:
            self.close()
            raise

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return the time of the last message of some channels [ns]; 0 without one."""
        found = np.flatnonzero(np.isin(self._topic, list(numbers)))
        return int(self._stamp[found[-1]]) if len(found) else 0

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages, see `Container.messages`."""
        first = 0 if start_ns is None else int(np.searchsorted(self._stamp, start_ns))
        chosen = first + np.flatnonzero(np.isin(self._topic[first:], list(numbers)))
        for index in chosen:
            payload = self._payload(int(self._row[index]))
            if payload is None:
                count_loss(losses, "messages that the database cannot give")
            else:
                yield plain(Message(int(self._topic[index]), int(self._stamp[index]), payload))

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def _payload(self, row: int) -> bytes | None:
        """Return the bytes of the message in a row of the table; None if they cannot be read."""
        try:
            found = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (row,)).fetchone()
        except (sqlite3.Error, MemoryError):
            return None
        return found[0] if found is not None and isinstance(found[0], bytes) else None

    def _plain_tables(self) -> set[str]:
        """Return the names of the plain tables.

        Views, virtual tables and computed columns can compute without end; recorders write none.

        Raises:
            SourceError: `messages` or `topics` is not such a table.
        """
        found = self._database.execute(
            "SELECT name FROM pragma_table_list AS t WHERE schema = 'main' AND type = 'table'"
            " AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(t.name) WHERE hidden)"
        )
        plain = {name for (name,) in found}
        if not {"messages", "topics"} <= plain:
            raise damaged("the database holds no tables of messages and topics", self._path)
        return plain

    def _read_index(self) -> tuple[Int, Int, Int]:
        """Return row, topic and time [ns] of all messages in the order of time, shape (N,) each. Damaged ones
        are left out; damaged pages end the list and are counted. Times behind steps of the recorder's clock
        are shifted and counted in `clock_steps`."""
        rows: list[tuple[int, int, int]] = []
        cursor = self._database.execute("SELECT rowid, topic_id, timestamp FROM messages")
        try:
            rows.extend(row for row in cursor if all(isinstance(cell, int) for cell in row))
        except sqlite3.Error:
            count_loss(self.damage, "pages of the database that cannot be read")
        table = np.array(rows, dtype=np.int64).reshape(-1, 3)
        self.clock_steps = _shift_after_steps(table[:, 1], table[:, 2])
        table = table[np.argsort(table[:, 2], kind="stable")]
        return table[:, 0], table[:, 1], table[:, 2]

    def _read_channels(self) -> list[Channel]:
        """Return the channels by number, with their numbers of messages."""
        definitions = self._definitions()
        channels = []
        for number, topic, msgtype, encoding in self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            form, text = definitions.get(msgtype, ("", ""))
            count = int(np.count_nonzero(self._topic == int(number)))
            name = ros2_type_name(str(msgtype))
            channels.append(Channel(int(number), str(topic), name, str(encoding or ""), text, form, count))
        return channels

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Return the format and text of message definitions by type, stored since ROS 2 Iron; empty without
        them, or if they cannot be read."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        if "message_definitions" not in self._tables:
            return {}
        try:
            return {str(name): (str(kind), str(text)) for name, kind, text in self._database.execute(query)}
        except sqlite3.Error:
            return {}


def _shift_after_steps(topic: Int, stamp: Int) -> int:
    """Shift times behind steps back of the recorder's clock, see `Container.clock_steps`; return the number
    of steps, at most MOST_STEPS. A step is a time that is more than STEP_BACK_NS earlier than one of its
    topic before.

    Args:
        topic: Topic of each message in the order of the file, int64, shape (N,).
        stamp: Time of recording [ns], int64, shape (N,); changed in place.
    """
    for steps in range(MOST_STEPS):
        back = np.zeros(len(stamp), dtype=np.bool_)
        for number in np.unique(topic):
            own = np.flatnonzero(topic == number)
            back[own[1:]] = stamp[own[1:]] < np.maximum.accumulate(stamp[own])[:-1] - STEP_BACK_NS
        if not back.any():
            return steps
        first = int(np.argmax(back))
        own = stamp[:first][topic[:first] == topic[first]]
        due_ns = 2 * own[-1] - own[-2] if len(own) > 1 else own[-1]
        stamp[first:] += max(due_ns, stamp[:first].max()) - stamp[first]
    return MOST_STEPS


#: The channels of the n-th file are numbered from n times this value.
_STRIDE = 1 << 40


def bag_files(folder: Path) -> list[Path]:
    """Return the .mcap and .db3 files of a folder in the order of the numbers at the end of their names; may
    be empty.

    Raises:
        SourceError: The files themselves are compressed, or there are several without metadata.yaml.
    """
    files = sorted((path for path in folder.iterdir() if path.suffix in (".mcap", ".db3")), key=_natural)
    packed = sorted(path for path in folder.iterdir() if path.suffixes[-1:] == [".zstd"])
    if packed and not files:
        raise SourceError(
            "the files of the recording are compressed",
            where=str(packed[0]),
            remedy="Unpack them with zstd -d.",
        )
    if len(files) > 1 and not (folder / "metadata.yaml").is_file():
        raise SourceError(
            f"the folder holds {len(files)} recordings without metadata.yaml",
            where=str(folder),
            remedy="Name one of the files.",
        )
    return files


def _natural(path: Path) -> tuple[int, str]:
    """Return the sort key of a part of a recording by its number: recorders write ..._0, ..._1, ..., ..._10.
    A name without a number comes first."""
    tail = path.stem.rpartition("_")[2]
    return (int(tail), path.name) if tail.isdecimal() and len(tail) < 10 else (0, path.name)


class BagFolder(Container):
    """The files of a recording as one container of messages.

    Args:
        files: The files in the order of recording.

    Raises:
        SourceError: None of the files can be read.
    """

    def __init__(self, files: list[Path]) -> None:
        """Open all files; one that cannot be read is counted in `damage`. Channels of the n-th file (from 0)
        are numbered from n times _STRIDE."""
        self.damage = {}
        self._parts: list[Container] = []
        for path in files:
            try:
                self._parts.append(open_bag(path))
            except SourceError:
                if len(files) == 1:
                    raise
                count_loss(self.damage, "files of the recording that cannot be read")
        if not self._parts:
            raise SourceError("none of the files of the recording can be read", where=str(files[0].parent))
        self.kind = self._parts[0].kind
        self.clock_steps = sum(part.clock_steps for part in self._parts)
        self.channels = []
        for index, part in enumerate(self._parts):
            self.channels += [replace(c, number=c.number + _STRIDE * index) for c in part.channels]
            for reason, count in part.damage.items():
                count_loss(self.damage, reason, count)

    def tail_ns(self, numbers: Collection[int]) -> int:
        """Return the latest of the times of all files [ns], see `Container.tail_ns`."""
        return max(part.tail_ns(_own(numbers, index)) for index, part in enumerate(self._parts))

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield messages of all files, merged by their times of recording, see `Container.messages`."""
        streams = [
            _renumbered(part.messages(_own(numbers, index), start_ns, losses), index)
            for index, part in enumerate(self._parts)
        ]
        return heapq.merge(*streams, key=attrgetter("log_ns"))

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of an attachment of any file, see `Container.attachment`. None if no file has
        it."""
        found = (part.attachment(name, limit) for part in self._parts)
        return next((content for content in found if content is not None), None)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()


def _own(numbers: Collection[int], index: int) -> list[int]:
    """Return the numbers of the channels of one file, as numbered in that file."""
    return [number - _STRIDE * index for number in numbers if number // _STRIDE == index]


def _renumbered(messages: Iterator[Message], index: int) -> Iterator[Message]:
    """Return the messages of the file with this index, with the numbers of its channels in the folder."""
    if index == 0:
        return messages
    return (replace(message, channel=message.channel + _STRIDE * index) for message in messages)


MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
HEADER_LIMIT = 1 << 20
LENGTH = struct.Struct("<I")
Header = dict[bytes, bytes]


class BagFile(ChunkedFile):
    """A ROS 1 bag as a container of messages.

    Raises:
        SourceError: It cannot be opened, is not a bag of version 2.0, is encrypted, or has no connections.
    """

    kind = "ROS 1 bag"

    def _read_index(self, end: int) -> None:
        """Read the headers of all records from the start of the file up to a cut; damage is counted.

        Raises:
            SourceError: It is not a bag of version 2.0, or is encrypted.
        """
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
            except DAMAGE:
                count_loss(self.damage, "damaged records of the recording")
                strange += 1
            at = body + length
        if at < end:
            count_loss(self.damage, "bytes at the end of a recording that was cut", end - at)

    def _take(self, header: Header, body: int, length: int) -> None:
        """Store the contents of a record: a connection, a chunk, or the counts of a chunk; other kinds are
        ignored.

        Args:
            header: Fields of its header.
            body: Position of its contents in the file.
            length: Length of its contents [bytes].

        Raises:
            SourceError: The bag is encrypted.
            DAMAGE: The record is damaged.
        """
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
        """Add the channel of a connection, by the header and the contents of its record.

        Raises:
            DAMAGE: A field is missing or damaged.
        """
        fields = _fields(content)
        (number,) = LENGTH.unpack(header[b"conn"])
        topic = header.get(b"topic", fields.get(b"topic", b"")).decode()
        msgtype = ros2_type_name(fields[b"type"].decode())
        text = fields.get(b"message_definition", b"").decode()
        self._known[number] = Channel(number, topic, msgtype, "ros1", text, "ros1msg", 0)

    def _count(self, number: int, table: bytes) -> None:
        """Store times and number of messages of a connection in the chunk before, from an index record.

        Args:
            number: Number of the connection.
            table: Entries of the index record.
        """
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

    def _parse(self, raw: bytes, *, define: bool) -> Iterator[Message]:
        """Yield the messages of an unpacked chunk, see `ChunkedFile._parse`."""
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


def open_bag(path: Path) -> Container:
    """Open a file of recorded messages by its contents.

    Raises:
        SourceError: It has another format, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
    if head.startswith(b"SQLite"):
        return Db3File(path)
    return BagFile(path) if head.startswith(b"#ROSBAG") else McapFile(path)
