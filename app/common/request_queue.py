"""A queue of requests that cost work."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from pipeline.errors import StemmapError

_MOST_WAITING = 4


class TooManyRequestsError(StemmapError):
    """Too many requests of this kind wait. The same request may succeed later."""


class RequestQueue:
    """Runs requests one after the other with a pause in between, and refuses those beyond a short queue.

    Args:
        pause_s: Pause between two requests [s].
        most_waiting: Maximum number of requests that wait for a turn. One that waits only for the end of the
            pause has the turn already.
    """

    def __init__(self, pause_s: float = 0.0, most_waiting: int = _MOST_WAITING) -> None:
        self._pause_s, self._most_waiting = pause_s, most_waiting
        self._lock = asyncio.Lock()
        self._waiting = 0
        self._free_at = 0.0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a turn, which lasts as long as the context. Turns are in the order of the calls, with the
        pause of the queue after each, also after one that raises.

        Raises:
            TooManyRequestsError: `most_waiting` other requests wait already.
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
