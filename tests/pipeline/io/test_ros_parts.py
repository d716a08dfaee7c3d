"""Parts of ROS recordings: clocks, order, compressed chunks, transforms."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.container import BrokenChunkError, Channel, plain, unpack
from pipeline.io.readers.mcap_file import MAGIC, MESSAGE_HEAD, RECORD, McapFile
from pipeline.io.readers.message_time import WINDOW_NS, Stamped, in_order_of_stamps
from pipeline.io.readers.topics import POINT_CLOUD, choose_topics
from pipeline.io.readers.transforms import TransformTree
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, drive, points_of, write_recording


def mcap_of(path: Path, payloads: list[bytes], *, pack: CompressionType, index: bool = True) -> None:
    """An MCAP with one topic of clouds."""
    with path.open("wb") as file:
        writer = Writer(file, compression=pack, use_chunking=index, use_statistics=index)
        writer.start("ros2", "")
        schema = writer.register_schema(POINT_CLOUD, "ros2msg", b"")
        channel = writer.register_channel("/points", "cdr", schema)
        for index_, payload in enumerate(payloads):
            writer.add_message(channel, START_NS + index_ * STEP_NS, payload, START_NS)
        writer.finish()


def cloud_payloads(count: int) -> list[bytes]:
    """Clouds in the standard definition."""
    author = Author("mcap")
    clouds = [author.cloud(START_NS + k * STEP_NS, points_of(k)) for k in range(count)]
    return [bytes(author.store.serialize_cdr(cloud, POINT_CLOUD)) for cloud in clouds]


@pytest.mark.parametrize("pack", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
@pytest.mark.parametrize("index", [True, False])
def test_every_packing_with_and_without_an_index_is_read(
    pack: CompressionType, index: bool, tmp_path: Path, opened: Opened
):
    path = tmp_path / "run.mcap"
    mcap_of(path, cloud_payloads(5), pack=pack, index=index)
    source = opened(path)
    assert source.description.scans == len(list(source.records())) == 5


def test_chunks_behind_a_damaged_length_are_found_by_the_summary(tmp_path: Path, opened: Opened):
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1, compression=CompressionType.LZ4)
        writer.start("ros2", "")
        channel = writer.register_channel(
            "/points", "cdr", writer.register_schema(POINT_CLOUD, "ros2msg", b"")
        )
        for k, payload in enumerate(cloud_payloads(6)):
            writer.add_message(channel, START_NS + k * STEP_NS, payload, START_NS)
        writer.finish()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    second = sorted(chunk.chunk_start_offset for chunk in summary.chunk_indexes)[1]
    content = bytearray(path.read_bytes())
    content[second + 1 : second + 9] = b"\xff" * 8
    path.write_bytes(content)
    source = opened(path)
    stamps = [(record.stamp_ns - START_NS) // STEP_NS for record in source.records()]
    assert stamps == [0, 2, 3, 4, 5]
    assert list(source.losses) == ["bytes between damaged records"]
    assert any("cut or damaged" in warning for warning in source.description.warnings)


def test_a_chunk_of_too_many_empty_messages_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    most = 1000  # the limit itself, a million, takes ten seconds
    monkeypatch.setattr("pipeline.io.readers.container.MOST_IN_CHUNK", most)
    message = RECORD.pack(Opcode.MESSAGE, 22) + MESSAGE_HEAD.pack(1, 0, START_NS, START_NS)
    raw = message * (most + 10)
    packed = zstandard.ZstdCompressor().compress(raw)
    head = struct.pack("<QQQII4sQ", START_NS, START_NS, len(raw), 0, 4, b"zstd", len(packed))
    path = tmp_path / "run.mcap"
    channel = struct.pack("<HHI7sI3sI", 1, 0, 7, b"/points", 3, b"cdr", 0)
    records = [(Opcode.CHANNEL, channel), (Opcode.CHUNK, head + packed)]
    content = b"".join(RECORD.pack(opcode, len(record)) + record for opcode, record in records)
    path.write_bytes(MAGIC + content)
    losses: dict[str, int] = {}
    with closing(McapFile(path)) as container:
        assert sum(1 for _ in container.messages({1}, None, losses)) <= most
        assert container.damage["chunks of the recording damaged in part"] == 1
        assert losses == {}


def test_messages_packed_one_by_one_are_read(tmp_path: Path, opened: Opened):
    payloads = [zstandard.ZstdCompressor().compress(payload) for payload in cloud_payloads(3)]
    path = tmp_path / "run.mcap"
    mcap_of(path, payloads, pack=CompressionType.NONE)
    source = opened(path)
    assert len(list(source.records())) == 3
    assert source.losses == {}


def test_times_of_writing_serve_where_stamps_do_not(tmp_path: Path, opened: Opened):
    def unstamped(author, write):
        for k in range(3):
            cloud = author.cloud(0, points_of(k))
            write("/points", "sensor_msgs/msg/PointCloud2", START_NS + k * STEP_NS, cloud)

    source = opened(write_recording("db3", tmp_path, unstamped))
    stamps = [record.stamp_ns for record in source.records()]
    np.testing.assert_allclose(np.array(stamps) - START_NS, STEP_NS * np.arange(3), atol=100_000)
    assert "times of recording" in " ".join(source.description.warnings)


def test_a_database_that_does_not_name_the_serialization_is_read_as_cdr(tmp_path: Path, opened: Opened):
    folder = write_recording("db3", tmp_path, drive)
    whole = [record.stamp_ns for record in opened(folder).records()]
    (path,) = folder.glob("*.db3")
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "UPDATE topics SET serialization_format = '' WHERE name IN ('/velodyne_points', '/odom')"
        )
        database.commit()
    source = opened(folder)
    assert [record.stamp_ns for record in source.records()] == whole
    assert source.description.warnings == (
        "the recording does not name the serialization format of /odom, /velodyne_points: CDR is assumed",
    )


def test_a_single_impossible_stamp_is_replaced_by_the_time_of_recording(tmp_path: Path, opened: Opened):
    def stamped(author, write):
        for k in range(4):
            stamp_ns = START_NS + k * STEP_NS + (10**15 if k == 1 else 0)
            cloud = author.cloud(stamp_ns, points_of(k))
            write("/points", "sensor_msgs/msg/PointCloud2", START_NS + k * STEP_NS, cloud)

    source = opened(write_recording("bag", tmp_path, stamped))
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert [(scan.stamp_ns - START_NS) // STEP_NS for scan in scans] == [0, 1, 2, 3]
    assert not source.losses


def test_without_a_transform_the_mounting_is_taken_as_none_and_said(tmp_path: Path, opened: Opened):
    def bare(author, write):
        for k in range(2):
            stamp_ns = START_NS + k * STEP_NS
            write("/odom", "nav_msgs/msg/Odometry", stamp_ns, author.odometry(stamp_ns, 0.0, 0.0))
            write("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, points_of(k)))

    known = opened(write_recording("mcap", tmp_path, bare)).description
    np.testing.assert_array_equal(known.T_base_lidar.R, np.eye(3))
    assert known.warnings == (
        "no fixed transform from velodyne to base_link: the LiDAR is assumed to be at the base",
    )


@pytest.mark.parametrize("child", ["vehicle", "robot1/base_link"])
def test_odometry_of_an_unknown_frame_is_that_of_the_base_to_which_the_lidar_is_mounted(
    child: str, tmp_path: Path, opened: Opened
):
    def other(author, write):
        mounting = author.transforms(START_NS, ("base_link", "velodyne", (0.5, 0.0, 1.0, 0.0)))
        write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, mounting)
        for k in range(2):
            stamp_ns = START_NS + k * STEP_NS
            write("/odom", "nav_msgs/msg/Odometry", stamp_ns, author.odometry(stamp_ns, 0.1 * k, 0.0, child))
            write("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, points_of(k)))

    source = opened(write_recording("mcap", tmp_path, other))
    np.testing.assert_allclose(source.description.T_base_lidar.t, (0.5, 0.0, 1.0))
    assert source.description.warnings == (
        f"no fixed transform from {child} to base_link: both are taken as the same frame",
    )
    odometry = [record for record in source.records() if isinstance(record, Odometry)]
    assert odometry[-1].T_odom_base.t[0] == pytest.approx(0.1)


def test_transforms_of_the_odometry_that_cannot_be_read_are_counted(tmp_path: Path, opened: Opened):
    path, kind = tmp_path / "run.mcap", "tf2_msgs/msg/TFMessage"
    author = Author("mcap")
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "")
        points, moving = (
            writer.register_channel(topic, "cdr", writer.register_schema(name, "ros2msg", b""))
            for topic, name in (("/points", POINT_CLOUD), ("/tf", kind))
        )
        for k, cloud in enumerate(cloud_payloads(5)):
            stamp_ns = START_NS + k * STEP_NS
            reach = np.nan if k == 3 else 0.1 * k
            links = ("odom", "base_link", (reach, 0.0, 0.0, 0.0)), ("base_link", "wheel", (np.nan,) * 4)
            payload = bytes(author.store.serialize_cdr(author.transforms(stamp_ns, *links), kind))
            writer.add_message(moving, stamp_ns, payload[:20] if k == 2 else payload, stamp_ns)
            writer.add_message(points, stamp_ns, cloud, stamp_ns)
        writer.finish()
    source = opened(path)
    poses = [record for record in source.records() if isinstance(record, Odometry)]
    np.testing.assert_allclose([pose.T_odom_base.t[0] for pose in poses], [0.0, 0.1, 0.4])
    assert source.losses == {"transforms that cannot be read": 2}


def test_rings_numbered_from_above_are_turned_round(tmp_path: Path, opened: Opened):
    def turned(author, write):
        table = points_of(0)
        table["ring"] = 15 - table["ring"]
        write("/points", "sensor_msgs/msg/PointCloud2", START_NS, author.cloud(START_NS, table))

    (scan,) = opened(write_recording("mcap", tmp_path, turned)).records()
    assert isinstance(scan, Scan)
    np.testing.assert_array_equal(scan.ring, np.delete(points_of(0)["ring"], [3, 5]))


def test_reading_twice_gives_the_same_and_losses_do_not_add_up(tmp_path: Path, opened: Opened):
    source = opened(write_recording("db3", tmp_path, drive))
    first = [record.stamp_ns for record in source.records()]
    assert first == [record.stamp_ns for record in source.records()]
    assert source.losses == {}


@given(st.lists(st.tuples(st.integers(0, 10 * WINDOW_NS), st.integers(0, WINDOW_NS)), max_size=60))
def test_what_comes_less_than_a_second_late_finds_its_place(arrivals: list[tuple[int, int]]):
    ordered = sorted(arrivals, key=lambda arrival: arrival[0] + arrival[1])
    losses: dict[str, int] = {}
    sorted_ = list(in_order_of_stamps([Stamped(stamp, 0, stamp) for stamp, _late in ordered], losses))
    assert [stamped.content for stamped in sorted_] == sorted(stamp for stamp, _late in arrivals)
    assert losses == {}


def test_what_comes_too_late_is_counted():
    losses: dict[str, int] = {}
    stamps = [0, 3 * WINDOW_NS, 1, 5 * WINDOW_NS]
    kept = [s.content for s in in_order_of_stamps([Stamped(stamp, 0, stamp) for stamp in stamps], losses)]
    assert kept == [0, 1, 3 * WINDOW_NS, 5 * WINDOW_NS]
    kept = [
        s.content
        for s in in_order_of_stamps(
            [Stamped(stamp, 0, stamp) for stamp in [*stamps, 7 * WINDOW_NS, 2]], losses
        )
    ]
    assert kept == [0, 1, 3 * WINDOW_NS, 5 * WINDOW_NS, 7 * WINDOW_NS]
    assert losses == {"records that came too late to be put in order": 1}


def test_what_was_recorded_across_a_gap_finds_its_place():
    losses: dict[str, int] = {}
    stamps = [*range(0, 2 * WINDOW_NS, WINDOW_NS // 4), 9 * WINDOW_NS, 2 * WINDOW_NS - 3, 10 * WINDOW_NS + 1]
    kept = [s.content for s in in_order_of_stamps([Stamped(stamp, 0, stamp) for stamp in stamps], losses)]
    assert kept == sorted(stamps)
    assert losses == {}


def test_one_time_in_the_future_delays_no_others():
    arrived = list[int]()

    def arrivals() -> Iterator[Stamped[int]]:
        for k in range(200):
            arrived.append(k)
            yield Stamped(1000 * WINDOW_NS if k == 50 else k * WINDOW_NS // 4, 0, k)

    kept = list[int]()
    for stamped in in_order_of_stamps(arrivals(), {}):
        kept.append(stamped.content)
        assert stamped.content == 50 or len(arrived) - stamped.content <= 8
    assert kept == [*range(50), *range(51, 200), 50]


PACKERS = {
    "lz4": lz4.frame.compress,
    "zstd": zstandard.ZstdCompressor().compress,
    "bz2": bz2.compress,
    "": bytes,
}


@pytest.mark.parametrize("name", PACKERS)
def test_blocks_are_unpacked_to_the_promised_size_only(name: str):
    content = bytes(1000) + b"end"
    packed = PACKERS[name](content)
    assert unpack(packed, name, len(content)) == content
    for size in (0, 1002, 1004, 1 << 40):
        with pytest.raises(BrokenChunkError):
            unpack(packed, name, size)
    with pytest.raises(BrokenChunkError):
        unpack(packed[: len(packed) // 2], name, len(content))


def test_a_truncated_payload_is_damaged():
    content = bytes(range(256)) * 2000
    packed = zstandard.ZstdCompressor().compress(content)
    assert plain(packed) == content
    assert plain(packed[: len(packed) // 2]) == b""
    assert plain(content) == content


@pytest.mark.parametrize("name", ["lz4", "zstd", "bz2"])
def test_a_bomb_is_not_unpacked_beyond_its_promise(name: str):
    with pytest.raises(BrokenChunkError, match="another size"):
        unpack(PACKERS[name](bytes(64 << 20)), name, 1000)


@pytest.mark.parametrize("name", ["xz", "zlib"])
def test_unknown_packings_are_refused(name: str):
    with pytest.raises(BrokenChunkError, match="unknown compression"):
        unpack(zlib.compress(b"x"), name, 1)


def test_transforms_are_chained_over_the_fewest_links():
    tree = TransformTree()
    steps = [Pose3.from_euler([1.0, 0.1 * k, 0.0], 0.1, 0.0, 0.3) for k in range(3)]
    for k, step in enumerate(steps):
        tree.add(f"f{k}", f"f{k + 1}", step)
    chain = tree.find("f0", "f3")
    assert chain is not None
    np.testing.assert_allclose(chain.t, (steps[0] @ steps[1] @ steps[2]).t, atol=1e-12)
    back = tree.find("f3", "f0")
    assert back is not None
    np.testing.assert_allclose((back @ chain).t, 0.0, atol=1e-12)
    assert tree.find("f0", "elsewhere") is None


@pytest.mark.parametrize(
    ("counts", "wanted", "why_not"),
    [
        ((5, 3), {}, ["", "/a has more messages"]),
        ((5, 5), {}, ["", "/a has as many messages, and is taken"]),
        ((3, 5), {}, ["/b has more messages", ""]),
        ((3, 5), {"scan": "/a"}, ["", "/a was named"]),
        ((5, 0), {}, ["", "no message in it"]),
    ],
)
def test_the_reason_why_a_topic_is_not_read_compares_numbers_of_messages(
    counts: tuple[int, int], wanted: dict[str, str], why_not: list[str]
):
    channels = [
        Channel(k, name, POINT_CLOUD, "cdr", count)
        for k, (name, count) in enumerate(zip(("/a", "/b"), counts, strict=True))
    ]
    assert [topic.why_not for topic in choose_topics(channels, wanted, "run").recorded()] == why_not
