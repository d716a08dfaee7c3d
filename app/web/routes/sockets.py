"""The two websockets: what the page is told, and the bridge to viser."""

from __future__ import annotations

from typing import Annotated

import msgspec
from fastapi import APIRouter
from msgspec import Meta
from starlette.websockets import WebSocket

from app.dashboard.dashboard import Dashboard
from app.dashboard.user import hand
from app.web.auth import role_of
from app.web.routes.access import Dash
from app.web.viser_proxy import bridge
from app.web.websocket_feed import telling

router = APIRouter()

_REFUSED = 1003
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
    role = role_of(browser.scope)
    with dashboard.pages.place(role) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        await browser.accept()
        async with telling(browser, dashboard.live):
            await _receive(browser, dashboard, may_touch=role == "owner")


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
            dashboard.selecting.cluster_soon(wanted.scan, wanted.cluster)
        else:
            dashboard.selecting.tree(wanted.tree)


@router.websocket("/viser")
@router.websocket("/viser/")
async def viser(browser: WebSocket, dashboard: Dash) -> None:
    """The 3D scene."""
    role, name = role_of(browser.scope), hand.get()

    def sign() -> None:
        dashboard.scene_hand = name

    with dashboard.scenes.place(role) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        await bridge(browser, dashboard.scene, looks_only=role != "owner", touched=sign)
