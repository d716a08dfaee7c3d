"""Requests to the worker process about the shown run: stories, comparisons and camera pictures."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable

from app.explain.records import ClusterStory, TreeStory
from app.worker.protocol import (
    Answer,
    AskCamera,
    AskCluster,
    AskCompare,
    AskTree,
    CameraPicture,
    Question,
    WorkerBusyError,
)
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import Frame

PATIENCE_S = 15.0
_MOST_WAITING = 100

Send = Callable[[Question], Awaitable[None]]


class NoStoryError(StemmapError):
    """The requested story, comparison or picture does not exist."""


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
        """Return the explanation of a cluster of a recently shown scan.

        Args:
            scan: Index of the scan; None if no scan is shown.
            cluster: Row of the cluster.
        """
        run = self._shown_run()
        if scan is None:
            raise _nothing_mapped()
        answer = await self._ask(AskCluster(next(self._tickets), run, scan, cluster))
        if answer.cluster is None:
            raise NoStoryError(answer.missing or "there is no such cluster")
        return answer.cluster

    async def tree(self, number: int) -> TreeStory:
        """Return the explanation of a tree, by its number, after the current scan."""
        answer = await self._ask(AskTree(next(self._tickets), self._shown_run(), number))
        if answer.tree is None:
            raise NoStoryError(answer.missing or "there is no such tree")
        return answer.tree

    async def compare(self, sets: list[Parameters]) -> list[Frame]:
        """Return the results of the current scan under each of several parameter sets."""
        plain = [each.model_dump() for each in sets]
        answer = await self._ask(AskCompare(next(self._tickets), self._shown_run(), plain))
        if answer.frames is None:
            raise NoStoryError(answer.missing or "there is nothing to compare")
        return answer.frames

    async def camera(self, stamp_ns: int) -> CameraPicture:
        """Return the camera picture of the run nearest to a time [ns]."""
        answer = await self._ask(AskCamera(next(self._tickets), self._shown_run(), stamp_ns))
        if answer.camera is None:
            raise NoStoryError(answer.missing or "there is no picture")
        return answer.camera

    def _shown_run(self) -> int:
        run = self._run()
        if run is None:
            raise _nothing_mapped()
        return run

    async def _ask(self, question: Question) -> Answer:
        if len(self._waiting) >= _MOST_WAITING:
            raise WorkerBusyError("too many requests at once", remedy="Try again")
        waiting = self._waiting[question.ticket] = asyncio.get_running_loop().create_future()
        try:
            await self._send(question)
            return await asyncio.wait_for(waiting, self._patience_s)
        except TimeoutError:
            raise WorkerBusyError("the mapping process is busy", remedy="Try again in a moment") from None
        finally:
            del self._waiting[question.ticket]


def _nothing_mapped() -> NoStoryError:
    return NoStoryError("nothing is mapped yet", remedy="Press play, or open a run")
