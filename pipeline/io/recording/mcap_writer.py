"""Writers of MCAP files in the ROS 2 profile: whole runs, live runs message by message, and repaired
recordings."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from mcap.records import Attachment, Metadata, Schema
from mcap.records import Channel as McapChannel
from mcap.records import Message as McapMessage
from mcap.writer import CompressionType, Writer

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.atomic_files import write_beside
from pipeline.io.ground_truth import ATTACHMENT, truth_json
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import NAME, PARAMETERS, SKIPPED, VERSION
from pipeline.io.readers.mcap_file import NOT_FINISHED, McapFile
from pipeline.io.readers.topics import is_fixed
from pipeline.io.recording import messages
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Imu, Odometry, Record, Scan, Sensor, Truth

CHUNK_SIZE = 1 << 20
#: Small, because a crash loses the last chunk.
LIVE_CHUNK_SIZE = 256 << 10
TOPICS = {
    "/velodyne_points": "sensor_msgs/msg/PointCloud2",
    "/odom": "nav_msgs/msg/Odometry",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
_LATCHED = "/tf_static"
CAMERA_INFO = "/camera/camera_info"
_TEXT = "std_msgs/msg/String"
_PICTURE, _INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"


# The numbers below are those of Humble; later releases write words instead.
BAG_METADATA = ("rosbag2", {"ROS_DISTRO": "humble"})

# Quality of service of each topic for `ros2 bag play`. Without it all topics are replayed as volatile, and
# late subscribers such as RViz get no /tf_static.
_KEEP_LAST, _RELIABLE, _TRANSIENT_LOCAL, _VOLATILE, _AUTOMATIC = 1, 1, 1, 2, 1
_FOREVER = "{sec: 9223372036, nsec: 854775807}"


def offered_qos_profiles(latched: bool) -> str:
    """Return the quality-of-service profile of a topic as YAML; if `latched`, the last message is kept for
    late subscribers, otherwise the last ten for present subscribers."""
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


class Stream(Protocol):
    """Sink of the bytes."""

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...


class _RosWriter:
    """An MCAP file in the ROS 2 profile that is being written.

    Args:
        stream: Stream of a new file.
        chunk_size: Size of a chunk [bytes].
        attachment, content: Name and JSON of the attachment of the file.
    """

    def __init__(self, stream: Stream | BinaryIO, chunk_size: int, attachment: str, content: bytes) -> None:
        """Write the head of the file: attachment and metadata."""
        self._writer = Writer(stream, chunk_size=chunk_size, compression=CompressionType.LZ4)
        # The default contains the version of the library, so the bytes would change with its releases.
        self._writer.start(profile="ros2", library="stemmap")
        # At the front, so that a file that is cut still has it.
        self._writer.add_attachment(0, 0, attachment, "application/json", content)
        self._writer.add_metadata(*BAG_METADATA)
        self._schemas: dict[str, int] = {}
        self._sequence = Counter[int]()

    def finish(self) -> None:
        """Write the last chunk and the index; the stream stays open.

        Raises:
            OSError: The stream cannot be written.
        """
        self._writer.finish()

    def _schema(self, kind: str) -> int:
        """Return the number of a message type in the file, which is defined at the first call."""
        if kind not in self._schemas:
            text = messages.definition(kind).encode()
            self._schemas[kind] = int(self._writer.register_schema(kind, "ros2msg", text))
        return self._schemas[kind]

    def _channel(self, topic: str, kind: str, latched: bool = False) -> int:
        """Return the number of a new channel in the file.

        Args:
            topic: Name of the topic.
            kind: Message type, e.g. "sensor_msgs/msg/Imu".
            latched: Whether late subscribers get the last message; topics of fixed transforms always are.
        """
        profiles = {"offered_qos_profiles": offered_qos_profiles(latched or is_fixed(topic))}
        return int(self._writer.register_channel(topic, "cdr", self._schema(kind), profiles))

    def _write(self, channel: int, stamp_ns: int, payload: bytes) -> None:
        """Append a message in CDR to a channel, with one time [ns] for log and publication.

        Raises:
            OSError: The stream cannot be written.
        """
        self._writer.add_message(channel, stamp_ns, payload, stamp_ns, self._sequence[channel])
        self._sequence[channel] += 1


def write_recording(
    path: Path,
    records: Iterable[Record | Picture],
    *,
    sensor: Sensor,
    T_base_lidar: Pose3,
    truth: Truth | None = None,
    camera: Camera | None = None,
) -> int:
    """Write a run; the file appears when it is complete, and replaces an existing one.

    The frames are odom -> base_link -> velodyne. Every message is logged at the time of its record. The same
    records give the same bytes.

    Args:
        path: The file.
        records: Records in the order of time.
        sensor: Sensor, stored with the ground truth.
        T_base_lidar: Extrinsics of the LiDAR.
        truth: Ground truth, attached as `stemmap_truth.json`.
        camera: Camera of the pictures among the records; None leaves pictures out.

    Returns:
        Number of messages: two for an odometry or a picture, one for a scan or an IMU reading, and the static
        transforms (one for the LiDAR, one for a camera; none without records). Other records are left out.

    Raises:
        StemmapError: ROS cannot represent a time, or writing fails.
    """
    with write_beside(path) as partial, partial.open("wb") as stream:
        run = _Run(stream, truth_json(sensor, truth), T_base_lidar, camera)
        for record in records:
            run.add(record)
        run.finish()
        return run.count


class _Run(_RosWriter):
    """The recording of a whole run."""

    def __init__(self, stream: BinaryIO, truth: bytes, T_base_lidar: Pose3, camera: Camera | None) -> None:
        """Define all types and topics; `truth` is the content of the attachment."""
        super().__init__(stream, CHUNK_SIZE, ATTACHMENT, truth)
        self._T_base_lidar: Pose3 | None = T_base_lidar
        self._camera = camera
        topics = TOPICS if camera is None else {**TOPICS, camera.topic: _PICTURE, CAMERA_INFO: _INFO}
        for kind in topics.values():  # all types come before the topics
            self._schema(kind)
        self._channels = {topic: self._channel(topic, kind) for topic, kind in topics.items()}

    @property
    def count(self) -> int:
        """Number of messages."""
        return self._sequence.total()

    def add(self, record: Record | Picture) -> None:
        """Write a record as one or two messages; other kinds, and pictures if there is no camera, are
        ignored. Extrinsics are written before the first record, with its time.

        Raises:
            StemmapError: ROS cannot represent the time.
            OSError: The stream cannot be written.
        """
        stamp = record.stamp_ns
        if self._T_base_lidar is not None:
            mounting = messages.transform(stamp, messages.BASE, messages.LIDAR, self._T_base_lidar)
            self._encode(_LATCHED, stamp, mounting)
            self._T_base_lidar = None
            if self._camera is not None:
                c = self._camera
                placed = messages.transform(stamp, messages.BASE, messages.CAMERA, c.T_base_camera)
                self._encode(_LATCHED, stamp, placed)
        if isinstance(record, Scan):
            self._encode("/velodyne_points", stamp, messages.point_cloud(record))
        elif isinstance(record, Odometry):
            self._encode("/odom", stamp, messages.odometry(record))
            moved = messages.transform(stamp, messages.ODOM, messages.BASE, record.T_odom_base)
            self._encode("/tf", stamp, moved)
        elif isinstance(record, Picture) and self._camera is not None:
            c = self._camera
            self._encode(CAMERA_INFO, stamp, messages.camera_info(stamp, c.width, c.height, c.K))
            self._encode(c.topic, stamp, messages.compressed_image(stamp, record.data))
        elif isinstance(record, Imu):
            self._encode("/imu/data", stamp, messages.imu(record))

    def _encode(self, topic: str, stamp_ns: int, message: messages.Message) -> None:
        """Append a message object to a topic at a time [ns]."""
        self._write(self._channels[topic], stamp_ns, messages.encode(message))


class LiveWriter(_RosWriter):
    """Writer of one recording of a live run, in the ROS 2 profile of MCAP.

    The robot's messages are written in their order of arrival, with their times of arrival as log times. The
    channel SKIPPED names the messages that the mapping did not use.

    Args:
        stream: Stream of a new file.
        channels: Channels of the robot; they keep their numbers.
        header: Fields of `LiveRunHeader` except the version, as JSON values.
        robot: Namespace of the robot, "" for none.
    """

    def __init__(
        self, stream: Stream, channels: Sequence[Channel], header: Mapping[str, Any], robot: str
    ) -> None:
        """Write the head of the file and define the channels of robot and outputs, whose topics begin with
        /ROBOT/stemmap/, or with /stemmap/ if `robot` is "".

        Raises:
            OSError: The stream cannot be written.
        """
        content = json.dumps({"version": VERSION, **header}).encode()
        super().__init__(stream, LIVE_CHUNK_SIZE, NAME, content)
        self._numbers = {c.number: self._channel(c.topic, c.msgtype) for c in channels}
        prefix = f"/{robot}/stemmap" if robot else "/stemmap"
        self._outputs = {
            topic: self._channel(f"{prefix}/{topic}", kind, topic in messages.LATCHED)
            for topic, kind in messages.TYPES.items()
        }
        self._parameters = self._channel(PARAMETERS, _TEXT, latched=True)
        self._skipped = self._channel(SKIPPED, _TEXT)
        self._last_ns = 0

    def add(self, message: Message) -> None:
        """Write a message of the robot at its time of arrival.

        Raises:
            KeyError: The channel of the message is not one of `channels`.
            OSError: The stream cannot be written.
        """
        self._last_ns = message.log_ns
        self._write(self._numbers[message.channel], self._last_ns, message.payload)

    def add_outputs(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Write results of the mapping at the time of the last message of the robot, 0 if there is none.
        `messages_by_topic` is a dict from topics of `messages.TYPES` to messages in CDR.

        Raises:
            KeyError: A topic is unknown.
            OSError: The stream cannot be written.
        """
        for topic, payload in messages_by_topic.items():
            self._write(self._outputs[topic], self._last_ns, payload)

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """Write the parameters that apply from a mapped scan onwards, at the time of the last message of the
        robot.

        Args:
            revision: Number of the change.
            from_scan: Index of the first scan with these parameters.
            values: Dict from stages to dicts from names to values, as in `Revision`.

        Raises:
            OSError: The stream cannot be written.
        """
        text = json.dumps({"revision": revision, "from_scan": from_scan, "values": values})
        self._write(self._parameters, self._last_ns, messages.text(text))

    def add_skipped(self, times_by_topic: Mapping[str, Sequence[int]]) -> None:
        """Write the messages that the mapping did not use, as a dict from topics to their log times [ns]. The
        log time of this note is that of the last message of the robot.

        Raises:
            OSError: The stream cannot be written.
        """
        self._write(self._skipped, self._last_ns, messages.text(json.dumps(times_by_topic)))

    def flush(self) -> None:
        """Write the present chunk to the stream, so that the stream has all messages.

        Raises:
            OSError: The stream cannot be written.
        """
        # The library ends a chunk when it is full or the file ends, and has no public method for it.
        self._writer._Writer__finalize_chunk()


@dataclass(frozen=True, slots=True)
class RepairResult:
    """Result of a repair.

    Attributes:
        messages: Number of messages in the new file.
        losses: Dict from reasons to numbers of lost parts.
    """

    messages: int
    losses: dict[str, int]


def repair(path: Path, out: Path) -> RepairResult:
    """Write all complete messages, attachments and metadata of a recording to a new file, which appears when
    it is complete; return what was written and lost. Messages of a channel without a definition count as
    lost.

    Args:
        path: The recording, which does not change.
        out: The new file; an existing one is replaced.

    Raises:
        SourceError: The recording cannot be read, is not an MCAP file, or has no complete message.
        StemmapError: The new file cannot be written.
    """
    with closing(McapFile(path)) as recording:
        lost, written = Counter[str](), 0
        with write_beside(out) as partial, partial.open("wb") as target:
            writer = Writer(target, compression=CompressionType.LZ4)
            writer.start(profile="ros2", library="stemmap")
            schemas, channels = {0: 0}, dict[int, int]()
            for record in recording.whole_records():
                match record:
                    case Schema(id=known) if known not in schemas:
                        schemas[known] = writer.register_schema(record.name, record.encoding, record.data)
                    case McapChannel(id=known) if known not in channels and record.schema_id in schemas:
                        channels[known] = writer.register_channel(
                            record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                        )
                    case McapMessage(channel_id=known) if known in channels:
                        writer.add_message(
                            channels[known], record.log_time, record.data, record.publish_time,
                            record.sequence,
                        )  # fmt: skip
                        written += 1
                    case McapMessage():
                        lost["messages of an unknown topic"] += 1
                    case Attachment():
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
            if not written:
                raise SourceError("nothing in the recording is whole", where=str(path))
            writer.finish()
        recording.damage.pop(NOT_FINISHED, None)  # the new file has an index
        return RepairResult(written, {**recording.damage, **lost})
