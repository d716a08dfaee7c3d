"""A run as a person drives it: play, pause, step, seek, tune. No thread, no socket and no clock: a
driver asks for the `pace` and calls `work` as often as it likes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path as FilePath
from typing import Literal

import numpy as np

from app.cursor import Cursor, Synchroniser
from app.live_cursor import LiveCursor
from app.messages import LONGEST_S, State, Status
from app.odometry import odometry_warnings
from app.robot.recording import Recording
from app.robot.source import LiveSource
from app.run import MakeMapper, Run
from app.session_status import clock, describe, opened_of
from app.stopwatch import Stopwatch
from app.story.records import ClusterStory, TreeStory
from app.story.telling import make_ready, tell_cluster, tell_tree
from app.worker_messages import Opened
from pipeline.errors import SourceError, StemmapError
from pipeline.parameters import Parameters
from pipeline.records import Frame, Path
from pipeline.sources.base import Source

OpenSource = Callable[[str, int], Source | LiveSource]
MakeSynchroniser = Callable[[str], Synchroniser]
Pace = Literal["idle", "replay", "hurry", "live"]

_NS = 1_000_000_000
_MOST_WARNINGS = 20


class Session:
    """Owns the source and the mapper.

    After `SourceError` or any other exception out of `open` or `work`, call `fail`; another source
    can be opened, and play begins anew.

    Args:
        open_source: From a URI and a seed.
        make_mapper: A fresh mapper for a source, from parameters, seed and a stopwatch.
        make_synchroniser: From the choice of odometry.
        parameters: In force at the beginning.
    """

    def __init__(
        self,
        open_source: OpenSource,
        make_mapper: MakeMapper,
        make_synchroniser: MakeSynchroniser,
        parameters: Parameters,
    ) -> None:
        self._open_source = open_source
        self._make_mapper = make_mapper
        self._make_synchroniser = make_synchroniser
        self._parameters = parameters
        self._revision = 0
        self._asked: tuple[str, str, int] | None = None
        self._record, self._publish = "", False
        self._run: Run | None = None
        self._robot: LiveSource | None = None
        self._state: State = "starting"
        self._detail = ""
        self._target_index: int | None = None
        self._target_ns: int | None = None
        self._under_way = False
        self._warnings: dict[str, None] = {}

    @property
    def pace(self) -> Pace:
        """Whether a scan is to be mapped at once (on the way to a sought scan), in its time, as soon as it
        comes (of a robot that is heard live), or not."""
        if self._state == "failed" or (self._run is None and self._robot is None):
            return "idle"
        if self._robot is not None:
            return "live" if self._run is None or self._state == "playing" else "idle"
        if self._seeking:
            return "hurry"
        return "replay" if self._state == "playing" else "idle"

    @property
    def frame(self) -> Frame | None:
        """The picture of the standing scan."""
        return self._run.frame if self._run else None

    @property
    def path(self) -> Path | None:
        """Where the robot was up to the standing scan."""
        return self._run.path if self._run else None

    @property
    def time_s(self) -> float:
        """Of the picture, since the run's first scan."""
        if self._run is None or self._run.frame is None:
            return 0.0
        return (self._run.frame.stamp_ns - self._run.start_ns) / _NS

    def next_ns(self) -> int | None:
        """Time of the next scan; None at the end of the run."""
        return self._run.peek_ns() if self._run else None

    def open(
        self, uri: str, odometry: str, seed: int, record: str = "", *, publish: bool = False
    ) -> Opened | None:
        """Leave the present run and stand, paused, before the first scan of another source. A robot is
        recorded to the file `record`, unless that is empty, and told of its map if `publish` says so.

        Returns:
            What was opened; None of a robot that is still to be heard, see `listen`.

        Raises:
            SourceError: It cannot be read.
        """
        self._leave()
        self._asked, self._record, self._publish = (uri, odometry, seed), record, publish
        source = self._open_source(uri, seed)
        if isinstance(source, LiveSource):
            try:
                source.use(Recording(FilePath(record)) if record else None, publish=publish)
            except SourceError:
                source.close()
                raise
            self._robot, self._state, self._detail = source, "waiting", ""
            return None
        return self._begin(source, odometry, seed)

    def listen(self) -> Opened | None:
        """Of a robot: what was opened, once it is heard; None before and after.

        Raises:
            SourceError: What it sends cannot be read.
        """
        if self._robot is None or self._asked is None:
            return None
        self._warn(self._robot.notices())
        if self._run is not None or not self._robot.listen():
            return None
        return self._begin(self._robot, *self._asked[1:])

    def _begin(self, source: Source, odometry: str, seed: int) -> Opened:
        synchronise = self._make_synchroniser(odometry)
        try:
            warnings = odometry_warnings(source.description, odometry)
        except SourceError:
            source.close()
            raise
        stopwatch = Stopwatch()
        mapper = self._make_mapper(source, self._parameters, seed, stopwatch)
        cursor: Cursor | LiveCursor = Cursor(source, synchronise)
        if isinstance(source, LiveSource):
            cursor = LiveCursor(source, odometry)
        self._run = Run(source, mapper, cursor, self._parameters, stopwatch)
        self._state, self._detail = "paused", ""
        self._warn((*source.description.warnings, *warnings))
        return opened_of(self._run)

    def prepare(self) -> None:
        """Have all ready for the first scan, which can take a minute the first time on a machine.

        Raises:
            SourceError: There is no scan.
        """
        if self._run is not None:
            self._run.prepare()
            make_ready(self._run.source.description.sensor)

    def disturb(self) -> None:
        """What is being mapped waits for something that is no part of the mapping: its times do not count."""
        if self._run is not None:
            self._run.stopwatch.disturb()

    def work(self) -> Frame | None:
        """Map one scan if one is wanted. None when there was none: the run is at its end, or the
        sought scan was already reached."""
        run = self._run
        if run is None or self.pace == "idle":
            return None
        if self._seeking and not self._under_way:
            self._set_out(run)
        if self._has_arrived(run):
            return self._arrive(run)
        frame = run.map_next()
        if frame is None:
            self._state = "finished" if self._robot is None else self._state
        else:
            self._warn(frame.warnings)
            if self._robot is not None:
                self._robot.mapped(frame, run.path)
        if self._has_arrived(run) or (frame is None and self._seeking):
            return self._arrive(run)
        return frame

    def play(self) -> Opened | None:
        """Go on; from the start when the run is at its end. A run that has failed is opened again.

        Returns:
            What was opened again, if so.

        Raises:
            SourceError: It cannot be read.
        """
        opened = None
        if self._run is None and self._robot is not None and self._state != "failed":
            return None  # it plays when it is heard
        if self._run is None or self._state == "failed":
            if self._asked is None:
                return None
            opened = self.open(*self._asked, self._record, publish=self._publish)
        elif self._state == "finished":
            self._seek_index(0)
        if self._run is not None:
            self._state, self._detail = "playing", ""
        return opened

    def pause(self) -> None:
        """Stand still; on the way to a sought scan, once it is reached."""
        if self._state == "playing":
            self._state = "paused"

    def advance(self, scans: int) -> None:
        """Pause, and stand so many scans further or back."""
        if self._run is None or self._is_live():
            return
        here = self._run.standing if self._target_index is None else self._target_index
        self._settle()
        self._seek_index(max(0, here + scans))

    def seek(self, time_s: float) -> None:
        """Stand at the last scan not later than a time; the run then goes on as it did before."""
        if self._run is None or not math.isfinite(time_s) or self._is_live():
            return
        if self._state != "playing":
            self._settle()
        seconds = min(max(time_s, 0.0), LONGEST_S)
        stamp_ns = self._run.start_ns + round(seconds * _NS)
        index = self._run.index_at(stamp_ns)
        if index is not None:
            self._seek_index(index)
        else:
            self._target_index, self._target_ns, self._under_way = None, stamp_ns, False

    def set_parameters(self, parameters: Parameters, revision: int) -> Frame | None:
        """Use other parameters: from the next scan on, or from the sought or the standing scan on.

        Returns:
            The standing scan, mapped again, when the run stands still; else None.
        """
        self._parameters, self._revision = parameters, revision
        run = self._run
        if run is None:
            return None
        if self._seeking:  # see `_arrive`
            return None
        stands = self._state != "playing" and run.standing >= 0
        from_scan = run.standing + (0 if stands else 1)
        run.use(parameters, from_scan)
        if self._robot is not None:
            self._robot.use_parameters(revision, from_scan, parameters)
        return run.map_again() if stands and self._state != "failed" else None

    def cluster_story(self, frame: Frame, cluster: int) -> ClusterStory:
        """The story of a cluster of a frame of this run, which may have lost its raw points.

        Raises:
            StemmapError: There is no such cluster.
        """
        run = self._run
        if run is None or not 0 <= cluster < len(frame.clusters.size):
            raise StemmapError(f"there is no cluster {cluster}", where=f"scan {frame.index}")
        parameters = run.parameters_at(frame.index)
        return tell_cluster(frame, cluster, parameters, run.source.description.sensor, run.start_ns)

    def tree_story(self, number: int) -> TreeStory:
        """The story of a tree as the standing scan knows it.

        Raises:
            StemmapError: There is no such tree now.
        """
        run = self._run
        frame = run.frame if run else None
        row = np.flatnonzero(frame.trees.number == number) if frame else np.zeros(0, np.int64)
        if run is None or frame is None or not len(row):
            raise StemmapError(
                f"tree {number} is not known at this time of the run", remedy="Play on, or select another"
            )
        parameters, sensor = run.parameters_at(frame.index), run.source.description.sensor
        return tell_tree(frame, int(row[0]), parameters, sensor, run.start_ns, run.history)

    def compare(self, sets: Sequence[Parameters]) -> list[Frame]:
        """The standing scan under each of other parameters; the run stays as it is.

        Raises:
            StemmapError: There is none, or a set cannot be mapped with.
        """
        if self._run is None or self._state == "failed":
            raise StemmapError("nothing is mapped", remedy="Press play, or open a run")
        return self._run.map_with(sets)

    def fail(self, detail: str) -> None:
        """Say that the run cannot go on, and why."""
        self._state, self._detail = "failed", detail
        self._forget_target()

    def status(self) -> Status:
        """How the run goes; what only a clock can tell is left at 0."""
        return describe(
            self._run,
            self._robot,
            state=self._state,
            detail=self._detail,
            uri=self._asked[0] if self._asked else "",
            time_s=self.time_s,
            warnings=tuple(self._warnings),
            revision=self._revision,
            going_to=self._going_to(),
        )

    def close(self) -> None:
        """Let go of the source."""
        self._leave()

    def _is_live(self) -> bool:
        """Whether the run is of a robot, in whose time nobody can go; a person is told so."""
        if self._robot is not None:
            self._warn(["a live run goes on as it comes: to step and seek, open its recording"])
        return self._robot is not None

    @property
    def _seeking(self) -> bool:
        return self._target_index is not None or self._target_ns is not None

    def _going_to(self) -> str:
        """The sought scan in words; empty when none is."""
        run = self._run
        if run is None or not self._seeking:
            return ""
        if self._target_ns is not None:
            return clock((self._target_ns - run.start_ns) / _NS)
        if self._target_index is not None and self._target_index < run.known:
            return clock((run.stamp_ns(self._target_index) - run.start_ns) / _NS)
        return f"scan {self._target_index}"

    def _settle(self) -> None:
        self._state, self._detail = "paused", ""

    def _seek_index(self, index: int) -> None:
        self._target_index, self._target_ns, self._under_way = index, None, False

    def _set_out(self, run: Run) -> None:
        """Begin the way to the sought scan: not before work begins, so that targets that are
        overtaken by another while a person drags the timeline cost nothing and leave no trace."""
        self._under_way = True
        if self._target_index is None:
            run.approach(run.known)
        elif self._target_index != run.standing or not run.is_whole:
            run.approach(self._target_index)

    def _has_arrived(self, run: Run) -> bool:
        if self._target_index is not None:
            return run.standing >= self._target_index
        if self._target_ns is None or run.standing < 0:
            return False
        following = run.peek_ns()
        return following is not None and following > self._target_ns

    def _arrive(self, run: Run) -> Frame | None:
        """Stand at the sought scan. The map before it is as it was; the parameters in force now act
        from this scan on, whenever on the way they came."""
        self._forget_target()
        return run.map_again() if run.use(self._parameters, run.standing) else run.frame

    def _forget_target(self) -> None:
        self._target_index = self._target_ns = None
        self._under_way = False

    def _leave(self) -> None:
        if self._run is not None:
            self._run.close()
        elif self._robot is not None:
            self._robot.close()
        self._run = self._robot = None
        self._warnings.clear()
        self._forget_target()

    def _warn(self, warnings: Iterable[str]) -> None:
        for warning in warnings:
            self._warnings.pop(warning, None)
            self._warnings[warning] = None
        while len(self._warnings) > _MOST_WARNINGS:
            del self._warnings[next(iter(self._warnings))]
