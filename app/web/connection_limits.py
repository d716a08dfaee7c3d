"""Room for browsers: those who only look have places of their own, and take none of a person who works."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from app.web.auth import Role

MOST: dict[Role, int] = {"owner": 50, "viewer": 50}
# What viewers ask the mapping process for takes at most this much of its time from the run, together.
_PAUSE_S = 0.5


class Places:
    """Who is connected to one kind of websocket."""

    def __init__(self) -> None:
        self._taken: Counter[Role] = Counter()

    def __len__(self) -> int:
        return self._taken.total()

    @contextmanager
    def place(self, role: Role) -> Iterator[bool]:
        """Inside, a place is taken; False where there is none left."""
        free = self._taken[role] < MOST[role]
        self._taken[role] += free
        try:
            yield free
        finally:
            self._taken[role] -= free


class Turns:
    """One after the other, with a pause between two."""

    def __init__(self, pause_s: float = _PAUSE_S) -> None:
        self._pause_s = pause_s
        self._lock = asyncio.Lock()
        self._free_at = 0.0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for it."""
        loop = asyncio.get_running_loop()
        async with self._lock:
            await asyncio.sleep(max(0.0, self._free_at - loop.time()))
            try:
                yield
            finally:
                self._free_at = loop.time() + self._pause_s
