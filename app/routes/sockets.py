"""The two websockets: what the page is told, and the bridge to viser."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated

import msgspec
from fastapi import APIRouter
from msgspec import Meta
from starlette.websockets import WebSocket, WebSocketDisconnect

from app.dashboard import Dashboard
from app.hands import hand
from app.live import Listener
from app.routes.access import Dash
from app.security import role_of
from app.viser_bridge import bridge

router = APIRouter()

_REFUSED = 1003
_MOST_BROWSERS = 50
_TRY_AGAIN_LATER = 1013


_Number = Annotated[int, Meta(ge=0, lt=2**31)]


class _Select(msgspec.Struct, frozen=True, tag="select"):
    """Select a tree everywhere; null selects nothing."""

    tree: _Number | None


class _SelectCluster(msgspec.Struct, frozen=True, tag="select_cluster"):
    """Select a cluster of a scan everywhere, with the tree that it is a view of."""

    scan: _Number
    cluster: _Number


_decoder: msgspec.json.Decoder[_Select | _SelectCluster] = msgspec.json.Decoder(_Select | _SelectCluster)


@router.websocket("/api/live")
async def live(browser: WebSocket, dashboard: Dash) -> None:
    """States as they change, newest wins; takes selections."""
    if dashboard.live.listeners >= _MOST_BROWSERS:
        await browser.close(_TRY_AGAIN_LATER)
        return
    await browser.accept()
    with dashboard.live.listener() as listener:
        sending = asyncio.create_task(_send(browser, listener))
        try:
            await _receive(browser, dashboard, may_touch=role_of(browser.scope) == "owner")
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending


async def _send(browser: WebSocket, listener: Listener) -> None:
    async for message in listener.messages():
        await browser.send_text(message.decode())


async def _receive(browser: WebSocket, dashboard: Dashboard, *, may_touch: bool) -> None:
    while (event := await browser.receive())["type"] != "websocket.disconnect":
        try:
            wanted = _decoder.decode(event.get("text") or b"")
        except (msgspec.MsgspecError, UnicodeDecodeError):
            await browser.close(_REFUSED, "not a message of the page")
            return
        if not may_touch:  # a selection is everybody's
            continue
        if isinstance(wanted, _SelectCluster):
            dashboard.select_cluster_soon(wanted.scan, wanted.cluster)
        else:
            await dashboard.select_tree(wanted.tree)


@router.websocket("/viser")
@router.websocket("/viser/")
async def viser(browser: WebSocket, dashboard: Dash) -> None:
    """The 3D scene."""
    if dashboard.scene_viewers >= _MOST_BROWSERS:
        await browser.close(_TRY_AGAIN_LATER)
        return
    name = hand.get()

    def sign() -> None:
        dashboard.scene_hand = name

    dashboard.scene_viewers += 1
    try:
        await bridge(browser, dashboard.scene, looks_only=role_of(browser.scope) != "owner", touched=sign)
    finally:
        dashboard.scene_viewers -= 1
