"""Runs the web server in this process: socket, connections whose request must arrive in time, printed link,
browser and signals."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import html
import logging
import os
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Awaitable, Callable, Iterable, Iterator
from pathlib import Path

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from app.common.memory import return_freed_memory
from app.common.settings import DEFAULT_PORT, MESSAGE_LIMIT, Settings
from app.dashboard.parameters import ParameterState
from app.web.auth import AccessTokens
from app.worker.protocol import Open
from app.worker.supervisor import WorkerProcess
from pipeline.errors import StemmapError

#: Longest time from the connection, or from the end of the response before, to the end of the header [s].
HEADER_S = 10.0
#: Most connections of one address that have not sent a request yet. Browsers open some in advance.
MOST_WAITING = 64


class HttpProtocol(H11Protocol):
    """Connection that is closed when the header of a request takes longer than HEADER_S, or when its address
    has MOST_WAITING connections without a request."""

    _header_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit, or abort the connection if its address has MOST_WAITING others without a
        request."""
        super().connection_made(transport)
        waiting = (c for c in self.connections if isinstance(c, HttpProtocol) and c._header_timer is not None)
        host = self.client[0] if self.client else ""
        if sum(other.client[0] == host for other in waiting if other.client) >= MOST_WAITING:
            transport.abort()
        else:
            self._limit_header()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the time limit."""
        self._unlimit_header()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Handle what has arrived; the time limit runs while the next request is not complete."""
        super().handle_events()
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            self._unlimit_header()
        elif self._header_timer is None:
            self._limit_header()

    def _limit_header(self) -> None:
        """Close the connection after HEADER_S, unless `_unlimit_header` is called before."""
        self._header_timer = self.loop.call_later(HEADER_S, self.transport.close)

    def _unlimit_header(self) -> None:
        """End the time limit, if it runs."""
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None


_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0;url={link}"><title>stemmap</title>
<p><a href="{link}">Open the dashboard</a></p></html>
"""


@contextlib.contextmanager
def page_that_leads_to(link: str) -> Iterator[Path]:
    """Yield the path of an HTML file that redirects a browser to a link, readable only by its owner; it is
    removed at the end of the context.

    Command-line arguments are visible to all users of a machine, so the link with its token is not passed to
    the browser.
    """
    number, name = tempfile.mkstemp(prefix="stemmap-", suffix=".html")  # readable by its owner only
    page = Path(name)
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(_PAGE.format(link=html.escape(link)))
        yield page
    finally:
        page.unlink(missing_ok=True)


def show_in_browser(page: Path) -> None:
    """Open a file in the default browser, if there is one. It may block until the browser has started."""
    import webbrowser

    with contextlib.suppress(webbrowser.Error):
        webbrowser.open(page.as_uri())


_PORTS_TRIED = 10
# A small send buffer: data that waits in the kernel for a slow link is outdated when it arrives.
_SEND_BUFFER = 128 * 1024
_GRACE_S = 1
# Messages of uvicorn about one client, which sends no HTTP, is refused, or does not read at the end.
_OF_CLIENTS = (
    "Invalid HTTP request",
    "ASGI callable returned without completing handshake",
    "Cancel %s running task(s), timeout graceful shutdown exceeded",
)
_OF_THE_PORT = (errno.EADDRINUSE, errno.EACCES)
_OTHER_HOST = "Give an address of this machine with --host, or omit it"


def serve(
    settings: Settings,
    *,
    source: Open,
    parameter_state: ParameterState,
) -> int:
    """Serve the dashboard until SIGINT or SIGTERM, and print which live runs were recorded; return the exit
    code, see `run_server`.

    Args:
        settings: Settings of the deployment.
        source: Source that is opened at the start.
        parameter_state: Parameters at the start.

    Raises:
        StemmapError: The port is in use, or the address is not an address of this machine.
        SystemExit: The dashboard fails at its start.
    """

    recordings: list[Path] = []

    async def make_app(port: int, tokens: AccessTokens) -> ASGIApp:
        nonlocal recordings
        worker = WorkerProcess()
        await worker.spawn()  # first: it imports its modules while this process imports those of the page
        from app.web.app import build

        app = build(
            settings,
            port=port,
            tokens=tokens,
            source=source,
            parameter_state=parameter_state,
            make_worker=lambda: worker,
        )
        recordings = app.state.dashboard.recordings
        return app

    try:
        return run_server(settings, make_app)
    finally:  # a signal ends the server by an exception
        for path in recordings:
            if path.is_file():  # without a message there is none
                print(f"Recording: {path}", flush=True)  # noqa: T201


def run_server(settings: Settings, make_app: Callable[[int, AccessTokens], Awaitable[ASGIApp]]) -> int:
    """Serve an application until SIGINT or SIGTERM and print its link; return the exit code: 0, or 1 if the
    server ended before it was ready.

    Args:
        settings: Settings of the deployment; without a token a random one is used.
        make_app: Awaited with port and tokens; returns the application. Its exceptions pass through.

    Raises:
        StemmapError: The port is in use, or the address is not an address of this machine.
        SystemExit: The application fails at its start; the code is that of uvicorn.
    """
    return_freed_memory()
    listening = bind(settings)
    port = listening.getsockname()[1]
    tokens = AccessTokens.of(settings)
    if settings.prints_viewer_link:
        print(f"View-only link: {link_of(settings, port, tokens.viewer)}", flush=True)  # noqa: T201

    async def served() -> bool:
        config, link = uvicorn_config(await make_app(port, tokens)), link_of(settings, port, tokens.owner)
        server = LinkedServer(config, settings, link)
        await server.serve(sockets=[listening])
        return server.started

    with contextlib.closing(listening):
        return 0 if asyncio.run(served()) else 1


def link_of(settings: Settings, port: int, token: str) -> str:
    """Return the link that opens the page and logs in with the token; for a server on any address it has the
    name of this machine.

    Args:
        settings: Settings with the host.
        port: Port of the server.
        token: Token of an owner or a viewer.
    """
    return f"http://{_name(settings.host)}:{port}/?token={token}"


def _is_of_this_server(record: logging.LogRecord) -> bool:
    """Return whether a message of uvicorn is about this server, and not about a client. A request whose
    answer is cancelled at the end is about its client, too."""
    is_cancelled = record.exc_info is not None and isinstance(record.exc_info[1], asyncio.CancelledError)
    return not is_cancelled and not str(record.msg).startswith(_OF_CLIENTS)


def uvicorn_config(app: ASGIApp) -> uvicorn.Config:
    """Return the uvicorn configuration of the application: without access log, since the first address
    contains the token, and without compression of websockets. Messages about single clients are filtered out
    of uvicorn's log."""
    logging.getLogger("uvicorn.error").addFilter(_is_of_this_server)
    return uvicorn.Config(
        app,
        http=HttpProtocol,
        ws="websockets-sansio",
        ws_max_size=MESSAGE_LIMIT,
        ws_per_message_deflate=False,  # point clouds do not compress well, and compression costs a core
        timeout_graceful_shutdown=_GRACE_S,
        server_header=False,
        log_level="warning",
        access_log=False,  # the first address contains the token
        lifespan="on",
    )


def bind(settings: Settings) -> socket.socket:
    """Return a listening socket on the requested port or, without one, on the first free of 10 ports from
    DEFAULT_PORT on; another port than the first is printed.

    Raises:
        StemmapError: No port is free, the name of the host is unknown, or the address is not an address of
            this machine.
    """
    first = DEFAULT_PORT if settings.port is None else settings.port
    listening = first_free(
        settings.host, range(first, first + (_PORTS_TRIED if settings.port is None else 1))
    )
    if isinstance(listening, socket.socket):
        if first not in (0, port := listening.getsockname()[1]):
            print(f"Port {first} is in use; {port} is taken instead.", flush=True)  # noqa: T201
        return listening
    reason = listening
    if isinstance(reason, socket.gaierror):
        raise StemmapError(
            f"no address is known by this name: {reason.strerror}", where=settings.host, remedy=_OTHER_HOST
        )
    other_port = "Give another port with --port, or 0 for any free one"
    raise StemmapError(
        f"cannot listen: {(reason.strerror or str(reason)).lower()}",
        where=f"{settings.host}:{first}",
        remedy=other_port if reason.errno in _OF_THE_PORT else _OTHER_HOST,
    )


def first_free(host: str, ports: Iterable[int]) -> socket.socket | OSError:
    """Return a listening socket on the first free of some ports, or the reason why there is none. An error
    that does not depend on the port ends the search."""
    reason = OSError("no port was tried")
    for port in ports:
        try:
            return bound(host, port)
        except OSError as error:
            reason = error
            if error.errno not in _OF_THE_PORT:
                break
    return reason


def bound(host: str, port: int) -> socket.socket:
    """Return a listening socket on a port; 0 is any free one.

    Raises:
        OSError: The port is in use, the name is unknown, or the address is not an address of this machine.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listening = socket.socket(family, kind, protocol)
    try:
        if os.name == "posix":  # on other systems it would permit two servers on one port
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        listening.bind(address)
        listening.listen(128)
    except OSError:
        listening.close()
        raise
    return listening


class LinkedServer(uvicorn.Server):
    """uvicorn server that prints its link when it is ready and ends without a traceback."""

    def __init__(self, config: uvicorn.Config, settings: Settings, link: str) -> None:
        super().__init__(config)
        self._settings = settings
        self._link = link
        self._until_the_end = contextlib.ExitStack()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start; then print the link, a warning if the network can reach the server, and open the browser if
        that is requested and there is a display."""
        await super().startup(sockets)
        if not self._settings.loopback:
            print(  # noqa: T201
                f"Warning: {self._settings.host} can be reached from the network, and what is sent is not "
                "encrypted. Whoever has the link can use this dashboard.",
                file=sys.stderr,
            )
        print(f"stemmap is ready: {self._link}", flush=True)  # noqa: T201
        if self._settings.opens_browser and _has_display():
            page = self._until_the_end.enter_context(page_that_leads_to(self._link))
            threading.Thread(target=show_in_browser, args=(page,), daemon=True).start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Shut down and remove temporary files."""
        self._until_the_end.close()
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """End on a signal; unlike uvicorn's, do not raise it again afterwards."""
        before = {s: signal.signal(s, self.handle_exit) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _has_display() -> bool:
    """Return whether a browser can be opened; always True on macOS and Windows."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _name(host: str) -> str:
    """Return the host as it is written in a link: the name of this machine for 0.0.0.0 and ::, which mean all
    its addresses, and other IPv6 addresses in brackets."""
    if host in ("0.0.0.0", "::"):  # noqa: S104 - compared with, not bound to
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host
