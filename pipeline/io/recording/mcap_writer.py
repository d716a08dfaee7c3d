"""Writers of MCAP files in the ROS 2 profile: whole runs, and live runs message by message."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from mcap.writer import CompressionType, Writer

from pipeline.geometry.poses import Pose3
from pipeline.io.atomic_files import write_beside
from pipeline.io.ground_truth import ATTACHMENT, truth_json
from pipeline.io.readers.camera import Camera, Picture
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import NAME, PARAMETERS, SKIPPED, VERSION
from pipeline.io.recording import messages, outputs
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
    """Write a run; the file appears when it is complete.

    The frames are odom -> base_link -> velodyne. Every message is logged at the time of its record. The same
    records give the same bytes.

    Args:
        path: The file.
        records: Records in the order of time.
        sensor: Sensor, stored with the ground truth.
        T_base_lidar: Extrinsics of the LiDAR.
        truth: Ground truth, attached as `stemmap_truth.json`.
        camera: Camera of the pictures among the records.

    Returns:
        Number of messages.

    Raises:
        StemmapError: ROS cannot represent a time, or writing fails.
    """
    with write_beside(path) as partial, partial.open("wb") as stream:
        run = _Run(stream, truth_json(sensor, truth), T_base_lidar, camera)
        for record in records:
            run.add(record)
        run.finish()
        return run.count


class _Run:
    """An MCAP file that is being written."""

    def __init__(self, stream: BinaryIO, truth: bytes, T_base_lidar: Pose3, camera: Camera | None) -> None:
        self.count = 0
        self._T_base_lidar: Pose3 | None = T_base_lidar
        self._camera = camera
        topics = TOPICS if camera is None else {**TOPICS, camera.topic: _PICTURE, CAMERA_INFO: _INFO}
        self._writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.LZ4)
        # The default contains the version of the library, so the bytes would change with its releases.
        self._writer.start(profile="ros2", library="stemmap")
        # At the front, so that a file that is cut still has it.
        self._writer.add_attachment(0, 0, ATTACHMENT, "application/json", truth)
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
        """Write a record; the extrinsics of the LiDAR come before the first one."""
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


# The numbers below are those of Humble; later releases write words instead.
BAG_METADATA = ("rosbag2", {"ROS_DISTRO": "humble"})

# Quality of service of each topic for `ros2 bag play`. Without it all topics are replayed as volatile, and
# late # subscribers such as RViz get no /tf_static.
_KEEP_LAST, _RELIABLE, _TRANSIENT_LOCAL, _VOLATILE, _AUTOMATIC = 1, 1, 1, 2, 1
_FOREVER = "{sec: 9223372036, nsec: 854775807}"


def offered_qos_profiles(latched: bool) -> str:
    """Return the profile of a topic as YAML; `latched` keeps the last message for late subscribers."""
    return (
        f"- history: {_KEEP_LAST}\n"
        f"  depth: {1 if latched else 10}\n"
        f"  reliability: {_RELIABLE}\n"
        f"  durability: {_TRANSIENT_LOCAL if latched else _VOLATILE}\n"
        f"  deadline: {_FOREVER}\n"
        f"  lifespan: {_FOREVER}\n"
        f"  liveliness: {_AUTOMATIC}\n"
        f"  liveliness_lease_duration: {_FOREVER}\n"
        f"  avoid_ros_namespace_conventions: false\n"
    )


#: Small, because a crash loses the last chunk.
LIVE_CHUNK_SIZE = 256 << 10
_TEXT = "std_msgs/msg/String"


class Stream(Protocol):
    """Sink of the bytes."""

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...


class LiveWriter:
    """Writer of one recording of a live run, in the ROS 2 profile of MCAP.

    The robot's messages are written in their order of arrival, with their times of arrival as log times. A
    channel names those that the mapping did not use, so that a replay can repeat the live map.

    Args:
        stream: Stream of a new file.
        channels: Channels of the robot; they keep their numbers.
        header: Further values that determine the run, as JSON values: address, topics, seed.
        robot: Namespace of the robot, "" for none.
    """

    def __init__(
        self, stream: Stream, channels: Sequence[Channel], header: Mapping[str, Any], robot: str
    ) -> None:
        self._writer = Writer(stream, chunk_size=LIVE_CHUNK_SIZE, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="stemmap")
        content = {"version": VERSION, **header}
        self._writer.add_attachment(0, 0, NAME, "application/json", json.dumps(content).encode())
        self._writer.add_metadata(*BAG_METADATA)
        self._schemas: dict[str, int] = {}
        self._numbers = {c.number: self._channel(c.topic, c.msgtype) for c in channels}
        prefix = f"/{robot}/stemmap" if robot else "/stemmap"
        self._outputs = {
            topic: self._channel(f"{prefix}/{topic}", kind, topic in outputs.LATCHED)
            for topic, kind in outputs.TYPES.items()
        }
        self._parameters = self._channel(PARAMETERS, _TEXT, latched=True)
        self._skipped = self._channel(SKIPPED, _TEXT)
        self._sequence: dict[int, int] = {}
        self._last_ns = 0

    def add(self, message: Message) -> None:
        """Write a message of the robot.

        Raises:
            OSError: The disk refuses.
        """
        self._last_ns = message.log_ns
        self._write(self._numbers[message.channel], message.payload)

    def add_outputs(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Write results of the mapping, at the time of the last message of the robot.

        Raises:
            OSError: The disk refuses.
        """
        for topic, payload in messages_by_topic.items():
            self._write(self._outputs[topic], payload)

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """Write the parameters that apply from a mapped scan onwards.

        Raises:
            OSError: The disk refuses.
        """
        text = json.dumps({"revision": revision, "from_scan": from_scan, "values": values})
        self._write(self._parameters, messages.text(text))

    def add_skipped(self, times_by_topic: Mapping[str, Sequence[int]]) -> None:
        """Write which messages the mapping did not use: log times [ns] by topic.

        Raises:
            OSError: The disk refuses.
        """
        self._write(self._skipped, messages.text(json.dumps(times_by_topic)))

    def flush(self) -> None:
        """End the present chunk, so that the system has all messages.

        Raises:
            OSError: The disk refuses.
        """
        # The library ends a chunk when it is full or the file ends, and has no public method for it.
        self._writer._Writer__finalize_chunk()

    def finish(self) -> None:
        """Write the index.

        Raises:
            OSError: The disk refuses.
        """
        self._writer.finish()

    def _channel(self, topic: str, kind: str, latched: bool = False) -> int:
        if kind not in self._schemas:
            text = messages.definition(kind)
            self._schemas[kind] = int(self._writer.register_schema(kind, "ros2msg", text.encode()))
        latched = latched or topic.endswith("tf_static")
        profiles = {"offered_qos_profiles": offered_qos_profiles(latched)}
        return int(self._writer.register_channel(topic, "cdr", self._schemas[kind], profiles))

    def _write(self, channel: int, payload: bytes) -> None:
        number = self._sequence.get(channel, 0)
        self._sequence[channel] = number + 1
        self._writer.add_message(channel, self._last_ns, payload, self._last_ns, number)
