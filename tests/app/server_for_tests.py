"""The web application with a fake worker and a fake scene, in process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import httpx
import uvicorn
from fastapi import FastAPI
from starlette.routing import BaseRoute, Route, WebSocketRoute

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import ParameterState
from app.web.app import ROUTERS, build
from app.web.auth import AccessTokens, session_value
from app.web.serving import bind, uvicorn_config
from app.worker.protocol import Open
from tests.app.fake_scene import FakeScene
from tests.app.fakes import FakeWorker

PORT = 8765
HOST = f"127.0.0.1:{PORT}"
TOKEN = "a-token-for-the-tests-only"
#: When the sessions of the tests end [Unix time].
ENDS = 4_000_000_000
BEARER = {"Authorization": f"Bearer {TOKEN}"}
#: A client that may do all, and what it talks to.
Running = tuple[httpx.AsyncClient, Dashboard]
COOKIE = {"Cookie": f"stemmap_{PORT}={session_value(TOKEN, PORT, ENDS)}"}


def build_app(
    settings: Settings | None = None, *, scene: FakeScene | None = None, port: int = PORT
) -> FastAPI:
    return build(
        settings or Settings(),
        port=port,
        tokens=AccessTokens(TOKEN),
        source=Open("fake:"),
        parameter_state=ParameterState(),
        make_scene=lambda _dashboard, _loop: scene or FakeScene(),
        make_worker=FakeWorker,
    )


@asynccontextmanager
async def running(
    settings: Settings | None = None,
) -> AsyncIterator[tuple[httpx.AsyncClient, Dashboard]]:
    """A client of a started application, and its dashboard."""
    app = build_app(settings)
    transport = httpx.ASGITransport(app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client,
    ):
        yield client, app.state.dashboard


@asynccontextmanager
async def served(scene: FakeScene | None = None) -> AsyncIterator[tuple[str, Dashboard]]:
    """The application on a real port; gives `host:port` and its dashboard."""
    settings = Settings(port=0)
    listening = bind(settings)
    port = listening.getsockname()[1]
    app = build_app(settings, scene=scene, port=port)
    server = uvicorn.Server(uvicorn_config(app))
    task = asyncio.create_task(server._serve([listening]))
    while not server.started:
        await asyncio.sleep(0.01)
    try:
        yield f"127.0.0.1:{port}", app.state.dashboard
    finally:
        server.should_exit = True
        await task


def routes() -> set[tuple[str, str]]:
    """Method and path of every route; websockets have the method WS."""
    return {pair for router in ROUTERS for route in router.routes for pair in pairs_of(route)}


def pairs_of(route: BaseRoute) -> Iterator[tuple[str, str]]:
    """Method and path of a route."""
    if isinstance(route, WebSocketRoute):
        yield "WS", route.path
    else:
        assert isinstance(route, Route)
        for method in (route.methods or set()) - {"HEAD"}:
            yield method, route.path
