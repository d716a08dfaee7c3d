"""Dependencies of the routes: the dashboard, the role of the request, and the limits of viewers."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from contextlib import (
    AbstractContextManager,
    ExitStack,
    asynccontextmanager,
    contextmanager,
    nullcontext,
)
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Query
from pydantic import ValidationError
from starlette.requests import HTTPConnection

from app.common.request_queue import RequestQueue
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.learning import Learning
from app.web.auth import Role, is_local, role_of
from app.web.responses import BadRequestError
from pipeline.config.stages import Stand
from pipeline.stand.volume import LONGEST

#: Largest number of connections of one kind.
MOST: dict[Role, int] = {"owner": 50, "viewer": 50}
T = TypeVar("T")


class ConnectionLimit:
    """Counts the browsers that are connected to one kind of websocket, at most MOST per role."""

    def __init__(self) -> None:
        self._taken: Counter[Role] = Counter()

    @contextmanager
    def place(self, role: Role) -> Iterator[bool]:
        """Take a place inside the context and yield True; if none is left for this role, take none and yield
        False."""
        free = self._taken[role] < MOST[role]
        self._taken[role] += free
        try:
            yield free
        finally:
            self._taken[role] -= free


class Limits:
    """The limits of one dashboard."""

    def __init__(self) -> None:
        self.pages, self.scenes = ConnectionLimit(), ConnectionLimit()
        # The pause leaves most of the machine to the run.
        self.viewers, self.comparisons = RequestQueue(pause_s=0.5), RequestQueue()


def _of_app(name: str) -> Any:  # noqa: ANN401 - what `Depends` returns
    """Return the dependency on an object of the application, by its name in `app.state`."""

    def get(connection: HTTPConnection) -> object:
        return getattr(connection.app.state, name)

    return Depends(get)


Dash = Annotated[Dashboard, _of_app("dashboard")]
Deployment = Annotated[Settings, _of_app("settings")]
Bounds = Annotated[Limits, _of_app("limits")]
Trainer = Annotated[Learning, _of_app("learning")]


def _role(connection: HTTPConnection) -> Role:
    return role_of(connection.scope)


def _may_open_any_file(connection: HTTPConnection) -> bool:
    """Return whether the request may name any file of this machine; otherwise only recordings in the data
    folders. It may as an owner, if the settings allow any file, or allow it locally and the request is local.
    """
    settings: Settings = connection.app.state.settings
    if role_of(connection.scope) != "owner" or settings.files == "folders":
        return False
    return settings.files == "any" or (settings.loopback and is_local(connection.headers))


async def _viewer_turn(connection: HTTPConnection) -> AsyncIterator[None]:
    """Wait for a turn if the request is that of a viewer, because the request costs work; raises
    TooManyRequestsError if too many wait. Owners do not wait."""
    viewer = role_of(connection.scope) == "viewer"
    limits: Limits = connection.app.state.limits
    async with limits.viewers.turn() if viewer else nullcontext():
        yield


def _figure_parameters(
    dbh_min: Annotated[float, Query(ge=0.0, le=1.0)] = 0.07,
    volume: Annotated[str, Query(max_length=LONGEST)] = "",
) -> Stand:
    """Return the parameters of stand figures that a request gives; BadRequestError for another formula.

    Args:
        dbh_min: Minimum diameter [m].
        volume: Volume formula; empty for none.
    """
    try:
        return Stand(dbh_min=dbh_min, volume=volume.strip())
    except ValidationError as error:
        what = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise BadRequestError(what, remedy='As in "0.00007 * dbh_cm^1.8 * height_m^0.95"') from None


@asynccontextmanager
async def in_thread(context: AbstractContextManager[T]) -> AsyncIterator[T]:
    """Yield the value of a context that is entered in a thread, because entering it writes files; it is left
    on the event loop."""
    with ExitStack() as stack:
        yield await asyncio.to_thread(stack.enter_context, context)


FigureParameters = Annotated[Stand, Depends(_figure_parameters)]
CallerRole = Annotated[Role, Depends(_role)]
AnyFile = Annotated[bool, Depends(_may_open_any_file)]
#: For routes that cost the mapping process or this one more than some milliseconds.
ViewerTurn = Depends(_viewer_turn, scope="function")
