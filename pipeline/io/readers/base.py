"""Sources of records: the interface, the description of a source, and its digest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from pipeline.geometry.poses import Pose3
from pipeline.types.records import Record, Sensor, Truth

#: Coordinates in metres are smaller than this in every reference system; larger ones are damaged.
COORDINATE_LIMIT = 1e8
#: Above this many bytes (about 1 s of hashing) only the ends of each file are hashed.
WHOLE_LIMIT = 1 << 30
_BLOCK = 1 << 20
_PARTIAL_ENDS = 16 << 20


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic of a recording, whether it is read or not.

    Attributes:
        name, type: Name and message type, e.g. "/velodyne_points" and "sensor_msgs/msg/PointCloud2".
        messages: Number of messages.
        read_as: Role in which it is read ("scan", "odometry", "imu", "gnss", "pose", "camera", "transforms");
            "" if it is not read.
        fits: First role that `--topic` can give it, "" when there is none.
        why_not: Reason why it is not read; "" if it is read.
        why: Reason why it is read and not another one of its kind; "" if it is the only one.
        rate_hz: Mean rate of its messages [Hz]; None if it is unknown.
        family: Family of the LiDAR; "" if it is unknown, or the topic has no scans.
        fields: Names and types of the fields of its points, e.g. "x float32".
        frame: Frame of its first message.
        chain: Frames from `frame` to the base along fixed transforms, both included; () if there are none.
        times: How the times of its points are read, or would be, or why they are not; "" for other topics.
        range_sigma: Measured standard deviation of a range [m]; None if it is not measured.
    """

    name: str
    type: str
    messages: int
    read_as: str
    fits: str
    why_not: str = ""
    why: str = ""
    rate_hz: float | None = None
    family: str = ""
    fields: tuple[str, ...] = ()
    frame: str = ""
    chain: tuple[str, ...] = ()
    times: str = ""
    range_sigma: float | None = None


@dataclass(frozen=True, slots=True)
class Revision:
    """Parameters that apply from a scan onwards.

    Attributes:
        revision: Number of the revision in the run.
        from_scan: First scan that is mapped with them.
        values: Dict from stages to dicts from names of parameters to values; not checked here.
    """

    revision: int
    from_scan: int
    values: dict[str, dict[str, bool | int | float | str]]


@dataclass(frozen=True, slots=True, eq=False)
class SourceDescription:
    """What is known of a source before its first scan is read.

    Attributes:
        uri: URI of the source as the user wrote it.
        kind: Name of the format, e.g. "ROS 2 MCAP".
        sensor: The LiDAR.
        T_base_lidar: Extrinsics of the LiDAR.
        has_odometry, has_imu: Whether the source yields such records.
        scans: Number of scans; None if it is not known before the end.
        start_ns, end_ns: Times of the first and the last scan [ns]; None if unknown.
        digest: SHA-256 (hex) of the file contents, or of the definition of a simulated scenario.
        preset: Parameter preset for this kind of source.
        topics: Topics of a recording of messages; () for other sources.
        warnings: Messages for the user, e.g. that there is no odometry.
        revisions: Parameters of a recorded run, in the order of their scans.
        gnss: How GNSS fixes are used, as text; "" when they are not used.
        other_slam: How the poses of another SLAM are used, as text; "" when they are not used.
        missing: What a recording lacks, what this costs, and what helps, one text each.
        has_times: Whether the source has the times of its scans; otherwise a rate is assumed.
    """

    uri: str
    kind: str
    sensor: Sensor
    T_base_lidar: Pose3
    has_odometry: bool
    has_imu: bool
    scans: int | None
    start_ns: int | None
    end_ns: int | None
    digest: str
    preset: str = "forest"
    topics: tuple[RecordedTopic, ...] = ()
    warnings: tuple[str, ...] = ()
    revisions: tuple[Revision, ...] = ()
    gnss: str = ""
    other_slam: str = ""
    missing: tuple[str, ...] = ()
    has_times: bool = True


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """Choices of the user for a source.

    Attributes:
        topics: Dict from roles ("scan", "odometry", "imu", "gnss", "pose", "camera") to topics; topics of
            other roles are found by type.
        T_base_lidar: Extrinsics of the LiDAR; None means those of the source, else identity.
        seed: Random seed of simulated runs.
        as_live: Of the recording of a live run: read only the messages that the live run mapped.
        form: Whether a file of points is a whole "cloud" or one "scan"; "auto" decides by its contents.
        unit: Unit of the coordinates of a whole cloud: "m", "cm", "mm", "ft" or "us-ft"; "auto" finds it.
        up: Axis of a whole cloud that points up, such as "z" or "-y"; "auto" finds it.
    """

    topics: dict[str, str] = field(default_factory=dict)
    T_base_lidar: Pose3 | None = None
    seed: int = 0
    as_live: bool = False
    form: str = "auto"
    unit: str = "auto"
    up: str = "auto"


class Source(Protocol):
    """A run that can be read from its start, more than once.

    A single bad record never raises: it is left out and counted in `losses`. `SourceError` is raised when the
    source is opened, or during reading when nothing more can be read; records that were yielded before it
    stay valid.
    """

    @property
    def description(self) -> SourceDescription:
        """Description that is known before reading."""

    @property
    def losses(self) -> dict[str, int]:
        """dict from reasons to numbers of records left out on opening and so far in the latest reading, e.g.
        {"scans without points": 3}. Each call of `records` begins a new count; empty if nothing was left
        out."""

    def records(self) -> Iterator[Record]:
        """Yield all records in the order of time."""

    def truth(self) -> Truth | None:
        """Ground truth that comes with the run, None when there is none."""

    def close(self) -> None:
        """Close files and sockets; safe to call twice."""


class FileSource:
    """Parts that sources share: description, losses, no ground truth, nothing to close.

    A subclass sets `_description`, adds to `_damage` what it leaves out on opening, and replaces `_losses` in
    each reading.
    """

    _description: SourceDescription

    def __init__(self) -> None:
        """Begin without losses."""
        self._damage: dict[str, int] = {}
        self._losses: dict[str, int] = {}

    @property
    def description(self) -> SourceDescription:
        """Description that is known before reading."""
        return self._description

    @property
    def losses(self) -> dict[str, int]:
        """New dict from reasons to numbers of records left out on opening and in the latest reading."""
        total = dict(self._damage)
        for reason, number in self._losses.items():
            count_loss(total, reason, number)
        return total

    def truth(self) -> Truth | None:
        """Return None: there is no ground truth."""
        return None

    def close(self) -> None:
        """Do nothing: no file is open."""


def count_loss(losses: dict[str, int], reason: str, number: int = 1) -> None:
    """Add a number of left-out records to the losses of one reason, in place. A new reason is added even if
    the number is 0."""
    losses[reason] = losses.get(reason, 0) + number


def digest_of(paths: Sequence[Path], *, whole_limit: int = WHOLE_LIMIT) -> str:
    """Return the SHA-256 (hex) of one file's contents, or of the names, sizes and contents of several files.

    Args:
        paths: One file, or the files of a folder in the order in which they are read.
        whole_limit: Above this many bytes in total, only the names, sizes and the first and last 16 MB of
            each file are hashed, and the digest begins with "partial:".

    Raises:
        OSError: A file cannot be read.
    """
    total = sum(path.stat().st_size for path in paths)
    state = hashlib.sha256()
    for path in paths:
        size = path.stat().st_size
        if len(paths) > 1 or total > whole_limit:
            state.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb", buffering=0) as file:
            if total <= whole_limit:
                while block := file.read(_BLOCK):
                    state.update(block)
            else:
                state.update(file.read(_PARTIAL_ENDS))
                file.seek(max(size - _PARTIAL_ENDS, 0))
                state.update(file.read(_PARTIAL_ENDS))
    return state.hexdigest() if total <= whole_limit else f"partial:{state.hexdigest()}"
