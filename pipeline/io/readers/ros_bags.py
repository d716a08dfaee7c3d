"""ROS 2 bags in SQLite (.db3), folders that a ROS 2 recorder writes, and ROS 1 bags, version 2.0
(http://wiki.ros.org/Bags/Format/2.0), indexed or not, complete or cut."""

from __future__ import annotations

import sqlite3
import struct
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import (
    BLOCK_LIMIT,
    DAMAGE,
    STRANGE_LIMIT,
    BrokenChunkError,
    Channel,
    Chunk,
    ChunkedFile,
    Container,
    Message,
    damaged,
    ros2_type_name,
    shift_after_steps,
)
from pipeline.io.readers.mcap_file import McapFile
from pipeline.types.records import Int

MESSAGE_LIMIT = 256 << 20
#: The channels of the n-th file of a folder are numbered from n times this value; those of one file have
#: smaller numbers.
_STRIDE = 1 << 40


class Db3File(Container):
    """A SQLite bag as a container of messages. The file is opened for reading only.

    Raises:
        SourceError: The file is not a bag, or its tables cannot be read.
    """

    kind = "ROS 2 bag (db3)"
    unreadable = "messages that the database cannot give"

    def __init__(self, path: Path) -> None:
        """Open the database and read the index of all messages. Times after steps back of the recorder's
        clock are shifted.

        Raises:
            SourceError: The file is not a bag, or its tables cannot be read.
        """
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
            self._check_tables()
            index, channels = self._read_index(), self._read_channels()
            self.clock_steps = shift_after_steps(index, {channel.number: channel for channel in channels})
            self._set_index(channels, index)
        except (sqlite3.Error, OverflowError, UnicodeDecodeError, ValueError, TypeError) as error:
            self.close()
            raise damaged(f"the database cannot be read: {error}", path) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def _message(self, number: int, log_ns: int, place: int) -> Message | None:
        """Return the message in row `place` of the table, with the channel and time [ns] of the index; None
        if the database cannot give it."""
        try:
            found = self._database.execute("SELECT data FROM messages WHERE rowid = ?", (place,)).fetchone()
        except (sqlite3.Error, MemoryError):
            return None
        if found is None or not isinstance(found[0], bytes):
            return None
        return Message(number, log_ns, found[0])

    def _check_tables(self) -> None:
        """Check that `messages` and `topics` are tables without computed columns.

        Views and virtual tables are refused.

        Raises:
            SourceError: `messages` or `topics` is not such a table.
        """
        found = self._database.execute(
            "SELECT name FROM pragma_table_list AS t WHERE schema = 'main' AND type = 'table'"
            " AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(t.name) WHERE hidden)"
        )
        if not {"messages", "topics"} <= {name for (name,) in found}:
            raise damaged(
                "the database holds no tables of messages and topics",
                self._path,
                "It is of another program: name the .db3 of a ROS 2 recorder.",
            )

    def _read_index(self) -> Int:
        """Return topic, time [ns] and row of all messages, int64, shape (N, 3). Damaged ones are left out
        and counted; damaged pages end the list and are counted."""
        rows: list[tuple[int, int, int]] = []
        cursor = self._database.execute("SELECT topic_id, timestamp, rowid FROM messages")
        try:
            for row in cursor:
                if all(isinstance(cell, int) for cell in row) and 0 <= row[0] < _STRIDE:
                    rows.append(row)
                else:
                    count_loss(self.damage, "damaged rows of the database")
        except sqlite3.Error:
            count_loss(self.damage, "pages of the database that cannot be read")
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    def _read_channels(self) -> list[Channel]:
        """Return the channels in the order of their numbers; those with an impossible number are left out, as
        are their messages."""
        rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id")
        return [
            Channel(int(number), str(topic), ros2_type_name(str(msgtype)), str(encoding or ""))
            for number, topic, msgtype, encoding in rows
            if 0 <= int(number) < _STRIDE
        ]


_BAGS = (".mcap", ".db3")
_PACKED = tuple(f"{suffix}.zstd" for suffix in _BAGS)


def bag_files(folder: Path) -> list[Path]:
    """Return the .mcap and .db3 files (suffix in any case) of a folder in the order of the numbers at the
    end of their names; may be empty. A compressed one (.mcap.zstd, .db3.zstd) is ignored beside an unpacked
    one of its name.

    Raises:
        SourceError: A file is only there compressed.
        OSError: The folder cannot be read.
    """
    inside = sorted(folder.iterdir(), key=_natural)
    files = [path for path in inside if path.suffix.lower() in _BAGS]
    unpacked = {path.stem.lower() for path in files}
    packed = [path for path in inside if path.name.lower().endswith(_PACKED)]
    packed = [path for path in packed if Path(path.stem).stem.lower() not in unpacked]
    if packed:
        raise SourceError(
            "files of the recording are compressed",
            where=str(packed[0]),
            remedy="Unpack them with zstd -d.",
        )
    return files


def _natural(path: Path) -> tuple[int, str]:
    """Return the sort key of a part of a recording: the number after the last "_" of the name, and the name.
    A name without a number, or with one of more than nine digits, has the number 0."""
    tail = path.stem.rpartition("_")[2]
    return (int(tail), path.name) if tail.isdecimal() and len(tail) < 10 else (0, path.name)


class BagFolder(Container):
    """The files of a recording as one container of messages.

    Args:
        files: The files in the order of recording.

    Raises:
        SourceError: None of the files can be read.
    """

    unreadable = "messages in damaged parts of the recording"

    def __init__(self, files: list[Path]) -> None:
        """Open all files; one of several that cannot be read is counted in `damage`. Channels of the n-th
        file that can be read (from 0) are numbered from n times _STRIDE.

        Raises:
            SourceError: None of the files can be read.
        """
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
        channels, index = list[Channel](), list[Int]()
        for number, part in enumerate(self._parts):
            channels += [replace(c, number=c.number + _STRIDE * number) for c in part.channels]
            index.append(part.index + np.array([_STRIDE * number, 0, 0]))
            for reason, count in part.damage.items():
                count_loss(self.damage, reason, count)
        # The clock may be set between two files, where no part sees a step; a part is in the order of time.
        table = np.concatenate(index)
        self.clock_steps += shift_after_steps(table, {channel.number: channel for channel in channels})
        ends = np.cumsum([len(part) for part in index]).tolist()
        self._shifts_ns = [
            int((table[end - len(rows) : end, 1] - rows[:, 1]).max(initial=0))
            for rows, end in zip(index, ends, strict=True)
        ]
        for rows, end, shift_ns in zip(index, ends, self._shifts_ns, strict=True):
            table[end - len(rows) : end, 1] = rows[:, 1] + shift_ns
        self._set_index(channels, table)

    def attachment(self, name: str, limit: int) -> bytes | None:
        """Return the bytes of an attachment of the first file that has one of this name; None if none has.

        Raises:
            SourceError: The attachment is longer than `limit` bytes or damaged.
        """
        found = (part.attachment(name, limit) for part in self._parts)
        return next((content for content in found if content is not None), None)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()

    def _message(self, number: int, log_ns: int, place: int) -> Message | None:
        """Return the message at the location `place` in the file to which the channel belongs; None if it
        cannot be read. SourceError if that file cannot be read."""
        part, own = divmod(number, _STRIDE)
        shift_ns = self._shifts_ns[part]
        message = self._parts[part]._message(own, log_ns - shift_ns, place)
        return None if message is None else replace(message, channel=number, log_ns=message.log_ns + shift_ns)


MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CONNECTION = 2, 3, 4, 5, 7
HEADER_LIMIT = 1 << 20
LENGTH = struct.Struct("<I")
Header = dict[bytes, bytes]


class BagFile(ChunkedFile):
    """A ROS 1 bag as a container of messages.

    Raises:
        SourceError: The file cannot be opened, is not a bag of version 2.0, is encrypted, or has no
            connections.
    """

    kind = "ROS 1 bag"

    def _read_index(self, end: int) -> None:
        """Read the headers of all records from the start of the file up to a cut; damage is counted.

        Raises:
            SourceError: The file is not a bag of version 2.0, or is encrypted.
        """
        if self._read(0, len(MAGIC)) != MAGIC:
            raise damaged(
                "not a ROS 1 bag of version 2.0", self._path, "Convert an older one with `rosbag fix`."
            )
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
                if self._chunks:  # the record may be a part of its index
                    self._chunks[-1].index_is_whole = False
            at = body + length
        if at < end:
            count_loss(self.damage, "bytes at the end of a recording that was cut", end - at)
            if self._chunks:  # a part of its index may be missing
                self._chunks[-1].index_is_whole = False

    def _take(self, header: Header, body: int, length: int) -> None:
        """Store the contents of a record: a connection, a chunk, or a part of the index of the last chunk;
        other kinds are ignored.

        Args:
            header: Fields of the header of the record.
            body: Position of its contents in the file [bytes].
            length: Length of its contents [bytes].

        Raises:
            SourceError: The bag is encrypted.
            DAMAGE: The record is damaged.
        """
        opcode = header[b"op"][0] if header[b"op"] else 0
        if opcode == BAG_HEADER and header.get(b"encryptor"):
            raise damaged("the bag is encrypted", self._path, "Decrypt it with `rosbag decrypt`.")
        if opcode == CONNECTION:
            self._define(header, self._read(body, min(length, HEADER_LIMIT)))
        elif opcode == CHUNK:
            size = LENGTH.unpack(header[b"size"])[0]
            method = header[b"compression"].decode()
            self._chunks.append(Chunk(body, length, method, size))
        elif opcode == INDEX and self._chunks:
            if length > BLOCK_LIMIT:
                raise ValueError("the index of a chunk is too large")
            table = np.frombuffer(self._read(body, length), "<u4").reshape(-1, 3).astype(np.int64)
            channel = np.full(len(table), LENGTH.unpack(header[b"conn"])[0])
            times = table[:, 0] * 1_000_000_000 + table[:, 1]
            self._chunks[-1].index.append(np.column_stack([channel, times, table[:, 2]]))

    def _define(self, header: Header, content: bytes) -> None:
        """Add the channel of a connection, by the header and the contents of its record.

        Raises:
            DAMAGE: A field is missing or damaged.
        """
        fields = _fields(content)
        (number,) = LENGTH.unpack(header[b"conn"])
        topic = header.get(b"topic", fields.get(b"topic", b"")).decode()
        msgtype = ros2_type_name(fields[b"type"].decode())
        self._known[number] = Channel(number, topic, msgtype, "ros1")

    def _record(self, raw: bytes, at: int) -> tuple[Message | None, int]:
        """Return the message of the record at an offset in an unpacked chunk, None for another record, and
        the offset of its end. A connection is added to the channels of the file.

        Raises:
            BrokenChunkError: The record is longer than the chunk, or has no header.
            DAMAGE: The record cannot be parsed.
        """
        (header_size,) = LENGTH.unpack_from(raw, at)
        (length,) = LENGTH.unpack_from(raw, at + 4 + header_size)
        body = at + 8 + header_size
        header, end = _fields(raw[at + 4 : body - 4]), body + length
        if end > len(raw) or not header:
            raise BrokenChunkError
        opcode = header.get(b"op")
        if opcode == bytes([MESSAGE]):
            (number,) = LENGTH.unpack(header[b"conn"])
            seconds, nanoseconds = struct.unpack("<II", header[b"time"])
            return Message(number, seconds * 1_000_000_000 + nanoseconds, raw[body:end]), end
        if opcode == bytes([CONNECTION]):
            self._define(header, raw[body:end])
        return None, end


def _fields(header: bytes) -> Header:
    """Return a dict from names to values of the name=value fields of the header of a record.

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
    """Open a file of recorded messages by its contents: SQLite, else a ROS 1 bag, else MCAP.

    Raises:
        SourceError: The file has another format, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise SourceError(f"cannot open the file: {error.strerror}", where=str(path)) from error
    if head.startswith(b"SQLite"):
        return Db3File(path)
    return BagFile(path) if head.startswith(b"#ROSBAG") else McapFile(path)
