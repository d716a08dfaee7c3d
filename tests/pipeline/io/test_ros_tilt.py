"""The fixed transforms and the IMU of a recording are checked against its ground and its trunks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.batch.summary import left_out_warning
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.ros import UNKNOWN_YAW
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SpinningLidar
from pipeline.types.records import Imu, Odometry, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, write_recording

STEP_NS = 1_000_000_000


def recorded(
    folder: Path,
    scenario: str,
    T_base_lidar: Pose3,
    orientation: Pose3 | None = None,
    child: str = "velodyne",
) -> Path:
    """A recording of a drive whose fixed transform places the LiDAR, or another child, upright, 0.8 m high,
    with an IMU of a constant orientation, or none."""
    run = replace(open_simulated(scenario).run, lidar=SpinningLidar(), T_base_lidar=T_base_lidar)

    def fill(author: Author, write: Write) -> None:
        link = ("base_link", child, (0.0, 0.0, 0.8, 0.0))
        write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, author.transforms(START_NS, link))
        for k in range(8):
            now_ns, scan = START_NS + k * STEP_NS, run.sweep(10 * k).scan
            table = np.zeros(len(scan.points), [(axis, "<f4") for axis in "xyz"])
            for axis, column in zip("xyz", scan.points.T, strict=True):
                table[axis] = column
            write("/points", "sensor_msgs/msg/PointCloud2", now_ns, author.cloud(now_ns, table))
            write("/odom", "nav_msgs/msg/Odometry", now_ns, author.odometry(now_ns, 1.0 * k, 0.0))
            if orientation is not None:
                w, x, y, z = orientation.quaternion()
                turned = author.make("Quaternion", x, y, z, w)
                imu = replace(author.imu(now_ns, (0.0, 0.0, 0.0)), orientation=turned)
                write("/imu", "sensor_msgs/msg/Imu", now_ns + 1, imu)

    return write_recording("mcap", folder, fill)


def tilted(roll: float, pitch: float) -> Pose3:
    """A mounting 0.8 m high with roll and pitch [degrees]."""
    return Pose3.from_euler(np.array([0.0, 0.0, 0.8]), np.radians(roll), np.radians(pitch), 0.0)


@pytest.mark.parametrize(("roll", "pitch"), [(0, 15), (-12, 0)])
@pytest.mark.parametrize("scenario", ["sim:stand?duration=10", "sim:paper?duration=10"])
def test_a_fixed_transform_without_the_tilt_of_the_lidar_is_contradicted_by_the_ground(
    scenario: str, roll: float, pitch: float, tmp_path: Path, opened: Opened
):
    source = opened(recorded(tmp_path, scenario, tilted(roll, pitch)))
    list(source.records())
    ((reason, scans),) = [loss for loss in source.losses.items() if "ground and trunks" in loss[0]]
    assert scans == 8
    assert left_out_warning(source.losses, scans) == "", "they are mapped"
    assert "--mount" in reason


def test_a_lidar_without_a_transform_whose_tilt_is_not_found_is_told(tmp_path: Path, opened: Opened):
    source = opened(recorded(tmp_path, "sim:paper?duration=10", tilted(0, 12), child="lidar_link"))
    list(source.records())
    assert any("no fixed transform from velodyne to base_link tells it" in reason for reason in source.losses)


@pytest.mark.parametrize("scenario", ["sim:stand?duration=10", "sim:slope?duration=10"])
def test_a_right_transform_is_not_contradicted_on_a_slope(scenario: str, tmp_path: Path, opened: Opened):
    source = opened(recorded(tmp_path, scenario, tilted(0, 0)))
    list(source.records())
    assert not any("tilted" in reason for reason in source.losses)


@pytest.mark.parametrize(("angle", "used"), [(0, True), (15, False)])
def test_an_orientation_by_which_all_trunks_lean_is_not_used(
    angle: float, used: bool, tmp_path: Path, opened: Opened
):
    source = opened(recorded(tmp_path, "sim:stand?duration=10", tilted(0, 0), tilted(angle, 0)))
    readings = [record for record in source.records() if isinstance(record, Imu)]
    assert len(readings) == 8
    assert all((reading.orientation is not None) is used for reading in readings)
    assert (
        any("all trunks would lean by 15 degrees" in text for text in source.description.warnings) is not used
    )


def test_trunks_that_lean_by_transform_and_imu_are_a_contradiction(tmp_path: Path, opened: Opened):
    # The base is tilted against the ground as well, so that neither can be trusted.
    source = opened(recorded(tmp_path, "sim:stand?duration=10", tilted(10, 0), tilted(0, 15)))
    list(source.records())
    (reason,) = [reason for reason in source.losses if "ground and trunks" in reason]
    assert "the orientation in /imu is wrong, or the fixed transform is wrong;" in reason


def test_without_a_transform_a_wrong_orientation_blames_none_that_is_there(tmp_path: Path, opened: Opened):
    mounting, orientation = tilted(10, 0), tilted(0, 15)
    path = recorded(tmp_path, "sim:stand?duration=10", mounting, orientation, child="lidar_link")
    source = opened(path)
    list(source.records())
    (reason,) = [reason for reason in source.losses if "ground and trunks" in reason]
    assert "the orientation in /imu is wrong, or no fixed transform from velodyne to base_link" in reason


def test_an_upright_lidar_is_read_rather_than_one_that_turns_about_a_horizontal_axis(
    tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        upright, lying = (
            author.transforms(START_NS, ("base_link", name, (0.0, 0.0, 1.0, 0.0))) for name in "ab"
        )
        turn = author.make("Quaternion", 0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
        placed = lying.transforms[0].transform
        lying.transforms[0].transform = replace(placed, rotation=turn)
        for links in (upright, lying):
            write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, links)
        table = np.ones(100, [(axis, "<f4") for axis in "xyz"])
        for k in range(10):
            for topic, frame, every in (("/upright", "a", 2), ("/lying", "b", 1)):
                if k % every == 0:
                    now_ns = START_NS + k * STEP_NS
                    write(topic, "sensor_msgs/msg/PointCloud2", now_ns, author.cloud(now_ns, table, frame))

    described = opened(write_recording("mcap", tmp_path, fill)).description
    assert [topic.name for topic in described.topics if topic.read_as == "scan"] == ["/upright"]


def test_a_lidar_on_its_side_is_named_rather_than_the_odometry(tmp_path: Path, opened: Opened):
    source = opened(recorded(tmp_path, "sim:stand?duration=10", tilted(90, 0), child="lidar_link"))
    list(source.records())
    assert source.description.T_base_lidar.R[2, 2] < 0.1
    assert UNKNOWN_YAW in source.losses


@pytest.mark.slow
@pytest.mark.parametrize(
    ("roll", "pitch", "lidar"),
    [
        pytest.param(60, 0, "os0-128", marks=pytest.mark.slow),
        pytest.param(0, 50, "mid360", marks=pytest.mark.slow),
        (90, 0, "vlp16"),
    ],
)
def test_a_lidar_on_its_side_whose_motion_shows_the_yaw_is_no_loss(
    roll: float, pitch: float, lidar: str, tmp_path: Path, opened: Opened
):
    mounting = Pose3.from_euler(np.array([0.0, 0.0, 0.8]), np.radians(roll), np.radians(pitch), np.pi / 2)
    address = f"sim:stand?duration=8&odometry=exact&lidar={lidar}"

    def fill(author: Author, write: Write) -> None:
        for record in open_simulated(address, SourceOptions(T_base_lidar=mounting)).records():
            stamp_ns = record.stamp_ns
            if isinstance(record, Odometry):
                x, y, yaw = record.T_odom_base.planar().as_array()
                message = author.odometry(stamp_ns, float(x), float(yaw))
                message.pose.pose.position.y = float(y)
                write("/odom", "nav_msgs/msg/Odometry", stamp_ns, message)
            elif isinstance(record, Scan):
                table = np.zeros(len(record.points), [(axis, "<f4") for axis in "xyz"])
                for axis, column in zip("xyz", record.points.T, strict=True):
                    table[axis] = column
                write("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, author.cloud(stamp_ns, table))

    source = opened(write_recording("mcap", tmp_path, fill))
    turn = source.description.T_base_lidar.R @ mounting.R.T
    assert np.arccos((np.trace(turn) - 1.0) / 2.0) < np.radians(5.0)
    assert any("by the ground" in text for text in source.description.warnings)
    assert source.losses == {}
