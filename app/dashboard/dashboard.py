"""State of the dashboard: the newest results of the worker and the choices of the users.

It connects the worker, the parameters, the 3D scene and the browsers. All of it runs on the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from app.common.timers import Throttle, ended
from app.common.user import SOMEBODY, current_user
from app.dashboard.annotations import AnnotationEditor
from app.dashboard.broadcast import Broadcast
from app.dashboard.camera_view import CameraView
from app.dashboard.events import Events
from app.dashboard.parameters import ParameterSets, ParameterState
from app.dashboard.payload import counts_before, counts_of, map_payload, truth_payload
from app.dashboard.run_recorder import ReviewedRuns, RunRecorder
from app.dashboard.scores import Scores
from app.dashboard.selection import Selector, WorkerClient
from app.dashboard.shown_run import ShownRun
from app.sources.opening import check_source
from app.sources.request import SourceRequest
from app.store.async_store import AsyncStore
from app.worker import protocol
from pipeline.config import preset
from pipeline.config.model import Value
from pipeline.geometry.columns import GrowingColumns, columns_of
from pipeline.repairs.record import Repair
from pipeline.seen_area import SeenRecorder
from pipeline.types.records import Float, Path, TruthTrees

if TYPE_CHECKING:
    from app.scene import Scene
    from app.worker.supervisor import WorkerProcess

# A little less than a tenth of a second, so that a sensor of 10 Hz never waits for the next round.
_SCENE_PAUSE_S = 0.09


class Dashboard:
    """State of the open run for the browsers, and the actions of users.

    `worker` is set before `start`, which sets `scene`.

    Args:
        parameters: Parameters at the beginning.
        live: Broadcast to the browsers.
        store: Access to the store; None keeps everything in memory.

    Attributes:
        status: Newest status of the worker.
        recordings: Files to which live runs were recorded so far.
        shown, path, path_xy: Newest results and path; None and shape (0, 2) before the first scan.
        seen: Views of the observed area.
        leaving: Coroutine functions that are called when the run is left, and at the end.
        run: Number of the open run at the worker; None before it is open.
        source, digest: Requested source, and digest (or URI) of the open run, "" before it is open.
    """

    worker: WorkerProcess
    scene: Scene

    def __init__(self, parameters: ParameterState, live: Broadcast, store: AsyncStore | None = None) -> None:
        self.parameters = parameters
        self.store = store or AsyncStore(None)
        self.leaving: list[Callable[[], Awaitable[None]]] = []
        self.run_recorder, self.reviewed_runs = RunRecorder(self.store), ReviewedRuns(self.store)
        self.annotation_editor = AnnotationEditor(self.store)
        self.annotation_editor.changed, self.annotation_editor.edited = self._use_edits, self._mark_edits
        self._repairs_sent: tuple[Repair, ...] = ()
        self._sending = asyncio.Lock()
        self.live = live
        self.scores = Scores(self._broadcast_score)
        self.status = protocol.Status(state="starting", detail="Starting")
        self.shown: protocol.Shown | None = None
        self.path: Path | None = None
        self.path_xy = np.zeros((0, 2))
        self._path_rows = _no_path()
        self._broadcast_map: tuple[dict[str, Any], Float] | None = None
        self._map_before: dict[str, Any] | None = None  # the last change of parameters
        self.seen = SeenRecorder()
        self.sets = ParameterSets(self.store, self._show_parameters)
        self.worker_client = WorkerClient(lambda question: self.worker.send(question), lambda: self.run)
        self.camera = CameraView(self.worker_client)
        self.selector = Selector(self)
        self.source = SourceRequest("")
        self.recordings: list[FilePath] = []
        self.digest = ""  # of what is mapped, "" before it is open
        self.events = Events()
        self.loop = LoopPlayback(self)
        self.run: int | None = None
        self._notice = ""
        self._restarts = 0
        self._opens = self._requests = 0
        self.check_source = check_source
        self._opening = asyncio.Lock()
        self.exporting = asyncio.Lock()  # during an export, so that exports never take all places of `ask`
        self.layers: dict[str, tuple[str, bytes]] = {}  # digest and bytes of the newest ones
        self._go = False
        self._show_scene = Throttle(lambda *shown: self.scene.show(*shown), pause_s=_SCENE_PAUSE_S)

    @property
    def truth(self) -> TruthTrees | None:
        """Ground truth with annotations; None where none is known."""
        return self.annotation_editor.truth

    @property
    def start_ns(self) -> int:
        """Time of the first scan of the run [ns]; 0 before a scan is shown."""
        return 0 if self.shown is None else self.shown.frame.stamp_ns - round(self.shown.time_s * 1e9)

    @property
    def offset(self) -> tuple[float, float]:
        """Offset x, y of the frame of the map in the coordinates of the file of a run of one step; (0, 0) for
        a run of scans [m]."""
        one_step = self.status.one_step
        return (0.0, 0.0) if one_step is None else one_step.offset[:2]

    async def start(self, source: protocol.Open, make_scene: Callable[[], Scene]) -> None:
        """Start the worker, which opens a source while the scene is made, and load the saved parameter sets.
        The source plays as soon as both are there. Exceptions of `make_scene` pass through.

        Args:
            source: The source, without parameters of its own.
            make_scene: Returns the scene; called in a thread.
        """
        scene = asyncio.create_task(asyncio.to_thread(make_scene))
        await self._send_parameters()
        await self.worker.send(source)
        self.scene = await scene
        await self.sets.load()
        self.live.publish("view", self.scene.view)
        self._opens += 1
        await self._leave_for(source)
        await self.worker.start(self.receive)

    async def close(self) -> None:
        """Write pending records, and end the worker, the store and the scene."""
        self.scores.close()
        self.selector.leave()
        await ended(self.leaving)
        await self.run_recorder.close()
        await self.worker.close()
        self._show_scene.cancel()  # the worker sends no scan any more
        await self.store.close()
        await asyncio.to_thread(self.scene.close)

    # --- actions of users ------------------------------------------------------------------------

    async def command(self, command: protocol.ToWorker) -> None:
        """Send a command to the worker and clear the notice. Play and Open are repeated if the worker is
        being restarted.

        Raises:
            WorkerBusyError: The worker cannot receive it now, and it is a step or a seek. Pause is dropped
            without an error then.
        """
        self._notice = ""
        # A worker that is down comes back with the source closed; then this is still to be done.
        self._go = isinstance(command, protocol.Play | protocol.Open) and self.worker.pid is None
        await self.worker.send(command)

    async def choose_view(self, name: str, value: str | bool) -> None:
        """Set a choice of the 3D scene for all browsers.

        Args:
            name: Name of a layer, "follow", or a name in colours.CHOICES.
            value: Visibility or following as bool; for CHOICES one of their values.

        Raises:
            ParameterError: There is no such choice, or the value is not one of it.
        """
        self.scene.choose(name, value)
        self.live.publish("view", self.scene.view)

    @property
    def request(self) -> SourceRequest:
        """Request that maps the open run in the same way: its source, with preset and parameters in force."""
        state = self.parameters
        changed = state.parameters.changes_from(preset(state.preset))
        return msgspec.structs.replace(self.source, preset=state.preset, parameters=changed)

    async def open(self, request: SourceRequest) -> None:
        """Close the run and open another source, with the parameters of the request if it has any. It returns
        when the command is sent; `receive` learns whether the source could be opened.

        While a run is open, the source is checked before that run is closed. Of several requests, only the
        newest is opened; the calls of the others return without an error.

        Raises:
            StemmapError: The source cannot be opened, or the parameters are not valid in this version; the
                open run is kept.
        """
        self._requests += 1
        asked = self._requests
        if self.run is not None:
            await self.check_source(request)
            if asked != self._requests:
                return
        if request.preset or request.parameters:
            self.parameters.take(request.preset, request.parameters)
            self._show_parameters()  # the worker receives them when the source is open
        command = msgspec.structs.replace(_open_command(request), preset="", parameters={})
        self._opens += 1
        number = self._opens
        async with self._opening:
            if number == self._opens:  # else another source was requested meanwhile
                await self._leave_for(command)
                await self.command(command)

    async def _leave_for(self, command: protocol.Open) -> None:
        """Close the run: end its record and what works on it, and remove it from the page. From now on, the
        source of `command` is expected to open. The worker gets no command."""
        source = command.request()
        self._set_status(protocol.Status(state="starting", detail=f"Opening {source.uri}", source=source.uri))
        self.run, self.source, self.digest = None, source, ""
        self.live.publish("source", source.for_page())
        self.camera.forget()
        self.run_recorder.leave()
        self.annotation_editor.leave()
        await ended(self.leaving)
        await self._forget()

    async def change_parameters(self, changes: dict[str, Value], gesture: str = "") -> None:
        """Change values by dotted name, as part of a gesture (see `ParameterState.change`).

        Raises:
            StemmapError: A value is not valid; nothing changes.
        """
        await self.tune(lambda state: state.change(changes, gesture))

    async def use_preset(self, name: str) -> None:
        """Set all parameters to the values of a preset, as one undo step.

        Raises:
            StemmapError: There is no preset of this name (ParameterError), or its forest does not exist or
                cannot be read; nothing changes.
        """
        await self.tune(lambda state: state.use_preset(name))

    async def reset_parameters(self, names: list[str]) -> None:
        """Reset the named parameters, or all if the list is empty, to the values of the preset.

        Raises:
            StemmapError: A name is unknown (ParameterError), or the values are refused, see
                `ParameterState.reset`; nothing changes.
        """
        await self.tune(lambda state: state.reset(names))

    async def tune(self, change: Callable[[ParameterState], None]) -> None:
        """Change parameters, and send them to the worker, the scene, the browsers and the store. The map is
        scored again.

        Args:
            change: Called with the parameter state, which it changes.

        Raises:
            StemmapError: The change is refused; nothing changes.
        """
        before, step = self.parameters.parameters, self.parameters.step
        change(self.parameters)
        if self.parameters.step != step:
            self._map_before = self._broadcast_map and self._broadcast_map[0]
        await self._send_parameters()  # first: the scan is mapped again while the browsers are updated
        self._show_parameters()
        if self.shown is not None:
            self.events.changed(before.flat(), self.parameters.parameters.flat(), self.shown.time_s)
            self._broadcast_events()
        state = self.parameters
        who = current_user.get() or SOMEBODY
        self.run_recorder.changed(before.flat(), state.parameters.flat(), state.preset, state.revision, who)
        self._score()

    async def reach(self, *, whole: bool) -> None:
        """Choose whether changes of parameters apply to the whole run, which is then mapped again at once, or
        from the current scan onwards; for all browsers. It is no change that can be undone."""
        self.parameters.whole = whole
        self._show_parameters()
        await self._send_parameters()

    async def select_tree(self, number: int | None) -> None:
        """Select a tree in all views by its number; None clears the selection."""
        self.selector.tree(number)

    async def select_cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster of a recently shown scan, with its tree, in all views; nothing if another run was
        opened meanwhile.

        Args:
            scan: Index of the scan.
            cluster: Row of the cluster in it.

        Raises:
            NoStoryError: The scan is not stored any more, or has no such cluster.
            WorkerBusyError: The worker did not answer in time.
        """
        await self.selector.cluster(scan, cluster)

    def _show_parameters(self) -> None:
        """Broadcast parameters and saved sets, and set the widgets of the scene."""
        state = self.parameters
        name = self.sets.name_of(state.preset, state.parameters)
        self.live.publish("sets", self.sets.as_plain())
        self.live.publish("parameters", {**state.as_plain(), "set": name})
        self.scene.show_parameters(state.parameters, state.preset)

    def _broadcast_events(self) -> None:
        """Broadcast the events of the run, and record those of a live run."""
        log = {**self.events.as_plain(), "start_s": self.start_ns / 1e9}
        self.live.publish("events", log)
        if self.status.live:
            self.run_recorder.logged(log)

    async def _send_parameters(self) -> None:
        """Send the parameters in force to the worker."""
        state = self.parameters
        values = state.parameters.model_dump()
        await self.worker.send(protocol.SetParameters(values, state.revision, state.whole, state.step))

    # --- messages of the worker ------------------------------------------------------------------

    async def receive(self, message: protocol.FromWorker) -> None:
        """Process a message of the worker: update the state and broadcast it. Messages of a run that has been
        left are ignored, except `Report` and `Answer`."""
        match message:
            case protocol.Report(status=status):
                self._set_status(status)
            case protocol.Opened() if message.requested in (
                "",
                self.source.uri,
            ):  # else it was left before it was open
                await self._begin(message)
            case protocol.Shown():
                await self._show(message)
            case protocol.Unmapped(run=run, frame=frame) if run == self.run and self.shown is None:
                self._show_scene(frame, np.zeros((0, 4)))
            case protocol.View(run=run, stamp_ns=stamp_ns, view=view) if run == self.run:
                self.seen.add(stamp_ns, view)
            case protocol.Answer():
                self.worker_client.take(message)
            case protocol.Remapped(run=run, changes=changes) if run == self.run:
                self._remapped(changes)
            case protocol.Rough(run=run, revision=revision, trees=trees) if run == self.run:
                # A preview is only roughly right, so it has no score.
                self.live.publish(
                    "rough", {"revision": revision, "places": np.round(trees.position, 3).tolist()}
                )

    def _remapped(self, changes: protocol.MapChanges) -> None:
        """Broadcast the differences after the run was mapped again, replace the events of trees and pose
        quality, clear the selection of a tree that vanished, and discard the observed area of the old map;
        the views of the new map follow."""
        self.seen = SeenRecorder()
        self.live.publish("remapped", msgspec.to_builtins(changes))
        self.events.remapped(changes.confirmed, changes.time_s, live=self.status.live)
        self._broadcast_events()
        self.selector.remove({change.number for change in changes.changes if change.kind == "vanished"})

    async def _begin(self, opened: protocol.Opened) -> None:
        """Load the annotations of an opened source, begin its record, use the preset that suits it, and send
        the worker the parameters; then it plays, except after a restart of the worker, unless `Play` or
        `Open` was requested meanwhile. Nothing is sent if another source was requested."""
        self.run, self.digest = opened.run, opened.digest or opened.uri
        number = self._opens
        await self.annotation_editor.begin(opened.digest or opened.uri, opened.uri, opened.truth)
        if number != self._opens:  # another source was requested meanwhile
            return
        await self._forget()
        if self.parameters.suit(opened.preset, self.digest):
            self._show_parameters()
        restarted, self._restarts = self.worker.restarts != self._restarts, self.worker.restarts
        self.run_recorder.begin(self.annotation_editor.run, self.source, opened, again=restarted)
        play = self._go or not restarted
        if not play:
            self._notice = "The mapping process ended and was started again. Press play to start again"
        self._go = False
        state, self._repairs_sent = self.parameters, ()
        # A worker that does not read in time must not keep the run from its beginning.
        with contextlib.suppress(protocol.WorkerBusyError):
            await self._send_repairs()
        # Always with the parameters: those sent for a run that was left since did not reach the worker.
        await self.worker.send(
            protocol.Begin(opened.run, state.parameters.model_dump(), state.revision, play)
        )

    async def _forget(self) -> None:
        """Remove map, path, observed area, selection, scores, events and the repetition of a part, and show
        the ground truth of the run that begins."""
        self.shown = self.path = self._broadcast_map = self._map_before = None
        self.seen = SeenRecorder()
        self.path_xy = np.zeros((0, 2))
        self._path_rows = _no_path()
        self.live.forget_map()
        self.scores.forget()
        self.events.forget()
        self._broadcast_events()
        self.loop.choose(None)
        self.live.publish("remapped", {})
        self.live.publish("rough", {})
        self._show_scene.cancel()
        self.scene.clear()
        self._use_truth()
        self.selector.tree(None)

    def _use_edits(self) -> None:
        """Use the annotations as ground truth, see `_use_truth`, and send the worker the repairs if they
        changed."""
        self._use_truth()
        if self.annotation_editor.repairs != self._repairs_sent:
            self._repairing = asyncio.create_task(self._send_repairs())

    async def _send_repairs(self) -> None:
        """Send the worker the repairs of the map, unless it has them; nothing before the run is open."""
        async with self._sending:
            repairs, run = self.annotation_editor.repairs, self.run
            if run is None or repairs == self._repairs_sent:
                return
            await self.worker.send(protocol.SetRepairs(run, repairs))
            if run == self.run:  # else another run was opened meanwhile
                self._repairs_sent = repairs

    def _use_truth(self) -> None:
        """Show the ground truth with the annotations in scene and browsers, and request the score of the map
        against it; without ground truth the score is removed."""
        self.scene.show_truth(self.truth)
        self.live.publish("truth", truth_payload(self.truth, self.annotation_editor.in_truth))
        self.live.publish("annotations", self.annotation_editor.as_plain())
        if self.truth is None:
            self.scores.forget()
        index = -1 if self.shown is None else self.shown.frame.index
        if self.shown and self._broadcast_map and self._broadcast_map[0]["index"] == index:
            distance = self.parameters.parameters.evaluation.match_distance
            payload, path_rows = self._broadcast_map
            self._show_map(payload | counts_of(self.shown.frame, self.truth, distance), path_rows)
        self._score()

    def _show_map(self, payload: dict[str, Any], path_rows: Float) -> None:
        """Broadcast a map with `before`, the counts of this scan before the last change of parameters; None
        if there was no change, or another scan was shown since then.

        Args:
            payload: Result of `map_payload`.
            path_rows: Positions x, y of path and odometry, shape (N, 4) [m].
        """
        self._broadcast_map, before = (payload, path_rows), counts_before(self._map_before, payload)
        if before is None:
            self._map_before = None
        self.live.show({**payload, "before": before}, path_rows)

    def _mark_edits(self, who: str, number: int) -> None:
        """Add an event for edits of annotations and broadcast it; nothing before the first scan.

        Args:
            who: Author of the last edit.
            number: Number of annotations that differ.
        """
        if self.shown is not None:
            self.events.annotated(who, number, self.shown.time_s)
            self._broadcast_events()

    async def _show(self, shown: protocol.Shown) -> None:
        """Take over the results of a scan: extend the path, broadcast map and events, record, score and draw
        it. A frame without ground has that of the frame before. Results of a run that was left are
        ignored."""
        if shown.run != self.run:  # of a run that was left
            return
        number = self._opens
        if self.shown is None:
            self.scene.suit(drive=shown.frame.of_drive)
            self.live.publish("view", self.scene.view)
        odometry = np.full((len(shown.path.x), 2), np.nan)
        odometry[: len(shown.odometry_xy)] = shown.odometry_xy
        new_rows = np.column_stack([shown.path.x, shown.path.y, odometry])
        self._path_rows.write(shown.path_start, *columns_of(shown.path), new_rows)
        *columns, path_rows = self._path_rows.shared()
        self.path, self.path_xy = Path(*columns), path_rows[:, :2]
        if shown.frame.ground is None and self.shown is not None:
            # The ground is sent only when it changes; the scene may not have drawn the earlier frame.
            frame = replace(shown.frame, ground=self.shown.frame.ground)
            shown = msgspec.structs.replace(shown, frame=frame)
        self.shown = shown
        await self.annotation_editor.follow(shown.repairs, shown.frame.trees)
        if number != self._opens:
            return
        payload = await asyncio.to_thread(map_payload, shown, self.truth, self.parameters.parameters)
        if number != self._opens:  # another source was requested meanwhile
            return
        payload["layers"] |= self.scene.counts
        self._show_map(payload, path_rows)
        stamp_ns = None if self.status.live else self.path.stamp_ns
        if self.events.shown(shown.frame, shown.time_s, shown.confirmed_s, stamp_ns, self.start_ns):
            self._broadcast_events()
        self.run_recorder.shown(ShownRun.of(self), self.scores.latest)
        self._score()
        self._show_scene(shown.frame, path_rows, shown.reflectance)
        await self.loop.shown(shown.time_s, self.status)

    def _broadcast_score(self, score: dict[str, Any] | None) -> None:
        """Broadcast a score (None if there is no map) and record it."""
        self.live.publish("evaluation", score)
        self.run_recorder.scored(score)

    def _score(self) -> None:
        """Request the score of the shown map; nothing without a map or ground truth."""
        if self.shown is not None and self.path is not None and self.truth is not None:
            self.scores.ask(self.shown.frame.trees, self.path, self.truth, self.parameters.parameters)

    def _set_status(self, status: protocol.Status) -> None:
        """Broadcast a status of the worker, and add events for new warnings, a silence and the recording.
        While paused, a notice replaces its detail."""
        if self._notice and status.state == "paused":
            status = replace(status, detail=self._notice)
        has_ended = status.live and status.state == "finished" != self.status.state
        self.status = status
        if has_ended:
            self.run_recorder.finished()
        if status.recorded_file:
            file = FilePath(status.recorded_file).absolute()
            if file not in self.recordings:
                self.recordings.append(file)
            self.run_recorder.recorded(str(file))
        self.live.publish("status", status)
        if status.scan_index < 0:
            return
        is_new = self.events.warned(status.warnings, status.time_s)
        if status.live:
            is_new |= self._note_gaps(status)
        is_new |= self.events.recorded(status.recording, status.recorded_file, status.time_s)
        if is_new:
            self._broadcast_events()

    def _note_gaps(self, status: protocol.Status) -> bool:
        """Add events for a silence and a pause of a live run; return whether there are any."""
        is_paused = status.state == "paused"
        is_new = self.events.paused(is_paused, status.time_s)
        if status.state == "waiting" or (is_paused and status.health.startswith("no data")):
            is_new |= self.events.silent(status.detail, status.time_s, status.silence_s or 0.0)
        elif is_paused:
            is_new |= self.events.heard(status.time_s)
        return is_new


def _no_path() -> GrowingColumns:
    """Return the columns of a path without scans; the last column has the positions of path and odometry,
    shape (0, 4)."""
    none = np.zeros(0)
    return GrowingColumns(np.zeros(0, np.int64), none, none, none, none, np.zeros((0, 4)))


def _open_command(request: SourceRequest) -> protocol.Open:
    """Return the command that opens a source: the request itself if it is one."""
    if isinstance(request, protocol.Open):
        return request
    return protocol.Open(**{name: getattr(request, name) for name in SourceRequest.__struct_fields__})


Span = tuple[float, float]


class LoopPlayback:
    """Repeats a part of the run.

    Args:
        dashboard: State of the run, with its worker.

    Attributes:
        span: First and last time of the part [s since the first scan]; None if there is no repetition.
    """

    def __init__(self, dashboard: Dashboard) -> None:
        self.span: Span | None = None
        self._dashboard = dashboard
        self._turning = False

    def choose(self, span: Span | None) -> None:
        """Set the part that is repeated and broadcast it; None ends the repetition. The run does not seek."""
        self.span, self._turning = span, False
        self._dashboard.live.publish("loop", None if span is None else {"from_s": span[0], "to_s": span[1]})

    async def shown(self, time_s: float, status: protocol.Status) -> None:
        """Seek to the beginning of the part, once for each time that its end is reached or passed, if the run
        plays or is finished; a finished run plays again. Nothing without a part, and while the worker is
        being restarted.

        Args:
            time_s: Time of the shown scan [s since the first scan].
            status: Status of the run.
        """
        if self.span is None:
            return
        if time_s < self.span[1]:
            self._turning = False
        elif not self._turning and status.state in ("playing", "finished"):
            self._turning = True  # frames that were sent before the seek must not cause a second one
            with contextlib.suppress(protocol.WorkerBusyError):  # the worker is being restarted
                await self._dashboard.worker.send(protocol.Seek(self.span[0]))
                if status.state == "finished":
                    await self._dashboard.worker.send(protocol.Play())
