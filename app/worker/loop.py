"""Main loop of the mapping process: executes commands between two scans, keeps the time of the replay, and
sends results to the web process.

Path of a scan from the source to the browsers, from `WorkerLoop.run` on:

1. `WorkerLoop._map_next` calls `Session.work`, which calls `Run.map_next` (`run.py`).
2. `Cursor.take` (`cursor.py`) returns the next step: scan, odometry and tilt, joined by the synchroniser.
3. `Mapper.process` (`pipeline/mapper.py`) maps it; `RunMap.add` (`remap.py`) stores the resulting `Frame`.
4. `WorkerLoop._show` puts the frame with the path as `Shown` (`protocol.py`) into the `Outbox` (`outbox.py`),
   whose thread writes it to the pipe.
5. In the web process `WorkerProcess` (`supervisor.py`) reads it and awaits `Dashboard.receive`
   (`app/dashboard/dashboard.py`), which draws it in the scene and broadcasts it to the pages.
"""

from __future__ import annotations

import contextlib
import math
import queue
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import msgspec

from app.common.text import COMPILING
from app.explain.build import cluster_story, section, tree_story
from app.worker import protocol
from app.worker.one_step_run import OneStepRun
from app.worker.outbox import RecentScans, for_comparison
from app.worker.session import Session, camera_picture, tree_picture
from pipeline.config.model import validated
from pipeline.errors import StemmapError
from pipeline.types.records import Frame
from pipeline.types.units import SECOND_NS

Put = Callable[[protocol.FromWorker], None]
T = TypeVar("T")

# Interval of status reports while a run plays, and of frames during a seek. A short seek shows no frames
# before its target, so that the page does not flicker.
_REPORT_S = 0.25
# The supervisor replaces a worker that plays and is silent for long.
_HEARTBEAT_S = 1.0
_GLIMPSE_S = 0.5
# The mapper follows to a scan that is shown from stored results, and a rerun begins or continues, this time
# after the last command, so that the next command, and drawing in the other processes, do not wait for it.
_QUIET_S = 0.3
_COMPILING = COMPILING.capitalize()
_COMPILES_ON_S = 60.0  # kernels compiled within this time of one another count as one wait
# Interval at which messages of a live source are taken; it costs less than 1 % of a core.
_LISTEN_S = 0.005
# Time of a rerun between two checks for commands, and number of scans of a playing run that are mapped before
# the rerun continues, even if the replay is late.
_REMAP_S = 0.02
_SCANS_A_REMAP = 4


class WorkerLoop:
    """Runs a session until the commands end.

    Args:
        session: The session with the run. Its `on_preview` is set, so that previews are sent as `Rough`.
        commands: Queue that another thread fills; None ends the loop.
        put: Queues a message to the web process; must not block.
        clock: Returns the time [s] from any origin.
        recent: Frames that were sent recently, to which questions refer.
        kernels: Returns the number of the kernels that are compiled, and of all.
    """

    def __init__(
        self,
        session: Session,
        commands: queue.Queue[protocol.ToWorker | None],
        put: Put,
        clock: Callable[[], float] = time.monotonic,
        recent: RecentScans | None = None,
        kernels: Callable[[], tuple[int, int]] = lambda: (1, 1),
    ) -> None:
        self._session = session
        session.on_preview = lambda revision, trees: put(protocol.Rough(self._run, revision, trees))
        self._commands = commands
        self._put = put
        self._clock = clock
        self._recent = recent or RecentScans()
        self._taken: deque[protocol.ToWorker | None] = deque()
        self._replay = ReplayClock()
        self._run, self._requested = 0, ""
        self._held = False
        self._prepared = False
        self._reported: tuple[protocol.Status, float] | None = None
        self._glimpse_at = 0.0
        self._long_way_at = self._quiet_until = 0.0
        self._compiling_since_s, self._compiled_at = 0.0, -math.inf
        self._kernels, self._progress_at = kernels, -math.inf
        self._prepare_at = 0.0
        self._mapped = 0  # scans since a scan was mapped again

    def run(self) -> None:
        """Execute commands and map scans until the command None; then close the session. Errors of the run
        are reported and do not end the loop."""
        self._report()
        while True:
            try:
                command = self._next_command()
            except queue.Empty:
                self._guarded(self._work)
                continue
            if command is None:
                self._session.close()
                return
            if isinstance(command, protocol.Question):
                self._answer(command)
            else:
                self._execute(command)

    def _work(self) -> None:
        """Do the next piece of work, the first of these that applies: a part of a rerun, if `_QUIET_S` passed
        since the last command and no scan is due or `_SCANS_A_REMAP` scans were mapped; live messages, if no
        live scan waits; the preparation, once for each run; a scan. Errors of the session pass through."""
        is_remapping = self._session.is_remapping and self._quiet_s() == 0.0
        if is_remapping and (self._mapped >= _SCANS_A_REMAP or self._due_in() != 0.0):
            self._mapped = 0
            self._remap()
        elif self._session.pace == "live" and self._session.next_ns() is None:
            self._listen()
        elif not self._prepared:
            self._prepare()
        else:
            self._mapped += 1
            self._map_next()

    def _map_next(self) -> None:
        """Map the next scan and show it, with a status when due. Frames of a seek are shown at most every
        `_GLIMPSE_S`, and not at all while the sought scan is shown from stored results. Errors of the session
        pass through."""
        session = self._session
        hurried = session.pace == "hurry"
        frame = session.work()
        now = self._clock()
        if frame is not None:
            self._replay.mapped(frame.stamp_ns, now)
        if hurried and session.pace != "hurry":  # arrived: time counts from here
            self._replay.release()
        elif hurried and (now < self._glimpse_at or session.shown.is_stored):
            return
        self._glimpse_at = now + _GLIMPSE_S
        self._show(session.shown.frame)
        if session.pace == "idle":
            self._report()
        else:
            self._report_when_due(now)

    def _answer(self, question: protocol.Question) -> None:
        """Answer a question; a comparison waits until the mapper has reached the shown scan."""
        while isinstance(question, protocol.AskCompare) and self._session.shown.is_stored:
            self._guarded(self._work)
        self._put(answer(self._session, self._recent, question, self._run))
        if self._is_compiling_reported:  # an answer may compile other kernels than the run
            self._report()

    def _next_command(self) -> protocol.ToWorker | None:
        """Return the next command, and wait for it until the next scan is due; None ends the worker. Of
        successive parameter changes (a slider drag) or seeks (the timeline) the last one is returned, and the
        others are dropped.

        Raises:
            queue.Empty: Work is due, see `_work`.
        """
        if not self._taken:
            self._taken.append(self._await_command())
        with contextlib.suppress(queue.Empty):
            while True:
                self._taken.append(self._commands.get_nowait())
        command = self._taken.popleft()
        while (
            isinstance(command, protocol.SetParameters | protocol.Seek)
            and self._taken
            and type(self._taken[0]) is type(command)
        ):
            command = self._taken.popleft()
        return command

    def _await_command(self) -> protocol.ToWorker | None:
        """Wait for the next command until work is due, see `_patience`, and return it; None ends the worker.
        Report at intervals that the worker is alive; while a robot is paused, how its recording grows.

        Raises:
            queue.Empty: Work is due.
        """
        while True:
            patience_s = self._patience()
            reports = self._session.is_live if patience_s is None else patience_s > _HEARTBEAT_S
            if not reports:
                return self._commands.get(timeout=patience_s)
            with contextlib.suppress(queue.Empty):
                return self._commands.get(timeout=_HEARTBEAT_S)
            self._report()

    def _patience(self) -> float | None:
        """Return the time until work is due [s], 0 if it is overdue: `_due_in`, or during a rerun the shorter
        one of `_due_in` and `_quiet_s`; None if only a command can start work."""
        due_s, quiet_s = self._due_in(), self._quiet_s()
        if not self._session.is_remapping:
            return due_s
        return quiet_s if due_s is None else min(due_s, quiet_s)

    def _quiet_s(self) -> float:
        """Return the time [s] until `_QUIET_S` has passed since the last command; 0 if it has."""
        return max(0.0, self._quiet_until - self._clock())

    def _due_in(self) -> float | None:
        """Return the time until the next scan is due [s].

        - 0 if it is overdue, during a seek, while nothing is prepared, and at the end of the run;
        - the time left of `_QUIET_S` after a command, if a sought scan is shown from stored results;
        - `_LISTEN_S` for a live run without a queued scan;
        - None if only a command can start work.

        An error of the source sets the state to "failed" and is reported.
        """
        pace = self._session.pace
        if self._session.shown.is_stored:
            return self._quiet_s()
        if pace == "idle":
            return None
        if pace == "live":
            return _LISTEN_S if self._guarded(self._session.next_ns) is None else 0.0
        if not self._prepared:
            return max(0.0, self._prepare_at - self._clock())
        if pace == "hurry":
            return 0.0
        stamp_ns = self._guarded(self._session.next_ns)
        return 0.0 if stamp_ns is None else self._replay.delay(stamp_ns, self._clock())

    def _remap(self) -> None:
        """Continue a rerun for up to `_REMAP_S`. When it is complete, forget the recent scans, and send the
        differences, the current scan in the new map and the status."""
        until = self._clock() + _REMAP_S
        done = self._session.remap()
        while done is None and self._session.is_remapping and self._clock() < until:
            done = self._session.remap()
        if done is None:
            self._report_when_due(self._clock())
            return
        frame, changes = done
        self._recent.forget()  # their verdicts are of other parameters
        self._put(protocol.Remapped(self._run, changes))
        self._show(frame)
        self._report()

    def _report_when_due(self, now: float) -> None:
        """Send the status if the last one was sent `_REPORT_S` or longer before `now` [s], or none was
        sent."""
        if self._reported is None or now >= self._reported[1] + _REPORT_S:
            self._report()

    def _listen(self) -> None:
        """Process the messages of a live source while no scan is queued. The run is opened with the first
        ones. Raises SourceError if they cannot be read."""
        opened = self._session.listen()
        if opened is not None:
            self._send_opened(opened)
        self._report_when_due(self._clock())

    def _execute(self, command: protocol.Command | protocol.Begin | protocol.SetRepairs) -> None:
        """Execute a command and send the status. The next scan becomes the anchor of the replay clock. An
        error sets the state "failed"."""
        self._replay.release()
        self._glimpse_at = self._long_way_at = self._clock() + _GLIMPSE_S
        self._quiet_until = self._clock() + _QUIET_S
        self._guarded(lambda: self._carry_out(command))
        self._report()

    def _carry_out(self, command: protocol.Command | protocol.Begin | protocol.SetRepairs) -> None:
        """Execute a command and show the frame that it returns, if any. Errors of the session pass through,
        and ParameterError for invalid values."""
        session = self._session
        match command:
            case protocol.Play():
                self._play()
            case protocol.Pause():
                self._held = True
                self._show(session.pause())
            case protocol.BeginRecording(path=path):
                session.start_recording(path)
            case protocol.EndRecording():
                session.end_recording()
            case protocol.EndRun():
                session.end_run()
            case protocol.Advance(scans=scans):
                self._held = True
                self._show(session.advance(scans))
            case protocol.Seek(time_s=time_s):
                self._show(session.seek(time_s))
            case protocol.SetSpeed(factor=factor):
                self._replay.speed = factor
            case protocol.SetParameters(values=values, revision=revision, whole=whole, step=step):
                self._show(session.set_parameters(validated(values), revision, whole=whole, step=step))
            case protocol.Open():
                self._open(command)
            case protocol.Begin():
                self._begin(command)
            case protocol.SetRepairs(run=run, repairs=repairs):
                if run == self._run:
                    self._show(session.shown.set_repairs(repairs))

    def _open(self, command: protocol.Open) -> None:
        """Open a source as the next run: send the status "starting" before, and `Opened` once it is open. A
        live source is opened by its first messages, see `_listen`. Raises SourceError if it cannot be
        read."""
        self._run, self._requested = self._run + 1, command.uri
        status = protocol.Status(state="starting", detail=f"Opening {command.uri}", source=command.uri)
        self._reported = (status, -math.inf)  # what is compiled from now on is waited for by this source
        self._put(protocol.Report(status))
        opened = self._session.open(command)
        if opened is not None:
            self._send_opened(opened)

    def _play(self) -> None:
        """Continue the run, see `Session.play`. A failed or closed run is opened again and announced with a
        new number. Raises SourceError if it cannot be read."""
        self._held = False
        opened_again = self._session.play()
        if opened_again is not None:
            self._run += 1
            self._send_opened(opened_again)

    def _send_opened(self, opened: protocol.Opened) -> None:
        """Send `Opened` with the number of the run; the run has to be prepared before its first scan."""
        self._prepared = self._held = False
        self._put(msgspec.structs.replace(opened, run=self._run, requested=self._requested))

    def _begin(self, command: protocol.Begin) -> None:
        """Set the parameters of the open run and show the current scan if there is one; then play, or seek
        the first scan if `command.play` is False. If `command.run` is not the open run, do nothing. If a
        person has paused or an error occurred since the opening, only set the parameters. Raises
        ParameterError for invalid values."""
        if command.run != self._run:  # another run was opened since
            return
        self._show(self._session.set_parameters(validated(command.values), command.revision))
        if self._held:  # a user has paused, or an error has stopped the run, since the opening
            return
        if command.play:
            self._session.play()
        else:
            self._session.advance(1)

    def _prepare(self) -> None:
        """Continue the preparation, see `Session.prepare`, and send the status; while kernels are compiled,
        show the next scan as points or clusters, one in each interval of _GLIMPSE_S. The run counts as
        prepared also after an error. Errors of the session pass through."""
        self._send_status(self._preparing(), self._clock())
        self._prepared = True
        if self._session.prepare():
            self._replay.release()
            self._report()
            return
        frame = None
        with contextlib.suppress(StemmapError):  # which the mapper meets when it comes to this scan
            frame = self._session.show_unmapped()
        if frame is not None:
            self._put(protocol.Unmapped(self._run, frame))
        self._prepared = False
        self._prepare_at = self._clock() + _GLIMPSE_S

    def _preparing(self) -> protocol.Status:
        """Return the status of the session with the state "starting", for the time while the mapper is
        prepared; also with the progress of a compilation that was reported within the last _HEARTBEAT_S."""
        status = replace(self._session.status(), state="starting", detail="Preparing the mapper")
        is_compiling = self._clock() < self._compiled_at + _HEARTBEAT_S
        return self._with_compilation(status) if is_compiling else status

    def compiling(self) -> None:
        """Report that the mapping waits for the compilation of a kernel; called during the compilation. The
        time measurement of the present scan is discarded. The status "playing" becomes "waiting"; further
        calls report the progress at intervals of _HEARTBEAT_S. Before the first status nothing is
        reported."""
        self._session.disturb()
        now = self._clock()
        if now > self._compiled_at + _COMPILES_ON_S:
            self._compiling_since_s = time.time()
        self._compiled_at = now
        if self._reported is None:
            return
        if self._is_compiling_reported and now < self._progress_at + _HEARTBEAT_S:
            return
        self._progress_at = now
        # The last status, because the session is in the middle of its work.
        status = self._with_compilation(self._reported[0])
        if status.state == "playing":
            status = replace(status, state="waiting")
        self._reported = (status, -math.inf)  # so that the next status is sent at once
        self._put(protocol.Report(status))

    def _with_compilation(self, status: protocol.Status) -> protocol.Status:
        """Return a status with the progress of the compilation."""
        compiled, of_all = self._kernels()
        return replace(
            status,
            detail=_COMPILING,
            compiling_since_s=self._compiling_since_s,
            compiled=compiled / of_all,
            kernels_left=of_all - compiled,
        )

    @property
    def _is_compiling_reported(self) -> bool:
        """Whether the last status states that a kernel is compiled."""
        return self._reported is not None and self._reported[0].detail == _COMPILING

    def _show(self, frame: Frame | None) -> None:
        """Queue the frame of the session with its repairs, the path and the confirmation times; nothing for
        None."""
        shown, run = self._session.shown, self._session.run
        path, repaired = shown.path, shown.repaired
        frame = None if frame is None else shown.frame
        if frame is not None and path is not None:
            self._put(
                protocol.Shown(
                    run=self._run,
                    time_s=shown.time_s,
                    frame=frame,
                    path_start=0,
                    path=path,
                    confirmed_s=shown.confirmed_s,
                    counts=shown.counts,
                    odometry_xy=shown.odometry_xy[: len(path.x)],
                    problems=() if repaired is None else repaired.problems,
                    loops=shown.loops,
                    repairs=() if repaired is None else shown.repairs,
                    repaired_numbers=() if repaired is None else repaired.numbers,
                    agreeing=() if repaired is None else repaired.agreeing,
                    reflectance=shown.reflectance,
                    has_intensity=None if run is None else run.has_intensity,
                )
            )

    def _report(self) -> None:
        """Queue the views that were not sent yet, and the present status with the speed, and with rate and
        scans behind, which are 0 unless the run plays. Before the preparation of a run that plays or seeks,
        the state is "starting"; a seek that takes long is named in `detail`."""
        run = self._session.run
        for stamp_ns, view in () if run is None else run.take_views():
            self._put(protocol.View(self._run, stamp_ns, view))
        now = self._clock()
        if self._session.pace not in ("idle", "live") and not self._prepared:
            # Nothing plays yet: the first scan is read and the kernels are compiled before.
            self._send_status(self._preparing(), now)
            return
        playing = self._session.pace in ("replay", "live")
        status = self._session.status()
        if status.going_to and now >= self._long_way_at:  # not for a short seek, which would flicker
            status = replace(status, detail=f"Going to {status.going_to} …", going_far=True)
        status = replace(
            status,
            speed=self._replay.speed,
            scan_rate_hz=round(self._replay.rate_hz, 2) if playing and status.state != "waiting" else 0.0,
            scans_behind=self._behind(status, now) if playing else 0,
        )
        self._send_status(status, now)

    def _send_status(self, status: protocol.Status, now: float) -> None:
        """Queue a status and remember it with its time [s]."""
        self._reported = (status, now)
        self._put(protocol.Report(status))

    def _behind(self, status: protocol.Status, now: float) -> int:
        """Return the number of scans that wait to be mapped: those in the queue of a live run, else at most
        those that are left in the run."""
        if status.live:
            return status.scans_behind
        behind = self._replay.behind(now)
        return behind if status.scans is None else min(behind, status.scans - 1 - status.scan_index)

    def _guarded(self, work: Callable[[], T]) -> T | None:
        """Return the result of `work`. After an error, return None, set the state "failed" and send the
        status; the process continues. Unexpected errors are printed."""
        try:
            return work()
        except StemmapError as error:
            self._fail(str(error))
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self._fail(
                f"The run stopped: {type(error).__name__}: {error}. This is a fault in stemmap; "
                "the terminal shows where. Play starts the run again"
            )
        self._report()
        return None

    def _fail(self, detail: str) -> None:
        """Set the state "failed" with the reason `detail`; the run does not continue by itself."""
        self._held = True
        self._session.fail(detail)


def answer(session: Session, recent: RecentScans, question: protocol.Question, run: int) -> protocol.Answer:
    """Return the answer to a question, or an answer with the reason why there is none. The run does not
    change.

    Args:
        session: Session of the run.
        recent: Recently sent frames; a question about a cluster refers to one of them.
        question: Question of any kind.
        run: Number of the open run.
    """
    try:
        if question.run != run:
            raise StemmapError("another run was opened")
        return _answer(session, recent, question)
    except StemmapError as error:
        return protocol.Answer(question.ticket, missing=str(error))
    except Exception as error:  # an answer that fails must not stop the run
        traceback.print_exc(file=sys.stderr)
        fault = f"this is a fault in stemmap: {type(error).__name__}: {error}"
        return protocol.Answer(question.ticket, missing=f"{fault}. The terminal shows where")


def _answer(session: Session, recent: RecentScans, question: protocol.Question) -> protocol.Answer:
    """Return the answer to a question; raises StemmapError if there is none, or if values of parameters are
    invalid. Arguments as in `answer`."""
    ticket, run = question.ticket, session.run
    match question:
        case protocol.AskCompare(sets=sets):
            frames = session.compare([validated(values) for values in sets])
            return protocol.Answer(ticket, frames=[for_comparison(frame) for frame in frames])
        case protocol.AskCamera(stamp_ns=stamp_ns):
            return protocol.Answer(
                ticket, camera=camera_picture(None if run is None else run.source, stamp_ns)
            )
        case protocol.AskTreePicture(tree=tree):
            return protocol.Answer(ticket, camera=tree_picture(run, tree))
        case protocol.AskSection():
            if run is None:
                raise StemmapError("no run is open", remedy="Open one")
            return protocol.Answer(ticket, section=section(session.shown.accumulated))
        case protocol.AskCourse(names=names, most=most, stages=stages):
            if run is None:
                raise StemmapError("no run is open", remedy="Open one")
            return protocol.Answer(ticket, course=run.course(names, most, stages=stages))
        case protocol.AskTree(tree=tree):
            if isinstance(run, OneStepRun):
                return protocol.Answer(ticket, tree=run.tree_story(tree))
            return protocol.Answer(
                ticket, tree=tree_story(run, session.shown.frame, tree, session.shown.mapped_place(tree))
            )
        case protocol.AskCluster(scan=scan, cluster=cluster):
            frame = recent.find(question.run, scan)
            if frame is None:
                raise StemmapError(
                    f"scan {scan} was shown too long ago", remedy="Click a cluster of the newest one"
                )
            if isinstance(run, OneStepRun):
                return protocol.Answer(ticket, cluster=run.cluster_story(cluster))
            return protocol.Answer(ticket, cluster=cluster_story(run, frame, cluster))


RATE_SCANS = 20  # scans over which the rate is measured
SLOWEST = 1e-3  # factor of real time; a smaller one would give times that no clock can wait for
LONGEST_DELAY_S = 3600.0


class ReplayClock:
    """Replay times at a factor of real time. No scan is skipped; `behind` counts the scans that are late.

    The anchor is a scan with the time at which it was shown; the due times of later scans follow from it.
    Parameters `now` are times of the computer [s] from any origin; times of the data are nanoseconds.
    """

    def __init__(self) -> None:
        self._speed = 1.0
        self._anchor: tuple[int, float] | None = None
        self._mapped: deque[tuple[int, float]] = deque(maxlen=RATE_SCANS)

    @property
    def speed(self) -> float:
        """Factor of real time, at least `SLOWEST`, to which smaller values are raised; 0 is the maximum
        speed. Call `release` after a change."""
        return self._speed

    @speed.setter
    def speed(self, factor: float) -> None:
        self._speed = 0.0 if factor == 0.0 else max(factor, SLOWEST)

    def anchor(self, stamp_ns: int, now: float) -> None:
        """Make the scan of `stamp_ns`, shown at `now`, the anchor; `rate_hz` and `behind` begin again."""
        self._anchor = (stamp_ns, now)
        self._mapped.clear()

    def release(self) -> None:
        """Make the next scan the anchor: after a pause, a jump or a change of speed; `rate_hz` and `behind`
        begin again."""
        self._anchor = None
        self._mapped.clear()

    def delay(self, stamp_ns: int, now: float) -> float:
        """Return the time until the scan of `stamp_ns` is due [s], at most `LONGEST_DELAY_S`; 0 if it is
        late, and at maximum speed. Without an anchor, the scan becomes the anchor, unless the speed is
        maximal."""
        if self.speed == 0.0:
            return 0.0
        if self._anchor is None:
            self.anchor(stamp_ns, now)
        return min(max(0.0, self._due(stamp_ns) - now), LONGEST_DELAY_S)

    def mapped(self, stamp_ns: int, now: float) -> None:
        """Record that the scan of `stamp_ns` was mapped at `now`."""
        self._mapped.append((stamp_ns, now))

    def behind(self, now: float) -> int:
        """Return the number of scans that are due at `now` and not mapped yet, estimated from the mean period
        of the last scans; 0 at maximum speed, without an anchor, or with fewer than two mapped scans."""
        if self.speed == 0.0 or self._anchor is None or len(self._mapped) < 2:
            return 0
        first, last = self._mapped[0][0], self._mapped[-1][0]
        period_ns = (last - first) / (len(self._mapped) - 1)
        late_ns = (now - self._due(last)) * self.speed * SECOND_NS
        return max(0, int(late_ns / period_ns)) if period_ns > 0 else 0

    @property
    def rate_hz(self) -> float:
        """Scans mapped per second of real time, over the last `RATE_SCANS` scans; 0 with fewer than two."""
        if len(self._mapped) < 2:
            return 0.0
        spent = self._mapped[-1][1] - self._mapped[0][1]
        return (len(self._mapped) - 1) / spent if spent > 0 else 0.0

    def _due(self, stamp_ns: int) -> float:
        """Return the time at which a scan is due [s]; RuntimeError without an anchor. The speed must not be
        0."""
        if self._anchor is None:
            raise RuntimeError("the replay clock has no anchor")
        anchor_ns, anchor_s = self._anchor
        return anchor_s + (stamp_ns - anchor_ns) / SECOND_NS / self.speed
