"""The selection: one tree or cluster for everybody who looks at the dashboard."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from app.dashboard.broadcast import Live
from app.explain.client import NoStoryError, WorkerClient
from app.explain.records import ClusterStory


@dataclass(frozen=True, slots=True)
class Selection:
    """A tree, a cluster with the tree that it is a view of, or nothing.

    Attributes:
        tree: Its number, None for none.
        cluster: The cluster as it was when it was selected, a standing picture of its scan.
    """

    tree: int | None = None
    cluster: ClusterStory | None = None

    @property
    def ring(self) -> tuple[float, float, float] | None:
        """Where the cluster stands in the map and how wide it is: x, y, radius [m]."""
        story = self.cluster
        if story is None:
            return None
        reach = max((x * x + y * y for x, y in story.points), default=0.0) ** 0.5
        return (*story.position, reach)

    def as_plain(self) -> dict[str, Any]:
        """For the browsers; the story itself is asked for by who wants to read it."""
        story = self.cluster
        if story is None:
            return {"tree": self.tree, "cluster": None}
        place = {"x": round(story.position[0], 4), "y": round(story.position[1], 4)}
        cluster = {"scan": story.scan, "cluster": story.cluster, "verdict": story.verdict, **place}
        return {"tree": self.tree, "cluster": cluster}


Ring = tuple[float, float, float] | None


class Selecting:
    """The selection, and how it comes about.

    Args:
        asking: Where stories are told.
        live: Where the browsers are told.
        mark: Marks a tree and a ring in the scene.
        run: The present run, None for none.
        newest: The newest scan that is shown, None for none.
    """

    def __init__(
        self,
        asking: WorkerClient,
        live: Live,
        mark: Callable[[int | None, Ring], None],
        *,
        run: Callable[[], int | None],
        newest: Callable[[], int | None],
    ) -> None:
        self.selection = Selection()
        self._asking, self._live, self._mark = asking, live, mark
        self._run, self._newest = run, newest
        self._task: asyncio.Task[None] | None = None

    def tree(self, number: int | None) -> None:
        """Select a tree; None selects nothing."""
        self.leave()
        self._select(Selection(number))

    async def cluster(self, scan: int, cluster: int) -> None:
        """Select a cluster, as it stands in a scan that was shown lately, with its tree.

        Raises:
            NoStoryError: It is not known any more.
        """
        run = self._run()
        story = await self.story(scan, cluster)
        if run == self._run():  # else it was left meanwhile
            self._select(Selection(story.tree, story))

    def cluster_soon(self, scan: int, cluster: int) -> None:
        """The same without waiting, for who cannot be told that it is not known any more; of clicks that
        follow one another the last counts."""
        self.leave()
        self._task = asyncio.create_task(self._if_known(scan, cluster), name="select")

    async def story(self, scan: int | None, cluster: int) -> ClusterStory:
        """The story of a cluster: the selected one as it was when it was selected, others of scans that were
        shown lately; None is the newest scan.

        Raises:
            NoStoryError: There is none.
        """
        kept = self.selection.cluster
        if kept is not None and (kept.scan, kept.cluster) == (scan, cluster):
            return kept
        return await self._asking.cluster(self._newest() if scan is None else scan, cluster)

    def renamed(self, numbers: Mapping[int, int]) -> None:
        """The map has other numbers: a selected tree that is there no more is selected no more."""
        selected = self.selection
        if selected.tree is not None:
            self._select(Selection(numbers.get(selected.tree), selected.cluster))

    def leave(self) -> None:
        """Wait no more for a story that was asked for."""
        if self._task is not None:
            self._task.cancel()

    async def _if_known(self, scan: int, cluster: int) -> None:
        try:
            await self.cluster(scan, cluster)
        except NoStoryError as error:
            self._live.tell("missing", {"detail": str(error), "scan": scan, "cluster": cluster})

    def _select(self, selection: Selection) -> None:
        self.selection = selection
        self._mark(selection.tree, selection.ring)
        self._live.tell("selection", selection.as_plain())
        self._live.tell("missing", None)
