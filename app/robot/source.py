"""A live robot as a source of records. Reading waits for a message only in `records` and `wait`. Pictures are
stored until the end of the run, when the positions of the trees are known."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

from app.robot.link import PICTURE_PAUSE_NS, PICTURES_SKIPPED, PICTURES_TOO_LARGE, Inbox, Link
from app.robot.recorder import Recorder
from app.robot.topics import SCAN_TYPES, Choice, choose
from app.robot.velodyne import VelodyneLink
from app.robot.zenoh import RosPublisher, ZenohLink
from app.sources.live_address import (
    ALL_ROBOTS,
    SILENT_S,
    Address,
    VelodyneAddress,
    ZenohAddress,
    extension_of,
    is_live,
    parse_address,
)
from app.sources.opening import open_source
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.io.block_file import BlockFile
from pipeline.io.readers.base import Source, SourceDescription, SourceOptions, count_loss
from pipeline.io.readers.camera import SAME_TIME_NS
from pipeline.io.readers.live import ArrivalReader, LiveCamera, camera_topics
from pipeline.io.readers.topics import TRANSFORMS, is_fixed
from pipeline.io.recording.messages import map_messages, scan_messages
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Frame, Path, Record, Truth

#: Motion between two stored pictures, which shows every tree from near, and limits of the disk space.
STEP_M, TURN_RAD = 1.0, math.radians(22.5)
MOST_BYTES, MOST_PICTURES = 1 << 30, 20_000


class PictureStore:
    """Pictures of a run in a temporary file.

    Attributes:
        losses: Dict from reasons to numbers of pictures that were not stored.
    """

    def __init__(self) -> None:
        self._file = BlockFile(MOST_BYTES)
        self._kept: dict[int, Picture] = {}  # by time, without their bytes
        self._last: tuple[float, float, float] | None = None
        self.losses: dict[str, int] = {}

    def is_due(self, path: Path) -> bool:
        """Return whether the robot has moved STEP_M or turned TURN_RAD since the last picture; True for the
        first one, False if there is no pose.

        Args:
            path: Path up to the present pose.
        """
        if not len(path.x):
            return False
        here = float(path.x[-1]), float(path.y[-1]), float(path.yaw[-1])
        if self._last is None:
            return True
        x, y, yaw = self._last
        turned = abs(math.remainder(here[2] - yaw, math.tau))
        return math.hypot(here[0] - x, here[1] - y) >= STEP_M or turned >= TURN_RAD

    def add(self, picture: Picture, path: Path) -> None:
        """Store a picture, unless one with the same time is stored. A picture that cannot be stored (limit,
        disk) is counted in `losses`. In any case `is_due` counts the motion from this pose on.

        Args:
            picture: The picture.
            path: Path, of at least one pose, up to the pose at which the picture was taken.
        """
        self._last = float(path.x[-1]), float(path.y[-1]), float(path.yaw[-1])
        if picture.stamp_ns in self._kept:
            return
        is_full = len(self._kept) >= MOST_PICTURES
        if is_full or not self._file.put_block(len(self._kept), picture.data):
            reason = "there are too many" if is_full else self._file.refusal
            count_loss(self.losses, f"pictures not stored for trees: {reason}")
            return
        self._kept[picture.stamp_ns] = replace(picture, data=b"")

    def stamps(self) -> list[int]:
        """Return the times of the pictures, ascending [ns]."""
        return sorted(self._kept)

    def at(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Yield the pictures of some of `stamps`, each once, in the order of their times. Other times are
        ignored; a picture that cannot be read is left out and counted in `losses`."""
        numbers = {stamp_ns: number for number, stamp_ns in enumerate(self._kept)}
        for stamp_ns in sorted(set(wanted_ns) & self._kept.keys()):
            data = self._file.read_block(numbers[stamp_ns], bytes)
            if data is None:
                count_loss(self.losses, "pictures stored for trees that cannot be read")
            else:
                yield replace(self._kept[stamp_ns], data=data)

    def close(self) -> None:
        """Close and delete the file."""
        self._file.close()


MakeLink = Callable[[Any, Inbox], Link]


def link_for(address: Address) -> MakeLink:
    """Return what connects to an address: VelodyneLink, ZenohLink, or the function of an extension."""
    if (extension := extension_of(address.uri)) is not None:
        connect: MakeLink = extension.connect
        return connect
    return VelodyneLink if isinstance(address, VelodyneAddress) else ZenohLink


#: The nodes of a robot start one after another: topics are chosen this long after the first scan topic [s].
_SETTLE_S = 1.0
_POLL_S = 0.005
_MOST_TOPICS = 10  # that a message lists
#: Ends of the notices when the scans of a robot are not announced any more, and when they are again.
GONE, BACK = "sends no scans any more", "sends scans again"
#: End of the notice about a topic of fixed transforms.
LATE = (
    "was announced after the topics of the run were chosen and is not read: if it tells where the LiDAR is, "
    "trees and poses may be wrong. Open the run again, or state the mounting"
)
#: Path and trees are published and recorded at this interval [s]; the pose at every scan.
_MAP_PAUSE_S = 1.0


class LiveSource:
    """Records of the messages that a robot sends from now on. They cannot be read again, but a recording of
    them can. The constructor connects in the background.

    A thread of the source watches the robot: it chooses the topics, starts the recorder and subscribes,
    independently of the mapping.

    Args:
        address: Address of the robot.
        options: Topics and mounting that the user chose.
        make_link: Returns the connection for the address and the inbox; None for that of `link_for`.
    """

    def __init__(
        self,
        address: Address,
        options: SourceOptions,
        make_link: MakeLink | None = None,
    ) -> None:
        self.uri = address.uri
        self._address, self._options = address, options
        self._topics = {**address.topics, **options.topics}
        self._inbox = Inbox()
        self._link = (make_link or link_for(address))(address, self._inbox)
        self._choice: Choice | None = None
        self._reader: ArrivalReader | None = None
        self._seen_s: float | None = None
        self._there: bool | None = None
        self._late: set[str] = set()  # topics of fixed transforms
        self._ending = threading.Event()
        self._notices: list[str] = []
        self._early: list[Record] = []
        self._version = -1
        self._began_ns = time.time_ns()
        self._recorder: Recorder | None = None
        self._recording = threading.Lock()  # while a recording begins
        self._recorded_from = 0
        self._unrecorded: Counter[str] = Counter()  # of the recordings before the present one
        self._refusal = ""
        self._publishes = False
        self._publisher: RosPublisher | None = None
        self._map_at_s = -_MAP_PAUSE_S
        self._mapped_s: float | None = None
        self._camera: LiveCamera | None = None
        self._kept: PictureStore | None = None
        self._failure: SourceError | None = None
        self._watch: threading.Thread | None = None

    def start(self, recorder: Recorder | None = None, *, publish: bool = False) -> None:
        """Start to choose topics and receive messages, in a thread; returns at once.

        Args:
            recorder: Records every message that arrives; the source closes it.
            publish: Whether results are published on the robot's network; only over Zenoh.
        """
        self._recorder, self._publishes = recorder, publish
        self._watch = threading.Thread(target=self._watch_robot, name="live source", daemon=True)
        self._watch.start()

    def record(self, path: FilePath, from_scan: int) -> None:
        """Record the messages of the robot from now on; those that wait to be mapped are recorded as well.
        Nothing while a recording goes on and after the end. If the file cannot be created, `recording` has
        the reason. The results of the mapping and `use_parameters` follow.

        Args:
            path: The file; if it exists, a number is appended to its name.
            from_scan: Index of the first scan that is read from now on.
        """
        with self._recording:
            if self._ending.is_set() or (self._recorder is not None and self._recorder.is_open):
                return
            try:
                recorder = Recorder(path)
            except SourceError as error:
                self._refusal = f"not recording: {error}"
                return
            if self._recorder is not None:
                self._unrecorded.update(self._recorder.losses)
            self._recorder, self._recorded_from, self._refusal = recorder, from_scan, ""
            if self._choice is not None:
                self._begin_recording(recorder, self._choice)
                self._inbox.record(recorder, self._link.times.now_ns())

    # --- as a source -----------------------------------------------------------------------------

    @property
    def description(self) -> SourceDescription:
        """Description of the source; see `ready`. Its digest differs for every run.

        Raises:
            SourceError: No scan has arrived yet.
        """
        known = None if self._reader is None else self._reader.description
        if known is None or self._choice is None:
            raise SourceError("nothing was heard yet", where=self.uri, remedy="Check that the robot sends.")
        digest = f"live:{self.uri}:{self._began_ns}"  # differs for every run
        topics = (*known.topics, *camera_topics(self._choice.camera))
        return replace(
            known, digest=digest, topics=topics, warnings=(*known.warnings, *self._choice.warnings)
        )

    @property
    def losses(self) -> dict[str, int]:
        """New dict from a reason to the number of messages that were left out for it: lost on the network,
        skipped by the mapping, not recorded, or not readable."""
        read = {} if self._reader is None else self._reader.losses
        kept = {} if self._kept is None else self._kept.losses
        recorder = {} if self._recorder is None else self._recorder.losses
        unrecorded = self._unrecorded + Counter(recorder)
        return {**self._link.losses, **self._inbox.losses, **unrecorded, **read, **kept}

    def records(self) -> Iterator[Record]:
        """Yield records when they arrive, until `stop`; then the recording of messages ends, and the records
        that the reader still holds are yielded, but not messages that are still queued.

        Raises:
            SourceError: A message cannot be read, or the topics of the robot cannot be used.
        """
        while not self._ending.is_set():
            records = self.take()
            yield from records
            if not records:
                self._ending.wait(_POLL_S)
        self._inbox.end()
        if self._reader is not None:
            yield from self._reader.finish()

    def truth(self) -> Truth | None:
        """Return None: a live run has no ground truth."""
        return None

    def close(self) -> None:
        """End the recording, then disconnect, which can take seconds. Stored pictures are deleted."""
        self._ending.set()
        self.end_recording()
        if self._watch is not None:
            self._watch.join(timeout=5.0)
        self._link.close()
        if self._kept is not None:
            self._kept.close()

    def end_recording(self) -> None:
        """Finish the recording; may be called from any thread while another one maps. Waits up to 8 s for the
        disk."""
        self._inbox.end()
        if self._recorder is not None:
            self._recorder.close()

    # --- camera ------------------------------------------------------------------------------

    def camera(self) -> tuple[Camera | None, str]:
        """Return the camera model and "". If the model is unknown, return None and the reason; without a
        camera, None and ""."""
        return (None, "") if self._camera is None else self._camera.camera(self._base)

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """Return the recent picture nearest to a time [ns], None if none is within `within_ns` of it."""
        return None if self._camera is None else self._camera.near(stamp_ns, self._offset_ns, within_ns)

    def picture_stamps(self) -> list[int]:
        """Return the times of the stored pictures, ascending [ns]."""
        return [] if self._kept is None else self._kept.stamps()

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Yield the pictures of some of `picture_stamps`, see `PictureStore.at`; none without stored
        pictures."""
        return iter(()) if self._kept is None else self._kept.at(wanted_ns)

    @property
    def picture_counts(self) -> str:
        """Numbers of pictures that arrived and were accepted, as text; "" if there is no camera."""
        if self._camera is None:
            return ""
        lost = sum(self._inbox.losses.get(reason, 0) for reason in (PICTURES_SKIPPED, PICTURES_TOO_LARGE))
        return (
            f"of {self._inbox.pictures_arrived:,} pictures {self._inbox.pictures_accepted:,} were taken in, "
            f"one every {PICTURE_PAUSE_NS / 1e9:g} s at most; {lost:,} were dropped"
        )

    def keep_pictures(self) -> None:
        """Store pictures from now on, for the pictures of trees at the end of the run; call it once."""
        self._kept = PictureStore()

    # --- live -----------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether the description is known."""
        return self._reader is not None and self._reader.description is not None

    @property
    def robot(self) -> str:
        """Namespace of the robot, "" for none or before it is known."""
        return "" if self._choice is None else self._choice.robot

    @property
    def robots(self) -> list[str]:
        """Namespaces of all robots that publish scans now."""
        return self._link.robots()

    @property
    def scans_waiting(self) -> int:
        """Number of scans that wait to be mapped."""
        return self._inbox.scans_waiting

    @property
    def recording(self) -> str:
        """State of the newest recording in one line, "" if there is none."""
        return self._refusal or ("" if self._recorder is None else self._recorder.status)

    @property
    def recorded_file(self) -> str:
        """Path of the file of the newest recording, "" if there is none."""
        return str(self._recorder.path) if self._recorder is not None and self._recorder.begun else ""

    def mapped(self, frame: Frame, path: Path, also: Mapping[str, bytes] | None = None) -> None:
        """Publish and record the results of a scan, and store its picture if one is due. Path and trees are
        published and recorded at most once per second. Without publishing, recording and `keep_pictures` only
        `map_age_s` changes.

        Args:
            frame: Results of the scan.
            path: Path up to the scan.
            also: Further messages in CDR by their topics, see `pipeline.io.recording.messages`.
        """
        self._mapped_s = now_s = time.monotonic()
        if self._camera is not None and self._kept is not None and self._kept.is_due(path):
            picture = self.picture_near(frame.stamp_ns)
            if picture is not None:
                self._kept.add(picture, path)
        if self._publisher is None and self._recorder is None:
            return
        messages = scan_messages(frame) | dict(also or {})
        if now_s >= self._map_at_s + _MAP_PAUSE_S:
            self._map_at_s = now_s
            messages |= map_messages(frame, path)
        if self._publisher is not None:
            self._publisher.publish(messages)
        if self._recorder is not None:
            self._recorder.add_outputs(messages)

    def use_parameters(self, revision: int, from_scan: int, parameters: Parameters) -> None:
        """Record parameters that apply from a mapped scan onwards; nothing happens if there is no recording.

        Args:
            revision: Number of the revision.
            from_scan: Index of the first scan that is mapped with them.
            parameters: The parameters.
        """
        if self._recorder is not None:
            in_file = max(from_scan - self._recorded_from, 0)
            self._recorder.add_parameters(revision, in_file, parameters.model_dump())

    def stop(self) -> None:
        """End the iteration of `records`, and the watch of the robot; may be called in a signal handler."""
        self._ending.set()

    def listen(self) -> bool:
        """Process queued messages until the description is known; return whether it is. The first records
        are held back for `take`. If scans were skipped before, a notice gives their number. Does not wait.

        Raises:
            SourceError: A message cannot be read, or the topics of the robot cannot be used.
        """
        if not self.ready:
            self._early = self.take()
            if self._early and self._inbox.early_scans:
                where = "in the recording only" if self._recorder is not None else "not mapped"
                self._notices.append(
                    f"{self._inbox.early_scans:,} scans arrived before mapping was ready: they are {where}"
                )
        return self.ready

    def wait(self) -> bool:
        """Process messages until the description is known or `stop` is called; return whether it is known.

        Raises:
            SourceError: A message cannot be read, or the topics of the robot cannot be used.
        """
        while not self.listen() and not self._ending.is_set():
            self._ending.wait(_POLL_S)
        return self.ready

    def take(self) -> list[Record]:
        """Return the records that `listen` held back, else those of the next queued message that has any; []
        if none has. Does not wait. Messages without records are processed, and pictures are passed to the
        camera.

        Raises:
            SourceError: A message cannot be read, or the topics of the robot cannot be used.
        """
        if self._failure is not None:
            raise self._failure
        if self._early:
            records, self._early = self._early, []
            return records
        if self._reader is None:
            return []
        while (message := self._inbox.take()) is not None:
            if self._camera is not None and self._camera.add(message):
                continue
            records = self._reader.add(message)
            if records:
                return records
        return []

    def notices(self) -> list[str]:
        """Return the messages for the user since the last call, for example about a lost robot, and forget
        them."""
        notices, self._notices = self._notices, []
        return notices

    @property
    def silence_s(self) -> float | None:
        """Seconds since the last scan arrived, None before the first."""
        return self._link.silence_s

    @property
    def map_age_s(self) -> float | None:
        """Seconds since a scan was mapped, None before the first."""
        return None if self._mapped_s is None else time.monotonic() - self._mapped_s

    def waiting_for(self) -> str:
        """Return why no scans arrive, as text; "" while they arrive."""
        silence_s = self._link.silence_s
        if self._choice is not None and silence_s is not None and silence_s < SILENT_S:
            return ""
        since = "" if silence_s is None else f"Nothing heard for {silence_s:.0f} s"
        if self._link.problem:
            problem = self._link.problem.rstrip(".")
            reason = f"{problem}{'' if problem.endswith('?') else '.'} It is tried again every second"
        elif self._choice is None:
            reason = f"{self._link.place}; {self._not_announced()}"
        elif self._there is False:
            reason = f"{self._name()} is gone; the map goes on when it is back"
        else:
            reason = f"{self._choice.channels[0].topic} is announced and silent"
        return f"{since}: {reason}" if since else f"Waiting: {reason}"

    # --- private --------------------------------------------------------------------------------

    def _not_announced(self) -> str:
        """Return why no scan topic is chosen; if the topic that the user named is not announced, with the
        topics that are."""
        named = self._topics.get("scan")
        there = sorted({p.topic for p in self._link.publishers() if p.msgtype in SCAN_TYPES})
        if named is None or named in there:
            return self._link.nothing
        others = f"scans are announced as {', '.join(there[:_MOST_TOPICS])}" if there else self._link.nothing
        return f"the topic {named} is not announced; {others}"

    @property
    def _base(self) -> str:
        """Name of the base frame; "" before the topics are chosen."""
        return "" if self._reader is None else self._reader.base

    @property
    def _offset_ns(self) -> int:
        """Stamp minus arrival of the first scan [ns]; 0 before it is known."""
        return 0 if self._reader is None else self._reader.offset_ns

    def _name(self) -> str:
        """Return the name of the robot or sensor for people."""
        if isinstance(self._address, VelodyneAddress):
            return "the sensor"
        return f"robot {self.robot}" if self.robot else "the robot"

    def _watch_robot(self) -> None:
        """Choose the topics and note the presence of the robot until the source ends. Runs in a thread; its
        errors are raised by `take`."""
        try:
            while not self._ending.wait(_POLL_S):
                if self._choice is None:
                    self._choose()
                elif self._version != self._link.version:
                    self._note_presence(self._choice)
        except SourceError as error:
            self._failure = error
        except Exception as error:  # raised by `take`; a thread that ends silently would look like waiting
            self._failure = SourceError(
                f"cannot listen to the robot: {type(error).__name__}: {error}", where=self.uri
            )

    def _note_presence(self, choice: Choice) -> None:
        """Update whether the chosen scans are still announced, and add a notice if that changed, not at the
        first call, and one for each topic of fixed transforms that was announced too late."""
        self._version = self._link.version
        publishers = self._link.publishers()
        scan = choice.channels[0].topic
        there = any(p.topic == scan and p.msgtype in SCAN_TYPES for p in publishers)
        if there != self._there:
            if self._there is not None:
                self._notices.append(f"{self._name()} {BACK if there else GONE}")
            self._there = there
        mine = [p for p in publishers if p.msgtype == TRANSFORMS and p.robot in (choice.robot, "")]
        topics = {p.topic for p in mine if is_fixed(p.topic)}
        late = topics - {channel.topic for channel in choice.channels} - self._late
        if self._options.T_base_lidar is None:
            self._notices += [f"{topic} {LATE}" for topic in sorted(late)]
        self._late |= late

    def _choose(self) -> None:
        """Choose the topics once scans have been announced for `_SETTLE_S`, start the recorder and subscribe;
        nothing before.

        Raises:
            SourceError: A topic that the user named has another type.
        """
        choice = choose(self._link.publishers(), self._address.robot, self._topics, self.uri)
        if choice is None:
            self._seen_s = None
            return
        now = time.monotonic()
        self._seen_s = now if self._seen_s is None else self._seen_s
        if now - self._seen_s < _SETTLE_S:
            return
        there = {channel.topic for channel in choice.channels}
        named = {role: name for role, name in self._topics.items() if role == "pose" and name in there}
        topics = {"scan": choice.channels[0].topic, **named}
        options = replace(self._options, topics=topics)
        reader = ArrivalReader(self.uri, self._address.kind, choice.channels, options)
        everything = (*choice.channels, *choice.camera)
        fixed = [channel for channel in choice.channels if is_fixed(channel.topic)]
        if choice.camera:
            self._camera = LiveCamera(choice.camera, fixed)
        if self._publishes and self._link.session is not None:
            self._publisher = RosPublisher(self._link.session, self._address.domain, choice.robot)
        with self._recording:
            if self._recorder is not None:
                self._begin_recording(self._recorder, choice)
            self._inbox.begin(self._recorder, [channel.number for channel in fixed])
            self._choice, self._reader = choice, reader  # the mapping thread reads from here on
        self._link.subscribe(everything)

    def _begin_recording(self, recorder: Recorder, choice: Choice) -> None:
        """Write the beginning of a recording of the chosen topics."""
        header = {"uri": self.uri, "topics": [channel.topic for channel in choice.channels],
                  "camera": [channel.topic for channel in choice.camera]}  # fmt: skip
        recorder.begin((*choice.channels, *choice.camera), header, choice.robot)


def open_live(uri: str, options: SourceOptions | None = None) -> LiveSource:
    """Connect to a live source and return it at once; `LiveSource.start` begins to read its topics.

    Args:
        uri: Address of the robot.
        options: Topics and mounting that the user chose.

    Raises:
        SourceError: The address is invalid, or names robots that cannot be mapped here.
    """
    address = parse_address(uri)
    if isinstance(address, ZenohAddress) and address.robot == ALL_ROBOTS:
        raise SourceError(
            "only one robot can be mapped at a time",
            where=uri,
            remedy="Name it, or show all of them with `stemmap serve`",
        )
    return LiveSource(address, options or SourceOptions())


def open_any(uri: str, options: SourceOptions) -> Source | LiveSource:
    """Open a source by its URI: recorded, simulated or live (see `open_live`).

    Raises:
        SourceError: The source does not exist, has an unknown format, or is damaged; or the address of a live
            source is invalid.
    """
    return open_live(uri, options) if is_live(uri) else open_source(uri, options)
