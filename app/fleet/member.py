"""One robot of a fleet: its dashboard, served on a port of its own."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections.abc import Iterator

import uvicorn
from fastapi import FastAPI

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.web.serving import bound, uvicorn_config
from app.worker.protocol import Open
from pipeline.errors import StemmapError

#: Ports tried after the fleet's own, so that who opens a firewall knows which.
PORTS_TRIED = 100


class Member:
    """A dashboard and its server.

    Args:
        name: Of the robot or run, as the page shows it.
        source: What it opens.
        listening: The socket of its port.
        app: The application of the dashboard.
        settings: Of the deployment.
    """

    def __init__(
        self, name: str, source: Open, listening: socket.socket, app: FastAPI, settings: Settings
    ) -> None:
        self.name, self.source = name, source
        self.port = int(listening.getsockname()[1])
        self.dashboard: Dashboard = app.state.dashboard
        self._listening = listening
        self._server = _Server(uvicorn_config(app, settings))
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to serve."""
        self._task = asyncio.create_task(self._server.serve([self._listening]), name=f"serve {self.name}")

    @property
    def started(self) -> bool:
        """Whether browsers are answered."""
        return self._server.started

    @property
    def ended(self) -> bool:
        """Whether it ended by itself, which is a fault."""
        return self._task is not None and self._task.done()

    @property
    def answers(self) -> bool:
        """Whether its page can be opened now; its port takes connections before and lets them wait."""
        return self.started and not self.ended

    async def close(self) -> None:
        """End the server, and with it the worker."""
        self._server.should_exit = True
        if self._task is not None:
            with contextlib.suppress(Exception):
                await self._task
        self._listening.close()


class _Server(uvicorn.Server):
    """Leaves the signals to the fleet's own server."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield


def next_port(settings: Settings, after: int) -> socket.socket:
    """A listening socket on the first free port after one.

    Raises:
        StemmapError: There is none.
    """
    reason = OSError("no port was tried")
    for port in range(after + 1, min(after + 1 + PORTS_TRIED, 1 << 16)):
        try:
            return bound(settings.host, port)
        except OSError as error:
            reason = error
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                break
    where = f"{settings.host}, ports after {after}"
    raise StemmapError(
        "no port is free for another robot", where=where, remedy=str(reason.strerror or reason)
    )
