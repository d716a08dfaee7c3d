"""Recordings with a damaged index: all messages of intact chunks are read."""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.io.readers.container import ChunkedFile
from pipeline.io.readers.mcap_file import MAGIC, RECORD, McapFile
from pipeline.io.readers.ros_bags import BagFile, BagFolder, Db3File
from tests.pipeline.io.recordings import START_NS, STEP_NS, drive, write_recording

TOPICS, COUNT = 3, 4


def mcap_of_topics(path: Path) -> list[tuple[int, int]]:
    """Write two chunks with messages of each topic; return position and length of their index records."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=350, compression=CompressionType.ZSTD)
        writer.start("ros2", "")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
        channels = [writer.register_channel(f"/t{k}", "cdr", schema) for k in range(TOPICS)]
        for k in range(COUNT):
            for channel in channels:
                writer.add_message(channel, START_NS + k * STEP_NS, b"content", START_NS)
        writer.finish()
    content, at, found = path.read_bytes(), len(MAGIC), []
    while at < len(content) - len(MAGIC):
        opcode, length = RECORD.unpack_from(content, at)
        if opcode == Opcode.MESSAGE_INDEX:
            found.append((at, length))
        at += RECORD.size + length
    assert len(found) == 2 * TOPICS
    return found


def bag_of_topics(path: Path) -> None:
    """Write a bag of one chunk with some messages of each topic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    text = store.types["std_msgs/msg/String"]("content")
    with Rosbag1Writer(path) as writer:
        topics = [
            writer.add_connection(f"/t{k}", "std_msgs/msg/String", typestore=store) for k in range(TOPICS)
        ]
        for k in range(COUNT):
            for topic in topics:
                raw = store.serialize_ros1(text, "std_msgs/msg/String")
                writer.write(topic, START_NS + k * STEP_NS, raw)


def times_by_channel(container: ChunkedFile) -> Counter[int]:
    """How many messages have each time; all are read, and none is lost."""
    losses: dict[str, int] = {}
    numbers = [channel.number for channel in container.channels]
    found = Counter(m.log_ns for m in container.messages(numbers, None, losses))
    assert not losses
    return found


EXPECTED = Counter({START_NS + k * STEP_NS: TOPICS for k in range(COUNT)})


@pytest.mark.parametrize("length", [None, 1 << 62], ids=["of two records", "impossible"])
def test_an_mcap_chunk_with_a_damaged_index_record_is_unpacked(length: int | None, tmp_path: Path):
    path = tmp_path / "run.mcap"
    _, (at, own), (_, after), *_others = mcap_of_topics(path)
    content = bytearray(path.read_bytes())
    content[at + 1 : at + 9] = struct.pack("<Q", length or own + RECORD.size + after)
    path.write_bytes(content)
    with closing(McapFile(path)) as container:
        assert times_by_channel(container) == EXPECTED
        assert container.damage


def test_a_bag_chunk_with_a_damaged_index_record_is_unpacked(tmp_path: Path):
    path = tmp_path / "run.bag"
    bag_of_topics(path)
    content = bytearray(path.read_bytes())
    index = content.rindex(b"op=\x04")
    at = content.find(b"conn=", index - 60)
    content[at : at + 4] = b"xonn"
    path.write_bytes(content)
    with closing(BagFile(path)) as container:
        assert times_by_channel(container) == EXPECTED
        assert container.damage == {"damaged records of the recording": 1}


def open_mcap(folder: Path) -> ChunkedFile:
    """A written MCAP file."""
    mcap_of_topics(folder / "run.mcap")
    return McapFile(folder / "run.mcap")


def open_bag(folder: Path) -> ChunkedFile:
    """A written bag."""
    bag_of_topics(folder / "run.bag")
    return BagFile(folder / "run.bag")


@pytest.mark.parametrize(
    ("make", "module", "count"),
    [(open_mcap, "mcap_file", 2 * TOPICS), (open_bag, "ros_bags", TOPICS)],
    ids=["mcap", "bag"],
)
def test_an_index_that_is_too_large_is_not_read(
    make: Callable[[Path], ChunkedFile],
    module: str,
    count: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(f"pipeline.io.readers.{module}.BLOCK_LIMIT", 20, raising=False)
    with closing(make(tmp_path)) as container:
        assert container.damage == {"damaged records of the recording": count}
        assert times_by_channel(container) == EXPECTED


def test_a_damaged_time_in_an_index_does_not_replace_the_time_of_the_message(tmp_path: Path):
    path = tmp_path / "run.mcap"
    (at, _), *_others = mcap_of_topics(path)
    content = bytearray(path.read_bytes())
    content[at + RECORD.size + 6 + 3] ^= 1  # the time of the first message, by 17 ms
    path.write_bytes(content)
    with closing(McapFile(path)) as container:
        assert times_by_channel(container) == EXPECTED


def test_an_empty_chunk_without_an_index_is_no_damage(tmp_path: Path):
    channel = struct.pack("<HHI7sI3sI", 1, 0, 7, b"/points", 3, b"cdr", 0)
    packed = zstandard.ZstdCompressor().compress(b"")
    head = struct.pack("<QQQII4sQ", 0, 0, 0, 0, 4, b"zstd", len(packed))
    records = [
        (Opcode.CHANNEL, channel),
        (Opcode.CHUNK, head + packed),
        (Opcode.DATA_END, bytes(4)),
        (Opcode.FOOTER, bytes(20)),
    ]
    content = b"".join(RECORD.pack(opcode, len(record)) + record for opcode, record in records)
    path = tmp_path / "run.mcap"
    path.write_bytes(MAGIC + content + MAGIC)
    with closing(McapFile(path)) as container:
        assert list(container.whole_records())
        assert container.damage == {}


@pytest.mark.parametrize("number", [1 << 40, -1])
def test_impossible_topics_of_a_database_are_left_out_and_counted(number: int, tmp_path: Path):
    folder = write_recording("db3", tmp_path, drive)
    (path,) = folder.glob("*.db3")
    with closing(sqlite3.connect(path)) as database:
        (topic,) = database.execute("SELECT id FROM topics WHERE name = '/odom'").fetchone()
        database.execute("UPDATE topics SET id = ? WHERE id = ?", (number, topic))
        count = database.execute("UPDATE messages SET topic_id = ? WHERE topic_id = ?", (number, topic))
        database.commit()
    with closing(Db3File(path)) as container:
        assert container.damage == {"damaged rows of the database": count.rowcount}
    with closing(BagFolder([path])) as container:
        numbers = [channel.number for channel in container.channels]
        assert number not in numbers
        losses: dict[str, int] = {}
        found = list(container.messages([*numbers, number], None, losses))
        assert found
        assert not losses
