"""ROS recordings (.mcap, .db3, .bag) as a source: clouds or Velodyne packets, odometry, IMU, transforms."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise, takewhile
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Float, Pose3
from pipeline.io.ground_truth import ATTACHMENT, SIZE_LIMIT, read_truth
from pipeline.io.readers.base import RecordedTopic, SourceDescription, SourceOptions, count_loss, digest_of
from pipeline.io.readers.camera import MessageSource
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.firing_order import FIRING_ORDER
from pipeline.io.readers.livox import CUSTOM_TYPES
from pipeline.io.readers.measured_poses import Fix, FrameAlignments
from pipeline.io.readers.message_time import (
    OPENING_MESSAGES,
    Clock,
    Opening,
    Stamped,
    header_frame,
    header_stamp,
    in_order_of_stamps,
)
from pipeline.io.readers.mounting import mounting_by_ground, mounting_by_grounds, tilt_text
from pipeline.io.readers.point_times import PointTimes, TimedScan, decide_point_times
from pipeline.io.readers.ros_records import TYPES, RecordDecoder
from pipeline.io.readers.scan_columns import (
    FARTHEST_MEDIAN,
    NO_METRES,
    measured_range_sigma,
    median_range,
    rings_descend,
    sensor_of,
)
from pipeline.io.readers.scan_frames import FramedScan, MovingLink, ScanFrames
from pipeline.io.readers.sensor_families import family_of
from pipeline.io.readers.topics import (
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    TYPES_BY_ROLE,
    Topic,
    Topics,
    choose_topics,
    decode,
    group_topics,
)
from pipeline.io.readers.transforms import MOVING_MESSAGES, Extrinsics, TransformTree, frame_name
from pipeline.types.records import Imu, Int, Notice, Odometry, Record, Scan, Sensor, Truth
from pipeline.types.units import SECOND_NS

#: Number of IMU messages in which an orientation is looked for.
_TRIES = 20
#: Path by which the yaw of a mounting is found, and how far the robot is from its start when it begins [m].
_MOTION, _BEGUN = 5.0, 0.2
#: Most readings and scans that are read for it.
_MOST_READINGS, _MOST_SCANS = 60_000, 400
#: Number of scans by which the tilt of a LiDAR is found, and least share of points that must fit to the map
#: of the scans before, for their motion to be known.
_LEVELS, _SAME_WORLD = 5, 0.5
CONTRADICTION = (
    "scans whose motion contradicts that of the odometry: it is of another robot, or its wheels slip, and "
    "the "
    "map may be wrong; --odometry lidar uses the scans alone"
)
_MOST_FIELDS = 64
_NO_FIELD = "there is no field with times"
#: Words in usual names of frames of LiDARs.
_LIDAR_WORDS = ("lidar", "velodyne", "livox", "laser", "hesai", "pandar", "os_sensor", "ouster", "rslidar")
#: Number of scans by which the times of points are decided.
_TIMED_SCANS = 10
#: Cosine of the tilt of a robot above which an IMU has other axes: these differ by 90 or 180 degrees, and no
#: robot stands on a slope of half of that.
_UPRIGHT = np.cos(np.radians(45.0))


Content = Message | Odometry | MovingLink


def nearness(
    tree: TransformTree,
    frames_of: Mapping[str, tuple[str, str]],
    role: str,
    topic: Topic,
    scans: Topic | None,
) -> tuple[int, ...]:
    """Return how surely a topic belongs to the LiDAR, see `choose_topics`: for scans, whether they are in a
    frame of the robot, and whether fixed transforms have that frame; for others, whether fixed transforms
    link them to the LiDAR, and the number of parts that their names, and those of their frames, have in
    common with those of the scans.

    Args:
        tree: Fixed transforms.
        frames_of: Dict from names of topics to `frame_id` and `child_frame_id` of their first messages.
        role, topic, scans: As in `Nearness`.
    """
    del role
    frame, child = frames_of[topic.name]
    if scans is None:
        maps = {parent for name, (parent, robot) in frames_of.items() if robot and name != topic.name}
        return int(frame not in maps), int(tree.knows(frame))
    lidar, place = frames_of[scans.name][0], child or frame
    linked = bool(lidar and place) and (tree.find(place, lidar) is not None or lidar == frame)
    return int(linked), _in_common(topic.name, scans.name), _in_common(place, lidar)


def _in_common(name: str, other: str) -> int:
    """Return the number of leading parts before a slash that two names have in common."""
    parts = zip(name.strip("/").split("/")[:-1], other.strip("/").split("/")[:-1], strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], parts))


def _length(poses: Sequence[Float]) -> float:
    """Return the distance from the first to the last of some poses, x, y [m] and yaw [rad]."""
    return float(np.hypot(*(poses[-1] - poses[0])[:2]))


class EmptyScansError(SourceError):
    """The last scan that could be read has no points: of a live run, later ones may have some."""


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
        self._is_cut = bool(container.damage)
        self._channels = {channel.number: channel for channel in container.channels}
        self._extrinsics = Extrinsics(container)
        every = group_topics(self._channels.values())
        transforms = Topics({}, tuple(every))
        self._extrinsics.read(transforms.transforms(fixed=True), transforms.transforms(fixed=False))
        self._frames_of = {topic.name: self._first_frames(topic) for topic in every}
        self._topics = topics = choose_topics(
            self._channels.values(),
            options.topics,
            uri,
            partial(nearness, self._extrinsics.tree, self._frames_of),
        )
        self._live, self._named = live, frozenset(options.topics)
        self._contradicting = 0  # scans whose motion contradicts that of the odometry
        self._records = RecordDecoder(self._channels, self._extrinsics.tree)
        self._warnings: list[str] = []
        self._choose_odometry(options)
        self._picture_channels = {number: self._channels[number] for number in topics.numbers("camera")}
        self._truth, sensor = self._read_truth()
        self._decide_point_times()
        self._clock = Clock(list(self._openings()))
        first, frame, known = self._first_scan()
        if median_range(first) > FARTHEST_MEDIAN:
            count_loss(self._damage, NO_METRES, topics.chosen["scan"].count)
        mounting = self._find_mounting(first, frame, options)
        self._offset_ns = self._clock.offset_ns
        self._new_frames = partial(
            ScanFrames, self._extrinsics.tree, frame, mounting or Pose3.identity(), self._world
        )
        self._top_ring: int | None = None
        if self._world:
            first = self._first_placed_scan()
        sensor = sensor or sensor_of(first, known)
        self._top_ring = sensor.rings - 1 if sensor.rings and rings_descend(first) else None
        described = self._describe(first, sensor, digest_of(paths), mounting)
        self._records.poses = topics.numbers("pose")
        odometry = topics.numbers("odometry") or self._moving
        self._alignments = FrameAlignments(
            container, self._records, topics, odometry, partial(self._times_of, self._clock.again())
        )
        self._frames = self._new_frames()
        self._description = self._alignments.begin(described, live=live)
        self._measured = self._alignments.numbers
        self.notices = self._alignments.notices
        if live:
            # The run starts again with its first message: the clock forgets the messages that were read here.
            self._clock = self._clock.again(self.notices)

    def records(self) -> Iterator[Record]:
        """Yield records in the order of time, scans after other records of the same time. Messages that
        cannot be used, or come too late, are counted in `losses`. SourceError if the recording cannot be
        read on."""
        losses: dict[str, int] = {}
        self._losses = losses
        yield from self._read(losses)

    def _read(self, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records as `records` does."""
        clock, frames = self._clock.again(), self._new_frames()
        for stamped in in_order_of_stamps(self._arrivals(clock, losses), losses, clock.window_ns):
            yield from (Notice(stamped.stamp_ns, text) for text in clock.notices)
            clock.notices.clear()
            yield from self._decoded(stamped, frames, losses)
        yield from frames.end(losses)

    def records_of(self, message: Message, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records of one message of a live run; none for a channel that is not read. Call it in the
        order of arrival. Messages for the user are added to `notices`.

        Args:
            message: The message.
            losses: Dict from reasons to numbers of contents that cannot be used; increased in place.
        """
        if message.channel in self._wanted or message.channel in self._alignments.numbers:
            for stamped in self._times_of(self._clock, message, losses):
                self._alignments.add(stamped)
                yield from self._decoded(stamped, self._frames, losses)

    def truth(self) -> Truth | None:
        """Return the ground truth attached to a simulated recording, None when there is none."""
        return self._truth

    def fixes(self) -> list[Fix]:
        """Return all GNSS fixes of the recording with their times by the clock of the source, in the order of
        recording. Messages that are damaged, have no fix or an impossible time are left out, not counted; []
        if there is no GNSS topic. SourceError if the recording cannot be read."""
        found, clock = [], self._clock.again()
        for message in self._container.messages(self._topics.numbers("gnss"), None, {}):
            for stamped in self._stamped(clock, message, {}):
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
        """Return the time of a picture [ns] by the clock of the source, None if it has no possible time."""
        return self._clock.near(stamp_ns, message)

    def _arrivals(self, clock: Clock, losses: dict[str, int]) -> Iterator[Stamped[Content]]:
        """Yield the messages that are read with their times by a clock, in the order of recording; what
        cannot be used is counted in `losses`."""
        wanted = self._wanted | self._measured
        for message in self._container.messages(wanted, None, losses):
            yield from self._times_of(clock, message, losses)

    def _times_of(self, clock: Clock, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Content]]:
        """Yield the message itself with its time, or, for a channel of moving transforms, each odometry that
        the message contains with its time; see `_stamped` and `_transforms`. Entries with an impossible time,
        and transforms that cannot be read, are omitted and counted in `losses`."""
        if message.channel in self._moving | self._linking:
            return self._transforms(clock, message, losses)
        return self._stamped(clock, message, losses)

    def _decoded(
        self, stamped: Stamped[Content], frames: ScanFrames, losses: dict[str, int]
    ) -> Iterator[Record]:
        """Yield the record of a message, none if it cannot be used (counted in `losses`). Rings of scans are
        numbered from below."""
        content = stamped.content
        if not isinstance(content, Message):
            yield from frames.add(content, losses)
            return
        record = self._records.record(content, stamped.stamp_ns, losses)
        if isinstance(record, Scan):
            frame = frame_name(header_frame(self._channels[content.channel], content.payload))
            yield from frames.add(FramedScan(frame, self._upright(record)), losses)
        elif record is not None:
            yield from frames.add(record, losses)

    def _stamped(self, clock: Clock, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message]]:
        """Yield a message with its time, with the rank 1 for a scan and 0 for others; nothing, counted in
        `losses`, if its time is impossible."""
        channel = self._channels[message.channel]
        stamp_ns = header_stamp(channel, message.payload)
        time_ns = clock.time_of(stamp_ns, message, header_frame(channel, message.payload))
        if time_ns is None:
            count_loss(losses, "messages with an impossible time stamp")
        else:
            yield Stamped(time_ns, int(message.channel in self._topics.numbers("scan")), message)

    def _transforms(
        self, clock: Clock, message: Message, losses: dict[str, int]
    ) -> Iterator[Stamped[Content]]:
        """Yield the odometry in a message of moving transforms, with its time; transforms between other
        frames are ignored; impossible times, and what cannot be read, are counted in `losses`."""
        for stamp_ns, parent, child, pose in self._extrinsics.decode(message, losses):
            is_odometry = (parent, child) == self._extrinsics.odometry_link and bool(self._moving)
            if is_odometry or (parent, child) in self._world_links:
                time_ns = clock.time_of(stamp_ns, message, f"{parent}>{child}")
                if time_ns is None:
                    count_loss(losses, "messages with an impossible time stamp")
                elif is_odometry:
                    yield Stamped(time_ns, 0, Odometry(time_ns, pose))
                else:
                    yield Stamped(time_ns, 0, MovingLink(time_ns, parent, child, pose))

    def _upright(self, scan: Scan) -> Scan:
        """Return a scan whose rings are numbered from below, as defined for `Scan`. It is the argument if it
        has no ring numbers, or if the rings of the first scan were numbered from below. Rings above the
        number of rings of the sensor become 0."""
        if self._top_ring is None or scan.ring is None:
            return scan
        return replace(scan, ring=np.maximum(self._top_ring - scan.ring, 0).astype(np.int32))

    # --- opening ---------------------------------------------------------------------------------

    def _openings(self) -> Iterator[Opening]:
        """Yield the first messages of each topic that is read. A scan is complete after its last point; where
        this time is unknown, in the middle between its stamp and the next one."""
        for role in ("scan", "odometry", "imu", "gnss", "pose"):
            if role in self._topics.chosen:
                topic = self._topics.chosen[role]
                messages = self._container.messages(topic.numbers, None, {})
                first = [
                    (m.log_ns, header_stamp(self._channels[m.channel], m.payload))
                    for m in islice(messages, OPENING_MESSAGES)
                ]
                yield Opening(
                    topic.name, topic.numbers, first, self._complete_ns(first) if role == "scan" else 0
                )
        if self._moving:
            found = [
                (message.log_ns, stamp_ns)
                for message in islice(self._container.messages(self._moving, None, {}), MOVING_MESSAGES)
                for stamp_ns, parent, child, _ in self._extrinsics.decode(message, {})
                if (parent, child) == self._extrinsics.odometry_link
            ]
            yield Opening("the transforms of the odometry", self._moving, found)

    def _complete_ns(self, messages: list[tuple[int, int | None]]) -> int:
        """Return the time of the last point of a scan after its stamp [ns]; half of the period without times
        of points.

        Args:
            messages: Times of recording and stamps of the first scans [ns].
        """
        ends = [times.high_ns for times in self._records.times.values() if times is not None]
        if ends:
            return max(*ends, 0)
        steps = np.diff([log_ns for log_ns, _ in messages])
        return min(int(np.median(steps)) // 2, SECOND_NS) if len(steps) else 0

    def _decide_point_times(self) -> None:
        """Decide how the times of points are read, for each frame among the first _TIMED_SCANS clouds with
        points. Times that cannot be used, and a clock that had to be assumed, become warnings."""
        self._untimed: dict[str, str] = {}
        timed_types = (POINT_CLOUD, *CUSTOM_TYPES)
        numbers = self._topics.numbers("scan") if self._topics.chosen["scan"].msgtype in timed_types else ()
        scans, delay_ns = self._first_timed(self._records, numbers)
        self._sensor_frames = list(scans)
        for frame, timed_scans in scans.items():
            times, why = decide_point_times(timed_scans, delay_ns=delay_ns)
            self._records.times[frame] = times
            if why:
                self._untimed[frame] = why
                self._warn(f"the times of points cannot be used, so scans are not de-skewed: {why}")
            elif times is not None and (times.origin in ("first", "last") or times.field == FIRING_ORDER):
                self._warn(f"times of points: {times.words}")

    def _warn(self, text: str) -> None:
        """Add a warning, unless there is the same one."""
        if text not in self._warnings:
            self._warnings.append(text)

    def _first_scan(self) -> tuple[Scan, str, Sensor | None]:
        """Return the first scan with points, its frame, and the sensor if it is known except for its range
        sigma. Of several LiDARs on the topic it is that of `_first_frames`, if this has points.

        Raises:
            SourceError: No message has points that can be read, or its packets cannot be decoded.
        """
        reason, kind = "the topic has no messages that can be read", SourceError
        lidar, other = self._frames_of[self._topics.chosen["scan"].name][0], None
        for number, arrival in enumerate(self._scan_arrivals()):
            try:
                with np.errstate(all="ignore"):
                    found = self._records.scan(arrival.content, arrival.stamp_ns, {})
            except SourceError as error:
                raise SourceError(error.what, where=self._scan_topic(), remedy=error.remedy) from None
            except Exception as error:  # as in RecordDecoder.record
                reason = f"its scans cannot be read: {str(error)[:200] or type(error).__name__}"
                kind = SourceError
                continue
            if len(found[0].points):
                if found[1] == lidar:
                    return found
                other = other or found
                if number >= _MOST_SCANS:
                    return other
                continue
            reason, kind = "its scans have no points", EmptyScansError
        if other is not None:
            return other
        raise kind(
            reason,
            where=self._scan_topic(),
            remedy="Name another with --topic scan=NAME.",
        )

    def _scan_topic(self) -> str:
        """Return the recording and its topic of scans, for errors."""
        return f"{self._uri}, topic {self._topics.chosen['scan'].name}"

    def _scan_arrivals(self) -> Iterator[Stamped[Message]]:
        """Yield the messages of the scan topic with their times."""
        clock = self._clock.again()
        for message in self._container.messages(self._topics.numbers("scan"), None, {}):
            yield from self._stamped(clock, message, {})

    def _is_clock_set(self) -> bool:
        """Return whether no stamp of the last messages (`Container.tail_ns`) of a topic is of the clock of
        its first ones."""
        for role in ("scan", "odometry"):
            numbers = self._topics.numbers(role)
            tail = self._container.messages(numbers, self._container.tail_ns(numbers), {})
            fits = [
                self._clock.fits(stamp_ns, message)
                for message in tail
                if (stamp_ns := header_stamp(self._channels[message.channel], message.payload))
            ]
            if fits and not any(fits):
                return True
        return False

    def _last_stamp(self) -> int | None:
        """Return about the time of the last scan [ns]; None if there is none with a possible time."""
        numbers = self._topics.numbers("scan")
        tail = self._container.messages(numbers, self._container.tail_ns(numbers), {})
        times = (self._clock.near(header_stamp(self._channels[m.channel], m.payload), m) for m in tail)
        return max((time_ns for time_ns in times if time_ns is not None), default=None)

    def _read_truth(self) -> tuple[Truth | None, Sensor | None]:
        """Return the attached ground truth and sensor, None for each that is missing. A damaged attachment
        becomes a warning."""
        try:
            content = self._container.attachment(ATTACHMENT, SIZE_LIMIT)
            return (None, None) if content is None else read_truth(content, self._uri)
        except SourceError as error:
            self._warnings.append(f"the attached ground truth is not used: {error.what}")
            return None, None

    def _first_frames(self, topic: Topic) -> tuple[str, str]:
        """Return `frame_id` in the header of the first message of a topic, and for odometry `child_frame_id`;
        "" for what is missing or damaged, and for topics that are not read. Of several LiDARs on a topic of
        scans, the first one whose frame the fixed transforms know counts."""
        role = next((role for role, types in TYPES_BY_ROLE.items() if topic.msgtype in types), "camera")
        if role == "camera":
            return "", ""
        if role == "scan":
            first = islice(self._container.messages(topic.numbers, None, {}), _TRIES)
            frames = [frame_name(header_frame(self._channels[m.channel], m.payload)) for m in first]
            known = (frame for frame in frames if self._extrinsics.tree.knows(frame))
            return next(known, frames[0] if frames else ""), ""
        for message in islice(self._container.messages(topic.numbers, None, {}), 1):
            frame = frame_name(header_frame(self._channels[message.channel], message.payload))
            if topic.msgtype != ODOMETRY:
                return frame, ""
            try:
                decoded = decode(self._channels[message.channel], message.payload)
            except Exception:  # as in RecordDecoder.record
                return frame, ""
            return frame, frame_name(decoded.child_frame_id)
        return "", ""

    def _choose_odometry(self, options: SourceOptions) -> None:
        """Choose between the topic of odometry and a moving transform, and find whether the scans are in the
        frame of a map. Sets the channels that are read."""
        topics = self._topics
        lidar = self._frames_of[topics.chosen["scan"].name][0]
        said, tree = self._extrinsics.choose_odometry(lidar, live=self._live), self._extrinsics.tree
        link = self._extrinsics.odometry_link
        if "odometry" in topics.chosen and "odometry" not in options.topics and link is not None:
            frame, child = self._frames_of[topics.chosen["odometry"].name]
            stranger = lidar != frame and tree.find(child, lidar) is None
            if lidar and stranger and tree.find(link[1], lidar) is not None:
                self._warn(
                    f"the odometry is that of the transform from {link[0]} to {link[1]}, which carries the "
                    f"LiDAR: no fixed transform links {child} of {topics.chosen['odometry'].name} to it"
                )
                del topics.chosen["odometry"]
        if said and "odometry" not in topics.chosen:
            self._warn(said)
        self._moving = frozenset[int]()  # channels of transforms that are read as odometry
        if "odometry" not in topics.chosen and link is not None:
            self._moving = topics.transforms(fixed=False)
        parent, child = ("", "") if link is None else link
        if "odometry" in topics.chosen:
            parent, child = self._frames_of[topics.chosen["odometry"].name]
        self._base_of_odometry = child if "odometry" in topics.chosen else ""
        self._world: tuple[str, ...] = ()
        base = self._extrinsics.base_frame(self._base_of_odometry, lidar)
        if lidar and parent and tree.find(base, lidar) is None:
            self._world = self._extrinsics.world_chain(lidar, parent)
        self._world_links = set(pairwise(self._world))
        self._linking = topics.transforms(fixed=False) if self._world_links else frozenset[int]()
        roles = [topics.numbers(role) for role in ("scan", "odometry", "imu")]
        self._wanted = self._moving.union(self._linking, *roles)
        self._measured = frozenset[int]()

    def _find_mounting(self, first: Scan, frame: str, options: SourceOptions) -> Pose3 | None:
        """Return T_base_lidar by the user, or the transforms, or the ground and the motion; None if it is
        unknown. Sets the base frame of the source and of its decoder, and adds warnings about what is
        assumed.

        Args:
            first: First scan.
            frame: Name of its frame.
            options: Choices of the user.
        """
        tree, self._is_mounting_assumed, self._lidar = self._extrinsics.tree, False, frame
        self._records.base = self.base = base = self._extrinsics.base_frame(self._base_of_odometry, frame)
        robot, lidar = base or "the base", frame or "the LiDAR"
        if self._base_of_odometry and tree.find(self._base_of_odometry, base) is None:
            self._warn(
                f"no fixed transform from {self._base_of_odometry} to {base}: both are taken as the same "
                "frame"
            )
        if self._world:
            return self._mounting_of_world(frame, options)
        # A frame without a name has no place on the robot, not even that of a base without a name.
        linked = options.T_base_lidar or (tree.find(base, frame) if frame else None)
        if linked is not None:
            return linked
        has_odometry = "odometry" in self._topics.chosen or bool(self._moving)
        self._is_mounting_assumed = base != frame and has_odometry
        level = mounting_by_ground(first)
        missing = f"no fixed transform from {lidar} to {robot}"
        if level is not None:
            self._warn(f"{missing}: {tilt_text(level)}")
        if has_odometry and not self._live:
            level = self._mounting_by_motion(level)
            if self._contradicting and self._is_of_another_robot():
                self._leave_out_odometry()
                return self._find_mounting(first, frame, options)
            if self._contradicting:
                count_loss(self._damage, CONTRADICTION, self._contradicting)
        if level is None and has_odometry and base != frame:
            self._warn(f"{missing}: the LiDAR is assumed to be at the base")
        if level is not None:
            tree.add(base, frame, level)  # also for an IMU in the same housing
        return level

    def _mounting_of_world(self, frame: str, options: SourceOptions) -> Pose3:
        """Return T_base_lidar of a LiDAR whose clouds are in the frame of a map: by the user, or that of the
        only frame on the robot with a usual name; else identity. Adds a warning."""
        usual = [
            name
            for name in self._extrinsics.tree.frames()
            if any(word in name.lower() for word in _LIDAR_WORDS)
            and self._extrinsics.tree.find(self.base, name) is not None
        ]
        place = self._extrinsics.tree.find(self.base, usual[0]) if len(usual) == 1 else None
        at = usual[0] if place is not None else self.base or "the base"
        self._warn(
            f"the clouds are in the frame {frame} of the odometry: each is moved back by its pose at its "
            "time, "
            f"and not de-skewed again; the LiDAR is taken to be at {at}; --mount overrides this"
        )
        return options.T_base_lidar or place or Pose3.identity()

    def _mounting_by_motion(self, level: Pose3 | None) -> Pose3 | None:
        """Return T_base_lidar of a LiDAR without a fixed transform: its tilt by the ground, and its yaw by
        its motion beside the odometry, with a warning; None if both are 0 or unknown. Odometry that
        contradicts the scans is counted.

        Args:
            level: T_base_lidar by the ground in the first scan, None for an upright LiDAR.
        """
        # Compiled kernels and SciPy, which a process that only records or serves does not need.
        from pipeline.odometry.mounting_yaw import lidar_path, overlap, yaw_of_mounting

        times_ns, path = self._odometry_path()
        if len(times_ns) < 2:
            return level
        scans = self._scans_between(int(times_ns[0]), int(times_ns[-1]))
        if len(scans) < _LEVELS:
            return level
        if level is None:
            level = mounting_by_grounds(scans[:: len(scans) // _LEVELS])
            if level is not None:
                self._warn(tilt_text(level))
        stamps = np.array([scan.stamp_ns for scan in scans], np.int64)
        at = np.column_stack([np.interp(stamps - times_ns[0], times_ns - times_ns[0], c) for c in path.T])
        by_scans, points = lidar_path(scans, level or Pose3.identity())
        found = yaw_of_mounting(by_scans, at)
        if found is None or overlap(by_scans, points) < _SAME_WORLD:
            return level
        if found.contradicts:
            self._contradicting = len(scans)
            return level
        degrees = round(float(np.degrees(found.yaw))) % 360
        if not degrees:
            return level
        self._warn(
            f"by the motion of the scans beside the odometry over {found.length:.0f} m, the yaw of the "
            "mounting "
            f"is {degrees} degrees; --mount overrides this"
        )
        return Pose3.from_euler(np.zeros(3), 0.0, 0.0, found.yaw) @ (level or Pose3.identity())

    def _is_of_another_robot(self) -> bool:
        """Return whether the names of the topics of scans and odometry begin with different parts, and the
        user has chosen neither."""
        chosen = self._topics.chosen
        if "odometry" not in chosen or "odometry" in self._named:
            return False
        scans, wheels = (chosen[role].name.strip("/").split("/") for role in ("scan", "odometry"))
        return len(scans) > 1 and len(wheels) > 1 and scans[0] != wheels[0]

    def _leave_out_odometry(self) -> None:
        """Read no odometry, with a warning; the motion is then found from the scans."""
        name = self._topics.chosen.pop("odometry").name
        self._warn(
            f"{name} is not used: by its name and its motion it is of another robot than the scans; "
            "--topic odometry=NAME overrides this"
        )
        self._contradicting, self._base_of_odometry = 0, ""
        self._wanted = self._topics.numbers("scan") | self._topics.numbers("imu")
        self._clock = Clock(list(self._openings()))

    def _odometry_path(self) -> tuple[Int, Float]:
        """Return times [ns], shape (N,), and poses x, y [m], unwrapped yaw [rad], shape (N, 3), of the first
        _MOTION of the drive by the odometry."""
        times, poses, clock = list[int](), list[Float](), self._clock.again()
        numbers = self._topics.numbers("odometry") or self._moving
        begun: int | None = None
        for message in islice(self._container.messages(numbers, None, {}), _MOST_READINGS):
            for stamped in self._times_of(clock, message, {}):
                content = stamped.content
                record: Record | MovingLink | None = None
                if isinstance(content, Message):
                    record = self._records.record(content, stamped.stamp_ns, {})
                else:
                    record = content
                if not isinstance(record, Odometry) or (times and record.stamp_ns <= times[-1]):
                    continue
                pose = record.T_odom_base.planar().as_array()
                if begun is None and poses and np.hypot(*(pose - poses[0])[:2]) > _BEGUN:
                    begun = len(times)
                times.append(record.stamp_ns)
                poses.append(pose)
            if begun is not None and _length(poses[begun:]) > _MOTION:
                break
        found = np.array(poses).reshape(-1, 3)[max((begun or 0) - 1, 0) :]
        found[:, 2] = np.unwrap(found[:, 2])
        return np.array(times, np.int64)[max((begun or 0) - 1, 0) :], found

    def _scans_between(self, start_ns: int, end_ns: int) -> list[Scan]:
        """Return at most _MOST_SCANS scans of the LiDAR from one time to another [ns]."""
        found: list[Scan] = []
        for arrival in self._scan_arrivals():
            if arrival.stamp_ns > end_ns or len(found) == _MOST_SCANS:
                break
            message = arrival.content
            frame = frame_name(header_frame(self._channels[message.channel], message.payload))
            if arrival.stamp_ns >= start_ns and frame == self._lidar:
                record = self._records.record(arrival.content, arrival.stamp_ns, {})
                if isinstance(record, Scan):
                    found.append(record)
        return found

    def _first_placed_scan(self) -> Scan:
        """Return the first scan that the odometry moves back.

        Raises:
            SourceError: There is none.
        """
        for record in self._read({}):
            if isinstance(record, Scan):
                return record
        raise SourceError(
            f"the clouds are in the frame {self._world[0]} of the odometry, and it has no pose at their "
            "times",
            where=self._scan_topic(),
            remedy="Name the topic of the LiDAR itself with --topic scan=NAME.",
        )

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
        self, first: Scan, sensor: Sensor, digest: str, mounting: Pose3 | None
    ) -> SourceDescription:
        """Return the description of the source with all warnings, to which some about times and damage are
        added.

        Args:
            first: First scan.
            sensor: The LiDAR.
            digest: Digest of the files.
            mounting: T_base_lidar; None if it is unknown.
        """
        chosen, base, warnings = self._topics.chosen, self.base, self._warnings
        if len(self._sensor_frames) > 1:
            frames = ", ".join(self._sensor_frames)
            warnings.append(
                f"the frame of the scans of {chosen['scan'].name} is one of several ({frames}): each is "
                "placed by "
                "its own fixed transform, and left out without one"
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
        warnings += self._clock.warnings
        if self._is_clock_set():
            warnings.append(
                "a clock was set during the recording: its times go on evenly in the order of the file"
            )
        if self._is_cut:
            warnings.append("the recording is cut or damaged: only whole messages are read")
        return SourceDescription(
            uri=self._uri,
            kind=self._container.kind,
            sensor=sensor,
            T_base_lidar=mounting or Pose3.identity(),
            has_odometry="odometry" in chosen or bool(self._moving),
            has_imu="imu" in chosen,
            scans=chosen["scan"].count,
            start_ns=first.stamp_ns,
            end_ns=self._last_stamp(),
            digest=digest,
            preset="laser2d" if chosen["scan"].msgtype == LASER_SCAN else "forest",
            topics=tuple(self._detailed(topic, sensor) for topic in self._topics.recorded()),
            warnings=tuple(warnings),
            missing=self._missing(),
        )

    def _detailed(self, topic: RecordedTopic, sensor: Sensor) -> RecordedTopic:
        """Return the description of a topic with its rate, family, fields and frames and, if it has points,
        their times and its range sigma."""
        numbers = [c.number for c in self._channels.values() if c.topic == topic.name]
        frame, child = self._frames_of[topic.name]
        place = child or frame
        is_assumed = not (self.base and place) or (
            place != self.base and self._is_mounting_assumed and place == self._lidar
        )
        fields, organised = self._fields_of(topic, numbers)
        family = family_of(fields, topic.type, names=(topic.name, frame), organised=organised)
        times, range_sigma = "", None
        if topic.read_as == "scan":
            times, range_sigma = self._words_of_times(self._records.times, self._untimed), sensor.range_sigma
        elif topic.fits == "scan":
            times, range_sigma = self._unread_points(topic, numbers)
        return replace(
            topic,
            rate_hz=self._container.rate_hz(numbers),
            family="" if family is None or topic.fits != "scan" else family.name,
            fields=tuple(f"{name} {kind}" for name, kind in fields.items()),
            frame=frame,
            chain=() if is_assumed else self._extrinsics.tree.chain(self.base, place)[::-1],
            times=times if topic.type in (POINT_CLOUD, *CUSTOM_TYPES) else "",
            range_sigma=range_sigma,
        )

    def _words_of_times(self, times: Mapping[str, PointTimes | None], untimed: Mapping[str, str]) -> str:
        """Return how the times of points are read, or why they are not, as text; each frame by itself if they
        differ.

        Args:
            times: Dict from frames to how their times are read, None where they are not.
            untimed: Dict from frames to the reasons why they are not.
        """
        words = {
            frame: f"not used: {untimed.get(frame, _NO_FIELD)}" if found is None else found.words
            for frame, found in times.items()
        }
        if len(set(words.values())) > 1:
            return "; ".join(f"{frame}: {text}" for frame, text in words.items())
        return next(iter(words.values()), f"not used: {_NO_FIELD}")

    def _unread_points(self, topic: RecordedTopic, numbers: list[int]) -> tuple[str, float | None]:
        """Return the times of the points of a topic that is not read, as text, and its range sigma [m]; ""
        and None if none of its first messages has points."""
        decoder = RecordDecoder(self._channels, self._extrinsics.tree)
        scans, delay_ns = self._first_timed(decoder, numbers)
        decided = {frame: decide_point_times(timed, delay_ns=delay_ns) for frame, timed in scans.items()}
        times = {frame: found for frame, (found, _) in decided.items()}
        untimed = {frame: why for frame, (found, why) in decided.items() if found is None and why}
        for message in islice(self._container.messages(numbers, None, {}), _TRIES):
            try:
                with np.errstate(all="ignore"):
                    scan = decoder.scan(message, 0, {})[0]
            except Exception:  # noqa: S112 - as in RecordDecoder.record
                continue
            if len(scan.points) and topic.type != LASER_SCAN:
                return self._words_of_times(times, untimed), measured_range_sigma(scan)
        return "", None

    def _first_timed(
        self, decoder: RecordDecoder, numbers: Collection[int]
    ) -> tuple[dict[str, list[TimedScan]], int]:
        """Return a dict from frames to the clouds with points among the first _TIMED_SCANS of some channels,
        and the median time from the stamp to the recording [ns], 0 if this is longer than a second. Messages
        that cannot be read are left out, not counted."""
        scans: dict[str, list[TimedScan]] = {}
        delays_ns = list[int]()
        for message in self._container.messages(numbers, None, {}):
            try:
                with np.errstate(all="ignore"):
                    timed = decoder.timed(message)
            except Exception:  # noqa: S112 - as in RecordDecoder.record, which counts it
                continue
            if timed is not None:
                scans.setdefault(timed[0], []).append(timed[1])
                delays_ns.append(message.log_ns - timed[1].stamp_ns)
            if len(delays_ns) == _TIMED_SCANS:
                break
        delay_ns = int(np.median(delays_ns)) if delays_ns else 0
        return scans, delay_ns if delay_ns < SECOND_NS else 0

    def _fields_of(self, topic: RecordedTopic, numbers: list[int]) -> tuple[dict[str, str], bool]:
        """Return a dict from the names of the fields of a PointCloud2 topic to their types, and whether its
        clouds have several rows; empty for other types, and if no message can be read."""
        if topic.type != POINT_CLOUD:
            return {}, False
        for message in islice(self._container.messages(numbers, None, {}), 1):
            try:
                cloud = self._records.message(message)
                names = {
                    str(field.name): np.dtype(TYPES[int(field.datatype)]).name
                    for field in cloud.fields[:_MOST_FIELDS]
                    if int(field.datatype) in TYPES
                }
                return names, int(cloud.height) > 1
            except Exception:  # as in RecordDecoder.record
                return {}, False
        return {}, False

    def _missing(self) -> tuple[str, ...]:
        """Return what the recording lacks, what this costs, and what helps."""
        chosen, found = self._topics.chosen, list[str]()
        frame = self._frames_of[chosen["scan"].name][0]
        lidar, robot = frame or "the LiDAR", self.base or "the base"
        if "odometry" not in chosen and not self._moving:
            found.append(
                "odometry: the motion is found from the scans alone, which drifts and fails in open ground; "
                "record nav_msgs/Odometry or the transform odom to base_link, or give --odometry "
                "file:poses.txt"
            )
        if "imu" not in chosen:
            found.append(
                "IMU: scans are not levelled while the robot tilts, and slipping wheels show less; record "
                "sensor_msgs/Imu and the fixed transform of its frame"
            )
        is_timed = self._records.times.get(frame) is not None or bool(self._world)
        if chosen["scan"].msgtype == POINT_CLOUD and not is_timed:
            rate = self._container.rate_hz(chosen["scan"].numbers) or 10.0
            smear = f"at 1 m/s each is smeared by up to {100.0 / rate:.0f} cm"
            found.append(
                f"times of points: scans are not de-skewed, and {smear}; let the driver of the LiDAR write a "
                "field t, time or timestamp"
            )
        if self._is_mounting_assumed:
            found.append(
                f"the fixed transform from {lidar} to {robot}: the mounting is assumed, and an error "
                "of it bends the map; record /tf_static, or give --mount"
            )
        return tuple(found)
