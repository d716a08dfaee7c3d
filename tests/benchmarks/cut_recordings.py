"""The real scans of a ROS recording, cut to their first points and written again by independent libraries.

Whole scans compressed by bzip2 take a quarter of a second to decompress, which would dominate the time of
thousands of copies. In compressed parts, a checksum or the compression itself detects most damage; in parts
that are not compressed, damage reaches the reader of the messages.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

POINTS, SCANS = 1000, 2
_TYPE = "sensor_msgs/msg/PointCloud2"
_CHUNK = 20_000  # bytes: two scans to each, so that there are several


def bag_of(recording: Path, out: Path, *, packed: bool) -> bytes:
    """The scans as a ROS 1 bag, its chunks packed by bzip2 or not at all."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(out)
    writer.chunk_threshold = _CHUNK
    if packed:
        writer.set_compression(BagWriter.CompressionFormat.BZ2)
    with writer:
        channels: dict[str, Any] = {}
        for topic, log_ns, cloud in _clouds(recording):
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, _TYPE, typestore=store)
            header = store.types["std_msgs/msg/Header"](
                seq=0, stamp=cloud.header.stamp, frame_id=cloud.header.frame_id
            )
            again = store.types[_TYPE](**{**_fields(cloud), "header": header})
            writer.write(channels[topic], log_ns, store.serialize_ros1(again, _TYPE))
    return _taken(out)


def plain_mcap_of(recording: Path, out: Path) -> bytes:
    """The scans as MCAP of ROS 2 messages, neither packed nor with checksums."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = store.generate_msgdef(_TYPE, ros_version=2)
    with out.open("wb") as file:
        writer = McapWriter(file, chunk_size=_CHUNK, compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="ros2")
        schema = writer.register_schema(_TYPE, "ros2msg", definition.encode())
        channels: dict[str, int] = {}
        for topic, log_ns, cloud in _clouds(recording):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            content = bytes(store.serialize_cdr(cloud, _TYPE))
            writer.add_message(channels[topic], log_ns, content, log_ns)
        writer.finish()
    return _taken(out)


def short_db3(recording: Path, out: Path) -> bytes:
    """The first messages of a db3 bag, left over by SQLite."""
    shutil.copyfile(recording, out)
    out.chmod(0o600)
    with closing(sqlite3.connect(out, isolation_level=None)) as database:
        database.execute(
            "DELETE FROM messages WHERE rowid NOT IN (SELECT rowid FROM messages ORDER BY rowid LIMIT ?)",
            (SCANS,),
        )
        database.execute("VACUUM")
    return _taken(out)


def short_pcap(capture: bytes, share: float) -> bytes:
    """The first packets of a capture that is little endian, in whole packets."""
    at = 24
    while at + 16 <= share * len(capture):
        at += 16 + int.from_bytes(capture[at + 8 : at + 12], "little")
    return capture[:at]


def _clouds(recording: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of writing [ns] and the cloud of the first points of each scan, as a ROS 2 message."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([recording], default_typestore=store) as reader:
        for connection, log_ns, raw in reader.messages():
            if connection.msgtype != _TYPE:
                continue
            cloud: Any = reader.deserialize(raw, connection.msgtype)
            size = POINTS * cloud.point_step
            cut = {"width": POINTS, "height": 1, "row_step": size, "data": cloud.data[:size]}
            yield connection.topic, log_ns, store.types[_TYPE](**{**_fields(cloud), **cut})


def _fields(cloud: Any) -> dict[str, Any]:
    return {name: getattr(cloud, name) for name in cloud.__dataclass_fields__ if not name.startswith("_")}


def _taken(path: Path) -> bytes:
    content = path.read_bytes()
    path.unlink()
    return content
