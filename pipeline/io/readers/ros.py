"""ROS recordings (.mcap, .db3, .bag) as a source: clouds or Velodyne packets, odometry, IMU, transforms."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.ground_truth import ATTACHMENT, SIZE_LIMIT, read_truth
from pipeline.io.readers.base import SourceOptions, count_loss, digest_of
from pipeline.io.readers.camera import MessageSource
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.measured_poses import FrameAlignments, readings_of
from pipeline.io.readers.message_time import Stamped, in_order_of_stamps
from pipeline.io.readers.robot_body import body_words
from pipeline.io.readers.ros_description import RosOpening, describe
from pipeline.io.readers.ros_first_scans import find_first_scan, times_of_topic
from pipeline.io.readers.ros_messages import Content, TimedMessages
from pipeline.io.readers.ros_mounting import LateTransforms, contradiction_of_yaw, find_mounting
from pipeline.io.readers.ros_odometry import choose_odometry, first_frames, nearness
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.ros_tilt import TiltCheck, check_tilt, spread_scans
from pipeline.io.readers.scan_columns import (
    FARTHEST_MEDIAN,
    NO_METRES,
    median_range,
    rings_descend,
    sensor_of,
)
from pipeline.io.readers.scan_frames import FramedScan, ScanFrames
from pipeline.io.readers.topics import Topics, choose_topics, group_topics
from pipeline.io.readers.transforms import Extrinsics, TransformTree
from pipeline.types.records import Imu, Notice, Record, Scan, Sensor, Truth

CONTRADICTION = (
    "motions of scans that contradict the odometry: it is of another robot, or its wheels slip, and "
    "the map may be wrong; --odometry lidar uses the scans alone"
)
UNKNOWN_YAW = (
    "motions of scans of a LiDAR that is tilted by more than 45 degrees by the ground: they do not show its "
    "yaw; give its pose with --mount"
)
#: Number of IMU messages in which an orientation is looked for.
_TRIES = 20
#: Cosine of the tilt of a robot above which an IMU has other axes: these differ by 90 or 180 degrees, and no
#: robot stands on a slope of half of that.
_UPRIGHT = np.cos(np.radians(45.0))


@dataclass(frozen=True, slots=True, eq=False)
class RecordReader:
    """Turns messages into records.

    Attributes:
        messages: The messages.
        decoder: Their decoder.
        new_frames: Function that returns new `ScanFrames` for a reading from the start.
        top_ring: Number of the lowest ring, if the rings are numbered from above, so that they are turned
            over; None if they are numbered from below, as defined for `Scan`, or have no numbers.
    """

    messages: TimedMessages
    decoder: RecordDecoder
    new_frames: Callable[[], ScanFrames]
    top_ring: int | None = None

    def read(self, numbers: Collection[int], losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records of some channels in the order of time, scans after others of the same time.

        Args:
            numbers: Numbers of the channels.
            losses: Dict from reasons to numbers of messages that cannot be used, or come too late; increased
                in place.

        Raises:
            SourceError: The recording cannot be read on.
        """
        clock, frames = self.messages.clock.again(), self.new_frames()
        arrivals = self.messages.read(numbers, losses, clock)
        for stamped in in_order_of_stamps(arrivals, losses, clock.window_ns):
            yield from (Notice(stamped.stamp_ns, text) for text in clock.notices)
            clock.notices.clear()
            yield from self.decode(stamped, frames, losses)
        yield from frames.end(losses)

    def decode(
        self, stamped: Stamped[Content], frames: ScanFrames, losses: dict[str, int]
    ) -> Iterator[Record]:
        """Yield the records that are complete with the next content of a message, none if it cannot be used.

        Args:
            stamped: The content, in the order of time.
            frames: Frames of the scans of this reading.
            losses: As in `read`.
        """
        content = stamped.content
        if not isinstance(content, Message):
            yield from frames.add(content, losses)
            return
        record = self.decoder.record(content, stamped.stamp_ns, losses)
        if isinstance(record, Scan):
            scan = FramedScan(self.messages.frame_of(content), self._upright(record))
            yield from frames.add(scan, losses)
        elif record is not None:
            yield from frames.add(record, losses)

    def _upright(self, scan: Scan) -> Scan:
        """Return a scan whose rings are numbered from below; those above `top_ring` become 0."""
        if self.top_ring is None or scan.ring is None:
            return scan
        return replace(scan, ring=np.maximum(self.top_ring - scan.ring, 0).astype(np.int32))


class RosSource(MessageSource):
    """Source of records from ROS messages, in a recording or live.

    Args:
        uri: URI as the user wrote it.
        container: The recording, or the first messages of a live run; the source closes it.
        paths: Files of the recording, for the digest.
        options: Topics and extrinsics chosen by the user.
        live: Whether the run is live: `records_of` gets all messages, in the order of arrival.

    Attributes:
        notices: New messages for the user from `records_of`; whoever shows them clears the list.

    Raises:
        SourceError: There are no scans, none of the first ones can be read, or a topic chosen by the user
            does not fit.
    """

    def __init__(
        self, uri: str, container: Container, paths: list[Path], options: SourceOptions, *, live: bool = False
    ) -> None:
        """Open the source: choose topics and clock, read transforms and the first scan, and align measured
        poses.

        Raises:
            SourceError: There are no scans, none of the first ones can be read, or a topic chosen by the user
                does not fit.
            OSError: A file cannot be read.
        """
        super().__init__(container)
        is_cut, channels = bool(container.damage), container.by_number
        every = Topics({}, tuple(group_topics(channels.values())))
        extrinsics = Extrinsics(container, every.transforms(fixed=True), every.transforms(fixed=False))
        self._tree = tree = extrinsics.tree
        frames = first_frames(container, every.every, tree)
        topics = choose_topics(channels.values(), options.topics, uri, partial(nearness, tree, frames))
        odometry = choose_odometry(extrinsics, topics, frames, options.topics, live=live)
        scans = odometry.topics.chosen["scan"]
        decoder = RecordDecoder(channels, tree, readings_of(odometry.topics))
        self._truth, sensor, spoilt = _attached_truth(container, uri)
        times = times_of_topic(container, decoder, scans)
        decoder.times.update(times.times)
        messages = TimedMessages(container, extrinsics, odometry, decoder.times.values())
        where = f"{uri}, topic {scans.name}"
        found = find_first_scan(messages, decoder, frames[scans.name][0], where)
        if median_range(found.scan) > FARTHEST_MEDIAN:
            count_loss(self._damage, NO_METRES, scans.count)
        mounting = find_mounting(found, odometry, extrinsics, messages, decoder, options, live=live)
        self._late = LateTransforms(extrinsics, mounting, every.transforms(fixed=True))
        tilted = mounting.T_base_lidar if mounting.is_assumed and not mounting.shows_yaw else None
        if tilted is not None and abs(tilted.R[2, 2]) < _UPRIGHT:
            count_loss(self._damage, UNKNOWN_YAW, scans.count)
        elif mounting.contradicting:
            count_loss(self._damage, CONTRADICTION, mounting.contradicting)
        if mounting.odometry is not odometry:
            messages = TimedMessages(container, extrinsics, mounting.odometry, decoder.times.values())
        if mounting.is_measured and mounting.T_base_lidar is not None:
            tree.add(mounting.base, found.frame, mounting.T_base_lidar)  # also for an IMU in the same housing
        decoder.base = mounting.base
        T_base_lidar = mounting.T_base_lidar or Pose3.identity()
        new_frames = partial(ScanFrames, tree, found.frame, T_base_lidar, odometry.world)
        reader = RecordReader(messages, decoder, new_frames)
        first = _first_placed_scan(reader, where) if odometry.world else found.scan
        sensor = sensor or sensor_of(first, found.sensor)
        if sensor.rings and rings_descend(first):
            reader = replace(reader, top_ring=sensor.rings - 1)
        decoder.levels = _is_upright(messages, decoder)
        tilt, body = TiltCheck(), tuple[str, ...]()
        if not live and not odometry.world and sensor.rings != 1:
            is_recorded = mounting.base != found.frame and tree.find(mounting.base, found.frame) is not None
            is_recorded = is_recorded and not mounting.is_measured and options.T_base_lidar is None
            blamed = "the fixed transform is wrong" if is_recorded else ""
            if mounting.is_assumed:
                blamed = f"no fixed transform from {found.frame or 'the LiDAR'} to {mounting.base} tells it"
            scans_of_run = spread_scans(messages, decoder, found.frame, T_base_lidar)
            tilt = check_tilt(messages, decoder, scans_of_run, blamed)
            body = body_words([points for _, points in scans_of_run])
        if tilt.scans:
            count_loss(self._damage, tilt.reason, tilt.scans)
        opening = RosOpening(messages, tree, frames, decoder, times, mounting, sensor, first, is_cut)
        warnings = (*odometry.warnings, *spoilt, *times.warnings, *mounting.warnings, *tilt.warnings, *body)
        described = describe(opening, uri, digest_of(paths), warnings)
        decoder.levels = decoder.levels and tilt.uses_imu
        self._alignments = FrameAlignments(decoder, messages)
        self._description = self._alignments.begin(described, live=live)
        self.notices = self._alignments.notices
        self.base, self._reader, self._mounting = mounting.base, reader, mounting
        self._offset_ns = messages.clock.offset_ns
        self._picture_channels = {number: channels[number] for number in odometry.topics.numbers("camera")}
        # A live run starts again with its first message: another clock than that of the opening.
        self._live_clock, self._live_frames = messages.clock.again(self.notices), new_frames()

    def records(self) -> Iterator[Record]:
        """Yield records in the order of time, scans after other records of the same time. Messages that
        cannot be used, or come too late, are counted in `losses`. SourceError if the recording cannot be
        read on."""
        losses: dict[str, int] = {}
        self._losses = losses
        yield from self._reader.read(self._wanted(), losses)

    def records_of(self, message: Message, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records of one message of a live run; none for a channel that is not read. Call it in the
        order of arrival. Messages for the user are added to `notices`.

        Args:
            message: The message.
            losses: Dict from reasons to numbers of contents that cannot be used; increased in place.
        """
        if late := self._late.notice(message):
            self.notices.append(late)
        if message.channel in self._wanted():
            for stamped in self._reader.messages.times_of(self._live_clock, message, losses):
                self._alignments.add(stamped)
                yield from self._reader.decode(stamped, self._live_frames, losses)

    def contradiction_of_mounting(self) -> str:
        """Return a message if the motion of the scans contradicts the yaw of the fixed transforms, see
        `contradiction_of_yaw`; for a map that contradicts the odometry."""
        return contradiction_of_yaw(self._mounting, self._reader.messages, self._reader.decoder)

    def truth(self) -> Truth | None:
        """Return the ground truth attached to a simulated recording, None when there is none."""
        return self._truth

    def readings(self, role: str) -> list[Any]:
        """Return all readings of a role, see `ReadingFormat`, with their times by the clock of the source, in
        the order of recording. Messages that are damaged, have no reading or an impossible time are left out,
        not counted; [] if there is no topic. SourceError if the recording cannot be read."""
        found, messages = list[Any](), self._reader.messages
        kinds = readings_of(messages.odometry.topics)
        for stamped in messages.messages([n for n, kind in kinds.items() if kind.role == role]):
            try:
                kind = kinds[stamped.content.channel]
                reading, _ = kind.read(self._reader.decoder, stamped.content, stamped.stamp_ns)
            except Exception:  # noqa: S112 - as in RecordDecoder.record
                continue
            if reading is not None:
                found.append(reading)
        return found

    def _wanted(self) -> frozenset[int]:
        """Return the numbers of the channels that are read."""
        return self._reader.messages.odometry.wanted | self._alignments.numbers

    def _fixed_transforms(self) -> TransformTree:
        """Return the fixed transforms."""
        return self._tree

    def _time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a picture [ns] by the clock of the source, None if it has no possible time."""
        return self._reader.messages.clock.near(stamp_ns, message)


def _attached_truth(container: Container, uri: str) -> tuple[Truth | None, Sensor | None, tuple[str, ...]]:
    """Return the attached ground truth and sensor, None for each that is missing, and a message for the user
    if the attachment is damaged."""
    try:
        content = container.attachment(ATTACHMENT, SIZE_LIMIT)
        return (None, None, ()) if content is None else (*read_truth(content, uri), ())
    except SourceError as error:
        return None, None, (f"the attached ground truth is not used: {error.what}",)


def _first_placed_scan(reader: RecordReader, where: str) -> Scan:
    """Return the first scan that the odometry moves back from the frame of a map. SourceError, which names
    the recording `where`, if there is none."""
    odometry = reader.messages.odometry
    for record in reader.read(odometry.wanted, {}):
        if isinstance(record, Scan):
            return record
    raise SourceError(
        f"the clouds are in the frame {odometry.world[0]} of the odometry, and it has no pose at their times",
        where=where,
        remedy="Name the topic of the LiDAR itself with --topic scan=NAME.",
    )


def _is_upright(messages: TimedMessages, decoder: RecordDecoder) -> bool:
    """Return whether the first orientation of the IMU among its first _TRIES messages is that of a robot that
    stands (_UPRIGHT); True if there is none."""
    for message in messages.container.first(messages.odometry.topics.numbers("imu"), _TRIES):
        reading = decoder.record(message, 0, {})
        if isinstance(reading, Imu) and reading.orientation is not None:
            return bool(Pose3.from_quaternion(np.zeros(3), reading.orientation).R[2, 2] > _UPRIGHT)
    return True
