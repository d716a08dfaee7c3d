"""The web application of a fleet: one page of all robots, and the way to the dashboard of each."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Protocol

from fastapi import APIRouter, FastAPI, Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from app.common.settings import Settings
from app.fleet.fleet import Fleet
from app.web.app import guarded
from app.web.auth import role_of
from app.web.responses import error_reply
from app.web.routes.page import access, lead_on, page_answer, page_file
from app.web.static_files import page_folder
from app.web.websocket_feed import telling

_TRY_AGAIN_LATER, _REFUSED = 1013, 1003

router = APIRouter()


class Watching(Protocol):
    """Adds robots to a fleet as they come."""

    def start(self) -> None: ...
    async def close(self) -> None: ...


def build_fleet(
    settings: Settings, *, port: int, token: str, fleet: Fleet, watching: Watching | None = None
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
