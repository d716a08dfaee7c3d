"""viser's server for the dashboard: local, and only for requests with a secret.

The only module that uses private parts of viser; `tests/app/scene/test_viser_contract.py` checks them.
"""

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
from urllib.parse import unquote

import numpy as np
import viser
import websockets.asyncio.server
from viser import _messages
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from app.common.user import SOMEBODY, current_user, is_user_name

SECRET_HEADER = "X-Stemmap-Secret"  # noqa: S105 - the name, not the secret
USER_HEADER = "X-Stemmap-User"

_starting = threading.Lock()


def start_server(secret: str) -> viser.ViserServer:
    """Return a viser server on 127.0.0.1 and a free port that refuses every request without the secret.

    Args:
        secret: Required value of the header `X-Stemmap-Secret`.
    """
    with _guarded_handshakes(secret), silenced():
        server = viser.ViserServer(host="127.0.0.1", port=0, label="stemmap", verbose=False)
    _refuse_tunnels(server)
    _take_values_only(server)
    return server


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress messages on standard output inside the context, because the command line uses it. It applies
    to all threads of the process."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


@contextlib.contextmanager
def _guarded_handshakes(secret: str) -> Iterator[None]:
    """Inside the context, a server of `websockets` that starts checks the secret of each handshake first. One
    context at a time is active; others wait."""
    # viser has no login, and every user of this machine can reach its port. It passes its own
    # `process_request` to websockets.asyncio.server.serve inside one long method, so nothing can be
    # overridden. While it starts (its constructor waits until the socket is bound) `serve` is wrapped so that
    # the secret is checked first. The lock keeps two scenes from wrapping each other.
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
    """Return a `process_request` of `websockets` that answers 403 without the secret. With it, it sets the
    current user from the header USER_HEADER (percent-encoded; SOMEBODY if it is missing or no valid name),
    and returns the answer of `then`, or None, which accepts the connection.

    Args:
        secret: Required value of the header SECRET_HEADER.
        then: viser's own `process_request`, a function or coroutine function; None for none.
    """

    async def process_request(connection: ServerConnection, request: Request) -> Response | None:
        given = request.headers.get(SECRET_HEADER, "")
        if not hmac.compare_digest(given.encode(), secret.encode()):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "Open the dashboard instead.\n")
        # viser handles all messages of a connection in tasks that copy this context, so a change of a slider
        # is credited to the person whose connection sent it.
        name = unquote(request.headers.get(USER_HEADER, ""))
        current_user.set(name if is_user_name(name) else SOMEBODY)
        answer = None if then is None else then(connection, request)
        return await answer if inspect.isawaitable(answer) else answer

    return process_request


def messages_sent(server: viser.ViserServer) -> int:
    """Return how many message numbers the server has used since it started, for all browsers together."""
    return server._websock_server.get_message_buffer().message_counter


def send_properties(node: viser.SceneNodeHandle, content: dict[str, Any]) -> None:
    """Set properties of a node by one message.

    viser sends each property by a message of its own and keeps the last one of each for browsers that connect
    later. Such a browser may get the colours before the positions, if only the positions changed last.

    Args:
        node: The node.
        content: Dict from names of properties to values; an array is sent with the type of the present one.
    """
    properties = node._impl.props
    for name, value in content.items():
        present = getattr(properties, name)
        if isinstance(present, np.ndarray):
            value = np.array(value, present.dtype)  # a copy, because viser packs it later
        setattr(properties, name, value)
    updates = {name: getattr(properties, name) for name in content}
    node._impl.api._queue_scene_message(_messages.SceneNodeUpdateMessage(node.name, updates))


def _refuse_tunnels(server: viser.ViserServer) -> None:
    """Remove viser's handlers of requests for a public address."""
    # Any client could request a public address of this machine; without a handler the message is ignored.
    for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)


def _take_values_only(server: viser.ViserServer) -> None:
    """Replace viser's handler of changed widgets by one that ignores messages with anything but a value, and
    values of the wrong type."""
    # viser sets any attribute of a widget that a client names. Only the value may be set here.
    handle = server.gui._handle_gui_updates
    server._websock_server.unregister_handler(_messages.GuiUpdateMessage, handle)

    async def guarded(client_id: Any, message: _messages.GuiUpdateMessage) -> None:  # noqa: ANN401
        if set(message.updates) != {"value"}:
            return
        with contextlib.suppress(TypeError, ValueError, OverflowError):  # not a value of this slider's type
            await handle(client_id, message)

    server._websock_server.register_handler(_messages.GuiUpdateMessage, guarded)


def add_posed(scene: viser.SceneApi, name: str) -> viser.FrameHandle:
    """Add a frame without axes at the origin of its parent, and send its pose.

    viser does not send the default pose of a new node. A node that is removed and added again reaches a
    browser as a change, so it would keep the pose of the last run until its pose differs from the origin.
    """
    frame = scene.add_frame(name, show_axes=False)
    frame.position, frame.wxyz = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)  # only the last of both is sent
    frame.position, frame.wxyz = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    return frame


def set_value(widget: Any, value: float | int | bool | str) -> None:  # noqa: ANN401
    """Set the value of a widget from code; all browsers receive it."""
    widget.value = value
