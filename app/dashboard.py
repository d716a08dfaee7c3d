"""The dashboard's state: what the worker said last, and what people asked for.

Joins the worker, the parameters, the 3D scene and the browsers. Everything runs on the event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from app.annotating import Annotating
from app.events import Events
from app.hands import SOMEBODY, hand
from app.keeper import Keeper
from app.live import Live
from app.live_payload import map_payload, truth_payload
from app.logbook import Glance, Logbook
from app.messages import Open, Play, Seek, SetParameters, Status
from app.neighbours import SceneLike, WorkerLike
from app.parameter_sets import ParameterSets
from app.parameter_state import ParameterState
from app.scores import Scores
from app.selection import Selection
from app.standing_scan import BeforeAfter, counts_of
from app.story.asking import Asking
from app.story.questions import NoStoryError
from app.story.records import ClusterStory
from app.throttle import Throttle
from app.worker_mailbox import joined
from app.worker_messages import Answer, Begin, FromWorker, Opened, Report, Shown, ToWorker
from pipeline.parameters.model import Value
from pipeline.records import Path, TruthTrees

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

    def __init__(self, parameters: ParameterState, live: Live, keeper: Keeper | None = None) -> None:
        self.parameters = parameters
        self.keeper = keeper or Keeper(None)
        self.logbook = Logbook(self.keeper)
        self.annotating = Annotating(self.keeper)
        self.annotating.changed, self.annotating.edited = self._use_truth, self._mark_edits
        self.live = live
        self.scores = Scores(self._tell_score)
        self.status = Status(state="starting", detail="Starting")
        self.shown: Shown | None = None
        self.path: Path | None = None
        self.path_xy = np.zeros((0, 2))
        self.truth: TruthTrees | None = None
        self.sets = ParameterSets(self.keeper, self._show_parameters)
        self._before_after = BeforeAfter()
        self.selection = Selection()
        self.asking = Asking(lambda question: self.worker.send(question), lambda: self._run)
        self._selecting: asyncio.Task[None] | None = None
        self.scene_viewers = 0
        self.scene_hand = SOMEBODY  # who moved something in the scene last
        self.source = Open("")
        self.events = Events()
        self.loop: tuple[float, float] | None = None
        self._turning = False
        self._run: int | None = None
        self._notice = ""
        self._restarts = 0
        self._go = False
        self._show_scene = Throttle(lambda f, xy: self.scene.show(f, xy), pause_s=_SCENE_PAUSE_S)

    @property
    def start_ns(self) -> int:
        """Time of the run's first scan, 0 before one is shown."""
        return 0 if self.shown is None else self.shown.frame.stamp_ns - round(self.shown.time_s * 1e9)

    async def start(self, source: Open) -> None:
        """Start the worker with a source; it plays as soon as it is open."""
        await self.sets.load()
        self.live.tell("view", self.scene.view)
        await self.worker.start()
        await self._send_parameters()
        await self.open(source)

    async def close(self) -> None:
        """End the worker and the scene."""
        self.scores.close()
        self._leave_selecting()
        self._show_scene.cancel()
        await self.logbook.close()
        await self.worker.close()
        await self.keeper.close()
        self.scene.close()

    # --- what people do --------------------------------------------------------------------------

    async def command(self, command: ToWorker) -> None:
        """Hand a command to the worker."""
        self._notice = ""
        # A worker that is down comes back with the source closed; then this is still to be done.
        self._go = isinstance(command, Play | Open) and self.worker.pid is None
        await self.worker.send(command)

    async def choose_view(self, name: str, value: str | bool) -> None:
        """Show or hide a layer of the scene, or colour, label or follow otherwise.

        Raises:
            ParameterError: There is no such choice.
        """
        self.scene.choose(name, value)
        self.live.tell("view", self.scene.view)

    def play_in_loop(self, loop: tuple[float, float] | None) -> None:
        """Play from the first to the second time [s] again and again; None plays on at the end."""
        self._tell_loop(loop)

    def _tell_loop(self, loop: tuple[float, float] | None) -> None:
        self.loop, self._turning = loop, False
        self.live.tell("loop", None if loop is None else {"from_s": loop[0], "to_s": loop[1]})

    async def open(self, source: Open) -> None:
        """Leave the run and open another source."""
        self._set_status(Status(state="starting", detail=f"Opening {source.uri}", source=source.uri))
        self._run, self.source = None, source
        self.logbook.leave()
        self.annotating.leave()
        await self._forget()
        await self.command(source)

    async def replay(self, source: Open, preset_name: str, values: dict[str, Value]) -> None:
        """Open a source once more with the parameters of an earlier run of it.

        Raises:
            ParameterError: They are not those of this version; nothing is changed.
        """
        self.parameters.take(preset_name, values)
        self._show_parameters()  # the worker gets them when the source is open
        await self.open(source)

    async def change_parameters(self, changes: dict[str, Value]) -> None:
        """Change values by their dotted names.

        Raises:
            ParameterError: A value does not fit; nothing is changed.
        """
        await self.tune(lambda state: state.change(changes))

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
        self._show_parameters()
        if self.shown is not None:
            self.events.changed(before.flat(), self.parameters.parameters.flat(), self.shown.time_s)
            self._tell_events()
        state = self.parameters
        who = hand.get() or self.scene_hand
        self.logbook.changed(before.flat(), state.parameters.flat(), state.preset, state.revision, who)
        await self._send_parameters()
        self._score()

    async def select_tree(self, number: int | None) -> None:
        """Select a tree everywhere; None selects nothing."""
        self._leave_selecting()
        self._select(Selection(number))

    async def select_cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster everywhere, as it stands in a scan that was shown lately, with its tree.

        Raises:
            NoStoryError: It is not known any more.
        """
        run = self._run
        story = await self.cluster_story(scan, cluster)
        if run == self._run:  # else it was left meanwhile
            self._select(Selection(story.tree, story))

    def select_cluster_soon(self, scan: int, cluster: int) -> None:
        """The same without waiting, for who cannot be told that it is not known any more; of clicks that
        follow one another the last counts."""
        self._leave_selecting()
        self._selecting = asyncio.create_task(self._select_if_known(scan, cluster), name="select")

    def _leave_selecting(self) -> None:
        if self._selecting is not None:
            self._selecting.cancel()

    async def _select_if_known(self, scan: int, cluster: int) -> None:
        try:
            await self.select_cluster(scan, cluster)
        except NoStoryError as error:
            self.live.tell("missing", {"detail": str(error), "scan": scan, "cluster": cluster})

    async def cluster_story(self, scan: int | None, cluster: int) -> ClusterStory:
        """The story of a cluster: the selected one as it was when it was selected, others of scans that were
        shown lately; None is the newest scan.

        Raises:
            NoStoryError: There is none.
        """
        kept = self.selection.cluster
        if kept is not None and (kept.scan, kept.cluster) == (scan, cluster):
            return kept
        newest = None if self.shown is None else self.shown.frame.index
        return await self.asking.cluster(newest if scan is None else scan, cluster)

    def _select(self, selection: Selection) -> None:
        self.selection = selection
        self.scene.select(selection.tree, selection.ring)
        self.live.tell("selection", selection.as_plain())
        self.live.tell("missing", None)

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
        await self.worker.send(SetParameters(state.parameters.model_dump(), state.revision))

    # --- what the worker says --------------------------------------------------------------------

    async def receive(self, message: FromWorker) -> None:
        """Take a message of the worker."""
        match message:
            case Report(status=status):
                self._set_status(status)
            case Opened():
                await self._begin(message)
            case Shown():
                self._show(message)
                await self._go_round(message)
            case Answer():
                self.asking.take(message)

    async def _begin(self, opened: Opened) -> None:
        """A source is open and waits: parameters that suit it first, then it plays."""
        self._run = opened.run
        await self.annotating.begin(opened.digest or opened.uri, opened.uri, opened.truth)
        if self._run != opened.run:  # it was left meanwhile
            return
        await self._forget()
        if self.parameters.suit(opened.preset):
            self._show_parameters()
        restarted, self._restarts = self.worker.restarts != self._restarts, self.worker.restarts
        self.logbook.begin(self.annotating.run, self.source, opened, again=restarted)
        play = self._go or not restarted
        if not play:
            self._notice = "The mapping process ended and was started again. Press play to begin anew"
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
        self._tell_loop(None)
        self._show_scene.cancel()
        self.scene.clear()
        self._use_truth()
        await self.select_tree(None)

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

    def _show(self, shown: Shown) -> None:
        if shown.run != self._run:  # of a run that was left
            return
        self.path = joined(self.path, shown.path_start, shown.path)
        if shown.frame.ground is None and self.shown is not None:
            # An earlier picture brought it, which the scene may not have drawn, or before it was built anew.
            frame = replace(shown.frame, ground=self.shown.frame.ground)
            shown = msgspec.structs.replace(shown, frame=frame)
        self.shown = shown
        self.path_xy = np.column_stack([self.path.x, self.path.y])
        distance = self.parameters.parameters.evaluation.match_distance
        counts = self._before_after.shown(counts_of(shown.frame, self.truth, distance))
        payload = map_payload(shown)
        payload["layers"] |= self.scene.counts
        self.live.show({**payload, **counts}, self.path_xy)
        if self.events.shown(shown.frame, shown.time_s):
            self._tell_events()
        self.logbook.shown(self._glance(shown))
        self._score()
        self._show_scene(shown.frame, self.path_xy)

    def _glance(self, shown: Shown) -> Glance:
        state = self.parameters
        return Glance(
            shown, self.path_xy, state.preset, state.parameters.flat(), self.truth, self.scores.latest
        )

    def _tell_score(self, score: dict[str, Any] | None) -> None:
        self.live.tell("evaluation", score)
        self.logbook.scored(score)

    async def _go_round(self, shown: Shown) -> None:
        """At the end of the loop go to its beginning, while the run plays."""
        if self.loop is None or shown.run != self._run:
            return
        if shown.time_s < self.loop[1]:
            self._turning = False
        elif not self._turning and self.status.state in ("playing", "finished"):
            self._turning = True  # pictures that are under way must not turn it once more
            await self.worker.send(Seek(self.loop[0]))
            if self.status.state == "finished":
                await self.worker.send(Play())

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
