"""Livox: CustomMsg of both drivers in all containers and live, clouds with offset_time, line and tag."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.formats.livox import CustomMsgError, decode_custom
from app.robot.topics import Publisher, choose
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.base import Source
from pipeline.io.readers.container import Message
from pipeline.io.readers.live import ArrivalReader
from pipeline.io.readers.scan_columns import sensor_of, tag_noise
from pipeline.io.readers.sensor_families import CUSTOM_TYPES
from pipeline.io.readers.topics import POINT_CLOUD
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.livox_messages import COUNT, custom, rosette
from tests.pipeline.io.recordings import START_NS, Author, Write, write_recording

SCANS = 3


def scans_of(source: Source) -> list[Scan]:
    return [record for record in source.records() if isinstance(record, Scan)]


def check(scan: Scan, index: int) -> None:
    """The scan has all returns of a rosette except noise."""
    table = rosette(index)
    good = (table["x"] != 0.0) & (table["tag"] == 0x10)
    np.testing.assert_array_equal(scan.points[:, 0], table["x"][good])
    np.testing.assert_array_equal(scan.offset_ns, table["offset_time"][good])
    np.testing.assert_array_equal(scan.reflectance, table["reflectivity"][good])
    assert scan.ring is None
    assert scan.dropped == COUNT - np.count_nonzero(good)


@pytest.mark.parametrize("container", ["bag", "db3", "mcap"])
@pytest.mark.parametrize("kind", CUSTOM_TYPES)
def test_a_custom_message_is_read(container: str, kind: str, tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for k in range(SCANS):
            write("/livox/lidar", kind, START_NS + (k + 1) * 100_000_000, custom(author, kind, k))

    source = opened(write_recording(container, tmp_path, fill))
    scans = scans_of(source)
    assert [scan.stamp_ns - START_NS for scan in scans] == [0, 100_000_000, 200_000_000]
    for k, scan in enumerate(scans):
        check(scan, k)
    assert source.description.sensor.rings == 0


@pytest.mark.parametrize("late_ns", [-30_000_000, 0, 40_000_000, -(10**18)])
def test_points_are_after_the_time_base_if_it_is_of_the_same_clock(
    late_ns: int, tmp_path: Path, opened: Opened
):
    kind = CUSTOM_TYPES[1]

    def fill(author: Author, write: Write) -> None:
        for k in range(SCANS):
            stamp_ns = START_NS + k * 100_000_000
            write("/livox/lidar", kind, stamp_ns, custom(author, kind, k, stamp_ns + late_ns))

    scan = scans_of(opened(write_recording("mcap", tmp_path, fill)))[0]
    assert scan.offset_ns is not None
    assert scan.offset_ns[0] == 250_000 + (late_ns if late_ns > -(10**9) else 0)  # the first point is none


@pytest.mark.parametrize("kind", CUSTOM_TYPES)
def test_a_live_robot_sends_it(kind: str):
    author = Author("mcap")
    publishers = [Publisher("", "/livox/lidar", kind), Publisher("", "/odom", "nav_msgs/msg/Odometry")]
    choice = choose(publishers, "", {}, "here")
    assert choice is not None
    assert choice.channels[0].msgtype == kind
    reader = ArrivalReader("here", "live", list(choice.channels[:1]), SourceOptions())
    records = []
    for k in range(SCANS):
        payload = bytes(author.store.serialize_cdr(custom(author, kind, k), kind))
        records += reader.add(Message(1, START_NS + k * 100_000_000, payload))
    records += reader.finish()
    scans = [record for record in records if isinstance(record, Scan)]
    assert len(scans) == SCANS
    for k, scan in enumerate(scans):
        check(scan, k)


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
@given(frame=st.text(max_size=9), length=st.integers(0, 90))
def test_a_frame_of_any_length_moves_no_point_and_a_cut_message_is_refused(
    encoding: str, frame: str, length: int
):
    author, kind = Author("bag" if encoding == "ros1" else "mcap"), CUSTOM_TYPES[1]
    message = custom(author, kind, 0)
    short = message.points[:3]
    header = author.header(START_NS, frame.replace("\0", ""))
    whole = type(message)(header, 17, 3, 0, message.rsvd, short)
    serialize = author.store.serialize_ros1 if encoding == "ros1" else author.store.serialize_cdr
    payload = bytes(serialize(whole, kind))
    decoded = decode_custom(payload, encoding)
    assert decoded.frame == header.frame_id
    assert decoded.timebase_ns == 17
    np.testing.assert_array_equal(decoded.points["line"], [0, 1, 2])
    np.testing.assert_array_equal(decoded.points["x"], rosette(0)["x"][:3])
    with pytest.raises(CustomMsgError):
        decode_custom(payload[: min(length, len(payload) - 5)], encoding)


def test_an_empty_message_has_no_points():
    author, kind = Author("mcap"), CUSTOM_TYPES[0]
    message = custom(author, kind, 0)
    empty = type(message)(message.header, 0, 0, 0, message.rsvd, [])
    assert len(decode_custom(bytes(author.store.serialize_cdr(empty, kind)), "cdr").points) == 0


def test_tags_are_noise_only_if_most_points_have_none():
    assert tag_noise(np.array([0, 0x10, 0x20, 0x03], np.uint8)) is None
    np.testing.assert_array_equal(
        tag_noise(np.array([0, 0x01, 0x10, 0x18, 0], np.uint8)), [False, True, False, True, False]
    )
    assert tag_noise(np.full(9, 0x05, np.uint8)) is None
    assert tag_noise(np.zeros(0, np.uint8)) is None


@pytest.mark.parametrize("time", ["offset_time", "timestamp"])
def test_a_cloud_of_a_livox_has_times_and_no_rings(time: str, tmp_path: Path, opened: Opened):
    names = ["x", "y", "z", "intensity", "tag", "line", time]
    form = ["f4", "f4", "f4", "f4", "u1", "u1", "f8" if time == "timestamp" else "u4"]

    def fill(author: Author, write: Write) -> None:
        for k in range(SCANS):
            table, stamp_ns = rosette(k), START_NS + k * 100_000_000
            cloud = np.zeros(COUNT, [(n, f) for n, f in zip(names, form, strict=True)])
            for name in ("x", "y", "z", "tag", "line"):
                cloud[name] = table[name]
            cloud["intensity"] = table["reflectivity"]
            since = stamp_ns if time == "timestamp" else 0
            cloud[time] = table["offset_time"] + np.float64(since) if since else table["offset_time"]
            write("/livox/lidar", POINT_CLOUD, stamp_ns, author.cloud(stamp_ns, cloud, "livox_frame"))

    source = opened(write_recording("mcap", tmp_path, fill))
    scan = scans_of(source)[0]
    table = rosette(0)
    good = (table["x"] != 0.0) & (table["tag"] == 0x10)
    assert scan.ring is None
    assert scan.offset_ns is not None
    # A double holds times since 1970 to 256 ns.
    np.testing.assert_allclose(scan.offset_ns, table["offset_time"][good], atol=300)
    assert source.description.sensor.rings == 0


def test_lines_that_a_converter_calls_rings_are_none():
    table = rosette(0, 4000)
    table = table[table["x"] != 0.0]
    points = np.stack([table[axis] for axis in "xyz"], axis=1)
    lines = Scan(0, points, ring=table["line"].astype(np.int32))
    assert sensor_of(lines).rings == 0


@pytest.mark.parametrize("tilt", [0.0, 30.0])
def test_rings_of_a_tilted_cloud_remain_rings(tilt: float):
    azimuth, ring = np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.4)), np.arange(32))
    elevation = np.radians(ring - 16.0)
    level = np.cos(elevation)
    points = 8.0 * np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    turned = points.reshape(-1, 3) @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    assert sensor_of(Scan(0, turned.astype(np.float32), ring=ring.ravel().astype(np.int32))).rings == 32


def test_a_custom_message_comes_before_a_cloud_that_may_be_derived_from_it(tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for k in range(SCANS):
            stamp_ns = START_NS + k * 100_000_000
            write("/livox/lidar", CUSTOM_TYPES[0], stamp_ns, custom(author, CUSTOM_TYPES[0], k))
            cloud = author.cloud(stamp_ns, rosette(k), "camera_init")
            write("/cloud_registered", POINT_CLOUD, stamp_ns, cloud)

    topics = opened(write_recording("bag", tmp_path, fill)).description.topics
    assert [topic.name for topic in topics if topic.read_as == "scan"] == ["/livox/lidar"]
    assert all(a.name < b.name for a, b in pairwise(topics))


def test_the_range_of_ouster_tells_what_is_no_return(tmp_path: Path, opened: Opened):
    """A driver that moves its cloud to another frame moves what is no return too."""
    names = ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"]
    form = ["f4", "f4", "f4", "f4", "u4", "u2", "u1", "u2", "u4"]
    azimuth, ring = np.meshgrid(np.radians(np.arange(0.0, 360.0, 2.0)), np.arange(64))
    cloud = np.zeros(azimuth.shape, [(n, f) for n, f in zip(names, form, strict=True)])
    cloud["x"], cloud["y"] = 5.0 * np.cos(azimuth), 5.0 * np.sin(azimuth)
    cloud["z"] = 5.0 * np.tan(np.radians(0.5 * ring - 16.0)) + 0.9
    cloud["range"], cloud["ring"] = 5000, ring
    cloud["t"] = np.arange(180) * 555_555
    cloud["range"][:, ::4] = 0
    cloud["x"][:, ::4], cloud["y"][:, ::4], cloud["z"][:, ::4] = 0.2, 0.0, 0.9
    flat = cloud.reshape(-1)

    def fill(author: Author, write: Write) -> None:
        message = author.cloud(
            START_NS, flat, "base_link", height=64, width=180, row_step=180 * flat.itemsize
        )
        write("/ouster/points", POINT_CLOUD, START_NS, message)

    source = opened(write_recording("mcap", tmp_path, fill))
    (scan,) = scans_of(source)
    assert len(scan.points) == 64 * 135
    assert scan.dropped == 64 * 45
    assert source.description.sensor.rings == 64
    assert scan.offset_ns is not None
    assert scan.offset_ns.max() == 179 * 555_555
