"""What the routes depend on: the dashboard, the role of the request, and the limits of viewers."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import nullcontext
from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.web.auth import Role, is_local, role_of
from app.web.connection_limits import Limits


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
    """Whether the request may name any file of this machine, or only recordings of the data folders."""
    settings = _settings(connection)
    if role_of(connection.scope) != "owner" or settings.files == "folders":
        return False
    return settings.files == "any" or (settings.loopback and is_local(connection.headers))


async def _viewer_turn(connection: HTTPConnection) -> AsyncIterator[None]:
    """Make viewers wait for their turn, because the request costs work."""
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
