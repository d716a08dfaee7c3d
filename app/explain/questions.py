"""Questions to the worker that are answered: each has a ticket, and somebody who waits for it."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from typing import Any

from app.explain.records import ClusterStory, TreeStory
from app.worker.camera import CameraPicture
from app.worker.internal_protocol import Answer, AskCamera, AskCluster, AskCompare, AskTree, Question
from pipeline.errors import StemmapError
from pipeline.types.records import Frame

PATIENCE_S = 15.0
_MOST_WAITING = 100

Send = Callable[[Question], Awaitable[None]]


class NoStoryError(StemmapError):
    """There is no story of what was asked for."""


class Questions:
    """Asks the worker for stories.

    Args:
        send: Hands a question to the worker.
        patience_s: How long an answer is waited for.
    """

    def __init__(self, send: Send, patience_s: float = PATIENCE_S) -> None:
        self._send = send
        self._patience_s = patience_s
        self._tickets = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[Answer]] = {}

    async def cluster(self, run: int, scan: int, cluster: int) -> ClusterStory:
        """The story of a cluster of a scan that was shown lately.

        Raises:
            NoStoryError: There is none, or nobody answers.
        """
        answer = await self._ask(AskCluster(next(self._tickets), run, scan, cluster))
        if answer.cluster is None:
            raise NoStoryError(answer.missing or "there is no such cluster")
        return answer.cluster

    async def tree(self, run: int, tree: int) -> TreeStory:
        """The story of a tree.

        Raises:
            NoStoryError: There is none, or nobody answers.
        """
        answer = await self._ask(AskTree(next(self._tickets), run, tree))
        if answer.tree is None:
            raise NoStoryError(answer.missing or "there is no such tree")
        return answer.tree

    async def compare(self, run: int, sets: list[dict[str, Any]]) -> list[Frame]:
        """The standing scan under each of other parameters.

        Raises:
            NoStoryError: There is none, or nobody answers.
        """
        answer = await self._ask(AskCompare(next(self._tickets), run, sets))
        if answer.frames is None:
            raise NoStoryError(answer.missing or "there is nothing to compare")
        return answer.frames

    async def camera(self, run: int, stamp_ns: int) -> CameraPicture:
        """What the run's camera saw at a time.

        Raises:
            NoStoryError: There is no picture, or nobody answers.
        """
        answer = await self._ask(AskCamera(next(self._tickets), run, stamp_ns))
        if answer.camera is None:
            raise NoStoryError(answer.missing or "there is no picture")
        return answer.camera

    def take(self, answer: Answer) -> None:
        """Hand an answer to who waits for it, if anybody still does."""
        waiting = self._waiting.get(answer.ticket)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)

    async def _ask(self, question: Question) -> Answer:
        if len(self._waiting) >= _MOST_WAITING:
            raise NoStoryError("too much is asked for at once", remedy="Try again")
        waiting = self._waiting[question.ticket] = asyncio.get_running_loop().create_future()
        try:
            await self._send(question)
            return await asyncio.wait_for(waiting, self._patience_s)
        except TimeoutError:
            raise NoStoryError("the mapping process is busy", remedy="Try again in a moment") from None
        finally:
            del self._waiting[question.ticket]
