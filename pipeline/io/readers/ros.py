"""ROS recordings (.mcap, .db3, .bag) as a source: clouds or Velodyne packets, odometry, IMU, transforms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.ground_truth import ATTACHMENT, SIZE_LIMIT, read_truth
from pipeline.io.readers.base import SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.camera import MessageSource
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.measured_poses import Fix, FrameAlignments
from pipeline.io.readers.message_time import (
    Clock,
    ClockStepFilter,
    Stamped,
    header_stamp,
    in_order_of_stamps,
)
from pipeline.io.readers.mounting import mounting_by_ground
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.scan_columns import rings_descend, sensor_of
from pipeline.io.readers.topics import LASER_SCAN, choose_topics
from pipeline.io.readers.transforms import Extrinsics, TransformTree, frame_name
from pipeline.io.readers.velodyne import SENSORS
from pipeline.types.records import Imu, Odometry, Record, Scan, Sensor, Truth

#: Number of unreadable scans at the start after which the recording is refused.
_TRIES = 20
#: Cosine of the tilt of a robot above which an IMU has other axes: these differ by 90 or 180 degrees, and no
#: robot stands on a slope of half of that.
_UPRIGHT = np.cos(np.radians(45.0))


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
        self._uri = uri
        self._channels = {channel.number: channel for channel in container.channels}
        self._topics = topics = choose_topics(self._channels.values(), options.topics, uri)
        self._extrinsics = Extrinsics(container)
        self._extrinsics.read(topics.transforms(fixed=True), topics.transforms(fixed=False))
        self._records = RecordDecoder(self._channels, self._extrinsics.tree)
        self._warnings: list[str] = []
        self._picture_channels = {number: self._channels[number] for number in topics.numbers("camera")}
        named = [topics.numbers(role) for role in ("scan", "odometry", "imu") if role in topics.chosen]
        offsets_ns = [self._clock_offset(numbers) for numbers in named]
        self._clock = ClockStepFilter(offsets_ns) if live else Clock(offsets_ns)
        self._offset_ns = self._clock.offset_ns
        self._moving = frozenset[int]()  # channels of transforms that are read as odometry
        if "odometry" not in topics.chosen and self._extrinsics.odometry_link is not None:
            self._moving = topics.transforms(fixed=False)
        self._wanted = self._moving.union(*named)
        self._truth, sensor = self._read_truth()
        first, frame, product = self._first_scan()
        sensor = sensor or sensor_of(first, SENSORS.get(product))
        self._top_ring = sensor.rings - 1 if rings_descend(first) else None
        described = self._describe(first, frame, sensor, digest_of(paths), options)
        self._records.poses = topics.numbers("pose")
        odometry = topics.numbers("odometry") or self._moving
        self._alignments = FrameAlignments(container, self._records, topics, odometry, self._times_of)
        self._description = self._alignments.begin(described, live=live)
        self.notices = self._alignments.notices
        if live:
            # The run starts again with its first message: the clock forgets the messages that were read here.
            self._clock = ClockStepFilter(offsets_ns, self.notices)

    def records(self) -> Iterator[Record]:
        """Yield records in the order of time, scans after other records of the same time. Messages that
        cannot be used, or come too late, are counted in `losses`. SourceError if the recording cannot be
        read on."""
        losses: dict[str, int] = {}
        self._losses = losses
        for stamped in in_order_of_stamps(self._arrivals(losses), losses):
            yield from self._decoded(stamped, losses)

    def records_of(self, message: Message, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records of one message of a live run; none for a channel that is not read. Call it in the
        order of arrival. Messages for the user are added to `notices`.

        Args:
            message: The message.
            losses: Dict from reasons to numbers of contents that cannot be used; increased in place.
        """
        if message.channel in self._wanted or message.channel in self._alignments.numbers:
            for stamped in self._times_of(message, losses):
                self._alignments.add(stamped)
                yield from self._decoded(stamped, losses)

    def truth(self) -> Truth | None:
        """Return the ground truth attached to a simulated recording, None when there is none."""
        return self._truth

    def fixes(self) -> list[Fix]:
        """Return all GNSS fixes of the recording with their times by the clock of the source, in the order of
        recording. Messages that are damaged, have no fix or an impossible time are left out, not counted; []
        if there is no GNSS topic. SourceError if the recording cannot be read."""
        found = []
        for message in self._container.messages(self._topics.numbers("gnss"), None, {}):
            for stamped in self._stamped(message, {}):
                try:
                    fix, _ = self._records.fix(stamped.content, stamped.stamp_ns)
                except Exception:  # noqa: S112 - as in RecordDecoder.record
                    continue
                if fix is not None:
                    found.append(fix)
        return found

    def _fixed_transforms(self) -> TransformTree:
        """Return the fixed transforms."""
        return self._extrinsics.tree

    # --- reading ---------------------------------------------------------------------------------

    def _time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a message [ns] by the clock of the source, None if it has no possible time; see
        `time_of` of `Clock` and, for a live run, of `ClockStepFilter`."""
        return self._clock.time_of(stamp_ns, message)

    def _arrivals(self, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        """Yield the messages that are read with their times, in the order of recording; what cannot be used
        is counted in `losses`."""
        wanted = self._wanted | self._alignments.numbers
        for message in self._container.messages(wanted, None, losses):
            yield from self._times_of(message, losses)

    def _times_of(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        """Yield the message itself with its time, or, for a channel of moving transforms, each odometry that
        the message contains with its time; see `_stamped` and `_transforms`. Entries with an impossible time,
        and transforms that cannot be read, are omitted and counted in `losses`."""
        if message.channel in self._moving:
            return self._transforms(message, losses)
        return self._stamped(message, losses)

    def _decoded(self, stamped: Stamped[Message | Odometry], losses: dict[str, int]) -> Iterator[Record]:
        """Yield the record of a message, none if it cannot be used (counted in `losses`). Rings of scans are
        numbered from below."""
        if isinstance(stamped.content, Odometry):
            yield stamped.content
            return
        record = self._records.record(stamped.content, stamped.stamp_ns, losses)
        if isinstance(record, Scan):
            yield self._upright(record)
        elif record is not None:
            yield record

    def _stamped(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message]]:
        """Yield a message with its time, with the rank 1 for a scan and 0 for others; nothing, counted in
        `losses`, if its time is impossible."""
        time_ns = self._clock.time_of(header_stamp(self._channels[message.channel], message.payload), message)
        if time_ns is None:
            count_loss(losses, "messages with an impossible time stamp")
        else:
            yield Stamped(time_ns, int(message.channel in self._topics.numbers("scan")), message)

    def _transforms(self, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message | Odometry]]:
        """Yield the odometry in a message of moving transforms, with its time; transforms between other
        frames are ignored; impossible times, and what cannot be read, are counted in `losses`."""
        for stamp_ns, parent, child, pose in self._extrinsics.decode(message, losses):
            if (parent, child) == self._extrinsics.odometry_link:
                time_ns = self._clock.time_of(stamp_ns, message)
                if time_ns is None:
                    count_loss(losses, "messages with an impossible time stamp")
                else:
                    yield Stamped(time_ns, 0, Odometry(time_ns, pose))

    def _upright(self, scan: Scan) -> Scan:
        """Return a scan whose rings are numbered from below, as defined for `Scan`. It is the argument if it
        has no ring numbers, or if the rings of the first scan were numbered from below. Rings above the
        number of rings of the sensor become 0."""
        if self._top_ring is None or scan.ring is None:
            return scan
        return replace(scan, ring=np.maximum(self._top_ring - scan.ring, 0).astype(np.int32))

    # --- opening ---------------------------------------------------------------------------------

    def _clock_offset(self, numbers: frozenset[int]) -> int | None:
        """Return stamp minus time of recording of the first message of some channels [ns]; None if there is
        no message, or its stamp is missing or 0."""
        for message in islice(self._container.messages(numbers, None, {}), 1):
            stamp_ns = header_stamp(self._channels[message.channel], message.payload)
            return stamp_ns - message.log_ns if stamp_ns else None
        return None

    def _first_scan(self) -> tuple[Scan, str, int]:
        """Return the first scan with points, its frame and the product number of the sensor (0 if unknown).

        Raises:
            SourceError: None of the first _TRIES messages has points that can be read.
        """
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
            where=f"{self._uri}, topic {self._topics.chosen['scan'].name}",
            remedy="Name another with --topic scan=NAME.",
        )

    def _scan_arrivals(self, log_start: int | None) -> Iterator[Stamped[Message]]:
        """Yield the messages of the scan topic with their times, from a time of recording on [ns] (None:
        all)."""
        for message in self._container.messages(self._topics.numbers("scan"), log_start, {}):
            yield from self._stamped(message, {})

    def _is_clock_set(self) -> bool:
        """Return whether no stamp of the last scans (`Container.tail_ns`) fits to their times of recording
        (`Clock.is_stepped`); False if there are no stamps."""
        numbers = self._topics.numbers("scan")
        stamps = [
            self._clock.is_stepped(stamp_ns, message)
            for message in self._container.messages(numbers, self._container.tail_ns(numbers), {})
            if (stamp_ns := header_stamp(self._channels[message.channel], message.payload)) is not None
        ]
        return bool(stamps) and all(stamps)

    def _last_stamp(self) -> int | None:
        """Return the time of the last scan [ns]; None if no message near the end has a possible time."""
        tail_ns = self._container.tail_ns(self._topics.numbers("scan"))
        return max((arrival.stamp_ns for arrival in self._scan_arrivals(tail_ns)), default=None)

    def _read_truth(self) -> tuple[Truth | None, Sensor | None]:
        """Return the attached ground truth and sensor, None for each that is missing. A damaged attachment
        becomes a warning."""
        try:
            content = self._container.attachment(ATTACHMENT, SIZE_LIMIT)
            return (None, None) if content is None else read_truth(content, self._uri)
        except SourceError as error:
            self._warnings.append(f"the attached ground truth is not used: {error.what}")
            return None, None

    def _odometry_base(self) -> str:
        """Return the base frame named by the first message of the odometry topic, "" if there is none or it
        is damaged."""
        numbers = self._topics.numbers("odometry")
        for message in islice(self._container.messages(numbers, None, {}), 1 if numbers else 0):
            try:
                return frame_name(self._records.message(message).child_frame_id)
            except Exception:  # as in RecordDecoder.record
                return ""
        return ""

    def _is_upright(self) -> bool:
        """Return whether the first orientation of the IMU among its first _TRIES messages is that of a robot
        that stands (_UPRIGHT); True if there is none."""
        numbers = self._topics.numbers("imu")
        for message in islice(self._container.messages(numbers, None, {}), _TRIES if numbers else 0):
            reading = self._records.record(message, 0, {})
            if isinstance(reading, Imu) and reading.orientation is not None:
                return bool(Pose3.from_quaternion(np.zeros(3), reading.orientation).R[2, 2] > _UPRIGHT)
        return True

    def _describe(
        self, first: Scan, frame: str, sensor: Sensor, digest: str, options: SourceOptions
    ) -> SourceDescription:
        """Return the description of the source with all warnings, to which some about frames, times and
        damage are added, and set the base frame of the source and of its decoder.

        Args:
            first: First scan.
            frame: Name of the frame of the first scan.
            sensor: The LiDAR.
            digest: Digest of the files.
            options: Extrinsics chosen by the user; without them, those of the transforms, else those by the
                ground (`mounting_by_ground`), else identity.
        """
        chosen = self._topics.chosen
        of_odometry = self._odometry_base()
        self._records.base = self.base = base = self._extrinsics.base_frame(of_odometry, frame)
        has_odometry = "odometry" in chosen or bool(self._moving)
        # A frame without a name has no place on the robot, not even that of a base without a name.
        linked = options.T_base_lidar or (self._extrinsics.tree.find(base, frame) if frame else None)
        warnings = self._warnings
        if linked is None and (linked := mounting_by_ground(first)) is not None:
            self._extrinsics.tree.add(base, frame, linked)  # also for an IMU in the same housing
            tilt = np.degrees(np.arccos(np.clip(linked.R[2, 2], -1.0, 1.0)))
            warnings.append(
                f"no fixed transform from {frame or 'the LiDAR'} to {base or 'the base'}: by the ground in "
                f"the first scan, the LiDAR is tilted by {tilt:.0f} degrees and {linked.t[2]:.1f} m high; "
                "--mount overrides this"
            )
        elif linked is None and has_odometry and base != frame:
            warnings.append(
                f"no fixed transform from {frame or 'the LiDAR'} to {base or 'the base'}: "
                "the LiDAR is assumed to be at the base"
            )
        if of_odometry and self._extrinsics.tree.find(of_odometry, base) is None:
            warnings.append(
                f"no fixed transform from {of_odometry} to {base}: both are taken as the same frame"
            )
        self._records.levels = self._is_upright()
        if not self._records.levels:
            warnings.append(
                f"by the orientation in {chosen['imu'].name} the robot would lie on its side or back: it is "
                f"not used (no fixed transform to {base or 'the base'}, or an IMU whose z axis points down)"
            )
        unnamed = {channel.topic for channel in self._channels.values() if not channel.encoding}
        read = [topic.name for topic in self._topics.recorded() if topic.read_as and topic.name in unnamed]
        if read:
            warnings.append(
                f"the recording does not name the serialization format of {', '.join(read)}: CDR is assumed"
            )
        if self._container.clock_steps:
            times = self._container.clock_steps
            warnings.append(
                f"the recorder's clock was set back {'once' if times == 1 else f'{times} times'}: "
                "the run goes on in the order of the file"
            )
        if self._clock.by_stamp and self._is_clock_set():
            warnings.append(
                "the clock of the time stamps was set during the recording: times of recording are used from "
                "then on"
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
            has_imu="imu" in chosen,
            scans=chosen["scan"].count,
            start_ns=first.stamp_ns,
            end_ns=self._last_stamp(),
            digest=digest,
            preset="laser2d" if chosen["scan"].msgtype == LASER_SCAN else "forest",
            topics=self._topics.recorded(),
            warnings=tuple(warnings),
        )
