"""viser behind our own port: its page, and a bridge between a browser's websocket and viser's.

viser has no login, so it listens on this machine only, asks for a secret that only the bridge knows,
and hears only messages that a browser may send.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from app.web.viser_messages import is_allowed

_log = logging.getLogger(__name__)

_LARGEST_FROM_VISER = 64 * 1024 * 1024
# Little is kept between viser and a slow browser: what waits there is old when it arrives.
_QUEUE, _SOCKET_BUFFER = 2, 256 * 1024
_PROTOCOLS = 4
_TRY_AGAIN_LATER = 1013


class ViserServer(Protocol):
    """Where viser listens; the port may change when it is renewed."""

    @property
    def port(self) -> int: ...

    secret: str


def client_page() -> Path:
    """The page of the installed viser, which speaks the protocol of exactly this version."""
    import viser

    return Path(viser.__file__).parent / "client" / "build" / "index.html"


async def bridge(
    browser: WebSocket,
    viser: ViserServer,
    *,
    looks_only: bool = False,
    touched: Callable[[], None] = lambda: None,
) -> None:
    """Carry messages between a browser and viser until one of them leaves.

    Args:
        browser: Not accepted yet.
        viser: Where viser listens.
        looks_only: The browser may move its own camera and nothing else.
        touched: Called before a message that may change something.
    """
    touched = (lambda: None) if looks_only else touched
    protocols = [Subprotocol(p) for p in browser.scope["subprotocols"] if p.startswith("viser-v")]
    try:
        upstream = await _connect(viser, protocols[:_PROTOCOLS])
    except (OSError, InvalidHandshake, TimeoutError) as error:
        _log.warning("the 3D scene cannot be reached: %s", error)
        await browser.close(_TRY_AGAIN_LATER)
        return
    async with upstream:
        await browser.accept(upstream.subprotocol)
        await _carry(browser, upstream, looks_only, touched)
    if browser.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it has just left by itself
            await browser.close()


async def _connect(viser: ViserServer, protocols: list[Subprotocol]) -> ClientConnection:
    loopback = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    loopback.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER)
    loopback.setblocking(False)
    try:
        await asyncio.get_running_loop().sock_connect(loopback, ("127.0.0.1", viser.port))
        return await connect(
            f"ws://127.0.0.1:{viser.port}/",
            sock=loopback,
            subprotocols=protocols or None,
            additional_headers={"X-Stemmap-Secret": viser.secret},
            compression=None,
            max_size=_LARGEST_FROM_VISER,
            max_queue=_QUEUE,
            proxy=None,
            close_timeout=1,
        )
    except BaseException:
        loopback.close()
        raise


async def _carry(
    browser: WebSocket, upstream: ClientConnection, looks_only: bool, touched: Callable[[], None]
) -> None:
    """Both directions at once; the first that ends, ends the other."""
    directions = {
        asyncio.create_task(_to_browser(browser, upstream)),
        asyncio.create_task(_to_viser(browser, upstream, looks_only, touched)),
    }
    try:
        await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in directions:
            task.cancel()
        results = await asyncio.gather(*directions, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            _log.warning("the bridge to the 3D scene broke", exc_info=result)


async def _to_browser(browser: WebSocket, upstream: ClientConnection) -> None:
    # Sending waits while the browser's socket is full, and then nothing more is taken from viser.
    with contextlib.suppress(ConnectionClosed, WebSocketDisconnect):
        async for message in upstream:
            await (browser.send_bytes(message) if isinstance(message, bytes) else browser.send_text(message))


async def _to_viser(
    browser: WebSocket, upstream: ClientConnection, looks_only: bool, touched: Callable[[], None]
) -> None:
    with contextlib.suppress(ConnectionClosed):
        while (event := await browser.receive())["type"] != "websocket.disconnect":
            message = event.get("bytes")
            if message is not None and is_allowed(message, looks_only=looks_only):
                touched()
                await upstream.send(message)
