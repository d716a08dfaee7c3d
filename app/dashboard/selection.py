"""Questions of the dashboard to the worker process about the shown run (explanations, comparisons, camera
pictures), and the selection of one tree or cluster."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from app.explain.records import ClusterStory, MapSection, TreeStory
from app.worker.protocol import (
    Answer,
    AskCamera,
    AskCluster,
    AskCompare,
    AskCourse,
    AskSection,
    AskTree,
    AskTreePicture,
    CameraPicture,
    Question,
    RunCourse,
    WorkerBusyError,
)
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import Frame

if TYPE_CHECKING:
    from app.dashboard.dashboard import Dashboard

PATIENCE_S = 15.0
_MOST_WAITING = 100

Send = Callable[[Question], Awaitable[None]]


P = ParamSpec("P")
T = TypeVar("T")


class NoStoryError(StemmapError):
    """The requested story, comparison or picture does not exist."""


class NothingMappedError(NoStoryError):
    """A request about the shown scan before the first scan."""

    def __init__(self) -> None:
        super().__init__("nothing is mapped yet", remedy="Press play, or open a run")


class WorkerClient:
    """Sends questions about the shown run to the worker and waits for the answers.

    Each question has a ticket, which its answer repeats. All methods that wait raise `NoStoryError` if there
    is no run or no such object, and `WorkerBusyError` without an answer in time.

    Args:
        send: Sends a question to the worker.
        run: Returns the number of the shown run, None while there is none.
        patience_s: How long to wait for an answer [s].
    """

    def __init__(self, send: Send, run: Callable[[], int | None], patience_s: float = PATIENCE_S) -> None:
        self._send, self._run, self._patience_s = send, run, patience_s
        self._tickets = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    def take(self, answer: Answer) -> None:
        """Deliver an answer of the worker to the method that waits for it; without effect if none does."""
        waiting = self._waiting.get(answer.ticket)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)

    async def cluster(self, scan: int | None, cluster: int) -> ClusterStory:
        """Return the explanation of a cluster of a recently shown scan; raises NoStoryError without such a
        cluster, WorkerBusyError without an answer.

        Args:
            scan: Index of the scan; None if no scan is shown, which raises NothingMappedError.
            cluster: Row of the cluster.
        """
        if scan is None:
            raise NothingMappedError
        return _known((await self._ask(AskCluster, scan, cluster)).cluster)

    async def tree(self, number: int) -> TreeStory:
        """Return the explanation of a tree, by its number, after the current scan; raises NoStoryError
        without such a tree, WorkerBusyError without an answer."""
        return _known((await self._ask(AskTree, number)).tree)

    async def compare(self, sets: list[Parameters]) -> list[Frame]:
        """Return the results of the current scan under each of several parameter sets, in their order; raises
        NoStoryError without a scan, WorkerBusyError without an answer."""
        plain = [each.model_dump() for each in sets]
        return _known((await self._ask(AskCompare, plain)).frames)

    async def camera(self, stamp_ns: int) -> CameraPicture:
        """Return the camera picture of the run nearest to a time [ns]; raises NoStoryError without one,
        WorkerBusyError without an answer."""
        return _known((await self._ask(AskCamera, stamp_ns)).camera)

    async def tree_picture(self, number: int) -> CameraPicture:
        """Return the camera picture of the run that shows a tree best, by its number; raises NoStoryError
        without one, WorkerBusyError without an answer."""
        return _known((await self._ask(AskTreePicture, number)).camera)

    async def section(self) -> MapSection:
        """Return the accumulated points at breast height after the current scan; raises NoStoryError without
        a run, WorkerBusyError without an answer."""
        return _known((await self._ask(AskSection)).section)

    async def course(self, names: list[str], most: int, stages: bool) -> RunCourse:
        """Return the course of the map, see `AskCourse` for the arguments; raises NoStoryError without a run,
        WorkerBusyError without an answer."""
        return _known((await self._ask(AskCourse, names, most, stages)).course)

    async def _ask(
        self, kind: Callable[Concatenate[int, int, P], Question], *values: P.args, **named: P.kwargs
    ) -> Answer:
        """Send a question and return its answer.

        Args:
            kind: Type of the question.
            values, named: Fields of the question after `ticket` and `run`.

        Raises:
            NothingMappedError: No run is shown.
            WorkerBusyError: 100 questions wait already, or there is no answer in time.
            NoStoryError: The worker answers that the object does not exist.
        """
        run = self._run()
        if run is None:
            raise NothingMappedError
        question = kind(next(self._tickets), run, *values, **named)
        if len(self._waiting) >= _MOST_WAITING:
            raise WorkerBusyError("too many requests at once", remedy="Try again")
        waiting = self._waiting[question.ticket] = asyncio.get_running_loop().create_future()
        try:
            await self._send(question)
            answer: Answer = await asyncio.wait_for(waiting, self._patience_s)
        except TimeoutError:
            raise WorkerBusyError("the mapping process is busy", remedy="Try again in a moment") from None
        finally:
            del self._waiting[question.ticket]
        if answer.missing:
            raise NoStoryError(answer.missing)
        return answer


def _known(found: T | None) -> T:
    """Return the part of an answer; raises NoStoryError if it is None."""
    if found is None:
        raise NoStoryError("there is no answer")
    return found


@dataclass(frozen=True, slots=True)
class Selection:
    """Selected tree, selected cluster with its tree, or nothing.

    Attributes:
        tree: Number of the tree, or None.
        cluster: Explanation of the cluster at the time of its selection, or None.
        by: Identity of the page that selected it; None for a click in the 3D scene, and for a run that
            begins.
    """

    tree: int | None = None
    cluster: ClusterStory | None = None
    by: str | None = None

    @property
    def ring(self) -> tuple[float, float, float] | None:
        """Position x, y of the selected cluster in the map [m] and the distance of its farthest point from
        there [m]; None if no cluster is selected."""
        story = self.cluster
        if story is None:
            return None
        reach = max((x * x + y * y for x, y in story.points), default=0.0) ** 0.5
        return (*story.position, reach)

    def as_plain(self) -> dict[str, Any]:
        """Return the selection as a dict for the dashboard: `tree`, a number or None, `by`, and `cluster`,
        None or a dict with `scan`, `cluster` (its row), `verdict`, `x` and `y` in the map [m]. The
        explanation is requested separately."""
        story = self.cluster
        if story is None:
            return {"tree": self.tree, "by": self.by, "cluster": None}
        place = {"x": round(story.position[0], 4), "y": round(story.position[1], 4)}
        cluster = {"scan": story.scan, "cluster": story.cluster, "verdict": story.verdict, **place}
        return {"tree": self.tree, "by": self.by, "cluster": cluster}


class Selector:
    """The selected tree or cluster, and its changes.

    There is one selection, the newest one of all pages: the scene marks it, and the pages follow it. A page
    on which a person annotates keeps its own tree instead, and needs to know which trees other pages have
    selected.

    Args:
        dashboard: State of the run, with its scene and its worker.
    """

    def __init__(self, dashboard: Dashboard) -> None:
        self.selection = Selection()
        self._dashboard = dashboard
        self._task: asyncio.Task[None] | None = None
        self._place: tuple[float, float, float] | None = None
        self._of_pages: dict[str, int] = {}

    def tree(self, number: int | None, by: str | None = None) -> None:
        """Select a tree, without a cluster, in place of the selection, and cancel a pending request. Whether
        the tree exists is not checked.

        Args:
            number: Number of the tree; None selects nothing.
            by: As in `Selection`.
        """
        self.leave()
        self._select(Selection(number, by=by))

    async def cluster(self, scan: int, cluster: int, by: str | None = None) -> None:
        """Select a cluster of a recently displayed scan, with its tree, in place of the selection. The
        selection does not change if another run was opened meanwhile, or after an error.

        Args:
            scan: Index of the scan.
            cluster: Row of the cluster.
            by: As in `Selection`.

        Raises:
            NoStoryError: The cluster is no longer available, or no run is shown.
            WorkerBusyError: The worker did not answer in time.
        """
        run = self._dashboard.run
        story = await self.story(scan, cluster)
        if run == self._dashboard.run:  # else it was left meanwhile
            self._select(Selection(story.tree, story, by))

    def cluster_soon(self, scan: int, cluster: int, by: str | None = None) -> None:
        """Select a cluster in the background; of several calls the last one counts. If it does not exist, or
        the worker does not answer in time, the browsers receive the message "missing" with the reason.

        Args:
            scan: Index of the scan.
            cluster: Row of the cluster.
            by: As in `Selection`.
        """
        self.leave()
        self._task = asyncio.create_task(self._if_known(scan, cluster, by), name="select")

    async def story(self, scan: int | None, cluster: int) -> ClusterStory:
        """Return the explanation of a cluster of a recent scan. For the selected cluster, given by its scan,
        it is the explanation at the time of its selection.

        Args:
            scan: Index of the scan; None for the newest.
            cluster: Row of the cluster.

        Raises:
            NoStoryError: The cluster is not available, or no run is shown.
            WorkerBusyError: The worker did not answer in time.
        """
        kept = self.selection.cluster
        if kept is not None and (kept.scan, kept.cluster) == (scan, cluster):
            return kept
        shown = self._dashboard.shown
        newest = None if shown is None else shown.frame.index
        return await self._dashboard.worker_client.cluster(newest if scan is None else scan, cluster)

    def remove(self, trees: Collection[int]) -> None:
        """Clear the selection of a tree that does not exist any more. A selected cluster stays.

        Args:
            trees: Numbers of the trees that vanished.
        """
        if self.selection.tree in trees:
            self._select(replace(self.selection, tree=None))

    def close_page(self, page: str | None) -> None:
        """Forget what a page has selected, because it was closed; the selection stays."""
        if page in self._of_pages:
            del self._of_pages[page]
            self._publish()

    def leave(self) -> None:
        """Cancel the pending request for an explanation."""
        if self._task is not None:
            self._task.cancel()

    async def _if_known(self, scan: int, cluster: int, by: str | None) -> None:
        """Select a cluster; if it does not exist, or the worker does not answer in time, broadcast the
        message "missing"."""
        try:
            await self.cluster(scan, cluster, by)
        except StemmapError as error:
            self._dashboard.live.publish("missing", {"detail": str(error), "scan": scan, "cluster": cluster})

    def _select(self, selection: Selection) -> None:
        """Set the selection, highlight it in the scene, broadcast it, and clear the message "missing"."""
        self.selection = selection
        self._place = self._dashboard.scene.select(selection.tree, selection.ring)
        if selection.by is None:  # all pages follow
            self._of_pages.clear()
        elif selection.tree is None:
            self._of_pages.pop(selection.by, None)
        elif self._of_pages.get(selection.by) != selection.tree:
            self._of_pages.pop(selection.by, None)
            self._of_pages[selection.by] = selection.tree  # as the last one
        self._publish()
        self._dashboard.live.publish("missing", None)

    def _publish(self) -> None:
        """Broadcast the selection with its `place`, the tree of each page that has selected one, in the order
        of these selections, and the number of the run: a page that annotates does not keep a tree of the run
        before."""
        content = {"place": self._place, "pages": self._of_pages, "run": self._dashboard.run}
        self._dashboard.live.publish("selection", {**self.selection.as_plain(), **content})
