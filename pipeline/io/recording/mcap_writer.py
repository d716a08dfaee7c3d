"""Writes records into one MCAP file with the profile of ROS 2."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from pipeline.geometry.poses import Pose3
from pipeline.io.atomic_files import write_beside
from pipeline.io.readers.camera import Camera, Picture
from pipeline.io.recording import messages
from pipeline.io.recording.quality_of_service import BAG_METADATA, offered_qos_profiles
from pipeline.io.recording.truth_json import MEDIA_TYPE, NAME, truth_json
from pipeline.types.records import Imu, Odometry, Record, Scan, Sensor, Truth

CHUNK_SIZE = 1 << 20
TOPICS = {
    "/velodyne_points": "sensor_msgs/msg/PointCloud2",
    "/odom": "nav_msgs/msg/Odometry",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
_LATCHED = "/tf_static"
CAMERA_INFO = "/camera/camera_info"
_PICTURE, _INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"


def write_recording(
    path: Path,
    records: Iterable[Record | Picture],
    *,
    sensor: Sensor,
    T_base_lidar: Pose3,
    truth: Truth | None = None,
    camera: Camera | None = None,
) -> int:
    """Write a run; the file appears when it is whole.

    The frames are odom -> base_link -> velodyne. Every message is logged at the time of its record.
    The same records give the same bytes.

    Args:
        path: Of the file.
        records: In the order of time.
        sensor: Goes into the attachment with the truth.
        T_base_lidar: Where the LiDAR stands on the robot.
        truth: What is known for certain, attached as `stemmap_truth.json`.
        camera: That takes the pictures among the records, where there are some.

    Returns:
        Number of messages.

    Raises:
        StemmapError: A time that ROS cannot hold, or the disk refuses.
    """
    with write_beside(path) as partial, partial.open("wb") as stream:
        run = _Run(stream, truth_json(sensor, truth), T_base_lidar, camera)
        for record in records:
            run.add(record)
        run.finish()
        return run.count


class _Run:
    """One MCAP while it is written."""

    def __init__(self, stream: BinaryIO, truth: bytes, T_base_lidar: Pose3, camera: Camera | None) -> None:
        self.count = 0
        self._T_base_lidar: Pose3 | None = T_base_lidar
        self._camera = camera
        topics = TOPICS if camera is None else {**TOPICS, camera.topic: _PICTURE, CAMERA_INFO: _INFO}
        self._writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.LZ4)
        # The library would write its own version, and the bytes would change with every release of it.
        self._writer.start(profile="ros2", library="stemmap")
        # At the front, so that a file that is cut short still has it.
        self._writer.add_attachment(0, 0, NAME, MEDIA_TYPE, truth)
        self._writer.add_metadata(*BAG_METADATA)
        schemas = {name: self._register(name) for name in dict.fromkeys(topics.values())}
        self._channels = {
            topic: self._writer.register_channel(
                topic, "cdr", schemas[name], {"offered_qos_profiles": offered_qos_profiles(topic == _LATCHED)}
            )
            for topic, name in topics.items()
        }
        self._sequence = dict.fromkeys(topics, 0)

    def add(self, record: Record | Picture) -> None:
        """Write one record, before the first the mounting of the LiDAR."""
        stamp = record.stamp_ns
        if self._T_base_lidar is not None:
            mounting = messages.transform(stamp, messages.BASE, messages.LIDAR, self._T_base_lidar)
            self._write(_LATCHED, stamp, mounting)
            self._T_base_lidar = None
            if self._camera is not None:
                c = self._camera
                placed = messages.transform(stamp, messages.BASE, messages.CAMERA, c.T_base_camera)
                self._write(_LATCHED, stamp, placed)
        if isinstance(record, Scan):
            self._write("/velodyne_points", stamp, messages.point_cloud(record))
        elif isinstance(record, Odometry):
            self._write("/odom", stamp, messages.odometry(record))
            moved = messages.transform(stamp, messages.ODOM, messages.BASE, record.T_odom_base)
            self._write("/tf", stamp, moved)
        elif isinstance(record, Picture) and self._camera is not None:
            c = self._camera
            self._write(CAMERA_INFO, stamp, messages.camera_info(stamp, c.width, c.height, c.K))
            self._write(c.topic, stamp, messages.compressed_image(stamp, record.data))
        elif isinstance(record, Imu):
            self._write("/imu/data", stamp, messages.imu(record))

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()

    def _register(self, type_name: str) -> int:
        text = messages.definition(type_name).encode()
        return int(self._writer.register_schema(type_name, "ros2msg", text))

    def _write(self, topic: str, stamp_ns: int, message: messages.Message) -> None:
        self._writer.add_message(
            self._channels[topic], stamp_ns, messages.encode(message), stamp_ns, self._sequence[topic]
        )
        self._sequence[topic] += 1
        self.count += 1
