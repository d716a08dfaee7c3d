"""ROS recordings (.mcap, .db3, .bag) as a source: clouds or Velodyne packets, odometry, IMU, transforms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.ground_truth import ATTACHMENT, SIZE_LIMIT, read_truth
from pipeline.io.readers.base import SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.camera import Camera, MessageSource, RecordedPictures, find_camera
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.frame_alignment import FrameAlignments
from pipeline.io.readers.message_time import WINDOW_NS, Clock, Stamped, by_stamp, header_stamp
from pipeline.io.readers.ros_bags import BagFile, BagFolder, Db3File, bag_files
from pipeline.io.readers.ros_messages import LASER_SCAN, MessageDecoder
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.scan_columns import rings_descend, sensor_of
from pipeline.io.readers.topics import Topic, choose_topics
from pipeline.io.readers.transforms import Extrinsics, frame_name
from pipeline.io.readers.velodyne import SENSORS
from pipeline.types.records import Odometry, Record, Scan, Sensor, Truth

#: Number of unreadable scans at the start after which the recording is refused.
_TRIES = 20


class RosSource(MessageSource):
    """Source of records from ROS messages, in a recording or live.

    Args:
        uri: As the user wrote it.
        container: The recording; the source closes it.
        paths: Files of the recording, for the digest.
        options: Topics and extrinsics chosen by the user.
        make_clock: Makes the clock from stamp minus time of recording of the first message of each topic.
        live: Whether `records_of` gets more messages than the container holds.

    Attributes:
        notices: New messages for the user from `records_of`; whoever shows them clears the list.

    Raises:
        SourceError: It has no scans, or none of the first ones can be read.
    """

    def __init__(
        self,
        uri: str,
        container: Container,
        paths: list[Path],
        options: SourceOptions,
        make_clock: Callable[[list[int | None]], Clock] = Clock,
        *,
        live: bool = False,
    ) -> None:
        super().__init__(container)
        self._uri = uri
        channels: dict[int, Channel] = {channel.number: channel for channel in container.channels}
        decoder = MessageDecoder(channels.values())
        self._channels, self._decoder = channels, decoder
        self._topics = choose_topics(channels.values(), options.topics, uri)
        self._extrinsics = Extrinsics(container, decoder)
        self._extrinsics.read(self._topics.fixed, self._topics.moving)
        self._records = RecordDecoder(channels, decoder, self._extrinsics.tree)
        self._warnings: list[str] = []
        self._camera: tuple[Camera | None, str] | None = None
        named = [t for t in (self._topics.scan, self._topics.odometry, self._topics.imu) if t is not None]
        self._clock = make_clock([self._clock_offset(topic) for topic in named])
        self._moving = self._moving_numbers()
        self._wanted = self._moving.union(*(topic.numbers for topic in named))
        self._truth, sensor = self._read_truth()
        first, frame, product = self._first_scan()
        sensor = sensor or SENSORS.get(product) or sensor_of(first)
        self._top_ring = sensor.rings - 1 if rings_descend(first) else None
        self._description = self._describe(first, frame, sensor, decoder.refused, options)
        self._description = replace(self._description, digest=digest_of(paths))
        self._records.poses = frozenset() if self._topics.pose is None else self._topics.pose.numbers
        odometry = self._moving if self._topics.odometry is None else self._topics.odometry.numbers
        self._alignments = FrameAlignments(container, self._records, self._topics, odometry, self._times_of)
        self._description = self._alignments.begin(self._description, live=live)
        self.notices = self._alignments.notices

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield records in the order of time; messages before `start_ns` are not decoded."""
        losses: dict[str, int] = {}
        self._losses = losses
        for stamped in by_stamp(self._arrivals(start_ns, losses), losses):
            yield from self._decoded(stamped, losses)

    def records_of(
        self, message: Message, losses: dict[str, int], from_ns: int | None = None
    ) -> Iterator[Record]:
        """Yield the records of one message.

        Args:
            message: The message.
            losses: Counts contents that cannot be used.
            from_ns: Time of the first record [ns]; None for all.
        """
        if message.channel in self._wanted or message.channel in self._alignments.numbers:
            for stamped in self._times_of(message, losses):
                self._alignments.add(stamped)
                if from_ns is None or stamped.stamp_ns >= from_ns:
                    yield from self._decoded(stamped, losses)

    def use_clock(self, clock: Clock) -> None:
        """Use another clock from now on."""
        self._clock = clock

    def truth(self) -> Truth | None:
        """Return the ground truth attached to a simulated recording, None when there is none."""
        return self._truth

    def camera(self) -> tuple[Camera | None, str]:
        """Return the camera, or None and the reason why it is unknown, "" when there is no camera."""
        topic = self._topics.camera
        if topic is None:
            return None, ""
        if self._camera is None:  # needed for each picture
            self._camera = find_camera(
                self._container, self._decoder, self._extrinsics.tree, self._records.base, topic.numbers
            )
        return self._camera

    @property
    def base(self) -> str:
        """Name of the base frame, "" when it is unknown."""
        return self._records.base

    # --- reading ---------------------------------------------------------------------------------

    def _pictures(self) -> RecordedPictures:
        numbers = frozenset[int]() if self._topics.camera is None else self._topics.camera.numbers
        clock = self._clock
        return RecordedPictures(
            self._container, self._decoder, self._channels, numbers, clock.time_of, clock.offset_ns
        )

    def _arrivals(
        self, start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Stamped[Message | Odometry]]:
        """Yield the messages that are read with their times, in the order of recording.

        Args:
            start_ns: Time of the first message [ns]; None for all.
            losses: Counts what cannot be used.
        """
        log_start = None if start_ns is None else start_ns - self._clock.offset_ns - WINDOW_NS
        wanted = self._wanted | self._alignments.numbers
        for message in self._container.messages(wanted, log_start, losses):
            for arrival in self._times_of(message, losses):
                if start_ns is None or arrival.stamp_ns >= start_ns:
                    yield arrival

    def _times_of(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        """Yield the contents of a message with their times."""
        if message.channel in self._moving:
            return self._transforms(message, losses)
        return self._stamped(message, losses)

    def _decoded(self, stamped: Stamped[Message | Odometry], losses: dict[str, int]) -> Iterator[Record]:
        if isinstance(stamped.content, Odometry):
            yield stamped.content
            return
        record = self._records.record(stamped.content, stamped.stamp_ns, losses)
        if isinstance(record, Scan):
            yield self._upright(record)
        elif record is not None:
            yield record

    def _stamped(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        time_ns = self._clock.time_of(header_stamp(self._channels[message.channel], message.payload), message)
        if time_ns is None:
            count_loss(losses, "messages with an impossible time stamp")
        else:
            yield Stamped(time_ns, int(message.channel in self._topics.scan.numbers), message)

    def _transforms(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        """Yield odometry that is recorded as a moving transform."""
        for stamp_ns, parent, child, pose in self._extrinsics.decode(message):
            if (parent, child) == self._extrinsics.odometry_link:
                time_ns = self._clock.time_of(stamp_ns, message)
                if time_ns is None:
                    count_loss(losses, "messages with an impossible time stamp")
                else:
                    yield Stamped(time_ns, 0, Odometry(time_ns, pose))

    def _upright(self, scan: Scan) -> Scan:
        """Return a scan whose rings are numbered from below, as defined for `Scan`."""
        if self._top_ring is None or scan.ring is None:
            return scan
        return replace(scan, ring=np.maximum(self._top_ring - scan.ring, 0).astype(np.int32))

    # --- opening ---------------------------------------------------------------------------------

    def _moving_numbers(self) -> frozenset[int]:
        if self._topics.odometry is not None or self._extrinsics.odometry_link is None:
            return frozenset()
        return frozenset[int]().union(*(topic.numbers for topic in self._topics.moving))

    def _clock_offset(self, topic: Topic) -> int | None:
        """Return stamp minus time of recording of the first message of a topic [ns], None without a stamp."""
        for message in islice(self._container.messages(topic.numbers, None, {}), 1):
            stamp_ns = header_stamp(self._channels[message.channel], message.payload)
            return stamp_ns - message.log_ns if stamp_ns else None
        return None

    def _first_scan(self) -> tuple[Scan, str, int]:
        """Return the first scan that can be read, its frame and the product number of the sensor."""
        reason = "the topic has no messages that can be read"
        for arrival in islice(self._scan_arrivals(None), _TRIES):
            try:
                with np.errstate(all="ignore"):
                    found = self._records.scan(arrival.content, arrival.stamp_ns, {})
            except Exception as error:  # as in RecordDecoder.record
                reason = f"the first scans cannot be read: {str(error)[:200] or type(error).__name__}"
                continue
            if len(found[0].points):
                return found
            reason = "the first scans have no points"
        raise SourceError(
            reason,
            where=f"{self._uri}, topic {self._topics.scan.name}",
            remedy="Name another with --topic scan=NAME.",
        )

    def _scan_arrivals(self, log_start: int | None) -> Iterator[Stamped[Message]]:
        for message in self._container.messages(self._topics.scan.numbers, log_start, {}):
            for arrival in self._stamped(message, {}):
                if isinstance(arrival.content, Message):
                    yield Stamped(arrival.stamp_ns, arrival.rank, arrival.content)

    def _last_stamp(self) -> int | None:
        tail_ns = self._container.tail_ns(self._topics.scan.numbers)
        return max((arrival.stamp_ns for arrival in self._scan_arrivals(tail_ns)), default=None)

    def _read_truth(self) -> tuple[Truth | None, Sensor | None]:
        try:
            content = self._container.attachment(ATTACHMENT, SIZE_LIMIT)
            return (None, None) if content is None else read_truth(content, self._uri)
        except SourceError as error:
            self._warnings.append(f"the attached ground truth is not used: {error.what}")
            return None, None

    def _odometry_base(self) -> str:
        """Return the base frame named by the odometry topic, "" when there is none."""
        topic = self._topics.odometry
        numbers = frozenset[int]() if topic is None else topic.numbers
        for message in islice(self._container.messages(numbers, None, {}), 1 if numbers else 0):
            try:
                return frame_name(self._records.message(message).child_frame_id)
            except Exception:  # as in RecordDecoder.record
                return ""
        return ""

    def _describe(
        self, first: Scan, frame: str, sensor: Sensor, refused: list[str], options: SourceOptions
    ) -> SourceDescription:
        self._records.base = base = self._extrinsics.base_frame(self._odometry_base())
        has_odometry = self._topics.odometry is not None or bool(self._moving)
        linked = options.T_base_lidar or self._extrinsics.tree.find(base, frame)
        warnings = [
            f"the definition of {topic} in the file is not used: it is not valid" for topic in refused
        ]
        warnings += self._warnings
        if linked is None and has_odometry and base != frame:
            warnings.append(
                f"no fixed transform from {frame or 'the LiDAR'} to {base or 'the base'}: "
                "the LiDAR is assumed to be at the base"
            )
        unnamed = {channel.topic for channel in self._channels.values() if not channel.encoding}
        read = [topic.name for topic in self._topics.recorded() if topic.read_as and topic.name in unnamed]
        if read:
            warnings.append(
                f"the recording does not name the serialization format of {', '.join(read)}: CDR is assumed"
            )
        if not self._clock.by_stamp:
            warnings.append("the time stamps in the messages are inconsistent: times of recording are used")
        if self._container.damage:
            warnings.append("the recording is cut or damaged: only whole messages are read")
        return SourceDescription(
            uri=self._uri,
            kind=self._container.kind,
            sensor=sensor,
            T_base_lidar=linked or Pose3.identity(),
            has_odometry=has_odometry,
            has_imu=self._topics.imu is not None,
            scans=self._topics.scan.count,
            start_ns=first.stamp_ns,
            end_ns=self._last_stamp(),
            digest="",
            preset="laser2d" if self._topics.scan.msgtype == LASER_SCAN else "forest",
            topics=self._topics.recorded(),
            warnings=tuple(warnings),
        )


def open_ros(
    uri: str, open_container: Callable[[], Container], paths: list[Path], options: SourceOptions
) -> RosSource:
    """Open a recording; its files are closed if it cannot be read.

    Args:
        uri: As the user wrote it.
        open_container: Opens the recording.
        paths: Files of the recording, for the digest.
        options: Choices of the user.

    Raises:
        SourceError: See RosSource.
    """
    container = open_container()
    try:
        return RosSource(uri, container, paths, options)
    except BaseException:
        container.close()
        raise


def open_db3(uri: str, path: Path, options: SourceOptions) -> RosSource:
    """Open a ROS 2 bag in SQLite.

    Raises:
        SourceError: See RosSource.
    """
    return open_ros(uri, lambda: Db3File(path), [path], options)


def open_bag(uri: str, path: Path, options: SourceOptions) -> RosSource:
    """Open a ROS 1 bag.

    Raises:
        SourceError: See RosSource.
    """
    return open_ros(uri, lambda: BagFile(path), [path], options)


def open_bag_folder(uri: str, folder: Path, options: SourceOptions) -> RosSource:
    """Open a folder that a ROS 2 recorder wrote.

    Raises:
        SourceError: See RosSource.
    """
    files = bag_files(folder)
    return open_ros(uri, lambda: BagFolder(files), files, options)
