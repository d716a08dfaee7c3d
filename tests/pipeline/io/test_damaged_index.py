"""Recordings with a damaged index: all messages of intact chunks are read."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.io.readers.container import ChunkedFile
from pipeline.io.readers.mcap_file import MAGIC, MESSAGE_HEAD, NOT_FINISHED, RECORD, McapFile
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


def test_the_index_tells_what_is_lost_in_a_damaged_chunk(tmp_path: Path):
    path = tmp_path / "run.mcap"
    (at, _), *_others = mcap_of_topics(path)
    content = bytearray(path.read_bytes())
    content[at - 3] ^= 0xFF  # the end of the first chunk
    path.write_bytes(content)
    losses: dict[str, int] = {}
    with closing(McapFile(path)) as container:
        assert [channel.count for channel in container.channels] == [COUNT] * TOPICS
        found = list(container.messages(range(1, TOPICS + 1), None, losses))
        assert container.damage == {}
    assert 0 < len(found) < TOPICS * COUNT
    assert losses == {container.unreadable: TOPICS * COUNT - len(found)}


def test_an_index_of_an_unknown_channel_is_not_used(tmp_path: Path):
    path = tmp_path / "run.mcap"
    (at, _), *_others = mcap_of_topics(path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<H", content, at + RECORD.size, 99)
    path.write_bytes(content)
    with closing(McapFile(path)) as container:
        assert times_by_channel(container) == EXPECTED


def test_a_damaged_time_in_an_index_does_not_replace_the_time_of_the_message(tmp_path: Path):
    path = tmp_path / "run.mcap"
    (at, _), *_others = mcap_of_topics(path)
    content = bytearray(path.read_bytes())
    content[at + RECORD.size + 6 + 3] ^= 1  # the time of the first message, by 17 ms
    path.write_bytes(content)
    with closing(McapFile(path)) as container:
        assert times_by_channel(container) == EXPECTED


CHANNEL = struct.pack("<HHI7sI3sI", 1, 0, 7, b"/points", 3, b"cdr", 0)


def mcap_record(opcode: int, content: bytes) -> bytes:
    """A record of an MCAP file."""
    return RECORD.pack(opcode, len(content)) + content


def mcap_message(k: int) -> bytes:
    """The record of a message with the number k as contents."""
    stamp_ns = START_NS + k * STEP_NS
    return mcap_record(Opcode.MESSAGE, MESSAGE_HEAD.pack(1, k, stamp_ns, stamp_ns) + bytes([k]))


def test_an_empty_chunk_without_an_index_is_no_damage(tmp_path: Path):
    packed = zstandard.ZstdCompressor().compress(b"")
    head = struct.pack("<QQQII4sQ", 0, 0, 0, 0, 4, b"zstd", len(packed))
    records = [
        (Opcode.CHANNEL, CHANNEL),
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


def test_the_bytes_behind_the_last_whole_record_of_a_cut_recording_are_counted(tmp_path: Path):
    records = [mcap_record(Opcode.CHANNEL, CHANNEL), *(mcap_message(k) for k in range(2))]
    content, path = MAGIC + b"".join(records), tmp_path / "run.mcap"
    ends = len(MAGIC) + np.cumsum([len(record) for record in records])
    for size in range(ends[0], ends[-1] + 1):
        path.write_bytes(content[:size])
        whole = np.count_nonzero(ends <= size)
        left = size - int(ends[whole - 1])
        with closing(McapFile(path)) as container:
            assert container.channels[0].count == whole - 1
            assert container.damage == (
                {"bytes at the end of a recording that was cut": left} if left else {NOT_FINISHED: 1}
            )


@pytest.mark.parametrize("pack", ["", "zstd"])
@pytest.mark.parametrize("checked", [False, True])
@pytest.mark.parametrize("run", [1, 100, 1 << 20])
def test_messages_beside_a_chunk_do_not_become_a_part_of_it(
    pack: str, checked: bool, run: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("pipeline.io.readers.mcap_file.LOOSE_RUN", run)
    raw = mcap_message(3) + mcap_message(4)
    packed = zstandard.ZstdCompressor().compress(raw) if pack else raw
    crc = zlib.crc32(raw) if checked else 0
    head = struct.pack("<QQQI", 0, 0, len(raw), crc) + struct.pack("<I", len(pack)) + pack.encode()
    chunk = mcap_record(Opcode.CHUNK, head + struct.pack("<Q", len(packed)) + packed)
    channel = mcap_record(Opcode.CHANNEL, CHANNEL)
    content = [
        *(channel, mcap_message(0), mcap_message(1), channel, mcap_message(2)),
        *(chunk, mcap_message(5), mcap_message(6), channel, mcap_message(7)),
        *(mcap_record(Opcode.DATA_END, bytes(4)), mcap_record(Opcode.FOOTER, bytes(20))),
    ]
    path, losses = tmp_path / "run.mcap", dict[str, int]()
    path.write_bytes(MAGIC + b"".join(content) + MAGIC)
    with closing(McapFile(path)) as container:
        payloads = [message.payload for message in container.messages({1}, None, losses)]
        assert payloads == [bytes([k]) for k in range(8)]
        assert (container.damage, losses) == ({}, {})


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
