"""Messages between the web process and the worker, encoded as msgpack."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from app.sources.request import SourceRequest
from pipeline.errors import StemmapError

# Beyond any run, and well inside of an int64 of nanoseconds.
LONGEST_S = 1e9
MOST_SCANS = 10**9
FASTEST = 1000.0

State = Literal["starting", "playing", "paused", "finished", "waiting", "failed"]


@dataclass(frozen=True, slots=True)
class Status:
    """Status of the run. Times are seconds since the first scan of the run.

    Attributes:
        state: "waiting" is a live source from which nothing comes; "failed" says why in `detail`.
        detail: What happened, what it means, what to do; empty when all is well.
        source: The URI.
        kind: The source's format in words.
        odometry: Where the motion comes from, in words.
        time_s, end_s: Of the standing scan, and of the last scan where it is known.
        scan_index: Of the standing scan, -1 before the first.
        scans: Number of scans in the run, None where it is not known.
        speed: Factor of real time.
        scan_rate_hz, mapping_ms: Measured over the last scans.
        stage_ms: Median time of each stage over the last scans.
        scans_behind: Scans that wait to be mapped.
        trees: Confirmed trees.
        distance_m: Distance driven.
        health: "good", "weak" or "lost", or why it is too soon to say (see `health_word`).
        warnings: The newest last, each once.
        revision: Of the parameters in force.
        going_to: The sought time or scan in words while it is not reached yet, else empty.
        going_to_s: The sought time where it is known, else None.
        going_far: Whether the way there takes long enough to speak of it.
        live: Whether the source is a robot that is heard live.
        robot: Its namespace, empty for none.
        robots: The namespaces of all robots that publish scans where it is heard.
        compiling_since_s: When this machine began to compile what it does now [Unix time], else None.
        remapped: How much of the run is mapped again (see `SetParameters`), from 0 to 1; None when it is not.
        camera: Whether there are pictures of a camera.
        recording: Where a live run is recorded to, or why it is no more; empty where it is not.
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
    camera: bool = False
    remapped: float | None = None
    compiling_since_s: float | None = None


class Play(msgspec.Struct, frozen=True, tag="play"):
    """Continue the run; at its end, play from the start."""


class Pause(msgspec.Struct, frozen=True, tag="pause"):
    """Pause at the displayed scan."""


class Advance(msgspec.Struct, frozen=True, tag="advance"):
    """Pause and step forward by a number of scans, or back if it is negative."""

    scans: Annotated[int, Meta(ge=-MOST_SCANS, le=MOST_SCANS)] = 1


class Seek(msgspec.Struct, frozen=True, tag="seek"):
    """Seek to a time [s since the first scan]; the map becomes that of this time."""

    time_s: Annotated[float, Meta(ge=0.0, le=LONGEST_S)]


class SetSpeed(msgspec.Struct, frozen=True, tag="set_speed"):
    """Set the replay speed as a factor of real time; 0 is the maximum speed."""

    factor: Annotated[float, Meta(ge=0.0, le=FASTEST)]


class SetParameters(msgspec.Struct, frozen=True, tag="set_parameters"):
    """Set parameters, given as validated nested values.

    They apply from the next scan onwards or, if paused, to the current scan. With `whole`, the run is mapped
    again from its first scan.

    Attributes:
        step: Changes with the same step (a slider drag) are compared with the map before the first of them;
            None is a step of its own.
    """

    values: dict[str, Any]
    revision: int
    whole: bool = False
    step: int | None = None


class Open(SourceRequest, frozen=True, tag="open"):
    """Close the current run and open this source. Its parameters arrive with `Begin`.

    Attributes:
        record: Path of the file to which a live run is recorded; empty for none. No browser can set it.
        publish: Whether the results of a live run are published to the robot's network.
    """

    record: str = ""
    publish: bool = False


class WorkerBusyError(StemmapError):
    """The worker is being restarted or does not answer in time. The same command may succeed later."""


Command = Play | Pause | Advance | Seek | SetSpeed | SetParameters | Open
