"""Shared parts of the routes: the dashboard, the role of the request, the limits of viewers, the files that a
sender may open, and edits of annotations."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import (
    AbstractContextManager,
    ExitStack,
    asynccontextmanager,
    contextmanager,
    nullcontext,
)
from pathlib import Path
from typing import Annotated, Any, Concatenate, ParamSpec, TypeVar
from urllib.parse import parse_qsl, urlencode

import msgspec
from fastapi import Depends
from pydantic import Field
from starlette.exceptions import WebSocketException
from starlette.requests import HTTPConnection
from starlette.responses import Response
from starlette.status import WS_1013_TRY_AGAIN_LATER

from app.common.settings import Settings
from app.common.timers import RequestQueue
from app.dashboard.dashboard import Dashboard
from app.sources.request import FILE, SourceRequest
from app.store.records import Author
from app.store.store import Store
from app.web.auth import ASK_OWNER, VIEW_ONLY, Role, is_local, role_of
from app.web.responses import BadRequestError, Body, Number, UserName, json_reply
from pipeline.errors import StemmapError
from pipeline.io.readers import path_of

#: Largest number of connections of one kind.
MOST: dict[Role, int] = {"owner": 50, "viewer": 50}
P = ParamSpec("P")
T = TypeVar("T")


class ConnectionLimit:
    """Counts the browsers that are connected to one kind of websocket, at most MOST per role."""

    def __init__(self) -> None:
        self._taken: Counter[Role] = Counter()

    @contextmanager
    def place(self, role: Role) -> Iterator[None]:
        """Count one connection of a role inside the context.

        Raises:
            WebSocketException: MOST connections of this role are counted already. It closes a websocket that
                is not accepted yet with 1013.
        """
        if self._taken[role] >= MOST[role]:
            raise WebSocketException(WS_1013_TRY_AGAIN_LATER)
        self._taken[role] += 1
        try:
            yield
        finally:
            self._taken[role] -= 1


class Limits:
    """The limits of one dashboard."""

    def __init__(self) -> None:
        self.pages, self.scenes = ConnectionLimit(), ConnectionLimit()
        # The pause leaves most of the machine to the run.
        self.viewers, self.comparisons = RequestQueue(pause_s=0.5), RequestQueue()


def of_app(name: str) -> Any:  # noqa: ANN401 - what `Depends` returns
    """Return the dependency on an object of the application, by its name in `app.state`."""

    def get(connection: HTTPConnection) -> object:
        return getattr(connection.app.state, name)

    return Depends(get)


Dash = Annotated[Dashboard, of_app("dashboard")]
Deployment = Annotated[Settings, of_app("settings")]
Bounds = Annotated[Limits, of_app("limits")]


def _role(connection: HTTPConnection) -> Role:
    return role_of(connection.scope)


def _permission(connection: HTTPConnection) -> Permission:
    """Return the permission of a request. It may name any file of this machine as an owner, if the settings
    allow any file, or allow it locally and the request is local; otherwise only recordings in the data
    folders."""
    settings: Settings = connection.app.state.settings
    is_local_request = not settings.files and settings.loopback and is_local(connection.headers)
    any_file = role_of(connection.scope) == "owner" and (settings.files == "any" or is_local_request)
    return lambda uri: permitted_uri(uri, settings, any_file)


async def _viewer_turn(connection: HTTPConnection) -> AsyncIterator[None]:
    """Wait for a turn if the request is that of a viewer, because the request costs work; raises
    TooManyRequestsError if too many wait. Owners do not wait."""
    viewer = role_of(connection.scope) == "viewer"
    limits: Limits = connection.app.state.limits
    async with limits.viewers.turn() if viewer else nullcontext():
        yield


def _owner(connection: HTTPConnection) -> None:
    """Raise 403 for others than an owner; for requests, not for WebSockets."""
    if role_of(connection.scope) != "owner":
        raise NotPermittedError(VIEW_ONLY, remedy=ASK_OWNER)


@asynccontextmanager
async def in_thread(context: AbstractContextManager[T]) -> AsyncIterator[T]:
    """Yield the value of a context that is entered in a thread, because entering it writes files; it is left
    on the event loop."""
    with ExitStack() as stack:
        yield await asyncio.to_thread(stack.enter_context, context)


CallerRole = Annotated[Role, Depends(_role)]
#: Returns the source that the request may open for a URI, or None, see `permitted_uri`.
Permission = Callable[[str], str | None]
Permitted = Annotated[Permission, Depends(_permission)]
#: For routes that cost the mapping process or this one more than some milliseconds.
ViewerTurn = Depends(_viewer_turn, scope="function")
#: For routes that cost minutes of work.
OwnerOnly = Depends(_owner)


# --- which files may be opened ------------------------------------------------------------------------


_ODOMETRY = ("auto", "wheels", "lidar", "static")


class NotPermittedError(StemmapError):
    """The request names a file that its sender may not open."""


def checked_uri(uri: str, permitted: Permission) -> str:
    """Return the source that the request may open for a URI; NotPermittedError if it may not be opened."""
    allowed = permitted(uri)
    if allowed is None:
        raise NotPermittedError(
            "only scenarios and the recordings of the data folder can be opened here",
            where=uri,
            remedy="Put it into the folder of recordings, or start stemmap with STEMMAP_FILES=any",
        )
    return allowed


def permitted_request(request: SourceRequest, permitted: Permission) -> SourceRequest:
    """Return the request with paths that may be opened.

    Args:
        request: The request of the browser.
        permitted: Permission of the sender.

    Raises:
        NotPermittedError: A file may not be opened.
        BadRequestError: The odometry is unknown.
    """
    uri, odometry = checked_uri(request.uri, permitted), request.odometry
    if odometry.startswith(FILE):
        odometry = f"{FILE}{checked_uri(odometry.removeprefix(FILE), permitted)}"
    elif odometry not in _ODOMETRY:
        raise BadRequestError(
            f"the odometry {odometry[:40]!r} is unknown",
            where="odometry",
            remedy=f"Use {', '.join(_ODOMETRY)} or file:PATH",
        )
    return msgspec.structs.replace(request, uri=uri, odometry=odometry)


def permitted_uri(uri: str, settings: Settings, any_file: bool) -> str | None:
    """Return the source that is opened for a URI, or None if it may not be opened. Whether it exists is not
    checked.

    Args:
        uri: URI of the request.
        settings: Settings of the deployment, with the data folders.
        any_file: Whether the request may open every source, also files outside of the data folders and live
            robots; then the URI is returned as it is. Otherwise only files in the data folders and simulated
            runs may be opened, those with the files `file` and `truth` only if these are in the
            data folders. The names of all these files are replaced by absolute paths without links, so that
            the file that was checked is the file that is opened.
    """
    if any_file:
        return uri
    try:
        if uri.startswith("sim:") and not Path(uri).exists():
            return _permitted_simulation(uri, settings)
        return _permitted_path(path_of(uri), settings)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: "~name" of an unknown user
        return None


def _permitted_path(name: str, settings: Settings) -> str | None:
    """Return the absolute path without links if it is in a data folder; else None. Raises OSError, ValueError
    or RuntimeError for a text that is no path."""
    path = Path(name).expanduser().resolve()
    inside_folder = any(path.is_relative_to(folder.resolve()) for folder in settings.data_folders)
    return str(path) if inside_folder else None


def _permitted_simulation(uri: str, settings: Settings) -> str | None:
    """Return the address of a simulated run with its files replaced by their permitted paths; None if one is
    not permitted; errors as `_permitted_path`. An address without files is permitted as it is."""
    beginning, _, query = uri.partition("?")
    values = dict(parse_qsl(query, keep_blank_values=True))
    for key in ("file", "truth"):
        if key in values:
            path = _permitted_path(values[key], settings)
            if path is None:
                return None
            values[key] = path
    return f"{beginning}?{urlencode(values)}" if {"file", "truth"} & values.keys() else uri


# --- edits of annotations --------------------------------------------------------------------------

# Eastings and northings on the earth are smaller.
FARTHEST_M = 1e7
BROWSER = r"^[0-9a-f]{16,40}$"
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]


class Edit(Body):
    """The fields of every edit: the run, the browser, and the person."""

    run: Number
    browser: Annotated[str, Field(pattern=BROWSER)]
    who: UserName

    @property
    def author(self) -> Author:
        """Author of the edit."""
        return Author(self.browser, self.who)


async def edited(dashboard: Dashboard, edit: Edit, payload: dict[str, Any], status: int = 200) -> Response:
    """Return a JSON response with the keys of `payload`, `serial`, the number of edits so far, and `undo` and
    `redo`, the numbers of edits of this browser that can be undone and redone, see `Store.steps`. Raises
    StemmapError if the store cannot be used.

    Args:
        dashboard: The dashboard.
        edit: The edit, with its browser.
        payload: Further keys and values of the response.
        status: HTTP status.
    """
    serial = dashboard.annotation_editor.serial
    steps = await dashboard.annotation_editor.read(lambda store, run: store.steps(run, edit.browser))
    undo, redo = steps or ({}, {})
    return json_reply({**payload, "serial": serial, "undo": undo, "redo": redo}, status)


async def apply_edit(
    dashboard: Dashboard,
    edit: Edit,
    change: Callable[Concatenate[Store, int, Author, P], T],
    *values: P.args,
    **named: P.kwargs,
) -> T:
    """Call a method of the store with the run and the author of an edit and further arguments, and return its
    result; see `AnnotationEditor.edit`, also for the errors."""
    return await dashboard.annotation_editor.edit(
        edit.run, lambda store: change(store, edit.run, edit.author, *values, **named)
    )
