"""Dependencies of the routes: the dashboard, the role of the request, and the limits of viewers."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, nullcontext
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.web.auth import Role, is_local, role_of
from pipeline.errors import StemmapError

MOST: dict[Role, int] = {"owner": 50, "viewer": 50}
# Pause between two requests of viewers that cost work, so that the run keeps most of the machine.
_PAUSE_S = 0.5
_MOST_WAITING = 4


class TooManyRequestsError(StemmapError):
    """Too many requests of this kind wait. The same request may succeed later."""


class ConnectionLimit:
    """Counts the browsers that are connected to one kind of websocket, at most MOST per role."""

    def __init__(self) -> None:
        self._taken: Counter[Role] = Counter()

    def __len__(self) -> int:
        """Return the number of connected browsers of all roles."""
        return self._taken.total()

    @contextmanager
    def place(self, role: Role) -> Iterator[bool]:
        """Take a place inside the context; yields False, and takes none, where none is left for this role."""
        free = self._taken[role] < MOST[role]
        self._taken[role] += free
        try:
            yield free
        finally:
            self._taken[role] -= free


class RequestQueue:
    """Runs requests one after the other with a pause in between, and refuses those beyond a short queue.

    Args:
        pause_s: Pause between two requests [s].
        most_waiting: Maximum length of the queue.
    """

    def __init__(self, pause_s: float = _PAUSE_S, most_waiting: int = _MOST_WAITING) -> None:
        self._pause_s, self._most_waiting = pause_s, most_waiting
        self._lock = asyncio.Lock()
        self._waiting = 0
        self._free_at = 0.0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a turn, which lasts as long as the context. Turns follow each other with the pause of the
        queue in between.

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


class Limits:
    """The limits of one dashboard."""

    def __init__(self) -> None:
        self.pages, self.scenes = ConnectionLimit(), ConnectionLimit()
        self.viewers = RequestQueue()
        self.comparisons = RequestQueue(pause_s=0.0)


def _dashboard(connection: HTTPConnection) -> Dashboard:
    dashboard: Dashboard = connection.app.state.dashboard
    return dashboard


def _settings(connection: HTTPConnection) -> Settings:
    settings: Settings = connection.app.state.settings
    return settings


def _limits(connection: HTTPConnection) -> Limits:
    limits: Limits = connection.app.state.limits
    return limits


def _role(connection: HTTPConnection) -> Role:
    return role_of(connection.scope)


def _may_open_any_file(connection: HTTPConnection) -> bool:
    """Return whether the request may name any file of this machine; otherwise only recordings in the data
    folders. It may as an owner, if the settings allow any file, or allow it locally and the request is local.
    """
    settings = _settings(connection)
    if role_of(connection.scope) != "owner" or settings.files == "folders":
        return False
    return settings.files == "any" or (settings.loopback and is_local(connection.headers))


async def _viewer_turn(connection: HTTPConnection) -> AsyncIterator[None]:
    """Wait for a turn if the request is that of a viewer, because the request costs work; raises
    TooManyRequestsError if too many wait. Owners do not wait."""
    viewer = role_of(connection.scope) == "viewer"
    async with _limits(connection).viewers.turn() if viewer else nullcontext():
        yield


Dash = Annotated[Dashboard, Depends(_dashboard)]
Deployment = Annotated[Settings, Depends(_settings)]
Bounds = Annotated[Limits, Depends(_limits)]
CallerRole = Annotated[Role, Depends(_role)]
AnyFile = Annotated[bool, Depends(_may_open_any_file)]
#: For routes that cost the mapping process or this one more than some milliseconds.
ViewerTurn = Depends(_viewer_turn, scope="function")
