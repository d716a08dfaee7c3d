"""Session: a run that a person controls (play, pause, step, seek, tune).

It has no thread, socket or clock; the loop of the worker reads `pace` and calls `work`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Literal

import msgspec
import numpy as np

from app.batch.summary import driven, health_word, scans_left_out
from app.batch.tree_pictures import best_views
from app.common.settings import DEFAULT_BUDGET, RunBudget
from app.explain import build as stories
from app.robot.link import LOST_SCANS
from app.robot.recorder import Recorder
from app.robot.source import BACK, GONE, LiveSource
from app.sources.one_step import OneStepSource
from app.worker.one_step_run import OneStepRun
from app.worker.protocol import (
    LONGEST_S,
    CameraPicture,
    MapChanges,
    Open,
    Opened,
    State,
    Status,
)
from app.worker.remap import MapComparison
from app.worker.run import MakeMapper, Run
from app.worker.shown_map import AnyRun, ShownMap
from pipeline.config import Parameters
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.base import Source, SourceDescription, SourceOptions
from pipeline.io.readers.camera import SHOWN_NS, PictureSource
from pipeline.io.readers.topics import COMPRESSED_IMAGE, IMAGE
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.types.records import Frame, Path, Trees
from pipeline.types.units import SECOND_NS

OpenSource = Callable[[str, SourceOptions], Source | LiveSource]
Pace = Literal["idle", "replay", "hurry", "live"]
_MOST_WARNINGS = 20
_NOT_REMAPPED = "the run was not mapped again, its map is as before"


class Session:
    """Owns the source and the mapper.

    After an exception of `open` or `work`, call `fail`; another source can then be opened, and `play` starts
    from the beginning.

    Args:
        open_source: Opens a source by its URI and options.
        make_mapper: Returns a new mapper.
        parameters: Parameters at the beginning.
        compiling: Compiles the kernels that are not compiled on this machine yet, in other processes; yields
            whether those of the front end are there until all are.
        warm_up: Loads the kernels; called while a robot is already received and recorded.
        budget: What a run may keep.

    Attributes:
        on_preview: Called by `remap` with the revision of the parameters and the preview trees of a rerun,
            before any scan is mapped again.
        unmapped: Number of scans of the run that `show_unmapped` returned.
        shown: The map that is shown.
    """

    def __init__(
        self,
        open_source: OpenSource,
        make_mapper: MakeMapper,
        parameters: Parameters,
        compiling: Callable[[], Iterator[bool]] = lambda: iter(()),
        warm_up: Callable[[], None] = lambda: None,
        budget: RunBudget = DEFAULT_BUDGET,
    ) -> None:
        self._open_source = open_source
        self._warm_up, self._budget = warm_up, budget
        self._compile, self._compiling, self._is_segmenting = compiling, compiling(), False
        self.unmapped = 0
        self._make_mapper = make_mapper
        self._parameters = parameters
        self._revision = 0
        self._request: Open | None = None
        self._robot: LiveSource | None = None
        self._state: State = "starting"
        self._detail = ""
        self._target = SeekTarget()
        self._comparison = MapComparison()
        self.shown = ShownMap(lambda: self._state == "playing" or self._target.sought)
        self._remaps_on_arrival = False
        self._warnings: dict[str, None] = {}
        self.on_preview: Callable[[int, Trees], None] = lambda _revision, _trees: None

    @property
    def pace(self) -> Pace:
        """When the next scan is mapped: "hurry" immediately, while seeking; "replay" at its time; "live" on
        arrival, also before the run of a robot is opened; "idle" not at all: paused, finished, failed, or
        without a run."""
        if self._state == "failed" or (self.run is None and self._robot is None):
            return "idle"
        if self._robot is not None:
            return "live" if self.run is None or self._state == "playing" else "idle"
        if self._target.sought:
            return "hurry"
        return "replay" if self._state == "playing" else "idle"

    @property
    def is_live(self) -> bool:
        """Whether the source is a robot, whose run may have ended."""
        return self._robot is not None

    @property
    def run(self) -> AnyRun | None:
        """The open run, or None."""
        return self.shown.run

    def next_ns(self) -> int | None:
        """Return the time of the next scan [ns]; None if there is no run, at the end of the run, or before a
        live scan arrived. Raises SourceError if nothing more can be read."""
        return self.run.peek_ns() if self.run else None

    def open(self, request: Open) -> Opened | None:
        """Close the present run and open another source, paused before its first scan; preset and parameters
        of the request are not used.

        Returns:
            The opened run; None for a robot that has not sent scans yet, see `listen`.

        Raises:
            SourceError: The source cannot be read, or the odometry is not available for it.
            StemmapError: The random forest of the parameters does not exist; or, for a robot, a process that
                compiles cannot be started.
        """
        self.close()
        self._request, record = request, request.record
        source = self._open_source(request.uri, request.options())
        if isinstance(source, LiveSource):
            try:
                source.start(Recorder(FilePath(record)) if record else None, publish=request.publish)
            except SourceError:
                source.close()
                raise
            self._robot, self._state, self._detail = source, "waiting", ""
            if isinstance(self._compiling, Generator):
                self._compiling.close()  # its lock would keep the warm-up waiting
            self._compiling = self._compile()
            self._warm_up()
            return None
        return self._begin(source, request)

    def listen(self) -> Opened | None:
        """Process what a live robot sent, without waiting. Return its run, opened and paused before the first
        scan, in the call in which its description becomes known; None in all other calls, and without a live
        robot. The notices of the robot become warnings of the session and, once it is open, of the run. The
        session's warning that the robot sends no scans ends when it sends again.

        Raises:
            SourceError: What it sends cannot be read, or the odometry is not available for it.
            StemmapError: The random forest of the parameters does not exist. After this error, and for an
                odometry that is not available, the source is closed.
        """
        if self._robot is None or self._request is None:
            return None
        is_heard = self.run is None and self._robot.listen()
        notices = self._robot.notices()
        for notice in notices:
            if notice.endswith(BACK):  # no warning: it ends one
                self._warnings.pop(notice.replace(BACK, GONE), None)
            else:
                self._warn([notice])
        opened = self._begin(self._robot, self._request) if is_heard else None
        if isinstance(self.run, Run):
            self.run.warnings += notices
        return opened

    def _begin(self, source: Source | LiveSource, request: Open) -> Opened:
        """Open a run of a source, paused before its first scan, and return its message.

        Raises:
            SourceError: The odometry is not available for this source; the source is closed.
            StemmapError: The random forest of the parameters does not exist; the source is closed.
        """
        run: AnyRun
        try:
            if isinstance(source, OneStepSource):
                run = OneStepRun(source, self._parameters)
            else:
                run = Run(source, request, self._parameters, self._make_mapper, self._budget)
        except BaseException:
            source.close()
            raise
        self.shown.begin(run)
        self._state, self._detail = "paused", ""
        self.unmapped = 0
        if isinstance(run, Run):
            self._is_segmenting = next(self._compiling, False)
        self._warn(run.warnings)
        return opened_of(run)

    def prepare(self) -> bool:
        """Continue the preparation of the run and return whether it is complete: the kernels are compiled in
        other processes, which can take minutes the first time on a machine, then the first scan is mapped,
        whose result is discarded. Nothing is left to do without a run, and for one of one step.

        Raises:
            SourceError: There is no scan, or it cannot be read.
            StemmapError: The scan cannot be mapped, or a process that compiles cannot be started.
        """
        if isinstance(self.run, Run):
            has_front_end = next(self._compiling, None)
            if has_front_end is not None:
                self._is_segmenting = has_front_end
                return False
            self._compiling = self._compile()  # for the next run, whose kernels may be others
            self.run.prepare()
            stories.warm_up(self.run.source.description.sensor)
        return True

    def show_unmapped(self) -> Frame | None:
        """Return the next scan of a run that waits for its kernels, see `Run.next_unmapped`, and count it in
        `unmapped`; None without one. Errors as there."""
        if not isinstance(self.run, Run):
            return None
        frame = self.run.next_unmapped(segmented=self._is_segmenting)
        self.unmapped += frame is not None
        return frame

    def disturb(self) -> None:
        """Discard the time measurement of the scan that is mapped now, since the mapping waits for something
        else. Nothing without a run."""
        if self.run is not None:
            self.run.stopwatch.disturb()

    def work(self) -> Frame | None:
        """Map at most one scan and return its frame. In a seek, each call maps one scan on the way, whose
        frame may have no points (`Run.is_bare`); the seek ends at its target or at the end of the run. The
        results of a live robot are published and recorded.

        None if no run is open, if `pace` is "idle", while a run of one step is not mapped completely, before
        a live scan arrived, and at the end of a run without a seek. The state becomes "finished" when no scan
        is left, unless the run is live; also in a seek, which then returns the last scan.

        Raises:
            StemmapError: Nothing more can be read, or the scan cannot be mapped.
        """
        run = self.run
        if run is None or self.pace == "idle":
            return None
        self._target.set_out(run)
        if self._target.is_at_end(run):
            return self._arrive(run)
        frame = run.map_next(hurried=self._target.sought)
        if isinstance(run, OneStepRun) and run.share is not None:
            return None
        if frame is None:
            self._state = "finished" if self._robot is None else self._state
        else:
            self._warn(frame.warnings)
            if self._robot is not None:
                self._robot.mapped(frame, run.path)
        if self._target.is_at_end(run) or (frame is None and self._target.sought):
            return self._arrive(run)
        return frame

    def play(self) -> Opened | None:
        """Continue the run; at its end, play from the start. A failed or closed run is opened again. Nothing
        before the first scan of a live robot, which plays when it arrives, after the end of a live run, and
        if nothing was ever opened.

        Returns:
            The run that was opened again, or None.

        Raises:
            SourceError: The source cannot be read.
            StemmapError: As in `open`.
        """
        opened = None
        if self.run is None and self._robot is not None and self._state != "failed":
            return None  # it plays when scans arrive
        if self._robot is not None and self._state == "finished":
            return None
        if self.run is None or self._state == "failed":
            opened = None if self._request is None else self.open(self._request)
        elif self._state == "finished":
            self._target.to_scan(0)
        if self.run is not None:
            self._state, self._detail = "playing", ""
        return opened

    def pause(self) -> Frame | None:
        """Pause if the run plays; while seeking, pause once the target is reached. Other states stay.

        Returns:
            The current scan if its loops were repaired by an earlier solution and are now by their own; else
            None.
        """
        was_hurried = self.shown.is_hurried
        if self._state == "playing":
            self._state = "paused"
        return self.shown.frame if was_hurried and not self.shown.is_hurried else None

    def advance(self, scans: int) -> Frame | None:
        """Pause and seek a number of scans forward, or back if it is negative, from the sought scan if its
        index is known, else from the current one; at most back to the first scan. A live run only gets a
        message that it cannot seek; nothing happens without a run.

        Returns:
            The sought scan if it was mapped, see `ShownMap.is_stored`; else None.
        """
        if self.run is None or self._refuses_seek():
            return None
        here = self.run.current if self._target.index is None else self._target.index
        self._settle()
        self._target.to_scan(max(0, here + scans))
        return self.shown.show_stored(self._target.index, self._parameters)

    def seek(self, time_s: float) -> Frame | None:
        """Seek to the last scan not later than a time; a playing run then plays on, any other is paused.
        Times are clipped to 0 to LONGEST_S; NaN and infinity are ignored. A live run only gets a message that
        it cannot seek.

        Returns:
            The sought scan if it was mapped, see `ShownMap.is_stored`; else None.
        """
        if self.run is None or not math.isfinite(time_s) or self._refuses_seek():
            return None
        if self._state != "playing":
            self._settle()
        seconds = min(max(time_s, 0.0), LONGEST_S)
        self._target.to_time(self.run, self.run.start_ns + round(seconds * SECOND_NS))
        return self.shown.show_stored(self._target.index, self._parameters)

    def set_parameters(
        self, parameters: Parameters, revision: int, *, whole: bool = False, step: int | None = None
    ) -> Frame | None:
        """Use other parameters from the next scan onwards; if the run does not play, from the current scan.
        During a seek they apply from its target onwards; without a run, to the run that is opened next. A
        rerun that is not complete is cancelled. The recording of a live run gets the parameters.

        Args:
            parameters, revision: The parameters.
            whole: Whether to map the run again from its first scan (see `remap`).
            step: Changes with the same step are compared with the map before the first of them.

        Returns:
            The current scan, mapped again; None if the run plays, has failed or has no scan yet, and during a
            seek.

        Raises:
            StemmapError: The current scan cannot be mapped again, or the forest of the parameters does not
                exist.
        """
        self._parameters, self._revision = parameters, revision
        self._comparison.begin(step)
        run = self.run
        if run is None:
            return None
        run.cancel_remapping()
        self.shown.forget_repaired()
        if self._target.sought:  # see `_arrive`
            self._remaps_on_arrival = whole
            return None
        paused = self._state != "playing" and run.current >= 0
        from_scan = run.current + (0 if paused else 1)
        run.use(parameters, from_scan)
        if self._robot is not None:
            self._robot.use_parameters(revision, from_scan, parameters)
        if whole and run.current >= 0:
            self._begin_remapping(run)
        return run.map_again() if paused and self._state != "failed" else None

    @property
    def is_remapping(self) -> bool:
        """Whether a rerun is in progress and can continue now, that is, no scan is sought."""
        return self.run is not None and self.run.remapped is not None and not self._target.sought

    def remap(self) -> tuple[Frame, MapChanges] | None:
        """Take the next step of a rerun: of its preview, or a scan. If the scan cannot be read, the rerun
        ends with a warning and the map stays. After the last scan, the recording of a live run gets the
        parameters.

        Returns:
            After the last scan, the frame of the current scan in the new map and the differences; before, and
            without a rerun, None.
        """
        run, shown = self.run, self.shown.frame
        if run is None or shown is None:
            return None
        try:
            done = run.remap_next()
        except StemmapError as error:
            self._warn([f"{_NOT_REMAPPED}: {error}"])
            return None
        if done is None:
            return None
        frame, confirmed_s = done
        self.shown.forget_repaired()
        frame = self.shown.frame or frame
        changes = self._comparison.changes(shown, frame, self._revision, self.shown.time_s, confirmed_s)
        if self._robot is not None:
            self._robot.use_parameters(self._revision, 0, run.parameters_at(0))
        return frame, changes

    def compare(self, sets: Sequence[Parameters]) -> list[Frame]:
        """Return the current scan mapped with other parameter sets, without a change of the run.

        Raises:
            StemmapError: There is no current scan, or a set cannot be used.
        """
        if self.run is None or self._state == "failed":
            raise StemmapError("nothing is mapped", remedy="Press play, or open a run")
        return self.run.map_with(sets)

    def fail(self, detail: str) -> None:
        """Set the state "failed" with the reason `detail`; a seek and a rerun are cancelled. The run stays
        open until `play` or `open`."""
        self._state, self._detail = "failed", detail
        self._target.forget()
        self.shown.show_current()
        if self.run is not None:
            self.run.cancel_remapping()

    def status(self) -> Status:
        """Return the status of the run, also if none is open. The loop knows its speed, its scan rate and,
        unless it is live, its number of scans behind; here they have the defaults of `Status`."""
        run, robot = self.run, self._robot
        status = Status(
            state=self._state,
            detail=self._detail,
            source=self._request.uri if self._request else "",
            time_s=self.shown.time_s,
            warnings=list(self._warnings),
            revision=self._revision,
            going_to="" if self.shown.is_stored else self._target.words(run),
            going_to_s=None if self.shown.is_stored else self._target.time_s(run),
            unmapped=self.unmapped,
        )
        status = status if run is None else _with_run(status, run, self.shown.frame, self.shown.path)
        return status if robot is None else with_robot(status, robot)

    def close(self) -> None:
        """Close the run or the robot, if one is open, and forget seek, warnings and comparison. State and
        parameters stay, and `play` can open the source again."""
        owner = self.run or self._robot
        if owner is not None:
            owner.close()
        self._robot, self._comparison = None, MapComparison()
        self._remaps_on_arrival = False
        self._warnings.clear()
        self._target.forget()
        self.shown.close()

    def start_recording(self, path: str) -> None:
        """Record a live run from now on, with the parameters in force; nothing if it is recorded, has ended,
        or no robot is open. A run that is opened again is recorded to this path as well."""
        robot, run = self._robot, self.run
        if robot is None or self._request is None:
            return
        self._request = msgspec.structs.replace(self._request, record=path)
        first = run.known if isinstance(run, Run) else 0
        robot.record(FilePath(path), first)
        if isinstance(run, Run):
            robot.use_parameters(self._revision, first, self._parameters)

    def end_recording(self) -> bool:
        """Finish the recording of a live run, which waits up to 8 s for the disk, and return whether the run
        is live; callable from any thread."""
        robot = self._robot
        if robot is not None:
            robot.end_recording()
        return robot is not None

    def end_run(self) -> None:
        """End a live run: finish its recording and map no more scans. The state becomes "finished", and the
        map stays until another source is opened. Nothing before the run is opened, and for other sources."""
        if self._robot is None or self.run is None or self._state == "failed":
            return
        self._robot.stop()
        self.end_recording()
        self._state = "finished"

    def _refuses_seek(self) -> bool:
        """Return whether the run is live; if so, add a warning that it cannot seek."""
        if self.is_live:
            self._warn(["a live run cannot step or seek: open its recording"])
        return self.is_live

    def _settle(self) -> None:
        """Set the state "paused", whatever it was, and remove the reason of a failure."""
        self._state, self._detail = "paused", ""

    def _arrive(self, run: AnyRun) -> Frame | None:
        """End the seek and return the frame of the current scan; None before the first scan. The scan is
        mapped again if its frame has no points. Parameters that were changed during the seek apply from this
        scan onwards, and a rerun that was requested begins. Raises StemmapError if the scan cannot be mapped
        again."""
        self._target.forget()
        self.shown.show_current()
        changed = run.use(self._parameters, run.current)
        if self._remaps_on_arrival:
            self._remaps_on_arrival = False
            self._begin_remapping(run)
        return run.map_again() if changed or run.is_bare else run.frame

    def _begin_remapping(self, run: AnyRun) -> None:
        """Begin to map a run again with the present parameters, see `remap`; a warning if it cannot be."""
        revision = self._revision
        try:
            run.remap(self._parameters, lambda trees: self.on_preview(revision, trees))
        except StemmapError as error:
            self._warn([f"{_NOT_REMAPPED}: {error}"])

    def _warn(self, warnings: Iterable[str]) -> None:
        """Add warnings, each once and the newest last; only the last 20 are kept."""
        for warning in warnings:
            self._warnings.pop(warning, None)
            self._warnings[warning] = None
        while len(self._warnings) > _MOST_WARNINGS:
            del self._warnings[next(iter(self._warnings))]


def with_robot(status: Status, robot: LiveSource) -> Status:
    """Return the status with the fields of a live run: namespaces, scans and recording of its robot.
    If the run plays or waits and the robot is silent, the state is "waiting". Then, and if it is silent while
    the run is paused, `detail` has the reason, and the quality of the last pose gives way to the time without
    data."""
    # While scans wait the robot is not silent, even if its link had no time to note it during a compilation.
    # A paused run lets them wait.
    is_paused = status.state == "paused" and status.scan_index >= 0
    is_asked = is_paused or (status.state in ("playing", "waiting") and not robot.scans_waiting)
    silent = robot.waiting_for() if is_asked else ""
    silence_s = robot.silence_s
    is_old = bool(silent) and silence_s is not None and status.scan_index >= 0
    return replace(
        status,
        state="waiting" if silent and not is_paused else status.state,
        detail=silent or status.detail,
        health=f"no data for {silence_s:.0f} s" if is_old else status.health,
        live=True,
        robot=robot.robot,
        robots=robot.robots,
        scans_behind=robot.scans_waiting,
        scans_lost=robot.losses.get(LOST_SCANS, 0),
        silence_s=None if silence_s is None else round(silence_s, 1),
        map_age_s=None if robot.map_age_s is None else round(robot.map_age_s, 1),
        recording=robot.recording,
        recorded_file=robot.recorded_file,
    )


def _with_run(status: Status, run: AnyRun, frame: Frame | None, path: Path | None) -> Status:
    """Return the status with the fields that the run and its source determine. The records that the source
    left out and the notice of the cache are appended to its warnings.

    Args:
        status: The status.
        run: The run.
        frame, path: The shown scan with the path up to it; None before the first scan.
    """
    description = run.source.description
    losses = tuple(f"{reason} ({n})" for reason, n in run.source.losses.items() if n)
    distance_m = 0.0 if path is None else round(driven(path)[1], 3)
    if isinstance(run, OneStepRun):
        status = _with_one_step(status, run)
    return replace(
        status,
        kind=description.kind,
        odometry=run.odometry,
        end_s=None if description.end_ns is None else (description.end_ns - run.start_ns) / SECOND_NS,
        scan_index=-1 if frame is None else frame.index,
        scans=description.scans,
        mapping_ms=round(run.stopwatch.scan_ms, 3),
        stage_ms={stage: round(ms, 3) for stage, ms in run.stopwatch.stage_ms.items()},
        scans_left_out=sum(scans_left_out(run.losses).values()) if isinstance(run, Run) else 0,
        trees=0 if frame is None else int(np.count_nonzero(frame.trees.confirmed)),
        distance_m=distance_m,
        health=health_word(frame, distance_m),
        warnings=[*status.warnings, *losses, *([run.cache_notice] if run.cache_notice else [])],
        camera=has_camera(description),
        remapped=run.remapped,
        storage=run.storage if isinstance(run, Run) else None,
    )


def _with_one_step(status: Status, run: OneStepRun) -> Status:
    """Return the status of a run of one step, with the progress of its first map."""
    status = replace(status, one_step=run.source.about)
    if run.frame is None and run.share is not None and status.state in ("playing", "paused"):
        return replace(status, state="starting", detail=f"Mapping: {100.0 * run.share:.0f} %")
    return status


def opened_of(run: AnyRun) -> Opened:
    """Return the message for an opened source, without `run` and `requested`. `end_s` is None unless the
    source has a known begin and end."""
    description = run.source.description
    truth = run.source.truth()
    end_s = None
    if description.start_ns is not None and description.end_ns is not None:
        end_s = (description.end_ns - description.start_ns) / SECOND_NS
    return Opened(
        uri=description.uri,
        kind=description.kind,
        preset=description.preset,
        scans=description.scans,
        end_s=end_s,
        truth=truth.trees if truth else None,
        digest=description.digest,
    )


class SeekTarget:
    """The scan that is sought: given by its index, or as the last scan not later than a time; or none."""

    def __init__(self) -> None:
        self._index: int | None = None
        self._stamp_ns: int | None = None
        self._under_way = False

    @property
    def sought(self) -> bool:
        """Whether a scan is sought."""
        return self._index is not None or self._stamp_ns is not None

    @property
    def index(self) -> int | None:
        """Index of the sought scan; None if a time or nothing is sought."""
        return self._index

    def to_scan(self, index: int) -> None:
        """Seek the scan with this index."""
        self._index, self._stamp_ns, self._under_way = index, None, False

    def to_time(self, run: AnyRun, stamp_ns: int) -> None:
        """Seek the last scan of the run not later than a time [ns]; if that scan was not read yet, the run is
        mapped on until it is found."""
        index = run.index_at(stamp_ns)
        if index is not None:
            self.to_scan(index)
        else:
            self._index, self._stamp_ns, self._under_way = None, stamp_ns, False

    def forget(self) -> None:
        """End the seek."""
        self._index, self._stamp_ns, self._under_way = None, None, False

    def set_out(self, run: AnyRun) -> None:
        """Restore a state of the run before the target, once for each target; nothing if the target is the
        current scan. This happens when mapping begins, so that targets that are replaced while the timeline
        is dragged cost nothing.

        Raises:
            SourceError: The run is live.
        """
        if self._under_way or not self.sought:
            return
        self._under_way = True
        if self._index is None:
            run.approach(run.known)
        elif self._index != run.current or not run.is_whole:
            run.approach(self._index)

    def is_at_end(self, run: AnyRun) -> bool:
        """Return whether the run has reached the sought scan; False if there is none. For a time, the
        following scan must be known; SourceError if it cannot be read."""
        if self._index is not None:
            return run.current >= self._index
        if self._stamp_ns is None or run.current < 0:
            return False
        following = run.peek_ns()
        return following is not None and following > self._stamp_ns

    def words(self, run: AnyRun | None) -> str:
        """Return a description of the sought scan: its time, for example "1:05", or "scan 12" if its time is
        unknown. Empty without a run or without a sought scan."""
        if run is None or not self.sought:
            return ""
        time_s = self.time_s(run)
        return f"scan {self._index}" if time_s is None else clock(time_s)

    def time_s(self, run: AnyRun | None) -> float | None:
        """Return the time of the sought scan [s since the first scan]; None if there is none, or if it is
        unknown."""
        if run is None:
            return None
        if self._stamp_ns is not None:
            return (self._stamp_ns - run.start_ns) / SECOND_NS
        if self._index is not None and self._index < run.known:
            return (run.stamp_ns(self._index) - run.start_ns) / SECOND_NS
        return None


def clock(seconds: float) -> str:
    """Return a time of 0 s or more as whole minutes and seconds, for example "1:05" or "75:00"."""
    whole = int(seconds)
    return f"{whole // 60}:{whole % 60:02d}"


def has_camera(description: SourceDescription) -> bool:
    """Return whether a source has camera pictures."""
    return any(t.read_as == "camera" and t.type in (IMAGE, COMPRESSED_IMAGE) for t in description.topics)


def pictures_of(source: Source | None) -> PictureSource:
    """Return the source that reads the camera pictures: `source`, or the source inside of an
    OdometryOverride. Raises StemmapError if it is None or has no camera."""
    origin: object = source.source if isinstance(source, OdometryOverride) else source
    if source is None or not has_camera(source.description) or not isinstance(origin, PictureSource):
        raise StemmapError("this run has no camera", remedy="Record the topic of a camera as well")
    return origin


def camera_picture(source: Source | None, stamp_ns: int) -> CameraPicture:
    """Return the camera picture of a source that is closest to a time, with its camera model if that is
    known.

    Args:
        source: The open source; None if no run is open.
        stamp_ns: The time [ns].

    Raises:
        StemmapError: The source has no camera, or no picture within `SHOWN_NS` of the time.
    """
    origin = pictures_of(source)
    picture = origin.picture_near(stamp_ns, SHOWN_NS)
    if picture is None:
        raise StemmapError(
            f"no picture was taken within {SHOWN_NS / 1e9:g} s of this scan",
            remedy="Play on, or go to another scan",
        )
    received = origin.picture_counts if isinstance(origin, LiveSource) else ""
    return CameraPicture(picture, *origin.camera(), received)


def tree_picture(run: AnyRun | None, number: int) -> CameraPicture:
    """Return the camera picture of a run that shows a tree best, see `best_views`, with its camera model.

    Of a recording, the pictures nearest to the mapped scans are considered, because a list of all pictures
    would need the whole recording.

    Args:
        run: The run; None if none is open.
        number: Number of the tree.

    Raises:
        StemmapError: Nothing is mapped, the source has no camera or an unknown one, or no picture shows a
            confirmed tree with this number.
    """
    frame = None if run is None else run.frame
    if run is None or frame is None:
        raise StemmapError("nothing is mapped yet", remedy="Press play, or open a run")
    origin = pictures_of(run.source)
    camera, why = origin.camera()
    if camera is None:
        raise StemmapError(f"trees cannot be found in the pictures: {why}")
    stamps = run.path.stamp_ns
    if isinstance(origin, LiveSource):
        stamps = np.array(origin.picture_stamps(), np.int64)
    tree = replace(frame.trees, confirmed=frame.trees.confirmed & (frame.trees.number == number))
    views = best_views(camera, tree, run.path, stamps)
    if not views:
        raise StemmapError(f"no picture shows tree {number}", remedy="Play on, or select another")
    return camera_picture(run.source, views[0].stamp_ns)
