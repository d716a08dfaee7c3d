"""Live runs: messages in the order of arrival, their camera, and their recording read again."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers import MessageFormat, added
from pipeline.io.readers.base import (
    RecordedTopic,
    Revision,
    Source,
    SourceDescription,
    SourceOptions,
    count_loss,
    digest_of,
)
from pipeline.io.readers.camera import SAME_TIME_NS, MessageSource, find_camera, picture_of, time_beside
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.ros_bags import BagFolder, bag_files, open_bag
from pipeline.io.readers.ros_first_scans import EmptyScansError
from pipeline.io.readers.topics import TYPES_BY_ROLE, is_fixed, standard_types
from pipeline.io.readers.transforms import Extrinsics, TransformTree
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Notice, Record
from pipeline.types.units import SECOND_NS

#: The source is described this long after the first scan, or after this many scans: then its topics and
#: extrinsics are known.
OPENING_NS = SECOND_NS
OPENING_SCANS = 10
#: Most messages that are kept before the first scan.
OPENING_LIMIT = 4000
#: Number of times that only unreadable scans arrived in OPENING_NS, after which the run is given up.
_TRIES = 15
T = TypeVar("T")


class MessageList(Container):
    """Messages in memory as a container."""

    def __init__(self, kind: str, channels: Sequence[Channel], messages: Sequence[Message]) -> None:
        """Index the messages, which are not copied."""
        self.kind, self.damage, self._messages = kind, {}, messages
        rows = [(message.channel, message.log_ns, k) for k, message in enumerate(messages)]
        self._set_index(channels, np.array(rows, np.int64).reshape(-1, 3))

    def _message(self, number: int, log_ns: int, place: int) -> Message:
        """Return the message with the index `place`."""
        del number, log_ns
        return self._messages[place]


class ArrivalReader:
    """Turns messages into records, one by one, in the order of arrival.

    The records depend only on the messages and their times of arrival, so a recording gives those of the live
    run.

    Args:
        uri, kind: Address and format of the source, for the user.
        channels: Channels of the messages.
        options: Topics and extrinsics chosen by the user.

    Attributes:
        description: Description of the source; None until OPENING_NS after the first scan, or until
            OPENING_SCANS scans.
        losses: Dict from reasons to numbers of records left out so far.
    """

    def __init__(self, uri: str, kind: str, channels: Sequence[Channel], options: SourceOptions) -> None:
        """Create a reader that has seen no message."""
        self._uri, self._kind, self._channels, self._options = uri, kind, channels, options
        self._scans = {c.number for c in channels if c.msgtype in TYPES_BY_ROLE["scan"]}
        self._fixed = {c.number for c in channels if is_fixed(c.topic)}
        self._opening: list[Message] = []
        self._first_ns: int | None = None
        self._scan_ns = 0
        self._heard = 0
        self._failures = 0
        self._ended = False
        self._refused: SourceError | None = None
        self._source: RosSource | None = None
        self.description: SourceDescription | None = None
        self.losses: dict[str, int] = {}

    @property
    def offset_ns(self) -> int:
        """Stamp minus arrival of the first scan [ns]; 0 before the description is known."""
        known = self.description
        return 0 if known is None or known.start_ns is None else known.start_ns - self._scan_ns

    @property
    def base(self) -> str:
        """Name of the base frame, "" if it is unknown or the source is not described yet."""
        return "" if self._source is None else self._source.base

    def add(self, message: Message) -> list[Record]:
        """Process the next message; return the records that it completes, after notices of the source. Until
        the source is described by its first OPENING_SCANS scans, or for OPENING_NS after the first one,
        messages are stored and [] is returned; then the stored ones follow at once. Of more than
        OPENING_LIMIT stored messages, the older half is dropped, except scans and fixed transforms, see
        `_forget_oldest`. Dropped messages, and what cannot be used, are counted in `losses`.

        Raises:
            SourceError: There are scans, and none could be read in _TRIES attempts of OPENING_NS. Scans
                without points are waited out.
        """
        if self._source is not None:
            return self._records_of(self._source, message)
        self._opening.append(message)
        if message.channel in self._scans:
            self._scan_ns = self._scan_ns or message.log_ns
            self._heard += 1
            self._first_ns = message.log_ns if self._first_ns is None else self._first_ns
        if len(self._opening) > OPENING_LIMIT:
            self._forget_oldest()
        if self._first_ns is None or not self._heard:
            return []
        if self._heard < OPENING_SCANS and message.log_ns < self._first_ns + OPENING_NS:
            return []
        return self._open(message.log_ns)

    def finish(self) -> list[Record]:
        """Return the records of the messages that still wait for the description, at the end of the input; []
        if it is known already, or no scan arrived.

        Raises:
            SourceError: There are scans, and none can be read.
        """
        if self._source is not None or self._first_ns is None:
            return []
        self._ended = True
        if not self._heard and self._refused is not None:
            raise self._refused
        return self._open(self._first_ns)

    def _forget_oldest(self) -> None:
        """Remove and count the older half of the waiting messages, except scans and fixed transforms, of
        which the newest remain in at most half of that space."""
        half, kept = len(self._opening) // 2, self._fixed | self._scans
        old = [message for message in self._opening[:half] if message.channel in kept][-half // 2 :]
        self._opening[:half] = old
        count_loss(self.losses, "messages that waited too long for scans", half - len(old))

    def _open(self, now_ns: int) -> list[Record]:
        """Describe the source by the waiting messages; return their records. If no scan can be read, or all
        are empty, they are removed and counted, and [] is returned after the next OPENING_NS begins at
        `now_ns`.

        Raises:
            SourceError: No scan could be read _TRIES times, or the input has ended.
        """
        heard = MessageList(self._kind, self._channels, self._opening)
        try:
            self._source = RosSource(self._uri, heard, [], self._options, live=True)
        except SourceError as error:
            self._failures += not isinstance(error, EmptyScansError)
            if self._failures >= _TRIES or self._ended:
                raise
            self._refused, waiting = error, len(self._opening)
            self._opening = [m for m in self._opening if m.channel not in self._scans]
            count_loss(self.losses, "scans before the first one with points", waiting - len(self._opening))
            self._first_ns, self._heard, self._scan_ns = now_ns, 0, 0
            return []
        known = self._source.description
        self.description = replace(known, scans=None, end_ns=None, digest="")
        opening, self._opening = self._opening, []
        return [record for message in opening for record in self._records_of(self._source, message)]

    def _records_of(self, source: RosSource, message: Message) -> list[Record]:
        """Return the records of a message, after notices of the source with the time of the first record (0
        if there is none)."""
        records = list(source.records_of(message, self.losses))
        if source.notices:
            stamp_ns = records[0].stamp_ns if records else 0
            records = [*(Notice(stamp_ns, text) for text in source.notices), *records]
            source.notices.clear()
        return records


#: Most pictures in memory, and their bytes; a paused run can still show those of its scan.
MOST_PICTURES, MOST_BYTES = 60, 64 << 20
_MOST_FIXED, _LARGEST_STORED = 200, 64 << 10


class LiveCamera:
    """Camera of a live run: the pictures of the last seconds, in bounded memory, and the pose of the camera.

    Pictures do not influence the map.

    Args:
        channels: Channel of the pictures, then that of their CameraInfo, if there is one.
        fixed: Channels of fixed transforms.
    """

    def __init__(self, channels: Sequence[Channel], fixed: Sequence[Channel]) -> None:
        """Create a camera without pictures."""
        self._pictures_of = channels[0]
        self._channels = {channel.number: channel for channel in (*channels, *fixed)}
        self._numbers = {channel.number for channel in channels}
        self._held: deque[tuple[int | None, Message]] = deque()
        self._bytes = 0
        self._fixed: list[Message] = []
        self._info: Message | None = None
        self._found: tuple[str, Camera | None, str] | None = None

    def add(self, message: Message) -> bool:
        """Process a message of any channel: store pictures (at most the last MOST_PICTURES and MOST_BYTES),
        the latest CameraInfo and the first _MOST_FIXED fixed transforms; CameraInfo and transforms larger
        than _LARGEST_STORED are omitted. Return whether the message is a picture or CameraInfo, which only
        the camera uses."""
        number = message.channel
        if number not in self._numbers:
            if number in self._channels and len(self._fixed) < _MOST_FIXED:
                self._keep_fixed(message)
            return False
        if number == self._pictures_of.number:
            self._held.append((header_stamp(self._pictures_of, message.payload), message))
            self._bytes += len(message.payload)
            while len(self._held) > MOST_PICTURES or self._bytes > MOST_BYTES:
                self._bytes -= len(self._held.popleft()[1].payload)
        elif len(message.payload) <= _LARGEST_STORED and (self._info is None or self._is_other(message)):
            self._info, self._found = message, None
        return True

    def camera(self, base: str) -> tuple[Camera | None, str]:
        """Return the camera with its pose on the robot, or None and the reason why it is unknown. The result
        is kept until CameraInfo, transforms or base change.

        Args:
            base: Name of the base frame.
        """
        if self._found is None or self._found[0] != base:
            known = [*self._fixed, *([] if self._info is None else [self._info])]
            messages = MessageList("", list(self._channels.values()), known)
            tree = fixed_transforms(messages)
            self._found = (base, *find_camera(messages, tree, base, self._pictures_of.topic))
        return self._found[1:]

    def near(self, stamp_ns: int, offset_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """Return the picture in memory that is nearest to a time; None if it is farther than `within_ns`,
        cannot be decoded, or there is none.

        Args:
            stamp_ns: The time [ns].
            offset_ns: Stamp minus arrival of the first scan of the run [ns].
            within_ns: Maximum time difference [ns].
        """
        times = [(time_beside(stamp, m.log_ns, offset_ns), k) for k, (stamp, m) in enumerate(self._held)]
        taken_ns, k = min(times, key=lambda each: abs(each[0] - stamp_ns), default=(0, -1))
        if k < 0 or abs(taken_ns - stamp_ns) > within_ns:
            return None
        return picture_of(self._held[k][1], self._channels, taken_ns)

    def _is_other(self, info: Message) -> bool:
        """Return whether a CameraInfo differs from the known one in more than its time."""
        head = 12  # of CDR: the byte order and the stamp
        return self._info is None or info.payload[head:] != self._info.payload[head:]

    def _keep_fixed(self, message: Message) -> None:
        """Store a message of fixed transforms unless it is stored or larger than _LARGEST_STORED."""
        known = {each.payload for each in self._fixed}
        if len(message.payload) <= _LARGEST_STORED and message.payload not in known:
            self._fixed.append(message)
            self._found = None


def fixed_transforms(container: Container) -> TransformTree:
    """Return the fixed transforms in the first FIXED_MESSAGES messages of the topics "tf_static" of a
    container; an empty tree if there are none."""
    fixed = frozenset(channel.number for channel in container.channels if is_fixed(channel.topic))
    return Extrinsics(container, fixed).tree


NAME, VERSION = "stemmap_live.json", 1
#: Channels of the recorder: parameters of the live run, and log times of messages that it did not map.
PARAMETERS, SKIPPED = "/stemmap/parameters", "/stemmap/skipped"
KIND = "recording of a live run"
_LIMIT = 1 << 20
_MOST_TOPICS = 100
_MOST_NOTES = 1_000_000
_MOST_SKIPPED = 10_000_000


class LiveRunHeader(msgspec.Struct, frozen=True):
    """Settings of a live run, attached to its recording.

    Attributes:
        version: Version of this record.
        uri: Address of the robot.
        topics: Topics that were read, in the order of their channel numbers; the first topic is that of the
            scans.
        seed, odometry, preset: Settings of the run.
        camera: Topics of pictures and their CameraInfo, which are not mapped.
    """

    version: int
    uri: str
    topics: list[str]
    seed: int = 0
    odometry: str = "auto"
    preset: str = "forest"
    camera: list[str] = []


def read_live_header(container: Container, where: str) -> LiveRunHeader | None:
    """Return the settings of a live run; None if the file is not the recording of a live run, or the settings
    are damaged, which is counted in `container.damage`.

    Args:
        container: The file.
        where: Name of the file in errors.

    Raises:
        SourceError: The settings are of another version, name no topic besides those of the camera, or more
            than _MOST_TOPICS with them.
    """
    try:
        content = container.attachment(NAME, _LIMIT)
        if content is None:
            return None
        run = msgspec.json.decode(content, type=LiveRunHeader)
    except (SourceError, msgspec.DecodeError, RecursionError):
        count_loss(container.damage, "settings of the live run that cannot be read")
        return None
    if run.version != VERSION or len(run.topics) + len(run.camera) > _MOST_TOPICS:
        raise SourceError("the recording is of a newer version of stemmap", where=where)
    if not run.topics:
        raise SourceError(
            "the recording has no topic of scans", where=where, remedy="Record the LiDAR as well."
        )
    return run


class LiveRecording(MessageSource):
    """Source that reads the recording of a live run: the same records in the same order.

    Args:
        uri: Path of the recording as the user wrote it.
        container: The recording; the source closes it.
        run: Settings of the live run.
        paths: Files of the recording, for the digest.
        options: Choices of the user.

    Raises:
        SourceError: A topic is missing, or the recording has no scan that can be read.
    """

    def __init__(
        self, uri: str, container: Container, run: LiveRunHeader, paths: list[Path], options: SourceOptions
    ) -> None:
        """Read the recording up to its description, and the notes of the recorder.

        Raises:
            SourceError: A topic is missing, or there is no scan that can be read.
            OSError: A file cannot be read.
        """
        super().__init__(container)
        self._uri, self._run = uri, run
        self._options = replace(options, topics={"scan": run.topics[0], **options.topics})
        self._channels = _channels(container, run, uri)
        self._numbers = [channel.number for channel in self._channels]
        self._skipped = self._read_skipped()
        self._camera_channels = tuple(c for c in container.channels if c.topic in run.camera)
        pictures = [c for c in self._camera_channels if c.msgtype in TYPES_BY_ROLE["camera"]]
        self._picture_channels = {channel.number: channel for channel in pictures}
        reader = self._opened_reader()
        self.base, self._offset_ns = reader.base, reader.offset_ns
        if reader.description is None:
            raise SourceError(
                "there is no scan in it",
                where=uri,
                remedy="The robot sent no scans that can be read while it was recorded.",
            )
        self._description = self._describe(reader.description, paths)

    def _time_of(self, stamp_ns: int | None, message: Message) -> int:
        """Return the time of a picture [ns], never None: its stamp, or its arrival plus the offset of the
        clocks if the stamp is missing, 0 or of another clock."""
        return time_beside(stamp_ns, message.log_ns, self._offset_ns)

    def records(self) -> Iterator[Record]:
        """Yield records in the order of arrival, with `as_live` only those that the live run mapped.
        What cannot be used is counted in `losses`."""
        reader = self._reader()
        self._losses = reader.losses
        for message in self._messages(self._numbers, reader.losses):
            yield from reader.add(message)
        yield from reader.finish()

    def _fixed_transforms(self) -> TransformTree:
        """Return the fixed transforms."""
        return fixed_transforms(self._container)

    def _reader(self) -> ArrivalReader:
        """Return a new reader of the messages of the robot."""
        return ArrivalReader(self._uri, KIND, self._channels, self._options)

    def _opened_reader(self) -> ArrivalReader:
        """Return a reader that has read up to its description, or to the end; if there is no scan, its
        description is None.

        Raises:
            SourceError: None of the scans can be read.
        """
        reader = self._reader()
        for message in self._messages(self._numbers, {}):
            reader.add(message)
            if reader.description is not None:
                return reader
        reader.finish()
        return reader

    def _describe(self, known: SourceDescription, paths: list[Path]) -> SourceDescription:
        """Return the description of the recording: that of its first messages with the number of scans,
        times, digest, and parameters of the live run. If the live run skipped scans and all are read here,
        only its last parameters apply, from the first scan on, and a warning is added.

        Args:
            known: Description of the first messages of the recording as a live run.
            paths: Files of the recording.

        Raises:
            OSError: A file cannot be read.
        """
        scans = {c.number: c.count for c in self._container.channels if c.topic == self._run.topics[0]}
        recorded, skipped = sum(scans.values()), sum(len(self._skipped.get(c, ())) for c in scans)
        first_ns = next((m.log_ns for m in self._messages(list(scans), {})), 0)
        last_ns = max((m.log_ns for m in self._container.last(scans)), default=first_ns)
        messages = Counter[str]()
        for channel in self._container.channels:
            messages[channel.topic] += channel.count
        topics = (replace(topic, messages=messages[topic.name]) for topic in known.topics)
        revisions, warnings = tuple(self._notes(PARAMETERS, Revision)), list(known.warnings)
        if self._container.damage:
            warnings.append("the recording is cut or damaged: only whole messages are read")
        if skipped and not self._options.as_live:
            # Scans are counted among those that were mapped live, so the numbers do not fit here.
            revisions = tuple(replace(last, from_scan=0) for last in revisions[-1:])
            warnings.append(
                f"the live run mapped {recorded - skipped:,} of the {recorded:,} recorded scans; all of "
                "them are read here, with its last parameters; `stemmap map --as-live` repeats the live run"
            )
        return replace(
            known,
            scans=recorded - (skipped if self._options.as_live else 0),
            end_ns=(known.start_ns or 0) + last_ns - first_ns,
            digest=digest_of(paths),
            preset=self._run.preset,
            warnings=tuple(warnings),
            revisions=revisions,
            topics=(*topics, *camera_topics(self._camera_channels)),
        )

    def _messages(self, numbers: Collection[int], losses: dict[str, int]) -> Iterator[Message]:
        """Yield the messages of the robot in the order of arrival; with `as_live`, only those that the live
        run mapped."""
        for message in self._container.messages(numbers, None, losses):
            skipped = self._skipped.get(message.channel) if self._options.as_live else None
            if skipped is None or message.log_ns not in skipped:
                yield message

    def _read_skipped(self) -> dict[int, set[int]]:
        """Return a dict from numbers of channels to the log times [ns] of the messages that the live run did
        not map. At most _MOST_SKIPPED times are read; later notes are ignored."""
        skipped: dict[int, set[int]] = {c.number: set() for c in self._channels}
        numbers = {c.topic: c.number for c in self._channels}
        total = 0
        for times_by_topic in self._notes(SKIPPED, dict[str, list[int]]):
            total += sum(map(len, times_by_topic.values()))
            if total > _MOST_SKIPPED:
                break
            for topic, times in times_by_topic.items():
                if topic in numbers:
                    skipped[numbers[topic]].update(times)
        return {number: times for number, times in skipped.items() if times}

    def _notes(self, topic: str, kind: type[T]) -> Iterator[T]:
        """Yield the JSON values of a topic of the recorder as `kind`; damaged ones are counted as damage.
        Reading ends after _MOST_NOTES and at a note longer than _LIMIT."""
        numbers = [c.number for c in self._container.channels if c.topic == topic]
        types: Any = standard_types("cdr")
        for count, message in enumerate(self._container.messages(numbers, None, self._damage)):
            if count >= _MOST_NOTES or len(message.payload) > _LIMIT:
                break
            try:
                text = types.deserialize_cdr(message.payload, "std_msgs/msg/String").data
                note = msgspec.json.decode(text, type=kind)
            except Exception:  # the generated decoders of rosbags raise many kinds
                count_loss(self._damage, "notes of the recorder that cannot be read")
            else:
                yield note


def camera_topics(channels: Iterable[Channel]) -> tuple[RecordedTopic, ...]:
    """Return a description with the role "camera" for each channel of the camera of a live run."""
    return tuple(RecordedTopic(c.topic, c.msgtype, c.count, "camera", "") for c in channels)


def _channels(container: Container, run: LiveRunHeader, where: str) -> list[Channel]:
    """Return the channels of the robot in the order of the live run, with the count 0.

    Args:
        container: The recording.
        run: Settings of the live run.
        where: Name of the recording in errors.

    Raises:
        SourceError: A topic is missing, or the first topic has no scans.
    """
    by_topic = {channel.topic: channel for channel in container.channels}
    missing = [topic for topic in run.topics if topic not in by_topic]
    if missing:
        raise SourceError(f"the recording lacks the topic {missing[0][:100]}", where=where)
    channels = [by_topic[topic] for topic in run.topics]
    if channels[0].msgtype not in TYPES_BY_ROLE["scan"]:
        raise SourceError("the recording's first topic is of no scans", where=where)
    return [replace(channel, count=0) for channel in channels]


def open_recording(uri: str, path: Path, options: SourceOptions) -> Source:
    """Open a recording of ROS messages, or the recording of a live run; its files are closed if it cannot be
    read.

    Args:
        uri: Path as the user wrote it.
        path: A file (.mcap, .db3, .bag), or the folder that a ROS 2 recorder wrote.
        options: Choices of the user.

    Raises:
        SourceError: The recording cannot be read, or has no scans.
        OSError: A file or folder cannot be read.
    """
    paths = bag_files(path) if path.is_dir() else [path]
    container = BagFolder(paths) if path.is_dir() else open_bag(path)
    try:
        run = read_live_header(container, uri)
        if run is not None:
            return LiveRecording(uri, container, run, paths, options)
        for kind in added(MessageFormat):
            if kind.recording is not None and not kind.refusal:
                container = kind.recording(container, path, options, uri)
        return RosSource(uri, container, paths, options)
    except BaseException:
        container.close()
        raise
