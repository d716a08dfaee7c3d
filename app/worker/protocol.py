"""Messages between the web process and the worker: four bytes with the length, then msgpack.

An array is encoded as dtype, shape and bytes. Both sides declare the types that they expect: a message of
another type, an array of another dtype, or an array whose size contradicts its bytes is refused. Unlike
pickle, a message cannot execute or import code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, BinaryIO, Generic, Literal, TypeVar, get_args

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from app.common.settings import RunStorage
from app.explain.records import ClusterStory, MapSection, TreeStory
from app.sources.one_step import OneStep
from app.sources.request import SourceRequest
from pipeline.errors import StemmapError
from pipeline.repairs.record import Repair
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Float, Frame, Int, Path, Trees, TruthTrees

UInt8 = NDArray[np.uint8]

# Beyond any run, and well inside of an int64 of nanoseconds.
LONGEST_S = 1e9
MOST_SCANS = 10**9
FASTEST = 1000.0

State = Literal["starting", "playing", "paused", "finished", "waiting", "failed"]


@dataclass(frozen=True, slots=True)
class Status:
    """Status of the run. Times are seconds since the first scan of the run.

    Attributes:
        state: "waiting" means that a live source sends nothing; the reason of "failed" is in `detail`.
        detail: What happened, what it means, and what to do; empty if there is no problem.
        source: URI of the source.
        kind: Name of the format of the source.
        odometry: Description of the source of motion.
        time_s, end_s: Time of the current scan, and of the last scan if it is known.
        scan_index: Index of the current scan, -1 before the first.
        scans: Number of scans in the run, None if unknown.
        speed: Playback speed as a factor of real time.
        scan_rate_hz, mapping_ms: Rate [Hz] and mapping time [ms], measured over the last scans.
        stage_ms: Dict from stages to median times over the last scans [ms].
        scans_behind: Number of scans that wait to be mapped.
        scans_left_out: Number of scans that were lost or skipped, or that the reader refused.
        scans_lost: Number of those that the network lost.
        silence_s: Time since the last scan of a robot arrived; None before the first, and if not live.
        map_age_s: Time since a scan of a robot was mapped; None before the first, and if not live.
        trees: Number of confirmed trees.
        distance_m: Driven distance [m].
        health: Pose quality "good", "weak" or "lost", why it is too early to know (see `health_word`), or
            "no data for 12 s" while a robot is silent.
        warnings: Warnings, each once, the newest last.
        revision: Revision of the parameters in force.
        going_to: Description of the sought time or scan until it is reached; empty otherwise.
        going_to_s: Sought time if it is known, else None.
        going_far: Whether the seek takes so long that the dashboard shows it.
        live: Whether the source is live.
        robot: Namespace of the robot, empty for none.
        robots: Namespaces of all robots on the network that publish scans.
        compiling_since_s: Start of the present compilation of kernels [s since 1970], None if there is none.
        compiled: Share of the kernels that are compiled, from 0 to 1; None if there is no compilation.
        kernels_left: Number of kernels that are not compiled yet; None if there is no compilation.
        unmapped: Number of scans that were shown as points before the mapper was ready.
        remapped: Share of the run that is mapped again (see `SetParameters`), from 0 to 1; None if there is
            no rerun.
        camera: Whether the source has camera pictures.
        recording: State of the recording of a live run; empty if there is none.
        recorded_file: Path of its file; empty if there is none.
        one_step: What is known of a source that is mapped in one step; None for a run of scans.
        storage: What a run of scans keeps; None without one.
    """

    state: State
    detail: str = ""
    source: str = ""
    kind: str = ""
    odometry: str = ""
    time_s: float = 0.0
    end_s: float | None = None
    scan_index: int = -1
    scans: int | None = None
    speed: float = 1.0
    scan_rate_hz: float = 0.0
    mapping_ms: float = 0.0
    stage_ms: dict[str, float] = field(default_factory=dict)
    scans_behind: int = 0
    scans_left_out: int = 0
    scans_lost: int = 0
    silence_s: float | None = None
    map_age_s: float | None = None
    trees: int = 0
    distance_m: float = 0.0
    health: str = "no scan yet"
    warnings: list[str] = field(default_factory=list)
    revision: int = 0
    going_to: str = ""
    going_to_s: float | None = None
    going_far: bool = False
    live: bool = False
    robot: str = ""
    robots: list[str] = field(default_factory=list)
    recording: str = ""
    recorded_file: str = ""
    camera: bool = False
    remapped: float | None = None
    compiling_since_s: float | None = None
    one_step: OneStep | None = None
    compiled: float | None = None
    storage: RunStorage | None = None
    kernels_left: int | None = None
    unmapped: int = 0


class Play(msgspec.Struct, frozen=True, tag="play"):
    """Continue the run; at its end, play from the start."""


class Pause(msgspec.Struct, frozen=True, tag="pause"):
    """Pause at the displayed scan."""


class Advance(msgspec.Struct, frozen=True, tag="advance"):
    """Pause and step forward by a number of scans, or back if it is negative."""

    scans: Annotated[int, Meta(ge=-MOST_SCANS, le=MOST_SCANS)] = 1


class BeginRecording(msgspec.Struct, frozen=True, tag="record"):
    """Record a live run from now on to a new file at this path; nothing if it is recorded."""

    path: str


class EndRecording(msgspec.Struct, frozen=True, tag="end_recording"):
    """Finish the recording of a live run; the run continues."""


class EndRun(msgspec.Struct, frozen=True, tag="end_run"):
    """End a live run: its recording is finished, no more scans are mapped, and the map stays."""


class Seek(msgspec.Struct, frozen=True, tag="seek"):
    """Seek to a time [s since the first scan]; the map becomes that of this time."""

    time_s: Annotated[float, Meta(ge=0.0, le=LONGEST_S)]


class SetSpeed(msgspec.Struct, frozen=True, tag="set_speed"):
    """Set the replay speed as a factor of real time; 0 is the maximum speed."""

    factor: Annotated[float, Meta(ge=0.0, le=FASTEST)]


class SetParameters(msgspec.Struct, frozen=True, tag="set_parameters"):
    """Set parameters, given as validated nested values.

    They apply from the next scan onwards or, if the run is paused, from the current scan onwards. With
    `whole`, the run is mapped again from its first scan.

    Attributes:
        values: Dict from stages to dicts from names to values, with all parameters.
        revision: Number of the revision, which results repeat.
        whole: Whether to map the run again.
        step: Changes with the same step (a slider drag) are compared with the map before the first of them;
            None is a step of its own.
    """

    values: dict[str, Any]
    revision: int
    whole: bool = False
    step: int | None = None


class SetRepairs(msgspec.Struct, frozen=True, tag="set_repairs"):
    """Set the repairs of the map of a run, in their order; ignored if another run is open."""

    run: int
    repairs: tuple[Repair, ...]


class Open(SourceRequest, frozen=True, tag="open"):
    """Close the current run and open this source. Its parameters arrive with `Begin`.

    Attributes:
        record: Path of the file to which a live run is recorded; empty for none.
        publish: Whether the results of a live run are published to the robot's network.
    """

    record: str = ""
    publish: bool = False


class WorkerBusyError(StemmapError):
    """The worker is being restarted or does not answer in time. The same command may succeed later."""


Command = (
    Play | Pause | Advance | Seek | SetSpeed | SetParameters | Open | BeginRecording | EndRecording | EndRun
)


class Opened(msgspec.Struct, frozen=True, tag="opened"):
    """A source was opened and waits for `Begin`.

    Attributes:
        run: Number of sources that this worker has opened.
        uri: URI as written by the user.
        kind: Name of the format.
        preset: Preset for this kind of source.
        scans: Number of scans, None if unknown.
        end_s: Time of the last scan since the first [s], None if unknown.
        truth: Ground truth of the source, or None.
        digest: Digest of the recording, empty if unknown.
        requested: URI of the `Open` that this message answers, empty if unknown.
    """

    uri: str
    kind: str
    preset: str
    scans: int | None
    end_s: float | None
    truth: TruthTrees | None
    run: int = 0
    digest: str = ""
    requested: str = ""


class RunCounts(msgspec.Struct, frozen=True):
    """Counts of a run up to a scan, as in run.json.

    Attributes:
        health: Dict from the states of the pose quality ("good", "weak", "lost") to numbers of scans; empty
            for a run of one step.
        sigma_xy_m: Maximum standard deviation of the position [m]; None if unknown.
        verdicts: Dict from verdicts to numbers of clusters.
        losses: Dict from reasons to numbers of messages or points that were left out.
        warnings: Warnings as strings, each once, with the number of its occurrences if it is more than 1.
        covered: Centres of the cells that a source of one step covers, shape (K, 2) [m]; None for a run of
            scans.
    """

    health: dict[str, int] = {}
    sigma_xy_m: float | None = None
    verdicts: dict[str, int] = {}
    losses: dict[str, int] = {}
    warnings: list[str] = []
    covered: Float | None = None


class Shown(msgspec.Struct, frozen=True, tag="shown"):
    """Displayed frame of a scan.

    The path is sent incrementally: the receiver cuts its path to `path_start` rows and appends `path`.

    Attributes:
        run: Number of the run, which identifies late frames of an older run.
        time_s: Time of the scan since the first scan of the run [s].
        frame: Results of the scan.
        path_start: Number of rows sent before that remain valid.
        path: Rows of the path from there on.
        odometry_xy: Positions x, y of the robot by odometry alone, for the same rows, shape (N, 2) [m]; no
            rows if they are unknown.
        confirmed_s: Confirmation time of each tree [s], NaN if unknown; None if all are unknown. Since not
            every scan is displayed, it does not follow from the frames.
        counts: Counts up to this scan; None if they are unknown.
        problems: Why each of the repairs of `SetRepairs` does not apply; "" if it does.
        loops: Numbers of the scans of both ends of each loop of the path, int64, shape (L, 2).
        repairs: The repairs to which `problems` belongs.
        repaired_numbers: Numbers of the trees that each of them is about, see `RepairedMap`.
        agreeing: How many stems agree with each of them, see `RepairedMap`.
        reflectance: Of the raw points, uint8, shape (N,), see `reflectance_of`; None if unknown.
        has_intensity: Whether scans of the run have reflectances; None before the first scan.
    """

    run: int
    time_s: float
    frame: Frame
    path_start: int
    path: Path
    confirmed_s: Float | None = None
    counts: RunCounts | None = None
    odometry_xy: Float = msgspec.field(default_factory=lambda: np.zeros((0, 2)))
    problems: tuple[str, ...] = ()
    loops: Int = msgspec.field(default_factory=lambda: np.zeros((0, 2), np.int64))
    repairs: tuple[Repair, ...] = ()
    repaired_numbers: tuple[tuple[int, ...], ...] = ()
    agreeing: tuple[tuple[int, ...], ...] = ()
    reflectance: UInt8 | None = None
    has_intensity: bool | None = None


class Report(msgspec.Struct, frozen=True, tag="report"):
    """Status of the run."""

    status: Status


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Answer to `Opened`: begin with these parameters; ignored if another run was opened meanwhile.

    Attributes:
        run: Number of the run in `Opened`.
        values, revision: As in `SetParameters`.
        play: Play unless a person has paused since the opening; else show the first scan.
    """

    run: int
    values: dict[str, Any]
    revision: int
    play: bool


class _Question(msgspec.Struct, frozen=True):
    """A question about the run, answered by an `Answer` with the same ticket.

    Attributes:
        ticket: Identifier that the answer repeats.
        run: Number of the run.
    """

    ticket: int
    run: int


class AskCluster(_Question, frozen=True, tag="ask_cluster"):
    """Request the explanation of a cluster of a recently displayed scan.

    Attributes:
        scan, cluster: Index of the scan, and of the cluster in it.
    """

    scan: int
    cluster: int


class AskTree(_Question, frozen=True, tag="ask_tree"):
    """Request the explanation of a tree.

    Attributes:
        tree: Number of the tree.
    """

    tree: int


class AskCompare(_Question, frozen=True, tag="ask_compare"):
    """Request the current scan mapped with other parameter sets, without a change of the run.

    Attributes:
        sets: Parameter sets as validated nested values.
    """

    sets: list[dict[str, Any]]


class AskCamera(_Question, frozen=True, tag="ask_camera"):
    """Request the camera picture of the run nearest to a time.

    Attributes:
        stamp_ns: The time [ns].
    """

    stamp_ns: int


class AskTreePicture(_Question, frozen=True, tag="ask_tree_picture"):
    """Request the camera picture of the run that shows a tree best.

    Attributes:
        tree: Number of the tree.
    """

    tree: int


class AskSection(_Question, frozen=True, tag="ask_section"):
    """Request the accumulated points at breast height."""


class AskCourse(_Question, frozen=True, tag="ask_course"):
    """Request the course of the map.

    Attributes:
        names: Names of quantities.
        most: Maximum number of scans; the last one is among them, the others are evenly spaced.
        stages: Whether the times of the stages are wanted.
    """

    names: list[str]
    most: Annotated[int, Meta(ge=2, le=MOST_SCANS)]
    stages: bool = False


class RunCourse(msgspec.Struct, frozen=True):
    """Quantities of the mapped scans, in their order. Unknown values are NaN.

    Attributes:
        scans: Indices of the scans, shape (N,).
        time_s: Times of the scans since the first one, shape (N,) [s].
        values: Dict from the requested names to the values, shape (N,), in the units of QUANTITIES.
        stages: Dict from stages, and "total", to the times of mapping the scans, shape (N,) [ms]; NaN for
            scans whose times were not measured, 0 for a stage that did not run. Empty unless they are wanted.
        known: Names of QUANTITIES of which any value is known.
    """

    scans: Int
    time_s: Float
    values: dict[str, Float]
    stages: dict[str, Float]
    known: list[str]


class CameraPicture(msgspec.Struct, frozen=True):
    """An encoded picture with the pose of its camera.

    Attributes:
        picture: Encoded picture.
        camera: Camera model and pose, None if unknown.
        why: Reason why the camera model is unknown; empty otherwise.
        received: Number of received pictures of a live run as text; empty for a recording.
    """

    picture: Picture
    camera: Camera | None
    why: str
    received: str = ""


class Answer(msgspec.Struct, frozen=True, tag="answer"):
    """Answer to a question.

    Attributes:
        ticket: Identifier of the question.
        cluster, tree, frames, camera, section, course: One of them is set unless `missing` is; `frames` has
            one frame per parameter set, without raw points.
        missing: Reason why there is no answer, and the remedy.
    """

    ticket: int
    cluster: ClusterStory | None = None
    tree: TreeStory | None = None
    frames: list[Frame] | None = None
    camera: CameraPicture | None = None
    section: MapSection | None = None
    course: RunCourse | None = None
    missing: str = ""


class TreeChange(msgspec.Struct, frozen=True):
    """A tree that differs between the maps.

    Attributes:
        kind: Kind of the difference.
        number: Number in the new map, or in the old one for a tree that vanished.
        x, y: Position in that map [m].
        why: Reason, as text.
    """

    kind: Literal["appeared", "vanished", "moved"]
    number: int
    x: float
    y: float
    why: str


class MapChanges(msgspec.Struct, frozen=True):
    """Differences between two maps.

    Attributes:
        revision: Revision of the parameters.
        scans: Number of scans that were mapped again.
        time_s: Time of the last of them since the first scan [s].
        before, after: Number of trees.
        ghost: x, y [m] and DBH [m] (None where unknown) of each tree of the old map.
        changes: Trees that appeared, vanished or moved.
        confirmed: Number of each tree that was confirmed, also of one that vanished later, and the time
            of its confirmation since the first scan [s].
    """

    revision: int
    scans: int
    time_s: float
    before: int
    after: int
    ghost: list[tuple[float, float, float | None]]
    changes: list[TreeChange]
    confirmed: list[tuple[int, float]]


class Remapped(msgspec.Struct, frozen=True, tag="remapped"):
    """The run was mapped again; the following frames belong to the new map.

    Attributes:
        run: As in `Shown`.
        changes: Differences between the maps.
    """

    run: int
    changes: MapChanges


class Rough(msgspec.Struct, frozen=True, tag="rough"):
    """Preview of the trees of the map that is being computed.

    Attributes:
        run: As in `Shown`.
        revision: Revision of the parameters.
        trees: Preview trees without diameters; their numbers are valid only in this message.
    """

    run: int
    revision: int
    trees: Trees


class View(msgspec.Struct, frozen=True, tag="view"):
    """A scan for the observed area of the present map; after `Remapped` all views are sent again.

    Attributes:
        run: As in `Shown`.
        stamp_ns: Time of the scan [ns].
        view: View of the scan, see `SegmentedScan.view`.
    """

    run: int
    stamp_ns: int
    view: Float


class Unmapped(msgspec.Struct, frozen=True, tag="unmapped"):
    """A scan that is shown before the mapper is ready, see `unmapped_frame`. It belongs to no map.

    Attributes:
        run: As in `Shown`.
        frame: Points of the scan, and its clusters once the front end is compiled.
    """

    run: int
    frame: Frame


FromWorker = Opened | Shown | Report | Answer | Remapped | Rough | View | Unmapped
Question = AskCluster | AskTree | AskCompare | AskCamera | AskTreePicture | AskSection | AskCourse
ToWorker = Command | Begin | SetRepairs | Question


M = TypeVar("M")

LENGTH_BYTES = 4
# A scan of 4 million points with all its layers, more than any sensor produces.
LARGEST_MESSAGE = 128 * 1024 * 1024
_DTYPES = frozenset({"<f4", "<f8", "<i4", "<i8", "|b1", "|u1"})
_MOST_DIMENSIONS = 4


class WireError(ValueError):
    """A message is too large, incomplete, or of an unexpected type."""


class _EncodedArray(msgspec.Struct, frozen=True, array_like=True):
    """An array as it is sent: dtype as in `numpy.dtype.str`, shape, and bytes in C order."""

    dtype: str
    shape: tuple[int, ...]
    content: bytes


class MessageCodec(Generic[M]):
    """Encodes and decodes the messages of one direction.

    Args:
        message_type: A union of msgspec Structs with tags, or one type; fields may be dataclasses with
            arrays.
    """

    def __init__(self, message_type: Any) -> None:  # noqa: ANN401 - a union is no `type`
        self._encoder = msgspec.msgpack.Encoder(enc_hook=_to_plain)
        self._decoder: msgspec.msgpack.Decoder[M] = msgspec.msgpack.Decoder(
            message_type, dec_hook=_from_plain
        )

    def encode(self, message: M) -> bytes:
        """Return the encoded message with its length as prefix.

        Raises:
            WireError: The message is longer than LARGEST_MESSAGE, or has an array of a dtype or number of
                dimensions that cannot be sent.
            NotImplementedError: The message has a value of a type that cannot be sent.
            ValueError, OverflowError: A text is not valid Unicode, or an integer has more than 64 bits.
        """
        packed = bytearray(LENGTH_BYTES)
        self._encoder.encode_into(message, packed, LENGTH_BYTES)
        size = len(packed) - LENGTH_BYTES
        check_size(size)
        packed[:LENGTH_BYTES] = size.to_bytes(LENGTH_BYTES, "little")
        return bytes(packed)

    def body(self, message: M) -> bytes:
        """Return the encoded message without prefix, for `decode`. Errors as `encode`."""
        packed = self._encoder.encode(message)
        check_size(len(packed))
        return packed

    def decode(self, body: bytes) -> M:
        """Return the message decoded from its bytes without the length prefix.

        Raises:
            WireError: The bytes are not a message of the declared types.
        """
        try:
            return self._decoder.decode(body)
        except (msgspec.MsgspecError, ValueError, OverflowError) as error:
            raise WireError(f"a message of {len(body)} bytes cannot be read: {error}") from None

    def read(self, stream: BinaryIO) -> M | None:
        """Return the next message of a blocking stream; None at its end. A length above LARGEST_MESSAGE is
        refused before memory is allocated.

        Raises:
            WireError: The stream ends within a message, or the message is too large or not of the declared
                types.
        """
        head = _read_exactly(stream, LENGTH_BYTES)
        if not head:
            return None
        size = int.from_bytes(head, "little")
        check_size(size)
        body = _read_exactly(stream, size)
        if len(head) < LENGTH_BYTES or len(body) < size:
            raise WireError("the stream ends within a message")
        return self.decode(body)


def check_size(size: int) -> None:
    """Check the length of a message [bytes] before memory is allocated for it.

    Raises:
        WireError: The message is longer than LARGEST_MESSAGE.
    """
    if size > LARGEST_MESSAGE:
        raise WireError(f"a message of {size} bytes is larger than {LARGEST_MESSAGE}")


def to_worker() -> MessageCodec[ToWorker]:
    """Return the codec of the messages from the web process to the worker."""
    return MessageCodec(ToWorker)


def from_worker() -> MessageCodec[FromWorker]:
    """Return the codec of the messages from the worker to the web process."""
    return MessageCodec(FromWorker)


def _read_exactly(stream: BinaryIO, size: int) -> bytes:
    """Return the next `size` bytes of a blocking stream; fewer if the stream ends before."""
    parts: list[bytes] = []
    while size > 0 and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _to_plain(value: object) -> object:
    """Return an array as a tuple of dtype, shape and bytes (see `_EncodedArray`), and a NumPy scalar as a
    Python number.

    Raises:
        WireError: The array has a dtype or number of dimensions that cannot be sent.
        NotImplementedError: The value is of another type.
    """
    if isinstance(value, np.ndarray):
        if value.dtype.str not in _DTYPES or value.ndim > _MOST_DIMENSIONS:
            raise WireError(f"an array of {value.dtype} and {value.ndim} dimensions cannot be sent")
        content = np.ascontiguousarray(value)
        return (value.dtype.str, value.shape, content.data.cast("B") if content.size else b"")
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} cannot be sent")


def _from_plain(expected: Any, plain: object) -> object:  # noqa: ANN401 - the hook's own signature
    """Return the received array, as a copy.

    Args:
        expected: Declared type of the array.
        plain: Decoded msgpack.

    Raises:
        ValueError, msgspec.ValidationError: `plain` is no encoded array, has another dtype than the declared
            type, more than four dimensions, or a shape that contradicts the number of bytes.
        NotImplementedError: The declared type is not an array.
    """
    if getattr(expected, "__origin__", None) is not np.ndarray:
        raise NotImplementedError(f"{expected} cannot be received")
    array = msgspec.convert(plain, _EncodedArray)
    want = np.dtype(get_args(get_args(expected)[1])[0])
    if array.dtype not in _DTYPES or np.dtype(array.dtype) != want:
        raise ValueError(f"an array of {array.dtype} where {want.str} was agreed")
    # Python integers: a product of hostile sizes cannot overflow.
    if len(array.shape) > _MOST_DIMENSIONS or min(array.shape, default=0) < 0:
        raise ValueError(f"an array of the shape {array.shape[:4]}")
    if math.prod(array.shape) * want.itemsize != len(array.content):
        raise ValueError(f"{len(array.content)} bytes are no array of {array.dtype} {array.shape}")
    # A copy, which is aligned and does not reference the whole message.
    return np.frombuffer(array.content, dtype=want).reshape(array.shape).copy()
