"""Frames of recordings: each scan by its own, clouds in a map frame, odometry of the same robot, the yaw of
an unknown mounting."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers import Source, SourceOptions
from pipeline.io.readers.ros import RosSource
from pipeline.odometry.mounting_yaw import yaw_of_mounting
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import POINT, START_NS, Author, Write, points_of, write_recording

KINDS = ["bag", "db3", "mcap"]
SCAN_NS, WHEELS_NS = 100_000_000, 20_000_000
SPEED = 1.5  # m/s
CLOUD, WHEELS, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


def base_at(time_ns: int) -> Pose3:
    """Pose of the robot in the world: ahead in wide turns."""
    s = SPEED * time_ns * 1e-9
    yaw = 0.5 * math.sin(0.6 * s)
    return Pose3.from_euler([s, 0.3 * s + 0.4 * math.sin(0.5 * s), 0.0], 0.0, 0.0, yaw)


def world(seed: int = 5) -> Float:
    """Points of posts about the way, shape (N, 3) [m]."""
    rng = np.random.default_rng(seed)
    foot = rng.uniform([-12.0, -14.0], [30.0, 20.0], (90, 2))
    angle, height = np.meshgrid(np.linspace(0.0, 2 * np.pi, 24, endpoint=False), np.linspace(-0.6, 2.5, 12))
    ring = 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(-1, 2)
    upright = np.broadcast_to(height.reshape(1, -1, 1), (90, height.size, 1))
    return np.concatenate([foot[:, None, :] + ring, upright], axis=2).reshape(-1, 3)


POSTS = world()


def table_of(points: Float) -> Any:
    """Points as the columns of a cloud, without times."""
    table = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    return table


def seen_from(T_world_lidar: Pose3) -> Float:
    """The posts within 15 m in the frame of a LiDAR, shape (N, 3) [m]."""
    points = T_world_lidar.inverse().apply(POSTS)
    near: Float = points[np.linalg.norm(points, axis=1) < 15.0]
    return near


def write_wheels(author: Author, write: Write, topic: str, seconds: float, **frames: str) -> None:
    """The odometry of the robot."""
    for k in range(int(seconds * 1e9) // WHEELS_NS):
        T, stamp_ns = base_at(k * WHEELS_NS), START_NS + k * WHEELS_NS
        message = author.odometry(stamp_ns, float(T.t[0]), T.euler()[2], frames.get("child", "base_link"))
        message.pose.pose.position.y = float(T.t[1])
        message.header.frame_id = frames.get("parent", "odom")
        write(topic, WHEELS, stamp_ns, message)


def scans_of(source: Source) -> list[Scan]:
    return [record for record in source.records() if isinstance(record, Scan)]


@pytest.mark.parametrize("kind", KINDS)
def test_each_scan_is_placed_by_its_own_frame(kind: str, tmp_path: Path, opened: Opened):
    places = {"front": (0.5, 0.0, 1.0, 0.0), "rear": (-0.5, 0.1, 1.2, math.pi), "left": (0.0, 0.4, 1.1, 1.5)}

    def fill(author: Author, write: Write) -> None:
        fixed = author.transforms(START_NS, *(("base_link", name, at) for name, at in places.items()))
        write("/tf_static", TRANSFORMS, START_NS, fixed)
        write_wheels(author, write, "/odom", 3.0)
        for k in range(30):
            name = [*places, "lost"][k % 4]
            stamp_ns = START_NS + k * SCAN_NS
            cloud = author.cloud(stamp_ns, table_of(POSTS[:300] + 0.01 * k), name)
            write("/points", CLOUD, stamp_ns + 1, cloud)

    source = opened(write_recording(kind, tmp_path, fill))
    scans = scans_of(source)
    assert len(scans) == 23
    for scan in scans:
        k = (scan.stamp_ns - START_NS) // SCAN_NS
        x, y, z, yaw = places[[*places][k % 4]]
        T = scan.T_base_lidar or source.description.T_base_lidar
        np.testing.assert_allclose(T.t, [x, y, z], atol=1e-9)
        np.testing.assert_allclose(T.euler()[2], yaw, atol=1e-9)
    assert [n for reason, n in source.losses.items() if "the other frame lost" in reason] == [7]
    assert any("several" in warning for warning in source.description.warnings)


@pytest.mark.parametrize("kind", KINDS)
def test_of_two_lidars_on_a_topic_that_of_the_robot_is_read(kind: str, tmp_path: Path, opened: Opened):
    """The first clouds are of a LiDAR that no transform links to the robot."""

    def fill(author: Author, write: Write) -> None:
        place = ("base_link", "velodyne", (0.1, 0.0, 1.1, 0.0))
        write("/tf_static", TRANSFORMS, START_NS, author.transforms(START_NS, place))
        for k in range(20):
            stamp_ns = START_NS + k * SCAN_NS
            write("/odom", WHEELS, stamp_ns, author.odometry(stamp_ns, 0.1 * k, 0.0))
            cloud = author.cloud(stamp_ns, points_of(0), "velodyne" if k % 2 else "stranger")
            write("/points", CLOUD, stamp_ns, cloud)

    source = opened(write_recording(kind, tmp_path, fill))
    assert source.description.T_base_lidar.t == pytest.approx([0.1, 0.0, 1.1])
    assert sum(isinstance(record, Scan) for record in source.records()) == 10
    assert source.losses == {"scans in the other frame stranger, without a fixed transform": 10}


@pytest.mark.parametrize("factor", [100.0, 1000.0])
def test_coordinates_that_are_no_metres_are_a_loss(factor: float, tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for k in range(5):
            table = points_of(k)
            for axis in "xyz":
                table[axis] *= factor
            write("/points", CLOUD, START_NS + k * SCAN_NS, author.cloud(START_NS + k * SCAN_NS, table))

    source = opened(write_recording("mcap", tmp_path, fill))
    assert [number for reason, number in source.losses.items() if "not in metres" in reason] == [5]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frame", ["camera_init", "map"])
def test_a_cloud_in_the_frame_of_a_map_is_moved_back(kind: str, frame: str, tmp_path: Path, opened: Opened):
    """Of "map", the odometry is moved by a transform that jumps in the middle."""

    def shift_at(time_ns: int) -> Pose3:
        late = frame == "map" and time_ns >= 2_000_000_000
        return Pose3.from_euler([3.0 if late else 0.0, 0.0, 0.0], 0.0, 0.0, 0.7 if late else 0.0)

    def fill(author: Author, write: Write) -> None:
        parent = "odom" if frame == "map" else frame
        events: list[tuple[int, str, str, int, Any]] = []
        write_wheels(
            author,
            lambda *event: events.append((event[2], *event)),
            "/odometry",
            4.0,
            parent=parent,
            child="body",
        )
        for k in range(40):
            stamp_ns, T_map_odom = k * SCAN_NS, shift_at(k * SCAN_NS)
            if frame == "map":
                x, y, z = T_map_odom.t.tolist()
                link = (frame, "odom", (x, y, z, T_map_odom.euler()[2]))
                message = author.transforms(START_NS + stamp_ns, link)
                events.append((START_NS + stamp_ns, "/tf", TRANSFORMS, START_NS + stamp_ns, message))
            points = (T_map_odom @ base_at(stamp_ns)).apply(POSTS[:500])
            cloud = author.cloud(START_NS + stamp_ns, table_of(points), frame)
            events.append((START_NS + stamp_ns + 5, "/cloud", CLOUD, START_NS + stamp_ns + 5, cloud))
        for _, topic, msgtype, log_ns, message in sorted(events, key=lambda event: event[0]):
            write(topic, msgtype, log_ns, message)

    source = opened(write_recording(kind, tmp_path, fill))
    scans = scans_of(source)
    assert len(scans) == 40
    for scan in scans:
        assert scan.offset_ns is None
        np.testing.assert_allclose(scan.points, POSTS[:500], atol=0.01)
    assert not source.losses
    assert any(f"in the frame {frame}" in warning for warning in source.description.warnings)


def test_odometry_is_that_of_the_robot_with_the_lidar(tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        write_wheels(author, write, "/robot1/odom", 2.0, child="robot1/base_link", parent="robot1/odom")
        for _ in range(2):  # twice as many messages of another robot
            write_wheels(author, write, "/robot2/odom", 2.0, child="robot2/base_link", parent="robot2/odom")
        for k in range(20):
            cloud = author.cloud(START_NS + k * SCAN_NS, table_of(POSTS[:200]), "robot1/velodyne")
            write("/robot1/points", CLOUD, START_NS + k * SCAN_NS, cloud)

    source = opened(write_recording("mcap", tmp_path, fill))
    topics = {topic.name: topic for topic in source.description.topics}
    assert topics["/robot1/odom"].read_as == "odometry"
    assert topics["/robot2/odom"].read_as == ""
    assert "nearer to the LiDAR" in topics["/robot2/odom"].why_not


@pytest.mark.parametrize(("linked", "read"), [("filtered", "/filtered"), ("wheels", "/wheels")])
def test_odometry_is_that_which_transforms_link_to_the_lidar(
    linked: str, read: str, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        fixed = author.transforms(START_NS, (f"base_of_{linked}", "velodyne", (0.0, 0.0, 1.0, 0.0)))
        write("/tf_static", TRANSFORMS, START_NS, fixed)
        for name in ("filtered", "wheels"):
            write_wheels(author, write, f"/{name}", 2.0, child=f"base_of_{name}")
        for k in range(20):
            cloud = author.cloud(START_NS + k * SCAN_NS, table_of(POSTS[:200]))
            write("/points", CLOUD, START_NS + k * SCAN_NS, cloud)

    topics = opened(write_recording("mcap", tmp_path, fill)).description.topics
    assert [topic.name for topic in topics if topic.read_as == "odometry"] == [read]


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize(("parent", "child"), [("odom", "base_link"), ("camera_init", "body")])
def test_a_transform_is_odometry_if_it_moves(
    moves: bool, parent: str, child: str, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        fixed = author.transforms(START_NS, (child, "velodyne", (0.0, 0.0, 1.0, 0.0)))
        write("/tf_static", TRANSFORMS, START_NS, fixed)
        for k in range(20):
            stamp_ns = START_NS + k * SCAN_NS
            place = (0.1 * k if moves else 0.0, 0.0, 0.0, 0.0)
            links = [("map", "odom", (0.0, 0.0, 0.0, 0.0)), (parent, child, place)]
            write("/tf", TRANSFORMS, stamp_ns, author.transforms(stamp_ns, *links))
            write("/points", CLOUD, stamp_ns + 1, author.cloud(stamp_ns, table_of(POSTS[:200])))

    source = opened(write_recording("mcap", tmp_path, fill))
    assert source.description.has_odometry is moves
    wheels = [record for record in source.records() if isinstance(record, Odometry)]
    assert len(wheels) == (20 if moves else 0)
    assert len(scans_of(source)) == 20


def unlinked(yaw: float, *, standing: bool = False) -> Callable[[Author, Write], None]:
    """A drive of 6 s without transforms, with a LiDAR that is turned; or the odometry of a robot that
    stands."""

    def fill(author: Author, write: Write) -> None:
        T_base_lidar = Pose3.from_euler([0.3, -0.1, 0.0], 0.0, 0.0, yaw)
        if standing:
            for k in range(300):
                stamp_ns = START_NS + k * WHEELS_NS
                write("/odom", WHEELS, stamp_ns, author.odometry(stamp_ns, 0.0, 0.0))
        else:
            write_wheels(author, write, "/odom", 6.0)
        for k in range(58):
            stamp_ns = k * SCAN_NS
            cloud = author.cloud(START_NS + stamp_ns, table_of(seen_from(base_at(stamp_ns) @ T_base_lidar)))
            write("/points", CLOUD, START_NS + stamp_ns, cloud)

    return fill


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("degrees", [0, 90, 180, 270, 33])
def test_the_yaw_of_a_mounting_is_found_by_its_motion(degrees: int, tmp_path: Path, opened: Opened):
    source = opened(write_recording("mcap", tmp_path, unlinked(math.radians(degrees))))
    found = math.degrees(source.description.T_base_lidar.euler()[2]) % 360.0
    assert abs((found - degrees + 180.0) % 360.0 - 180.0) < 2.0
    assert any("yaw of the mounting" in w for w in source.description.warnings) is (degrees != 0)
    assert not source.losses


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "stated"), [(90, 0), (60, -60), (90, 90), (33, 30)])
def test_a_fixed_transform_with_another_yaw_than_the_motion_is_told(
    degrees: int, stated: int, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        fixed = author.transforms(START_NS, ("base_link", "velodyne", (0.3, -0.1, 0.0, math.radians(stated))))
        write("/tf_static", TRANSFORMS, START_NS, fixed)
        unlinked(math.radians(degrees))(author, write)

    source = opened(write_recording("mcap", tmp_path, fill))
    assert isinstance(source, RosSource)
    text = source.contradiction_of_mounting()
    assert bool(text) is (abs(degrees - stated) > 15)
    if text:
        assert text.startswith("the transform from base_link to velodyne has a wrong yaw")
        assert f"and not {stated};" in text


@pytest.mark.slow
def test_a_mounting_of_the_user_with_another_yaw_than_the_motion_is_told(tmp_path: Path, opened: Opened):
    options = SourceOptions(T_base_lidar=Pose3.identity())
    source = opened(write_recording("mcap", tmp_path, unlinked(math.radians(90))), options)
    assert isinstance(source, RosSource)
    text = source.contradiction_of_mounting()
    assert text.startswith("the yaw given with --mount is wrong: by the motion")
    assert text.endswith("and not 0; correct it")


@pytest.mark.slow
def test_odometry_of_a_robot_that_stands_contradicts_scans_that_move(tmp_path: Path, opened: Opened):
    source = opened(write_recording("mcap", tmp_path, unlinked(0.0, standing=True)))
    assert any("that contradict the odometry" in reason for reason in source.losses)


@pytest.mark.slow
def test_odometry_of_another_robot_is_left_out(tmp_path: Path, opened: Opened):
    def fill(author: Author, write: Write) -> None:
        for k in range(300):
            stamp_ns, along = START_NS + k * WHEELS_NS, -1.3 * k * WHEELS_NS * 1e-9
            message = author.odometry(stamp_ns, along, 0.002 * k, "robot2/base")
            write("/robot2/odom", WHEELS, stamp_ns, message)
        for k in range(58):
            stamp_ns = k * SCAN_NS
            cloud = author.cloud(START_NS + stamp_ns, table_of(seen_from(base_at(stamp_ns))), "robot1/lidar")
            write("/robot1/points", CLOUD, START_NS + stamp_ns, cloud)

    source = opened(write_recording("mcap", tmp_path, fill))
    assert not source.description.has_odometry
    assert any("/robot2/odom is not used" in warning for warning in source.description.warnings)
    assert not any(isinstance(record, Odometry) for record in source.records())
    assert not source.losses


@pytest.mark.parametrize("yaw", [-2.5, 0.0, 1.0, math.pi / 2, 3.1])
def test_the_yaw_of_exact_motions(yaw: float):
    T_base_lidar = Pose3.from_euler([0.5, 0.2, 0.0], 0.0, 0.0, yaw)
    start = base_at(0) @ T_base_lidar
    times = [k * SCAN_NS for k in range(80)]
    lidar = [(start.inverse() @ base_at(t) @ T_base_lidar).planar().as_array() for t in times]
    odometry = np.array([base_at(t).planar().as_array() for t in times])
    found = yaw_of_mounting(np.array(lidar), odometry)
    assert found is not None
    assert not found.contradicts
    assert abs(math.remainder(found.yaw - yaw, 2 * math.pi)) < 0.06


def test_a_robot_that_stands_tells_no_yaw():
    assert yaw_of_mounting(np.zeros((50, 3)), np.zeros((50, 3))) is None
