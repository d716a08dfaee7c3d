"""The recording of a live run as a source: the same records in the same order as the robot gave."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from pipeline.errors import SourceError
from pipeline.io.readers.base import RecordedTopic, Revision, SourceDescription, SourceOptions
from pipeline.io.readers.camera import SAME_TIME_NS, Camera, Picture
from pipeline.io.readers.container import Channel, count_loss
from pipeline.io.readers.digest import digest_of
from pipeline.io.readers.live_camera import placed
from pipeline.io.readers.live_reader import ArrivalReader
from pipeline.io.readers.mcap_file import McapFile, open_mcap
from pipeline.io.readers.pictures import RecordedPictures, time_beside
from pipeline.io.readers.rostypes import MessageDecoder, standard_types
from pipeline.io.readers.topics import TYPES_BY_ROLE
from pipeline.types.records import Record, Truth

NAME, PARAMETERS, VERSION = "stemmap_live.json", "/stemmap/parameters", 1
KIND = "recording of a live run"
_LIMIT = 1 << 20
_MOST_TOPICS = 100
_MOST_REVISIONS = 10_000


class Told(msgspec.Struct, frozen=True):
    """What the recorder said of the run.

    Attributes:
        version: Of this form.
        uri: The robot's address.
        topics: That were read, in the order of their numbers; the first one is of the scans.
        seed, odometry, preset: As the run had them.
        camera: Topics of pictures and of what tells of them, of which no map is made.
    """

    version: int
    uri: str
    topics: list[str]
    seed: int = 0
    odometry: str = "auto"
    preset: str = "forest"
    camera: list[str] = []


def told_of(container: McapFile, where: str) -> Told | None:
    """What the recorder said; None where the file is another recording.

    Raises:
        SourceError: It is damaged or of a newer form.
    """
    content = container.attachment(NAME, _LIMIT)
    if content is None:
        return None
    try:
        told = msgspec.json.decode(content, type=Told)
    except (msgspec.DecodeError, RecursionError) as error:
        raise SourceError(f"what the recorder said cannot be read: {error}", where=where) from error
    if told.version != VERSION or not 0 < len(told.topics) + len(told.camera) <= _MOST_TOPICS:
        raise SourceError("the recording is of a newer version of stemmap", where=where)
    return told


class LiveRecording:
    """A live run, read again.

    Args:
        uri: As the user wrote it.
        container: The file; the source closes it.
        told: What the recorder said.
        path: Of the file, for the digest.
        options: Mounting, where the user knows better.

    Raises:
        SourceError: There is no scan in it that can be read.
    """

    def __init__(self, uri: str, container: McapFile, told: Told, path: Path, options: SourceOptions) -> None:
        self._uri, self._container, self._told = uri, container, told
        self._options = replace(options, topics={"scan": told.topics[0], **options.topics})
        self._channels = _channels(container, told, uri)
        self._losses: dict[str, int] = {}
        self._base, self._offset_ns = "", 0
        self._placed: tuple[Camera | None, str] | None = None
        camera = [c for c in container.channels if c.topic in told.camera]
        self._camera = tuple(replace(c, definition="", definition_format="") for c in camera)
        self.description = self._describe(path)
        self._recorded = RecordedPictures(
            container,
            MessageDecoder(self._camera),
            {channel.number: channel for channel in self._camera},
            frozenset(c.number for c in self._camera if c.msgtype in TYPES_BY_ROLE["camera"]),
            lambda stamp_ns, message: time_beside(stamp_ns, message.log_ns, self._offset_ns),
            self._offset_ns,
        )

    @property
    def losses(self) -> dict[str, int]:
        """What was left out when opening and in the latest reading, by reason."""
        return {**self._container.damage, **self._losses}

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield records in the order in which they came; what lies before `start_ns` is not decoded."""
        reader = self._reader()
        self._losses = reader.losses
        reader.from_ns = start_ns
        numbers = [channel.number for channel in self._channels]
        for message in self._container.messages(numbers, None, reader.losses):
            yield from reader.add(message)
        yield from reader.finish()

    def truth(self) -> Truth | None:
        """Nobody knows."""
        return None

    def camera(self) -> tuple[Camera | None, str]:
        """How the camera stands; None and why where nobody tells, or there is none ("")."""
        if self._placed is None:  # it is asked for with each picture
            pictures = [c.number for c in self._camera if c.msgtype in TYPES_BY_ROLE["camera"]]
            self._placed = None, ""
            if pictures:
                self._placed = placed(self._container, MessageDecoder(()), pictures[0], self._base)
        return self._placed

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The picture that was taken nearest to a time, None where none is within `within_ns` of it."""
        return self._recorded.near(stamp_ns, within_ns)

    def picture_stamps(self) -> list[int]:
        """When the pictures were taken, ascending [ns]."""
        return self._recorded.stamps()

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """The pictures that were taken at some of `picture_stamps`, each once."""
        return self._recorded.at(wanted_ns)

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _reader(self) -> ArrivalReader:
        return ArrivalReader(self._uri, KIND, self._channels, self._options)

    def _describe(self, path: Path) -> SourceDescription:
        reader = self._reader()
        numbers = [channel.number for channel in self._channels]
        for message in self._container.messages(numbers, None, {}):
            reader.add(message)
            if reader.description is not None:
                break
        else:
            reader.finish()
        known = reader.description
        self._base, self._offset_ns = reader.base, reader.offset_ns
        if known is None:
            raise SourceError("there is no scan in it", where=self._uri, remedy="Record the LiDAR's topic.")
        scans = {c.number: c.count for c in self._container.channels if c.topic == self._told.topics[0]}
        first_ns = next((m.log_ns for m in self._container.messages(scans, None, {})), 0)
        tail_ns = self._container.tail_ns(scans)
        last_ns = max((m.log_ns for m in self._container.messages(scans, tail_ns, {})), default=first_ns)
        cut = (
            ("the recording is cut or damaged: only what is whole is read",) if self._container.damage else ()
        )
        return replace(
            known,
            scans=sum(scans.values()),
            end_ns=(known.start_ns or 0) + last_ns - first_ns,
            digest=digest_of([path]),
            preset=self._told.preset,
            warnings=(*known.warnings, *cut),
            revisions=tuple(self._revisions()),
            topics=(*known.topics, *camera_topics(self._camera)),
        )

    def _revisions(self) -> Iterator[Revision]:
        """The parameters that the run was mapped with; what is damaged is passed over."""
        numbers = [c.number for c in self._container.channels if c.topic == PARAMETERS]
        types: Any = standard_types("cdr")
        for count, message in enumerate(self._container.messages(numbers, None, {})):
            if count >= _MOST_REVISIONS or len(message.payload) > _LIMIT:
                break
            try:
                text = types.deserialize_cdr(message.payload, "std_msgs/msg/String").data
                yield msgspec.json.decode(text, type=Revision)
            except Exception:  # whatever the generated decoders of rosbags raise
                count_loss(self._losses, "revisions of the parameters that cannot be read")


def camera_topics(channels: Iterable[Channel]) -> tuple[RecordedTopic, ...]:
    """The topics of a live run's camera, for people."""
    return tuple(RecordedTopic(c.topic, c.msgtype, c.count, "camera", "") for c in channels)


def _channels(container: McapFile, told: Told, where: str) -> list[Channel]:
    """The robot's channels as the live run had them: numbered in the order of their choice."""
    by_topic = {channel.topic: channel for channel in container.channels}
    missing = [topic for topic in told.topics if topic not in by_topic]
    if missing:
        raise SourceError(f"the recording lacks the topic {missing[0][:100]}", where=where)
    channels = [by_topic[topic] for topic in told.topics]
    if channels[0].msgtype not in TYPES_BY_ROLE["scan"]:
        raise SourceError("the recording's first topic is of no scans", where=where)
    # The live run had no definitions but the standard ones.
    return [replace(channel, definition="", definition_format="", count=0) for channel in channels]


def open_live_recording(uri: str, path: Path, options: SourceOptions) -> LiveRecording | None:
    """Open an MCAP as the recording of a live run; None where it is another one.

    Raises:
        SourceError: It is one and cannot be read.
    """
    container = open_mcap(path)
    try:
        told = told_of(container, uri)
        if told is not None:
            return LiveRecording(uri, container, told, path, options)
    except BaseException:
        container.close()
        raise
    container.close()
    return None
