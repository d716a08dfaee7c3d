"""The status of a run, in figures that a person can read from two metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.batch.summary import driven
from app.dashboard.payload import health_word
from app.robot.source import LiveSource
from app.worker.camera import has_camera
from app.worker.internal_protocol import Opened
from app.worker.protocol import State, Status
from app.worker.run import Run

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Said:
    """What the session says itself; see `Status`.

    Attributes:
        state, detail: How it goes, and why.
        uri: Of the source, as it was asked for.
        time_s: Of the standing scan.
        warnings: The newest last.
        revision: Of the parameters in force.
        going_to: The sought scan in words; going_to_s: its time [s], where that is known.
    """

    state: State
    detail: str
    uri: str
    time_s: float
    warnings: tuple[str, ...]
    revision: int
    going_to: str
    going_to_s: float | None


def describe(run: Run | None, robot: LiveSource | None, said: Said) -> Status:
    """The status of a run, or of none; speed, rate and lateness are the driver's to fill in."""
    status = _of_session(said) if run is None else _of_run(run, said)
    return status if robot is None else _live(status, robot)


def _live(status: Status, robot: LiveSource) -> Status:
    """The same with what is heard of the robot."""
    # While scans wait the robot was heard, whatever its link had no time to note while a machine compiled.
    is_asked = status.state in ("playing", "waiting") and not robot.scans_waiting
    silent = robot.waiting_for() if is_asked else ""
    return replace(
        status,
        state="waiting" if silent else status.state,
        detail=silent or status.detail,
        live=True,
        robot=robot.robot,
        robots=robot.robots,
        scans_behind=robot.scans_waiting,
        recording=robot.recording,
    )


def _of_session(said: Said) -> Status:
    return Status(
        state=said.state,
        detail=said.detail,
        source=said.uri,
        warnings=list(said.warnings),
        revision=said.revision,
    )


def _of_run(run: Run, said: Said) -> Status:
    description = run.source.description
    losses = tuple(f"{reason} ({n})" for reason, n in run.source.losses.items() if n)
    frame = run.frame
    return replace(
        _of_session(said),
        kind=description.kind,
        odometry=run.odometry,
        time_s=said.time_s,
        end_s=None if description.end_ns is None else (description.end_ns - run.start_ns) / _NS,
        scan_index=-1 if frame is None else frame.index,
        scans=description.scans,
        mapping_ms=round(run.stopwatch.scan_ms, 3),
        stage_ms={stage: round(ms, 3) for stage, ms in run.stopwatch.stage_ms.items()},
        trees=0 if frame is None else int(np.count_nonzero(frame.trees.confirmed)),
        distance_m=round(driven(run.path)[1], 3),
        health=health_word(frame),
        warnings=[*said.warnings, *losses, *([run.cache_notice] if run.cache_notice else [])],
        going_to=said.going_to,
        going_to_s=said.going_to_s,
        camera=has_camera(description),
        remapped=run.remapped,
    )


def clock(seconds: float) -> str:
    """A time as the page writes it: minutes and seconds."""
    whole = int(seconds)
    return f"{whole // 60}:{whole % 60:02d}"


def opened_of(run: Run) -> Opened:
    """What the web process is told of a run that was opened."""
    description = run.source.description
    truth = run.source.truth()
    end_s = None
    if description.start_ns is not None and description.end_ns is not None:
        end_s = (description.end_ns - description.start_ns) / _NS
    return Opened(
        uri=description.uri,
        kind=description.kind,
        preset=description.preset,
        scans=description.scans,
        end_s=end_s,
        truth=truth.trees if truth else None,
        digest=description.digest,
    )
