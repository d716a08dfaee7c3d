"""Sources of records: the interface, what is known of a source, and its digest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from pipeline.geometry.poses import Pose3
from pipeline.types.records import Record, Sensor, Truth


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic that a recording holds, whether it is read or not.

    Attributes:
        name, type: e.g. "/velodyne_points" and "sensor_msgs/msg/PointCloud2".
        messages: How many.
        read_as: What it is read as ("scan", "odometry", "imu", "gnss", "pose", "transforms"), "" when it
            is not read.
        fits: The role that it could be given with `--topic`, "" when none.
        why_not: Why it is not read, "" when it is.
    """

    name: str
    type: str
    messages: int
    read_as: str
    fits: str
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Revision:
    """Parameters that were in force from a scan on.

    Attributes:
        revision: Its number in the run.
        from_scan: The first scan that was mapped with them.
        values: Values by stage and name; checked by whoever uses them.
    """

    revision: int
    from_scan: int
    values: dict[str, dict[str, bool | int | float | str]]


@dataclass(frozen=True, slots=True, eq=False)
class SourceDescription:
    """What is known of a source before its first scan is read.

    Attributes:
        uri: As the user wrote it.
        kind: The format in words, e.g. "ROS 2 MCAP".
        sensor: The LiDAR.
        T_base_lidar: Where the LiDAR stands on the robot.
        has_odometry, has_imu: Whether such records will come.
        scans: Number of scans, None when it is not known before the end.
        start_ns, end_ns: Time of the first and last scan, None when not known.
        digest: SHA-256 (hex) of what is read: file contents, or the scenario's definition.
        preset: The preset that suits this kind of source.
        topics: What a recording of messages holds; () where there are no topics.
        warnings: What a person should know, e.g. that there is no odometry.
        in_order_of_arrival: Whether records come as they came to a live run, not sorted by their time.
        revisions: The parameters that a recorded run was mapped with, in the order of their scans.
        gnss: How GNSS fixes are used, in words, "" when none are.
        other_slam: Likewise of the poses of another SLAM.
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
    in_order_of_arrival: bool = False
    revisions: tuple[Revision, ...] = ()
    gnss: str = ""
    other_slam: str = ""


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """What the user may say about a source.

    Attributes:
        topics: Chosen topic by role ("scan", "odometry", "imu", "gnss", "pose"); empty means found by type.
        T_base_lidar: Mounting of the LiDAR; None means what the source says, else identity.
        seed: Of simulated runs.
    """

    topics: dict[str, str] = field(default_factory=dict)
    T_base_lidar: Pose3 | None = None
    seed: int = 0


class Source(Protocol):
    """A run that can be read from the start or from any time.

    Reading never raises for a single bad record: it is left out and counted in `losses`. A
    `SourceError` is raised when opening, or while reading when nothing more can be read; what was
    yielded before stays valid.
    """

    @property
    def description(self) -> SourceDescription:
        """What is known before reading."""

    @property
    def losses(self) -> dict[str, int]:
        """What was left out so far, by reason in words, e.g. {"scans without points": 3}."""

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield records in the order of time, from `start_ns` on (None: all)."""

    def truth(self) -> Truth | None:
        """What is known for certain about this run, if anything."""

    def close(self) -> None:
        """Let go of files and sockets; safe to call twice."""


#: Above this many bytes (about 1 s of work) only the ends of each file are hashed, and the digest says so.
WHOLE_LIMIT = 1 << 30
_BLOCK = 1 << 20
_PARTIAL_ENDS = 16 << 20


def digest_of(paths: Sequence[Path], *, whole_limit: int = WHOLE_LIMIT) -> str:
    """SHA-256 (hex) of one file's contents, or of the names and contents of several.

    Args:
        paths: One file, or the files of a folder in the order in which they are read.
        whole_limit: Above this many bytes in all, only sizes and the first and last 16 MB of each
            file are hashed, and the digest begins with "partial:".

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
