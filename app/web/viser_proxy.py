"""Proxy to viser: its client page, and a bridge between the websocket of a browser and that of viser.

viser has no authentication. It listens on loopback only, requires a secret that only the bridge knows, and
receives only permitted messages. Without the filter, any browser could open a public tunnel or upload files.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import msgspec
from msgspec import Meta
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

LARGEST = 64 * 1024

_Name = Annotated[str, Meta(max_length=300)]
_Id = Annotated[str, Meta(max_length=100)]
_Text = Annotated[str, Meta(max_length=2000)]
_Vector = tuple[float, float, float]
_Pixel = tuple[float, float]
_Pixels = Annotated[int, Meta(ge=0, le=100_000)]
_Index = Annotated[int, Meta(ge=0, le=2**31)] | None
_Modifier = _Id | None
_Value = bool | int | float | _Text | Annotated[list[bool | int | float | _Text], Meta(max_length=16)]


class _FromBrowser(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type"):
    """Message of a browser; viser stores the kind of a message in the field `type`."""


class _Camera(_FromBrowser, frozen=True, tag="ViewerCameraMessage"):
    wxyz: tuple[float, float, float, float]
    position: _Vector
    fov: float
    near: float
    far: float
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector


class _Click(_FromBrowser, frozen=True, tag="SceneNodeClickMessage"):
    name: _Name
    instance_index: _Index
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: _Pixel
    modifier: _Modifier = None
    owner: _Name = ""


class _Updates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Permitted changes of a control: only its value."""

    value: _Value


class _Gui(_FromBrowser, frozen=True, tag="GuiUpdateMessage"):
    uuid: _Id
    updates: _Updates


class _Command(_FromBrowser, frozen=True, tag="CommandTriggerMessage"):
    uuid: _Id


_Allowed = _Camera | _Click | _Gui | _Command
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(_Allowed)
# Each browser has its own camera; all other messages affect everybody.
_viewers_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(_Camera)


def is_allowed(message: bytes, *, looks_only: bool = False) -> bool:
    """Return whether a browser may send a message to viser: a known kind of at most 64 kB, without further
    fields, NaN or infinity.

    Args:
        message: The message, as msgpack.
        looks_only: Whether the browser has a view-only link; then only the pose of its camera is allowed.
    """
    if len(message) > LARGEST:
        return False
    try:
        decoded = (_viewers_decoder if looks_only else _decoder).decode(message)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    return _is_finite(msgspec.to_builtins(decoded))


def _is_finite(value: object) -> bool:
    """Return whether a value of dicts and lists contains no NaN or infinity."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_is_finite, value))
    return True


_log = logging.getLogger(__name__)

_LARGEST_FROM_VISER = 64 * 1024 * 1024
# Short queues between viser and a slow browser: waiting data is outdated when it arrives.
_QUEUE, _SOCKET_BUFFER = 2, 256 * 1024
_PROTOCOLS = 4
_TRY_AGAIN_LATER = 1013


def client_page() -> Path:
    """Return the client page of the installed viser version."""
    import viser

    return Path(viser.__file__).parent / "client" / "build" / "index.html"


async def bridge(
    browser: WebSocket,
    *,
    port: int,
    secret: str,
    user: str,
    looks_only: bool,
) -> None:
    """Carry messages between a browser and viser until one of them leaves, then close the websocket. If viser
    cannot be reached, the websocket is closed with 1013 before it is accepted, which is logged. Text messages
    of the browser and those that `is_allowed` rejects are dropped; all messages of viser pass.

    Args:
        browser: The websocket of the browser, not accepted yet.
        port, secret: Port of viser on 127.0.0.1, and the secret that it requires.
        user: Name of the person at the browser, to whom its changes are credited.
        looks_only: Whether the browser may move its own camera and nothing else.
    """
    protocols = [Subprotocol(p) for p in browser.scope["subprotocols"] if p.startswith("viser-v")]
    try:
        upstream = await _connect(port, secret, user, protocols[:_PROTOCOLS])
    except (OSError, InvalidHandshake, TimeoutError) as error:
        _log.warning("the 3D scene cannot be reached: %s", error)
        await browser.close(_TRY_AGAIN_LATER)
        return
    async with upstream:
        await browser.accept(upstream.subprotocol)
        await _carry(browser, upstream, looks_only)
    if browser.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it has disconnected
            await browser.close()


async def _connect(port: int, secret: str, user: str, protocols: list[Subprotocol]) -> ClientConnection:
    """Return a connection to viser.

    Args:
        port, secret: Port of viser, and the secret that it requires.
        user: Name of the person.
        protocols: Subprotocols of the browser.

    Raises:
        OSError, InvalidHandshake, TimeoutError: viser does not answer or refuses the connection.
    """
    loopback = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    loopback.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER)
    loopback.setblocking(False)
    try:
        await asyncio.get_running_loop().sock_connect(loopback, ("127.0.0.1", port))
        return await connect(
            f"ws://127.0.0.1:{port}/",
            sock=loopback,
            subprotocols=protocols or None,
            additional_headers={"X-Stemmap-Secret": secret, "X-Stemmap-User": quote(user)},
            compression=None,
            max_size=_LARGEST_FROM_VISER,
            max_queue=_QUEUE,
            proxy=None,
            close_timeout=1,
        )
    except BaseException:
        loopback.close()
        raise


async def _carry(browser: WebSocket, upstream: ClientConnection, looks_only: bool) -> None:
    """Forward messages in both directions until either side disconnects; errors are logged.

    Args:
        browser: Websocket of the browser.
        upstream: Connection to the 3D scene.
        looks_only: Whether commands of the browser that change the scene are dropped.
    """
    directions = {
        asyncio.create_task(_to_browser(browser, upstream)),
        asyncio.create_task(_to_viser(browser, upstream, looks_only)),
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
    """Forward messages of viser until one side disconnects."""
    # Sending blocks while the socket of the browser is full; nothing is then received from viser.
    with contextlib.suppress(ConnectionClosed, WebSocketDisconnect):
        async for message in upstream:
            await (browser.send_bytes(message) if isinstance(message, bytes) else browser.send_text(message))


async def _to_viser(browser: WebSocket, upstream: ClientConnection, looks_only: bool) -> None:
    """Forward the allowed binary messages of the browser until one side disconnects; all others are dropped.

    Args:
        browser: Websocket of the browser.
        upstream: Connection to viser.
        looks_only: Whether only messages of the camera are allowed.
    """
    with contextlib.suppress(ConnectionClosed):
        while (event := await browser.receive())["type"] != "websocket.disconnect":
            message = event.get("bytes")
            if message is not None and is_allowed(message, looks_only=looks_only):
                await upstream.send(message)
