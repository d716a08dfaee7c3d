"""viser's server as the dashboard needs it: on this machine only, and only for who knows the secret."""

from __future__ import annotations

import contextlib
import functools
import hmac
import http
import inspect
import io
import threading
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

SECRET_HEADER = "X-Stemmap-Secret"  # noqa: S105 - the name, not the secret

_starting = threading.Lock()


def start_server(secret: str) -> viser.ViserServer:
    """A viser server on 127.0.0.1 and a free port that refuses every request without the secret.

    Args:
        secret: What the header `X-Stemmap-Secret` must hold.
    """
    with _guarded_handshakes(secret), silenced():
        server = viser.ViserServer(host="127.0.0.1", port=0, label="stemmap", verbose=False)
    _refuse_tunnels(server)
    _take_values_only(server)
    return server


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """viser greets and parts on standard output, which belongs to the command line."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _guarded_handshakes(secret: str) -> Iterator[None]:
    # viser has no login and its port can be reached by everybody on this machine. It hands its own
    # `process_request` to websockets.asyncio.server.serve inside of one long method, so there is nothing to
    # override; while it starts (its constructor waits until the socket is bound) `serve` is wrapped so that
    # our check runs first. The lock keeps two scenes from wrapping one another.
    with _starting:
        serve = websockets.asyncio.server.serve

        @functools.wraps(serve)
        def guarded_serve(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - handed through untouched
            kwargs["process_request"] = _check_first(secret, kwargs.get("process_request"))
            return serve(*args, **kwargs)

        websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _check_first(secret: str, then: Callable[..., Any] | None) -> Callable[..., Any]:
    async def process_request(connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get(SECRET_HEADER, "")
        if not hmac.compare_digest(given.encode(), secret.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Open the dashboard instead.\n")
        answer = None if then is None else then(connection, request)
        return await answer if inspect.isawaitable(answer) else answer

    return process_request


def _refuse_tunnels(server: viser.ViserServer) -> None:
    # Any client could ask for a public address of this machine; nobody answers that message any more.
    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)


def _take_values_only(server: viser.ViserServer) -> None:
    # viser sets whatever attribute of a slider a client names. Ours only ever change their value.
    handle = server.gui._handle_gui_updates
    server._websock_server.unregister_handler(_messages.GuiUpdateMessage, handle)

    async def guarded(client_id: Any, message: _messages.GuiUpdateMessage) -> None:  # noqa: ANN401
        if set(message.updates) != {"value"}:
            return
        with contextlib.suppress(TypeError, ValueError, OverflowError):  # not a value of this slider's type
            await handle(client_id, message)

    server._websock_server.register_handler(_messages.GuiUpdateMessage, guarded)
