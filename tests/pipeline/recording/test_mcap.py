"""A recording, read back by independent libraries."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.simulated import open_simulated
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.io.recording.messages import Message
from pipeline.types.records import Imu, Odometry, Record, Scan, Sensor, Truth, TruthPath, TruthTrees

URI = "sim:stand?duration=1&seed=2"
NUMPY = {2: "u1", 4: "<u2", 5: "<i4", 7: "<f4"}


def write(path: Path, records: Iterable[Record] | None = None) -> int:
    source = open_simulated(URI)
    return write_recording(
        path,
        source.records() if records is None else records,
        sensor=source.description.sensor,
        T_base_lidar=source.description.T_base_lidar,
        truth=source.truth(),
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    write(path)
    return path


def stamp_of(message: Message) -> int:
    return int(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)


def table_of(cloud: Message) -> NDArray[np.void]:
    dtype = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [NUMPY[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.point_step * cloud.width == len(cloud.data)
    table: NDArray[np.void] = cloud.data.view(dtype)
    return table


def messages_of(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time and message by the types that the file itself defines."""
    with AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            yield connection.topic, time_ns, reader.deserialize(raw, connection.msgtype)


def test_every_record_comes_back_exactly(recording):
    records = list(open_simulated(URI).records())
    scans = [record for record in records if isinstance(record, Scan)]
    poses = [record for record in records if isinstance(record, Odometry)]
    readings = [record for record in records if isinstance(record, Imu)]
    got: dict[str, list[tuple[int, Any]]] = {}
    for topic, time_ns, message in messages_of(recording):
        got.setdefault(topic, []).append((time_ns, message))
    for scan, (time_ns, cloud) in zip(scans, got["/velodyne_points"], strict=True):
        assert time_ns == stamp_of(cloud) == scan.stamp_ns
        assert cloud.header.frame_id == "velodyne"
        table = table_of(cloud)
        np.testing.assert_array_equal(np.stack([table[axis] for axis in "xyz"], axis=1), scan.points)
        np.testing.assert_array_equal(table["intensity"], scan.reflectance)
        np.testing.assert_array_equal(table["ring"], scan.ring)
        np.testing.assert_array_equal(table["t"], scan.offset_ns)
        assert scan.offset_ns is not None
        np.testing.assert_allclose(table["time"], scan.offset_ns / 1e9, atol=1e-8)
    for record, (_, message) in zip(poses, got["/odom"], strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        assert stamp_of(message) == record.stamp_ns
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = Pose3.from_quaternion([p.x, p.y, p.z], [q.w, q.x, q.y, q.z])
        np.testing.assert_array_equal(pose.t, record.T_odom_base.t)
        np.testing.assert_allclose(pose.R, record.T_odom_base.R, atol=1e-15)
    for reading, (_, message) in zip(readings, got["/imu/data"], strict=True):
        assert stamp_of(message) == reading.stamp_ns
        w, a, q = message.angular_velocity, message.linear_acceleration, message.orientation
        np.testing.assert_array_equal([w.x, w.y, w.z], reading.angular_velocity)
        np.testing.assert_array_equal([a.x, a.y, a.z], reading.linear_acceleration)
        np.testing.assert_array_equal([q.w, q.x, q.y, q.z], reading.orientation)


def test_frames_hang_together(recording):
    chain: dict[tuple[str, str], list[Any]] = {}
    for topic, _, message in messages_of(recording):
        if topic in ("/tf", "/tf_static"):
            (moved,) = message.transforms
            chain.setdefault((moved.header.frame_id, moved.child_frame_id), []).append(moved.transform)
    assert set(chain) == {("odom", "base_link"), ("base_link", "velodyne")}
    (mounting,) = chain["base_link", "velodyne"]
    assert (mounting.translation.x, mounting.translation.z) == (0.1, 0.8)
    assert len(chain["odom", "base_link"]) == 51


def test_the_file_is_what_foxglove_and_ros_expect(recording):
    with recording.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert {index.compression for index in summary.chunk_indexes} == {"lz4"}
        # A chunk ends with the message that fills it.
        assert max(index.uncompressed_size for index in summary.chunk_indexes) < 2 << 20
        counts: Counter[str] = Counter()
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert message.log_time == message.publish_time
            assert message.sequence == counts[channel.topic]
            counts[channel.topic] += 1
        assert counts == {"/velodyne_points": 10, "/odom": 51, "/tf": 51, "/imu/data": 101, "/tf_static": 1}
        cloud = next(s for s in summary.schemas.values() if s.name == "sensor_msgs/msg/PointCloud2")
        assert b"MSG: sensor_msgs/PointField" in cloud.data
        assert b"MSG: std_msgs/Header" in cloud.data


def test_the_mounting_is_latched_and_nothing_else(recording):
    with recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for channel in summary.channels.values():
        (profile,) = YAML(typ="safe").load(channel.metadata["offered_qos_profiles"])
        assert len(profile) == 9
        assert (profile["durability"] == 1) == (channel.topic == "/tf_static")
        assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}


def test_the_types_are_those_of_ros(recording):
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([recording]) as reader:
        for connection in reader.connections:
            ours = reader.typestore.hash_rihs01(connection.msgtype)
            assert ours == store.hash_rihs01(connection.msgtype)


def test_the_truth_is_attached(recording):
    with recording.open("rb") as stream:
        (attachment,) = make_reader(stream).iter_attachments()
    assert (attachment.name, attachment.media_type) == ("stemmap_truth.json", "application/json")
    content = json.loads(attachment.data)
    source = open_simulated(URI)
    trees, path = source.truth().trees, source.truth().path
    assert trees is not None
    assert path is not None
    assert content["version"] == 1
    assert content["sensor"]["rings"] == 16
    assert content["trees"]["x"] == trees.x.tolist()
    assert content["trees"]["kind"] == list(trees.kind)
    dbh = [np.nan if value is None else value for value in content["trees"]["dbh"]]
    np.testing.assert_array_equal(dbh, trees.dbh)
    assert content["path"]["stamp_ns"] == path.stamp_ns.tolist()
    assert content["path"]["yaw"] == path.yaw.tolist()


def test_same_run_same_bytes(recording, tmp_path):
    again = tmp_path / "again.mcap"
    write(again)
    assert again.read_bytes() == recording.read_bytes()


def test_a_run_that_fails_leaves_no_file(tmp_path):
    def broken() -> Iterator[Record]:
        yield from list(open_simulated(URI).records())[:20]
        raise RuntimeError("the source broke")

    with pytest.raises(RuntimeError, match="broke"):
        write(tmp_path / "run.mcap", broken())
    assert list(tmp_path.iterdir()) == []


def test_a_time_before_1970_or_after_2038_is_refused(tmp_path):
    for stamp in (-1, 2**31 * 1_000_000_000):
        with pytest.raises(StemmapError, match="1970 and 2038"):
            write(tmp_path / "run.mcap", [Odometry(stamp, Pose3.identity())])
    assert list(tmp_path.iterdir()) == []


def test_columns_that_a_scan_lacks_are_left_out(tmp_path):
    path = tmp_path / "bare.mcap"
    bare = Scan(5_000_000_000, np.array([[1.0, 2.0, 3.0]], dtype=np.float32))
    before = Scan(
        6_000_000_000, np.ones((2, 3), dtype=np.float32), offset_ns=np.array([-50_000_000, 0], np.int32)
    )
    empty = Scan(7_000_000_000, np.empty((0, 3), dtype=np.float32))
    level = Imu(8_000_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    assert write(path, [bare, before, empty, level]) == 5
    clouds = [message for topic, _, message in messages_of(path) if topic == "/velodyne_points"]
    assert [field.name for field in clouds[0].fields] == ["x", "y", "z"]
    assert table_of(clouds[1])["t"].tolist() == [-50_000_000, 0]
    assert clouds[2].width == 0
    (unit,) = (message for topic, _, message in messages_of(path) if topic == "/imu/data")
    assert unit.orientation_covariance[0] == -1.0


def test_a_path_in_another_frame_is_not_passed_off_as_truth(tmp_path):
    path = tmp_path / "run.mcap"
    trees = TruthTrees(np.array([1.0]), np.array([2.0]), np.array([np.nan]), ("tree",))
    gnss = TruthPath(np.array([0]), np.zeros(1), np.zeros(1), np.array([np.nan]), same_frame=False)
    write_recording(path, [], sensor=Sensor(), T_base_lidar=Pose3.identity(), truth=Truth(trees, gnss))
    with path.open("rb") as stream:
        (attachment,) = make_reader(stream).iter_attachments()
    content = json.loads(attachment.data)
    assert content["trees"]["dbh"] == [None]
    assert "path" not in content
