"""Limits per role: how many browsers are connected, and how much work viewers can cause."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from app.web.auth import Role
from pipeline.errors import StemmapError

MOST: dict[Role, int] = {"owner": 50, "viewer": 50}
# Pause between two requests of viewers that cost work, so that the run keeps most of the machine.
_PAUSE_S = 0.5
_MOST_WAITING = 4


class TooManyRequestsError(StemmapError):
    """Too many requests of this kind wait. The same request may succeed later."""


class Places:
    """Counts the browsers that are connected to one kind of websocket."""

    def __init__(self) -> None:
        self._taken: Counter[Role] = Counter()

    def __len__(self) -> int:
        return self._taken.total()

    @contextmanager
    def place(self, role: Role) -> Iterator[bool]:
        """Take a place inside the context; yields False where none is left."""
        free = self._taken[role] < MOST[role]
        self._taken[role] += free
        try:
            yield free
        finally:
            self._taken[role] -= free


class Turns:
    """Runs requests one after the other with a pause in between, and refuses those beyond a short queue.

    Args:
        pause_s: Pause between two requests.
        most_waiting: Longest queue.
    """

    def __init__(self, pause_s: float = _PAUSE_S, most_waiting: int = _MOST_WAITING) -> None:
        self._pause_s, self._most_waiting = pause_s, most_waiting
        self._lock = asyncio.Lock()
        self._waiting = 0
        self._free_at = 0.0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a turn, which lasts as long as the context.

        Raises:
            TooManyRequestsError: The queue is full.
        """
        if self._waiting >= self._most_waiting:
            raise TooManyRequestsError("too many requests wait", remedy="Try again in some seconds")
        loop = asyncio.get_running_loop()
        self._waiting += 1
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        try:
            await asyncio.sleep(max(0.0, self._free_at - loop.time()))
            yield
        finally:
            self._free_at = loop.time() + self._pause_s
            self._lock.release()


class Limits:
    """The limits of one dashboard."""

    def __init__(self) -> None:
        self.pages, self.scenes = Places(), Places()
        self.viewers = Turns()
        self.comparisons = Turns(pause_s=0.0)
