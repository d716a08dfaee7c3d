"""Serves a fleet: the page of all robots on the port asked for, their dashboards on those after it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace

from app.common.settings import Settings
from app.dashboard.parameters import ParameterState
from app.fleet.fleet import Fleet
from app.fleet.remote import RemoteRobots
from app.fleet.server import build_fleet
from app.fleet.warming import warmed
from app.fleet.watching import Watching
from app.robot.address import ZenohAddress
from app.web.auth import new_token, viewer_token
from app.web.serving import LinkedServer, bind, link_of, uvicorn_config
from app.worker.protocol import Open


def serve_fleet(
    settings: Settings,
    *,
    sources: Mapping[str, Open],
    make_parameters: Callable[[], ParameterState],
    watched: tuple[ZenohAddress, Open] | None,
    open_browser: bool,
    viewer: bool = False,
) -> int:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: Of the deployment.
        sources: What is open from the start, by name.
        make_parameters: The parameters that each dashboard begins with.
        watched: A router whose robots are added as they come, and how they are opened.
        open_browser: Whether to show the page.
        viewer: Whether to print the link for looking only too.

    Raises:
        StemmapError: The port is in use, or the address is not one of this machine.
    """
    listening = bind(settings)
    port = listening.getsockname()[1]
    token = settings.token or new_token()
    if viewer:
        print(f"for looking only: {link_of(settings, port, viewer_token(token))}", flush=True)  # noqa: T201

    async def served() -> bool:
        fleet = Fleet(replace(settings, port=port), port, token, make_parameters, warm=warmed)
        for name, source in sources.items():
            fleet.add(name, source)
        watching: Watching | RemoteRobots | None = None
        if watched is not None:
            address, source = watched
            there = address.mapped_there
            watching = RemoteRobots(fleet, address.uri) if there else Watching(fleet, address, source)
        app = build_fleet(settings, port=port, token=token, fleet=fleet, watching=watching)
        server = LinkedServer(
            uvicorn_config(app, settings), settings, link_of(settings, port, token), open_browser=open_browser
        )
        await server.serve(sockets=[listening])
        return server.started

    with contextlib.closing(listening):
        return 0 if asyncio.run(served()) else 1
