"""Web server of a fleet: the page of all robots on one port, their dashboards on the ports after it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace

from fastapi import APIRouter, FastAPI, Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.common.settings import Settings
from app.dashboard.parameters import ParameterState
from app.fleet.fleet import Fleet
from app.fleet.remote import RemoteRobots
from app.fleet.robots import Watching
from app.robot.address import ZenohAddress
from app.web.app import guarded
from app.web.auth import new_token, role_of, viewer_token
from app.web.responses import error_reply
from app.web.routes.page import access, lead_on, page_answer, page_file
from app.web.serving import LinkedServer, bind, link_of, uvicorn_config
from app.web.static_files import page_folder
from app.web.websocket_feed import telling
from app.worker.numba_warmup import PATIENCE_S
from app.worker.protocol import Open

WARMING = python_module("app.worker.numba_warmup", "warm_up")


async def warm_kernels(command: Sequence[str] = WARMING) -> None:
    """Compile the kernels of the mapper in a child process, so that not every worker does.

    Raises:
        StemmapError: The process cannot be started.
    """
    child = await ChildProcess.start(command)
    try:
        with contextlib.suppress(TimeoutError, ProtocolError):
            await child.receive(object, PATIENCE_S)  # None when it ends
    finally:
        await child.end()


_TRY_AGAIN_LATER, _REFUSED = 1013, 1003

router = APIRouter()


def build_fleet(
    settings: Settings,
    *,
    port: int,
    token: str,
    fleet: Fleet,
    watching: Watching | RemoteRobots | None = None,
) -> FastAPI:
    """The application.

    Args:
        settings: Of the deployment.
        port: On which it is served, for Host and Origin.
        token: That browsers must show.
        fleet: The robots; watching: what adds further ones.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        fleet.start()
        if watching is not None:
            watching.start()
        try:
            yield
        finally:
            if watching is not None:
                await watching.close()
            await fleet.close()

    app = guarded(settings, port=port, token=token, lifespan=lifespan)
    app.state.fleet, app.state.fleet_port = fleet, None
    app.include_router(router)
    app.add_api_route("/api/access", access, methods=["GET"])
    app.add_api_route("/static/{path:path}", page_file, methods=["GET"])
    return app


@router.get("/")
def fleet_page(request: Request) -> Response:
    """The page of all robots."""
    return page_answer(request, page_folder() / "fleet.html")


@router.get("/robots/{name:path}")
def robot_page(request: Request, name: str) -> Response:
    """Lead on to a robot's own dashboard, with the token that who asks may use there."""
    fleet: Fleet = request.app.state.fleet
    member = fleet.members.get(name)
    if member is None:
        return error_reply(404, "there is no such robot", where=name[:200])
    if not member.answers:
        remedy = (
            "The terminal shows why" if member.ended else "Try again in a moment; its card shows how it goes"
        )
        return error_reply(503, "its dashboard does not answer", where=name[:200], remedy=remedy)
    return lead_on(request, member.port)


@router.websocket("/api/fleet")
async def fleet_live(browser: WebSocket) -> None:
    """States of all robots as they change; nothing is taken."""
    fleet: Fleet = browser.app.state.fleet
    with fleet.pages.place(role_of(browser.scope)) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        await browser.accept()
        async with telling(browser, fleet.live):
            if (await browser.receive())["type"] != "websocket.disconnect":
                await browser.close(_REFUSED, "nothing is taken here")


def serve_fleet(
    settings: Settings,
    *,
    sources: Mapping[str, Open],
    make_parameters: Callable[[], ParameterState],
    watched: tuple[ZenohAddress, Open] | None,
    open_browser: bool,
    viewer: bool = False,
) -> int:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: Of the deployment.
        sources: What is open from the start, by name.
        make_parameters: The parameters that each dashboard begins with.
        watched: A router whose robots are added as they come, and how they are opened.
        open_browser: Whether to show the page.
        viewer: Whether to print the view-only link.

    Raises:
        StemmapError: The port is in use, or the address is not one of this machine.
    """
    listening = bind(settings)
    port = listening.getsockname()[1]
    token = settings.token or new_token()
    if viewer:
        print(f"View-only link: {link_of(settings, port, viewer_token(token))}", flush=True)  # noqa: T201

    async def served() -> bool:
        fleet = Fleet(replace(settings, port=port), port, token, make_parameters, warm=warm_kernels)
        for name, source in sources.items():
            fleet.add(name, source)
        watching: Watching | RemoteRobots | None = None
        if watched is not None:
            address, source = watched
            there = address.mapped_there
            watching = RemoteRobots(fleet, address.uri) if there else Watching(fleet, address, source)
        app = build_fleet(settings, port=port, token=token, fleet=fleet, watching=watching)
        server = LinkedServer(
            uvicorn_config(app, settings), settings, link_of(settings, port, token), open_browser=open_browser
        )
        await server.serve(sockets=[listening])
        return server.started

    with contextlib.closing(listening):
        return 0 if asyncio.run(served()) else 1
