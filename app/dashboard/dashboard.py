"""The dashboard's state: the last results of the worker and the choices of the users.

Joins the worker, the parameters, the 3D scene and the browsers. Everything runs on the event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from app.common.timers import Throttle
from app.common.user import SOMEBODY, current_user
from app.dashboard.annotations import AnnotationEditor
from app.dashboard.broadcast import Broadcast
from app.dashboard.camera_view import CameraView
from app.dashboard.events import Events
from app.dashboard.parameters import ParameterSets, ParameterState
from app.dashboard.payload import BeforeAfter, Counts, counts_of, map_payload, truth_payload
from app.dashboard.run_recorder import RunRecorder, RunState
from app.dashboard.scores import Scores, score_map
from app.dashboard.selection import Selector
from app.explain.client import WorkerClient
from app.sources.request import SourceRequest
from app.store.async_store import AsyncStore
from app.tuning.job import TuneSearch
from app.tuning.sweep.sensitivity import Sensitivity, question_of
from app.worker.map_changes import MapChanges
from app.worker.outbox import joined
from app.worker.protocol import (
    Answer,
    Begin,
    FromWorker,
    Open,
    Opened,
    Play,
    Remapped,
    Report,
    Rough,
    Seek,
    SetParameters,
    Shown,
    Status,
    ToWorker,
    WorkerBusyError,
)
from pipeline.config import Parameters, preset
from pipeline.config.model import Value
from pipeline.types.records import Frame, Path, Trees, TruthTrees


class SceneLike(Protocol):
    """What the dashboard needs of `app.scene.Scene`."""

    @property
    def port(self) -> int: ...

    secret: str

    def show(self, frame: Frame, path: NDArray[np.float64], /) -> None: ...
    def show_parameters(self, parameters: Parameters, preset_name: str, /) -> None: ...
    def show_truth(self, trees: TruthTrees | None, /) -> None: ...
    def select(self, tree: int | None, ring: tuple[float, float, float] | None, /) -> None: ...
    def choose(self, name: str, value: str | bool, /) -> None: ...
    @property
    def view(self) -> dict[str, Any]: ...
    @property
    def counts(self) -> dict[str, int]: ...
    def clear(self) -> None: ...
    def close(self) -> None: ...


class WorkerLike(Protocol):
    """What the dashboard needs of `app.worker.supervisor.WorkerProcess`."""

    restarts: int

    @property
    def pid(self) -> int | None: ...

    async def start(self) -> None: ...
    async def send(self, command: ToWorker, /) -> None: ...
    async def close(self) -> None: ...


# A little less than a tenth of a second, so that a sensor of 10 Hz never waits for the next round.
_SCENE_PAUSE_S = 0.09


class Dashboard:
    """What is shown, and what can be done to it. `worker` and `scene` are set before `start`.

    Args:
        parameters: In force at the beginning.
        live: Where the browsers listen.
        keeper: Of the store; None keeps all in memory.
    """

    worker: WorkerLike
    scene: SceneLike

    def __init__(self, parameters: ParameterState, live: Broadcast, keeper: AsyncStore | None = None) -> None:
        self.parameters = parameters
        self.keeper = keeper or AsyncStore(None)
        self.logbook = RunRecorder(self.keeper)
        self.annotating = AnnotationEditor(self.keeper)
        self.annotating.changed, self.annotating.edited = self._use_truth, self._mark_edits
        self.live = live
        self.scores = Scores(self._tell_score)
        self.sensitivity = Sensitivity(lambda told: live.tell("sensitivity", told))
        self.status = Status(state="starting", detail="Starting")
        self.shown: Shown | None = None
        self.path: Path | None = None
        self.path_xy = np.zeros((0, 2))
        self.truth: TruthTrees | None = None
        self.sets = ParameterSets(self.keeper, self._show_parameters)
        self._before_after = BeforeAfter()
        self.asking = WorkerClient(lambda question: self.worker.send(question), lambda: self._run)
        self.camera = CameraView(self.asking)
        self.selecting = Selector(
            self.asking,
            live,
            lambda tree, ring: self.scene.select(tree, ring),
            run=lambda: self._run,
            newest=lambda: None if self.shown is None else self.shown.frame.index,
        )
        self.source = SourceRequest("")
        self.digest = ""  # of what is mapped, "" before it is open
        self.events = Events()
        self.search = TuneSearch(lambda told: live.tell("search", told))
        self.loop = LoopPlayback(live, self._send_if_ready)
        self._run: int | None = None
        self._notice = ""
        self._restarts = 0
        self._opens = 0
        self._opening = asyncio.Lock()
        self._go = False
        self._show_scene = Throttle(lambda f, xy: self.scene.show(f, xy), pause_s=_SCENE_PAUSE_S)

    @property
    def start_ns(self) -> int:
        """Time of the run's first scan, 0 before one is shown."""
        return 0 if self.shown is None else self.shown.frame.stamp_ns - round(self.shown.time_s * 1e9)

    async def start(self, source: SourceRequest) -> None:
        """Start the worker with a source; it plays as soon as it is open."""
        await self.sets.load()
        self.live.tell("view", self.scene.view)
        await self.worker.start()
        await self._send_parameters()
        await self.open(source)

    async def close(self) -> None:
        """End the worker and the scene."""
        self.scores.close()
        await self.sensitivity.leave()
        self.selecting.leave()
        self._show_scene.cancel()
        await self.search.leave()
        await self.logbook.close()
        await self.worker.close()
        await self.keeper.close()
        await asyncio.to_thread(self.scene.close)

    # --- what people do --------------------------------------------------------------------------

    async def command(self, command: ToWorker) -> None:
        """Hand a command to the worker."""
        self._notice = ""
        # A worker that is down comes back with the source closed; then this is still to be done.
        self._go = isinstance(command, Play | Open) and self.worker.pid is None
        await self.worker.send(command)

    async def _send_if_ready(self, command: ToWorker) -> None:
        """Send a command that has no meaning while the worker restarts."""
        with contextlib.suppress(WorkerBusyError):
            await self.worker.send(command)

    async def choose_view(self, name: str, value: str | bool) -> None:
        """Show or hide a layer of the scene, or colour, label or follow otherwise.

        Raises:
            ParameterError: There is no such choice.
        """
        self.scene.choose(name, value)
        self.live.tell("view", self.scene.view)

    @property
    def request(self) -> SourceRequest:
        """How the open run is mapped now: its source and the parameters in force."""
        state = self.parameters
        changed = state.parameters.changes_from(preset(state.preset))
        return msgspec.structs.replace(self.source, preset=state.preset, parameters=changed)

    async def open(self, request: SourceRequest) -> None:
        """Leave the run and open another source, with the parameters of the request if it has any.

        Raises:
            ParameterError: The parameters are not those of this version; nothing is changed.
        """
        if request.preset or request.parameters:
            self.parameters.take(request.preset, request.parameters)
            self._show_parameters()  # the worker receives them when the source is open
        command = msgspec.structs.replace(_open_command(request), preset="", parameters={})
        source = command.request()
        self._opens += 1
        number = self._opens
        async with self._opening:
            if number == self._opens:  # else another source was asked for meanwhile
                await self._leave_for(source)
                await self.command(command)

    async def _leave_for(self, source: SourceRequest) -> None:
        """Leave the run; from now on this source is the one that is expected to open."""
        self._set_status(Status(state="starting", detail=f"Opening {source.uri}", source=source.uri))
        self._run, self.source, self.digest = None, source, ""
        self.live.tell("source", source.for_page())
        self.camera.forget()
        self.logbook.leave()
        self.annotating.leave()
        await self.sensitivity.leave()
        await self.search.leave()
        await self._forget()

    async def change_parameters(self, changes: dict[str, Value], gesture: str = "") -> None:
        """Change values by their dotted names, as part of a gesture (see `ParameterState.change`).

        Raises:
            ParameterError: A value does not fit; nothing is changed.
        """
        await self.tune(lambda state: state.change(changes, gesture))

    async def use_preset(self, name: str) -> None:
        """Take all values of a preset.

        Raises:
            ParameterError: There is none of this name.
        """
        await self.tune(lambda state: state.use_preset(name))

    async def reset_parameters(self, names: list[str]) -> None:
        """Give parameters (none named: all) the preset's values again.

        Raises:
            ParameterError: A name is unknown.
        """
        await self.tune(lambda state: state.reset(names))

    async def tune(self, change: Callable[[ParameterState], None]) -> None:
        """Let parameters be changed, and tell everybody.

        Raises:
            StemmapError: The change is refused; nothing is changed.
        """
        before, step = self.parameters.parameters, self.parameters.step
        change(self.parameters)
        if self.parameters.step != step:
            self._before_after.step()
        await self._send_parameters()  # first: the scan is mapped again while the browsers are updated
        self._show_parameters()
        if self.shown is not None:
            self.events.changed(before.flat(), self.parameters.parameters.flat(), self.shown.time_s)
            self._tell_events()
        state = self.parameters
        who = current_user.get() or SOMEBODY
        self.logbook.changed(before.flat(), state.parameters.flat(), state.preset, state.revision, who)
        self._score()

    async def reach(self, *, whole: bool) -> None:
        """Let changes of parameters act on the whole run, which is mapped again at once, or from the standing
        scan on."""
        self.parameters.whole = whole
        self._show_parameters()
        await self._send_parameters()

    def how_much_matters(self, name: str, values: list[Value]) -> None:
        """Have the whole run scored over values of a parameter.

        Raises:
            StemmapError: It cannot be, and why.
        """
        state = self.parameters.parameters
        self.sensitivity.ask(
            question_of(self.source, self.digest, self.status, self.truth, state, name, values)
        )

    async def select_tree(self, number: int | None) -> None:
        """Select a tree everywhere; None selects nothing."""
        self.selecting.tree(number)

    async def select_cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster of a recently shown scan everywhere, with its tree.

        Raises:
            NoStoryError: It is not known any more.
        """
        await self.selecting.cluster(scan, cluster)

    def _show_parameters(self) -> None:
        state = self.parameters
        name = self.sets.name_of(state.preset, state.parameters)
        self.live.tell("sets", self.sets.as_plain())
        self.live.tell("parameters", {**state.as_plain(), "set": name})
        self.scene.show_parameters(state.parameters, state.preset)

    def _tell_events(self) -> None:
        self.live.tell("events", self.events.as_plain())

    async def _send_parameters(self) -> None:
        state = self.parameters
        values = state.parameters.model_dump()
        await self.worker.send(SetParameters(values, state.revision, state.whole, state.step))

    # --- what the worker says --------------------------------------------------------------------

    async def receive(self, message: FromWorker) -> None:
        """Take a message of the worker."""
        match message:
            case Report(status=status):
                self._set_status(status)
            case Opened() if message.asked in ("", self.source.uri):  # else it was left before it was open
                await self._begin(message)
            case Shown():
                await self._show(message)
            case Answer():
                self.asking.take(message)
            case Remapped(run=run, changes=changes) if run == self._run:
                self._remapped(changes)
            case Rough(run=run, revision=revision, trees=trees) if run == self._run:
                await self._tell_rough(run, revision, trees)

    async def _tell_rough(self, run: int, revision: int, trees: Trees) -> None:
        """The run is being mapped again: what will come of it, roughly, with its score."""
        score = None
        if self.truth is not None:
            evaluation = self.parameters.parameters.evaluation
            score = await asyncio.to_thread(score_map, trees, self.truth, evaluation, self.path_xy)
            if run != self._run:  # another one was opened meanwhile
                return
        places = np.round(trees.position, 3).tolist()
        self.live.tell("rough", {"revision": revision, "places": places, "score": score})

    def _remapped(self, changes: MapChanges) -> None:
        """The run was mapped again: the map has other trees, and other numbers."""
        self.live.tell("remapped", msgspec.to_builtins(changes))
        self.events.remapped(changes.confirmed, changes.time_s)
        self._tell_events()
        self.selecting.renamed(dict(changes.followed))

    async def _begin(self, opened: Opened) -> None:
        """A source is open and waits: parameters that suit it first, then it plays."""
        self._run, self.digest = opened.run, opened.digest or opened.uri
        number = self._opens
        await self.annotating.begin(opened.digest or opened.uri, opened.uri, opened.truth)
        if number != self._opens:  # another source was asked for meanwhile
            return
        await self._forget()
        if self.parameters.suit(opened.preset):
            self._show_parameters()
        restarted, self._restarts = self.worker.restarts != self._restarts, self.worker.restarts
        self.logbook.begin(self.annotating.run, self.source, opened, again=restarted)
        play = self._go or not restarted
        if not play:
            self._notice = "The mapping process ended and was started again. Press play to start again"
        self._go = False
        state = self.parameters
        # Always with the parameters: those sent for a run that was left since did not reach the worker.
        await self.worker.send(Begin(opened.run, state.parameters.model_dump(), state.revision, play))

    async def _forget(self) -> None:
        """Show an empty map, with the truth of the run that comes."""
        self.shown = self.path = None
        self.path_xy = np.zeros((0, 2))
        self.live.forget_map()
        self.scores.forget()
        self._before_after.forget()
        self.events.forget()
        self._tell_events()
        self.loop.choose(None)
        self.live.tell("remapped", {})
        self.live.tell("rough", {})
        self._show_scene.cancel()
        self.scene.clear()
        self._use_truth()
        self.selecting.tree(None)

    def _use_truth(self) -> None:
        """Show the truth, score against it, and tell what was annotated."""
        self.truth = self.annotating.truth
        self.scene.show_truth(self.truth)
        self.live.tell("truth", truth_payload(self.truth))
        self.live.tell("annotations", self.annotating.as_plain())
        if self.truth is None:
            self.scores.forget()
        self._score()

    def _mark_edits(self, who: str, number: int) -> None:
        if self.shown is not None:
            self.events.annotated(who, number, self.shown.time_s)
            self._tell_events()

    async def _show(self, shown: Shown) -> None:
        if shown.run != self._run:  # of a run that was left
            return
        number = self._opens
        self.path = joined(self.path, shown.path_start, shown.path)
        if shown.frame.ground is None and self.shown is not None:
            # The ground is sent only when it changes; the scene may not have drawn the earlier frame.
            frame = replace(shown.frame, ground=self.shown.frame.ground)
            shown = msgspec.structs.replace(shown, frame=frame)
        self.shown = shown
        self.path_xy = np.column_stack([self.path.x, self.path.y])
        path_xy = self.path_xy
        distance = self.parameters.parameters.evaluation.match_distance
        payload, counted = await asyncio.to_thread(_map_and_counts, shown, self.truth, distance)
        if number != self._opens:  # another source was asked for meanwhile
            return
        counts = self._before_after.shown(counted)
        payload["layers"] |= self.scene.counts
        self.live.show({**payload, **counts}, path_xy)
        if self.events.shown(shown.frame, shown.time_s, shown.confirmed_s):
            self._tell_events()
        self.logbook.shown(self._glance(shown))
        self._score()
        self._show_scene(shown.frame, self.path_xy)
        await self.loop.shown(shown.time_s, self.status)

    def _glance(self, shown: Shown) -> RunState:
        state = self.parameters
        return RunState(
            shown, self.path_xy, state.preset, state.parameters.flat(), self.truth, self.scores.latest
        )

    def _tell_score(self, score: dict[str, Any] | None) -> None:
        self.live.tell("evaluation", score)
        self.logbook.scored(score)

    def _score(self) -> None:
        if self.shown is not None and self.truth is not None:
            evaluation = self.parameters.parameters.evaluation
            self.scores.ask(self.shown.frame.trees, self.truth, evaluation, self.path_xy)

    def _set_status(self, status: Status) -> None:
        if self._notice and status.state == "paused":
            status = replace(status, detail=self._notice)
        self.status = status
        self.live.tell("status", status)
        if status.scan_index >= 0 and self.events.warned(status.warnings, status.time_s):
            self._tell_events()


def _map_and_counts(
    shown: Shown, truth: TruthTrees | None, match_distance: float
) -> tuple[dict[str, Any], Counts]:
    """The message "map" without its path, and the verdict counts of the scan."""
    return map_payload(shown), counts_of(shown.frame, truth, match_distance)


def _open_command(request: SourceRequest) -> Open:
    """The command that opens a source; only the command line can ask for a recording or publishing."""
    if isinstance(request, Open):
        return request
    return Open(**{name: getattr(request, name) for name in SourceRequest.__struct_fields__})


Span = tuple[float, float]


class LoopPlayback:
    """From where to where, and when to turn.

    Args:
        live: Where the browsers are told.
        send: Sends a command to the worker.

    Attributes:
        span: First and last time [s since the first scan], None for no loop.
    """

    def __init__(self, live: Broadcast, send: Callable[[ToWorker], Awaitable[None]]) -> None:
        self.span: Span | None = None
        self._live, self._send = live, send
        self._turning = False

    def choose(self, span: Span | None) -> None:
        """Play this part; None plays on at its end."""
        self.span, self._turning = span, False
        self._live.tell("loop", None if span is None else {"from_s": span[0], "to_s": span[1]})

    async def shown(self, time_s: float, status: Status) -> None:
        """At the end of the part go to its beginning, while the run plays."""
        if self.span is None:
            return
        if time_s < self.span[1]:
            self._turning = False
        elif not self._turning and status.state in ("playing", "finished"):
            self._turning = True  # pictures that are under way must not turn it once more
            await self._send(Seek(self.span[0]))
            if status.state == "finished":
                await self._send(Play())
