"""Description of a ROS recording for people: its topics, what is assumed, and what it lacks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import RecordedTopic, SourceDescription
from pipeline.io.readers.ros_first_scans import TIMED_TYPES, TopicTimes, times_of_topic
from pipeline.io.readers.ros_messages import TimedMessages
from pipeline.io.readers.ros_mounting import Mounting
from pipeline.io.readers.ros_odometry import Frames
from pipeline.io.readers.ros_records import TYPES, RecordDecoder
from pipeline.io.readers.scan_columns import measured_range_sigma
from pipeline.io.readers.sensor_families import family_of
from pipeline.io.readers.topics import LASER_SCAN, POINT_CLOUD, Topic
from pipeline.io.readers.transforms import TransformTree
from pipeline.types.records import Scan, Sensor

#: Number of messages of a topic that is not read in which points are looked for.
_TRIES = 20
_MOST_FIELDS = 64


@dataclass(frozen=True, slots=True, eq=False)
class RosOpening:
    """What is decided when a recording is opened.

    Attributes:
        messages: Its messages, with the topics and transforms that are read.
        tree: Fixed transforms.
        frames: Frames of its topics.
        decoder: Decoder of the messages, with the base frame and the times of points.
        times: How the times of the points of the scans are read, by the first scans.
        mounting: Mounting of the LiDAR.
        sensor: The LiDAR.
        first: First scan.
        is_cut: Whether the recording is cut or damaged.
    """

    messages: TimedMessages
    tree: TransformTree
    frames: Frames
    decoder: RecordDecoder
    times: TopicTimes
    mounting: Mounting
    sensor: Sensor
    first: Scan
    is_cut: bool


def describe(opening: RosOpening, uri: str, digest: str, warnings: Collection[str]) -> SourceDescription:
    """Return the description of a recording.

    Args:
        opening: What is decided.
        uri: URI as the user wrote it.
        digest: Digest of the files.
        warnings: Messages for the user so far, which come first; of equal ones only the first is kept.

    Raises:
        SourceError: The recording cannot be read.
    """
    messages, odometry = opening.messages, opening.messages.odometry
    scans = odometry.topics.chosen["scan"]
    return SourceDescription(
        uri=uri,
        kind=messages.container.kind,
        sensor=opening.sensor,
        T_base_lidar=opening.mounting.T_base_lidar or Pose3.identity(),
        has_odometry=odometry.is_known,
        has_imu="imu" in odometry.topics.chosen,
        scans=scans.count,
        start_ns=opening.first.stamp_ns,
        end_ns=messages.end_ns(),
        digest=digest,
        preset="laser2d" if scans.msgtype == LASER_SCAN else "forest",
        topics=tuple(_detailed(topic, opening) for topic in odometry.topics.recorded()),
        warnings=tuple(dict.fromkeys([*warnings, *_warnings(opening)])),
        missing=tuple(_missing(opening)),
    )


def _warnings(opening: RosOpening) -> Iterator[str]:
    """Yield messages for the user about frames, encodings, clocks and damage."""
    container, topics = opening.messages.container, opening.messages.odometry.topics
    if len(opening.times.times) > 1:
        yield (
            f"the frame of the scans of {topics.chosen['scan'].name} is one of several "
            f"({', '.join(opening.times.times)}): each is placed by its own fixed transform, and left out "
            "without one"
        )
    if not opening.decoder.levels:
        yield (
            f"by the orientation in {topics.chosen['imu'].name} the robot would lie on its side or back: it "
            f"is not used (no fixed transform to {opening.mounting.base or 'the base'}, or an IMU whose z "
            "axis points down)"
        )
    unnamed = {channel.topic for channel in container.channels if not channel.encoding}
    read = [topic.name for topic in topics.recorded() if topic.read_as and topic.name in unnamed]
    if read:
        yield f"the recording does not name the serialization format of {', '.join(read)}: CDR is assumed"
    if times := container.clock_steps:
        yield (
            f"the recorder's clock was set back {'once' if times == 1 else f'{times} times'}: the run goes "
            "on in the order of the file"
        )
    yield from opening.messages.clock.warnings
    if opening.messages.is_clock_set():
        yield "a clock was set during the recording: its times go on evenly in the order of the file"
    if opening.is_cut:
        yield "the recording is cut or damaged: only whole messages are read"


def _detailed(topic: RecordedTopic, opening: RosOpening) -> RecordedTopic:
    """Return the description of a topic with its rate, family, fields and frames and, if it has points, their
    times and its range sigma."""
    container, mounting = opening.messages.container, opening.mounting
    numbers = frozenset(channel.number for channel in container.channels if channel.topic == topic.name)
    frame, child = opening.frames[topic.name]
    place = child or frame
    is_assumed = not (mounting.base and place) or (
        place != mounting.base and mounting.is_assumed and place == mounting.lidar
    )
    fields, organised = _fields_of(topic, numbers, opening)
    family = family_of(fields, topic.type, names=(topic.name, frame), organised=organised)
    times, range_sigma = "", None
    if topic.read_as == "scan":
        # Later frames, whose times are decided by their first clouds, are included.
        times = TopicTimes(opening.decoder.times, opening.times.reasons).words
        range_sigma = opening.sensor.range_sigma
    elif topic.fits == "scan":
        times, range_sigma = _unread_points(Topic(topic.name, topic.type, numbers, topic.messages), opening)
    return replace(
        topic,
        rate_hz=container.rate_hz(numbers),
        family="" if family is None or topic.fits != "scan" else family.name,
        fields=tuple(f"{name} {kind}" for name, kind in fields.items()),
        frame=frame,
        chain=() if is_assumed else opening.tree.chain(mounting.base, place)[::-1],
        times=times if topic.type in TIMED_TYPES else "",
        range_sigma=range_sigma,
    )


def _unread_points(topic: Topic, opening: RosOpening) -> tuple[str, float | None]:
    """Return the times of the points of a topic that is not read, as text, and its range sigma [m]; "" and
    None if none of its first messages has points, or it is of a planar laser."""
    container = opening.messages.container
    decoder = RecordDecoder(container.by_number, opening.tree)
    for message in container.first(topic.numbers, _TRIES if topic.msgtype != LASER_SCAN else 0):
        try:
            with np.errstate(all="ignore"):
                scan = decoder.scan(message, 0, {})[0]
        except Exception:  # noqa: S112 - as in RecordDecoder.record
            continue
        if len(scan.points):
            return times_of_topic(container, decoder, topic).words, measured_range_sigma(scan)
    return "", None


def _fields_of(
    topic: RecordedTopic, numbers: Collection[int], opening: RosOpening
) -> tuple[dict[str, str], bool]:
    """Return a dict from the names of the fields of a PointCloud2 topic to their types, and whether its
    clouds have several rows; empty for other types, and if no message can be read."""
    for message in opening.messages.container.first(numbers, 1) if topic.type == POINT_CLOUD else ():
        try:
            cloud = opening.decoder.message(message)
            names = {
                str(field.name): np.dtype(TYPES[int(field.datatype)]).name
                for field in cloud.fields[:_MOST_FIELDS]
                if int(field.datatype) in TYPES
            }
            return names, int(cloud.height) > 1
        except Exception:  # as in RecordDecoder.record
            return {}, False
    return {}, False


def _missing(opening: RosOpening) -> Iterator[str]:
    """Yield what the recording lacks, what this costs, and what helps."""
    odometry, mounting = opening.messages.odometry, opening.mounting
    scans = odometry.topics.chosen["scan"]
    frame = opening.frames[scans.name][0]
    if not odometry.is_known:
        yield (
            "odometry: the motion is found from the scans alone, which drifts and fails in open ground; "
            "record nav_msgs/Odometry or the transform odom to base_link, or give --odometry file:poses.txt"
        )
    if "imu" not in odometry.topics.chosen:
        yield (
            "IMU: scans are not levelled while the robot tilts, and slipping wheels show less; record "
            "sensor_msgs/Imu and the fixed transform of its frame"
        )
    is_timed = opening.decoder.times.get(frame) is not None or bool(odometry.world)
    if scans.msgtype == POINT_CLOUD and not is_timed:
        rate_hz = opening.messages.container.rate_hz(scans.numbers) or 10.0
        yield (
            f"times of points: scans are not de-skewed, and at 1 m/s each is smeared by up to "
            f"{100.0 / rate_hz:.0f} cm; let the driver of the LiDAR write a field t, time or timestamp"
        )
    if mounting.is_assumed:
        yield (
            f"the fixed transform from {frame or 'the LiDAR'} to {mounting.base or 'the base'}: the mounting "
            "is assumed, and an error of it bends the map; record /tf_static, or give --mount"
        )
