"""The two websockets: the live states of the page, and the bridge to viser."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Annotated

import msgspec
from fastapi import APIRouter
from msgspec import Meta
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.common.user import current_user
from app.dashboard.broadcast import Broadcast, Listener
from app.dashboard.dashboard import Dashboard
from app.web.responses import LARGEST_NUMBER
from app.web.routes.access import Bounds, CallerRole, Dash
from app.web.viser_proxy import bridge

router = APIRouter()

_REFUSED = 1003
_TRY_AGAIN_LATER = 1013

_Number = Annotated[int, Meta(ge=0, le=LARGEST_NUMBER)]


class _Select(msgspec.Struct, frozen=True, tag="select"):
    """Select a tree for everybody; null selects nothing."""

    tree: _Number | None


class _SelectCluster(msgspec.Struct, frozen=True, tag="select_cluster"):
    """Select a cluster of a scan for everybody, with the tree that it belongs to."""

    scan: _Number
    cluster: _Number


_decoder: msgspec.json.Decoder[_Select | _SelectCluster] = msgspec.json.Decoder(_Select | _SelectCluster)


@router.websocket("/api/live")
async def live(browser: WebSocket, dashboard: Dash, bounds: Bounds, role: CallerRole) -> None:
    """WebSocket /api/live: send states as they change, the newest of each kind, and receive selections; those
    of viewers are ignored. The websocket is closed with 1013 before it is accepted if too many pages are
    open, and with 1003 after an invalid message."""
    with bounds.pages.place(role) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        await browser.accept()
        async with telling(browser, dashboard.live):
            await _receive(browser, dashboard, may_select=role == "owner")


async def _receive(browser: WebSocket, dashboard: Dashboard, *, may_select: bool) -> None:
    """Process the selections of a browser until it disconnects; an invalid message closes the websocket
    (1003).

    Args:
        browser: Websocket of the browser.
        dashboard: The dashboard, whose selection changes.
        may_select: Whether selections are processed; otherwise they are ignored.
    """
    while (event := await browser.receive())["type"] != "websocket.disconnect":
        try:
            wanted = _decoder.decode(event.get("text") or b"")
        except (msgspec.MsgspecError, UnicodeDecodeError):
            await browser.close(_REFUSED, "not a message of the page")
            return
        if not may_select:  # the selection is shared by everybody
            continue
        if isinstance(wanted, _SelectCluster):
            dashboard.selector.cluster_soon(wanted.scan, wanted.cluster)
        else:
            dashboard.selector.tree(wanted.tree)


@router.websocket("/viser")
@router.websocket("/viser/")
async def viser(browser: WebSocket, dashboard: Dash, bounds: Bounds, role: CallerRole) -> None:
    """WebSocket /viser: connect the browser with the 3D scene; viewers cannot change it. The websocket is
    closed with 1013 before it is accepted if too many scenes are open."""
    with bounds.scenes.place(role) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        scene = dashboard.scene
        await bridge(
            browser,
            port=scene.port,
            secret=scene.secret,
            user=current_user.get(),
            looks_only=role != "owner",
        )


@contextlib.asynccontextmanager
async def telling(browser: WebSocket, live: Broadcast) -> AsyncIterator[None]:
    """Send all state changes to a browser while the context is active.

    Args:
        browser: Websocket of the browser.
        live: Broadcast of the dashboard.
    """
    with live.listener() as listener:
        sending = asyncio.create_task(_send(browser, listener))
        try:
            yield
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending


async def _send(browser: WebSocket, listener: Listener) -> None:
    """Send the messages of a listener to a browser without end."""
    async for message in listener.messages():
        await browser.send_text(message.decode())
