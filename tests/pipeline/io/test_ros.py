"""ROS recordings: real ones, and written ones of known content."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.container import Channel
from pipeline.io.readers.topics import choose_topics
from pipeline.types.records import Imu, Odometry, Scan
from tests.benchmarks.mutating import read_all
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import (
    SCANS,
    START_NS,
    STEP_NS,
    Author,
    Write,
    drive,
    points_of,
    write_recording,
)
from tests.pipeline.io.test_bad_input import mutations

KINDS = ["bag", "db3", "mcap"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("vlp16_ros1.bag", "ROS 1 bag"),
        ("vlp16_ros2_mcap", "ROS 2 MCAP"),
        ("vlp16_ros2_mcap/vlp16_ros2_mcap.mcap", "ROS 2 MCAP"),
    ],
)
def test_real_clouds_are_read(opened: Opened, name: str, kind: str, shared_data: Path):
    source = opened(shared_data / "velodyne" / name)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert source.description.kind == kind
    assert source.description.sensor.name == "VLP-16"
    assert not source.description.has_odometry
    assert [len(scan.points) for scan in scans] == [14981, 14845, 14868, 14720]
    assert source.description.scans == len(scans)
    assert [source.description.start_ns, source.description.end_ns] == [scans[0].stamp_ns, scans[-1].stamp_ns]
    assert np.all(np.diff([scan.stamp_ns for scan in scans]) > 90_000_000)
    assert source.losses == {}


@pytest.mark.parametrize("name", ["vlp16_rosbag2", "vlp16_rosbag2/1673400471837873222_0.db3"])
def test_real_packets_in_a_bag_give_the_clouds_of_the_driver(opened: Opened, name: str, shared_data: Path):
    source = opened(shared_data / "velodyne" / name)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    decoded = list(opened(shared_data / "velodyne" / "vlp16_ros1.bag").records())
    assert source.description.sensor.rings == 16
    assert len(scans) == 4
    for scan, other in zip(scans, decoded, strict=True):
        assert isinstance(other, Scan)
        ours = {tuple(point) for point in scan.points.tolist()}
        shared = sum(tuple(point) in ours for point in other.points.tolist())
        # The two cut the stream of packets at another place, by one packet at most.
        assert shared > 0.98 * len(other.points)
        assert scan.ring is not None
        assert scan.offset_ns is not None
        assert 0 <= scan.ring.min() <= scan.ring.max() <= 15
        assert np.abs(scan.offset_ns).max() < 110_000_000


@pytest.mark.parametrize("odometry", ["topic", "transform"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_written_drive_is_read_back(opened: Opened, kind: str, odometry: str, tmp_path: Path):
    source = opened(write_recording(kind, tmp_path, partial(drive, odometry=odometry)))
    known = source.description
    assert (known.scans, known.has_odometry, known.has_imu) == (SCANS, True, True)
    assert (known.start_ns, known.end_ns) == (START_NS, START_NS + (SCANS - 1) * STEP_NS)
    np.testing.assert_allclose(known.T_base_lidar.t, [0.5, 0.0, 1.0])
    assert known.sensor.rings == 16
    assert known.sensor.ring_step == pytest.approx(np.radians(2.0), abs=1e-6)
    assert known.sensor.azimuth_step == pytest.approx(np.radians(2.0), abs=1e-6)
    records = list(source.records())
    assert [record.stamp_ns for record in records] == sorted(record.stamp_ns for record in records)
    scans = [record for record in records if isinstance(record, Scan)]
    for index, scan in enumerate(scans):
        assert scan.stamp_ns == START_NS + index * STEP_NS
        assert scan.dropped == 2
        kept = np.delete(points_of(index), [3, 5])
        np.testing.assert_array_equal(scan.points, np.stack([kept[axis] for axis in "xyz"], axis=1))
        np.testing.assert_array_equal(scan.ring, kept["ring"])
        assert scan.offset_ns is not None
        np.testing.assert_allclose(scan.offset_ns.astype(np.float64), kept["time"] * 1e9, atol=10)
    poses = [record for record in records if isinstance(record, Odometry)]
    np.testing.assert_allclose([pose.T_odom_base.t[0] for pose in poses], 0.01 * np.arange(SCANS * 5))
    readings = [record for record in records if isinstance(record, Imu)]
    # The IMU stands a quarter turn to the left on the base: its x is the base's y.
    np.testing.assert_allclose(readings[0].angular_velocity, [-0.2, 0.1, 0.3], atol=1e-12)
    orientation = readings[0].orientation
    assert orientation is not None
    np.testing.assert_allclose(orientation, [np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)], atol=1e-9)
    assert source.losses == {}


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_topic_is_told_with_the_topics_that_are_there(opened: Opened, kind: str, tmp_path: Path):
    def talk(author, write):
        write("/chatter", "std_msgs/msg/String", START_NS, author.make("String", "hello"))

    path = str(write_recording(kind, tmp_path, talk))
    with pytest.raises(SourceError, match=r"no scans.*/chatter \[std_msgs/msg/String, 1\]"):
        opened(path)


@pytest.mark.parametrize(
    ("topic", "msgtype", "helps"),
    [
        ("/scan_multi", "sensor_msgs/msg/MultiEchoLaserScan", "which is not read: play it through"),
        ("/odom", "nav_msgs/msg/Odometry", "No topic of it is of a LiDAR"),
    ],
)
def test_without_scans_the_remedy_is_one_that_helps(topic: str, msgtype: str, helps: str):
    with pytest.raises(SourceError, match="no scans") as raised:
        choose_topics([Channel(1, topic, msgtype, "cdr", 5)], {}, "run")
    assert helps in raised.value.remedy


def test_a_topic_of_scans_without_messages_is_named():
    with pytest.raises(SourceError, match="no scans") as raised:
        choose_topics([Channel(1, "/points", "sensor_msgs/msg/PointCloud2", "cdr", 0)], {}, "run")
    assert "/points has no message" in raised.value.remedy


def test_a_part_that_is_only_there_compressed_is_told(opened: Opened, tmp_path: Path):
    folder = write_recording("db3", tmp_path, drive)
    (part,) = folder.glob("*.db3")
    (folder / f"{part.name}.zstd").write_bytes(b"as unpacking leaves it")
    assert opened(folder).description.scans == SCANS
    (folder / "notes.txt.zstd").write_bytes(b"not a part")
    assert opened(folder).description.scans == SCANS
    (folder / "run_1.db3.zstd").write_bytes(b"")
    with pytest.raises(SourceError, match=r"compressed.*zstd -d") as refusal:
        opened(folder)
    assert refusal.value.where == str(folder / "run_1.db3.zstd")


def test_topics_can_be_chosen_and_wrong_choices_are_told(opened: Opened, tmp_path: Path):
    def two(author, write):
        drive(author, write)
        for index in range(2):
            cloud = author.cloud(START_NS + index, points_of(0)[:200])
            write("/other", "sensor_msgs/msg/PointCloud2", START_NS + index, cloud)

    path = str(write_recording("mcap", tmp_path, two))
    assert opened(path).description.scans == SCANS
    assert opened(path, SourceOptions(topics={"scan": "/other"})).description.scans == 2
    with pytest.raises(SourceError, match=r"no topic /none; it has .*/other"):
        opened(path, SourceOptions(topics={"scan": "/none"}))
    with pytest.raises(SourceError, match="not of the type"):
        opened(path, SourceOptions(topics={"scan": "/odom"}))
    with pytest.raises(SourceError, match="not of the type sensor_msgs/msg/CompressedImage"):
        opened(path, SourceOptions(topics={"camera": "/other"}))
    with pytest.raises(SourceError, match="no role"):
        opened(path, SourceOptions(topics={"radar": "/other"}))


def test_the_mounting_that_the_user_gives_wins(opened: Opened, tmp_path: Path):
    mounted = Pose3.from_euler([1.0, 2.0, 3.0], 0.0, 0.1, 0.0)
    source = opened(write_recording("mcap", tmp_path, drive), SourceOptions(T_base_lidar=mounted))
    np.testing.assert_allclose(source.description.T_base_lidar.t, [1.0, 2.0, 3.0])


def test_bad_scans_are_counted_and_the_others_read(opened: Opened, tmp_path: Path):
    def spoiled(author, write):
        good = points_of(0)
        clouds = [
            author.cloud(START_NS, good),
            author.cloud(START_NS + 1, good, width=2**32 - 1),
            author.cloud(START_NS + 2, good, point_step=0),
            author.cloud(START_NS + 3, good, width=len(good) + 1),
            author.cloud(START_NS + 4, good[:0]),
            author.cloud(START_NS + 5, good[3:4]),
            author.cloud(START_NS + 6, good),
        ]
        for index, cloud in enumerate(clouds):
            write("/points", "sensor_msgs/msg/PointCloud2", START_NS + index, cloud)

    source = opened(write_recording("db3", tmp_path, spoiled))
    assert [record.stamp_ns - START_NS for record in source.records()] == [0, 6]
    assert source.losses == {"scans that cannot be read": 3, "scans without points": 2}


def test_a_topic_of_bad_scans_only_is_refused(opened: Opened, tmp_path: Path):
    def spoiled(author, write):
        for index in range(30):
            cloud = author.cloud(START_NS + index, points_of(0), point_step=7)
            write("/points", "sensor_msgs/msg/PointCloud2", START_NS + index, cloud)

    path = write_recording("bag", tmp_path, spoiled)
    with pytest.raises(SourceError, match=r"cannot be read.*topic /points"):
        opened(path)


def begin_with_nothing(author: Author, write: Write) -> None:
    """60 clouds without points, of which every third cannot be read, before the drive."""
    for k in range(60):
        stamp_ns = START_NS - (60 - k) * STEP_NS
        cloud = author.cloud(stamp_ns, points_of(0)[:0])
        if k % 3 == 0:
            cloud.width = 1000
        write("/velodyne_points", "sensor_msgs/msg/PointCloud2", stamp_ns, cloud)
    drive(author, write)


@pytest.mark.parametrize("kind", KINDS)
def test_empty_clouds_at_the_start_are_counted(kind: str, opened: Opened, tmp_path: Path):
    source = opened(write_recording(kind, tmp_path, begin_with_nothing))
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert [scan.stamp_ns for scan in scans] == [START_NS + k * STEP_NS for k in range(SCANS)]
    assert source.losses == {"scans without points": 40, "scans that cannot be read": 20}


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_cut_recording_gives_what_is_whole(opened: Opened, kind: str, tmp_path: Path):
    def long(author, write):
        for index in range(60):
            table = np.tile(points_of(index), 10)
            cloud = author.cloud(START_NS + index * STEP_NS, table)
            write("/points", "sensor_msgs/msg/PointCloud2", START_NS + index * STEP_NS, cloud)

    path = write_recording(kind, tmp_path, long)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    cut = tmp_path / f"cut.{kind}"
    cut.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.7)])
    source = opened(cut)
    scans = list(source.records())
    assert 20 <= len(scans) < 60
    assert "cut or damaged" in " ".join(source.description.warnings)
    assert sum(source.losses.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_drives_end_with_a_clear_error_or_with_losses(kind: str, tmp_path: Path):
    path = write_recording(kind, tmp_path, drive)
    file = path if path.is_file() else next(file for file in path.iterdir() if file.suffix == f".{kind}")
    content = file.read_bytes()
    damaged = tmp_path / f"damaged.{kind}"
    for mutation in mutations(content, seed=7):
        damaged.write_bytes(mutation)
        read_all(damaged)


def test_a_folder_with_a_broken_part_gives_the_other(opened: Opened, tmp_path: Path):
    folder = write_recording("mcap", tmp_path, drive)
    part = next(folder.glob("*.mcap"))
    shutil.copyfile(part, folder / "run_1.mcap")
    (folder / "run_0.mcap").write_bytes(b"nothing")
    part.unlink()
    source = opened(folder)
    assert len([r for r in source.records() if isinstance(r, Scan)]) == SCANS
    assert source.losses == {"files of the recording that cannot be read": 1}


def test_several_recordings_in_a_folder_are_not_mixed(opened: Opened, tmp_path: Path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(SourceError, match=r"Open what is in it: a\.mcap, b\.mcap"):
        opened(tmp_path)
