"""Recordings of known content, written with rosbags, which shares no code with our readers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000_000_000_000
SCANS, STEP_NS = 12, 100_000_000
Write = Callable[[str, str, int, Any], None]


class Author:
    """Makes messages and writes them in one of the three formats."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.store: Any = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
        if kind == "bag":
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def make(self, name: str, *values: Any) -> Any:
        """A message of a type by its short name."""
        package = {
            "PointCloud2": "sensor_msgs",
            "PointField": "sensor_msgs",
            "Imu": "sensor_msgs",
            "Odometry": "nav_msgs",
            "TFMessage": "tf2_msgs",
            "Header": "std_msgs",
            "Time": "builtin_interfaces",
            "String": "std_msgs",
        }.get(name, "geometry_msgs")
        return self.store.types[f"{package}/msg/{name}"](*values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A std_msgs/Header."""
        stamp = self.make("Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("Header", *([0] if self.kind == "bag" else []), stamp, frame)

    def cloud(self, stamp_ns: int, table: NDArray[np.void], frame: str = "velodyne", **changes: Any) -> Any:
        """A PointCloud2 of a structured array."""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        dtype = table.dtype
        columns = {name: (part[0], part[1]) for name, part in (dtype.fields or {}).items()}
        fields = [
            self.make("PointField", name, offset, codes[kind.str[1:]], 1)
            for name, (kind, offset) in columns.items()
        ]
        form: dict[str, Any] = {
            "height": 1,
            "width": len(table),
            "fields": fields,
            "is_bigendian": any(kind.str[0] == ">" for kind, _ in columns.values()),
            "point_step": dtype.itemsize,
            "row_step": dtype.itemsize * len(table),
            "data": np.frombuffer(table.tobytes(), np.uint8),
            "is_dense": True,
        }
        return self.make("PointCloud2", self.header(stamp_ns, frame), *{**form, **changes}.values())

    def pose(self, x: float, y: float, z: float, yaw: float) -> tuple[Any, Any]:
        """Position and orientation."""
        turn = self.make("Quaternion", 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
        return self.make("Vector3", x, y, z), turn

    def odometry(self, stamp_ns: int, x: float, yaw: float, child: str = "base_link") -> Any:
        """A nav_msgs/Odometry from odom to a frame of the robot."""
        zero, (at, turn) = np.zeros(36), self.pose(x, 0.0, 0.0, yaw)
        pose = self.make(
            "PoseWithCovariance", self.make("Pose", self.make("Point", at.x, at.y, at.z), turn), zero
        )
        still = self.make("Vector3", 0.0, 0.0, 0.0)
        twist = self.make("TwistWithCovariance", self.make("Twist", still, still), zero)
        return self.make("Odometry", self.header(stamp_ns, "odom"), child, pose, twist)

    def imu(self, stamp_ns: int, rate: tuple[float, float, float], *, oriented: bool = True) -> Any:
        """A sensor_msgs/Imu in the frame imu_link."""
        zero = np.zeros(9)
        known = zero if oriented else np.array([-1.0] + [0.0] * 8)
        turn = self.make("Quaternion", 0.0, 0.0, 0.0, 1.0)
        vector = self.make("Vector3", *rate)
        pull = self.make("Vector3", 0.0, 0.0, 9.81)
        return self.make("Imu", self.header(stamp_ns, "imu_link"), turn, known, vector, zero, pull, zero)

    def transforms(self, stamp_ns: int, *links: tuple[str, str, tuple[float, float, float, float]]) -> Any:
        """A tf2_msgs/TFMessage of links (parent, child, (x, y, z, yaw))."""
        stamped = [
            self.make(
                "TransformStamped",
                self.header(stamp_ns, parent),
                child,
                self.make("Transform", *self.pose(*pose)),
            )
            for parent, child, pose in links
        ]
        return self.make("TFMessage", stamped)


def write_recording(kind: str, folder: Path, fill: Callable[[Author, Write], None]) -> Path:
    """Write "bag", "db3" or "mcap" as `fill` says; the path to open."""
    author = Author(kind)
    connections: dict[str, Any] = {}
    writer: Any
    if kind == "bag":
        path, storage = folder / "run.bag", folder / "run.bag"
        writer = Rosbag1Writer(path)
    else:
        storage = folder / "run"
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Rosbag2Writer(storage, version=9, storage_plugin=plugin)
        path = storage

    def write(topic: str, msgtype: str, log_ns: int, message: Any) -> None:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, msgtype, typestore=author.store)
        serialize = author.store.serialize_ros1 if kind == "bag" else author.store.serialize_cdr
        writer.write(connections[topic], log_ns, serialize(message, msgtype))

    with writer:
        fill(author, write)
    return path


POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 32,
    }
)


def points_of(index: int) -> NDArray[np.void]:
    """The cloud of a scan: 16 rings at 2 degrees, one NaN and one (0, 0, 0)."""
    azimuth, ring = np.meshgrid(np.radians(np.arange(0.0, 360.0, 2.0)), np.arange(16))
    elevation = np.radians(2.0 * ring - 15.0)
    reach = 5.0 + index
    table = np.zeros(azimuth.size, POINT)
    table["x"] = (reach * np.cos(elevation) * np.cos(azimuth)).ravel()
    table["y"] = (reach * np.cos(elevation) * np.sin(azimuth)).ravel()
    table["z"] = (reach * np.sin(elevation)).ravel()
    table["intensity"] = 7.0
    table["ring"] = ring.ravel()
    table["time"] = np.linspace(-0.1, 0.0, len(table))
    table["x"][3] = np.nan
    table[["x", "y", "z"]][5] = (0.0, 0.0, 0.0)
    for axis in "xyz":
        table[axis][5] = 0.0
    return table


def drive(author: Author, write: Write, *, odometry: str = "topic") -> None:
    """A robot that drives along x with a LiDAR 0.5 m ahead of and 1 m above its base.

    Scans are written 60 ms after their stamp, so they stand after odometry that is younger.
    """
    base_lidar = ("base_link", "velodyne", (0.5, 0.0, 1.0, 0.0))
    base_imu = ("base_link", "imu_link", (0.0, 0.0, 0.0, np.pi / 2))
    write("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, author.transforms(START_NS, base_lidar, base_imu))
    events: list[tuple[int, str, str, Any]] = []
    for step in range(SCANS * 5):
        stamp_ns = START_NS + step * STEP_NS // 5
        if odometry == "topic":
            message = author.odometry(stamp_ns, 0.01 * step, 0.0)
            events.append((stamp_ns, "/odom", "nav_msgs/msg/Odometry", message))
        if odometry == "transform":
            message = author.transforms(stamp_ns, ("odom", "base_link", (0.01 * step, 0.0, 0.0, 0.0)))
            events.append((stamp_ns, "/tf", "tf2_msgs/msg/TFMessage", message))
        events.append((stamp_ns, "/imu/data", "sensor_msgs/msg/Imu", author.imu(stamp_ns, (0.1, 0.2, 0.3))))
    for index in range(SCANS):
        stamp_ns = START_NS + index * STEP_NS
        cloud = author.cloud(stamp_ns, points_of(index))
        events.append((stamp_ns + 60_000_000, "/velodyne_points", "sensor_msgs/msg/PointCloud2", cloud))
    for log_ns, topic, msgtype, message in sorted(events, key=lambda event: event[0]):
        write(topic, msgtype, log_ns, message)
