"""Web server of a fleet: the page of all robots on one port, their dashboards on the ports after it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import msgspec
from fastapi import APIRouter, FastAPI, Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.common.settings import Settings
from app.common.timers import cancel
from app.dashboard.parameters import ParameterState
from app.fleet.fleet import NAMELESS, Fleet
from app.robot.address import ROOT, ZenohAddress
from app.robot.link import Inbox
from app.robot.zenoh import ZenohLink
from app.web.app import guarded
from app.web.auth import role_of
from app.web.responses import error_reply
from app.web.routes.page import access, lead_on, page_answer, page_file, page_folder
from app.web.routes.sockets import telling
from app.web.serving import run_server
from app.worker.numba_warmup import PATIENCE_S
from app.worker.protocol import Open

WARMING = python_module("app.worker.numba_warmup", "warm_up")


async def warm_kernels(command: Sequence[str] = WARMING) -> None:
    """Compile the kernels of the mapper in a child process, so that the workers find them in the cache.

    Return when the child ends, whatever its return code, or after PATIENCE_S. A child that is still running
    then, or when the call is cancelled, is killed. It must not write to its standard output: the first line
    ends the wait, too.

    Args:
        command: Program and arguments of the child process.

    Raises:
        StemmapError: The process cannot be started.
    """
    async with await ChildProcess.start(command) as child:
        with contextlib.suppress(TimeoutError, ProtocolError):
            await child.receive(object, PATIENCE_S)  # None when it ends


def named(sources: Sequence[Open]) -> dict[str, Open]:
    """Return the sources by short names: for a file its stem, for a simulated run or an address with options
    the whole address, with " (2)" and so on appended if two are equal. With several sources, the names of
    their recordings get the name, see `recorded_apart`."""
    found: dict[str, Open] = {}
    for source in sources:
        short = source.uri
        if "?" not in short and not short.startswith("sim:"):
            short = Path(short).stem or short
        name, k = short, 1
        while name in found:
            k += 1
            name = f"{short} ({k})"
        found[name] = source
    if len(found) > 1:
        taken: list[str] = []
        for name, source in found.items():
            found[name] = recorded_apart(source, name, taken)
            taken.append(found[name].record)
    return found


def recorded_apart(source: Open, name: str, taken: Iterable[str]) -> Open:
    """Return a source whose recording has the name of the robot in its file name; the same source if it is
    not recorded.

    Args:
        source: The run that is opened.
        name: Name of the robot; characters other than letters, digits, "-" and "_" become "_".
        taken: Recordings of the other robots. Names that give the same file (`a/b`, `a_b`) are numbered.
    """
    if not source.record:
        return source
    path = Path(source.record)
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)
    others = {other.casefold() for other in taken}  # some file systems ignore case
    record, k = path.with_name(f"{path.stem}-{safe}{path.suffix}"), 1
    while str(record).casefold() in others:
        k += 1
        record = path.with_name(f"{path.stem}-{safe}-{k}{path.suffix}")
    return msgspec.structs.replace(source, record=str(record))


def address_of(address: ZenohAddress, robot: str) -> str:
    """Return the address of one robot at a router; an empty `robot` is the robot without a namespace."""
    options = {"robot": robot or ROOT, "domain": str(address.domain) if address.domain else ""}
    options |= address.topics | address.files
    query = urlencode({name: value for name, value in options.items() if value}, safe="/")
    return f"zenoh:{address.endpoint}" + (f"?{query}" if query else "")


_LOOK_S = 0.5
#: A router lists its publishers within milliseconds; the nodes of a robot start one after another [s].
_DISCOVERY_S, _SETTLED_S = 3.0, 0.7


class RobotWatch:
    """Adds each robot that appears at a router to a fleet. It does not subscribe to messages of the robots.
    The constructor connects to the router in the background.

    Args:
        fleet: The fleet.
        address: Address of the router.
        source: Odometry, seed, recording and publishing for all robots.
    """

    def __init__(self, fleet: Fleet, address: ZenohAddress, source: Open) -> None:
        self._fleet, self._address, self._source = fleet, address, source
        self._link = ZenohLink(address, Inbox())
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start to watch the router."""
        self._task = asyncio.create_task(self._watch(), name="watch robots")

    async def close(self) -> None:
        """Stop to watch, and disconnect from the router."""
        await cancel(self._task)
        await asyncio.to_thread(self._link.close)

    async def _watch(self) -> None:
        """Add the robots of the router every 0.5 s until the task is cancelled. While the fleet is empty,
        `notice` has the problem or that no robot is announced."""
        while True:
            for robot in self._link.robots():
                self.take(robot)
            if not self._fleet.members:
                problem = self._link.problem
                self._fleet.notice = problem or f"Waiting: no robot is announced at {self._address.endpoint}"
            elif self._fleet.notice.startswith(("Waiting", "no connection", "not connected")):
                self._fleet.notice = ""
            await asyncio.sleep(_LOOK_S)

    def take(self, robot: str) -> None:
        """Add the robot of a namespace, "" for none, unless it is in the fleet already."""
        source, name = self._source, robot or NAMELESS
        if name in self._fleet.members:
            return
        own = msgspec.structs.replace(source, uri=address_of(self._address, robot))
        taken = [member.source.record for member in self._fleet.members.values()]
        self._fleet.add(name, recorded_apart(own, name, taken))


def robots_at(address: ZenohAddress) -> list[str]:
    """Return the namespaces of the robots at a router; [] if the router does not answer. It blocks for up to
    3 s: until a short time after the connection, or after the second robot appeared."""
    link = ZenohLink(address, Inbox())
    end = time.monotonic() + _DISCOVERY_S
    connected_s = None
    try:
        while time.monotonic() < end:
            if not link.problem and connected_s is None:
                connected_s = time.monotonic()
            if len(link.robots()) > 1:
                time.sleep(_SETTLED_S)
                break
            if connected_s is not None and time.monotonic() > connected_s + _SETTLED_S:
                break
            time.sleep(0.02)
        return link.robots()
    finally:
        link.close()


_TRY_AGAIN_LATER, _REFUSED = 1013, 1003

router = APIRouter()


def build_fleet(
    settings: Settings,
    *,
    port: int,
    token: str,
    fleet: Fleet,
    watching: RobotWatch | None = None,
) -> FastAPI:
    """Return the application of the page of the fleet. It starts the fleet and `watching` when it starts, and
    closes both when it ends.

    Args:
        settings: Settings of the deployment.
        port: Port on which it is served, to check Host and Origin.
        token: Access token of browsers.
        fleet: The robots.
        watching: What adds further robots; None for nothing.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        fleet.start()
        if watching is not None:
            watching.start()
        try:
            yield
        finally:
            if watching is not None:
                await watching.close()
            await fleet.close()

    app = guarded(settings, port=port, token=token, lifespan=lifespan)
    app.state.fleet, app.state.fleet_port = fleet, None
    app.include_router(router)
    app.add_api_route("/api/access", access, methods=["GET"])
    app.add_api_route("/static/{path:path}", page_file, methods=["GET"])
    return app


@router.get("/")
def fleet_page(request: Request) -> Response:
    """GET /: return the page of all robots."""
    return page_answer(request, page_folder() / "fleet.html")


@router.get("/robots/{name:path}")
def robot_page(request: Request, name: str) -> Response:
    """GET /robots/{name}: redirect to the dashboard of a robot, with a ticket for the role of the caller; 404
    for an unknown robot, 503 if its dashboard does not answer."""
    fleet: Fleet = request.app.state.fleet
    member = fleet.members.get(name)
    if member is None:
        return error_reply(404, "there is no such robot", where=name[:200])
    if not member.answers:
        remedy = (
            "The terminal shows why" if member.ended else "Try again in a moment; its card shows the state"
        )
        return error_reply(503, "its dashboard does not answer", where=name[:200], remedy=remedy)
    return lead_on(request, member.port)


@router.websocket("/api/fleet")
async def fleet_live(browser: WebSocket) -> None:
    """WebSocket /api/fleet: send states and maps of all robots as they change. A message of the browser
    closes the connection with code 1003; without room for another connection it is closed with 1013 before it
    is accepted."""
    fleet: Fleet = browser.app.state.fleet
    with fleet.pages.place(role_of(browser.scope)) as free:
        if not free:
            await browser.close(_TRY_AGAIN_LATER)
            return
        await browser.accept()
        async with telling(browser, fleet.live):
            if (await browser.receive())["type"] != "websocket.disconnect":
                await browser.close(_REFUSED, "messages are not accepted here")


def serve_fleet(
    settings: Settings,
    *,
    sources: Mapping[str, Open],
    make_parameters: Callable[[], ParameterState],
    watched: tuple[ZenohAddress, Open] | None,
    open_browser: bool,
    viewer: bool,
) -> int:
    """Serve until SIGINT or SIGTERM; return the exit code: 0, or 1 if the server could not start.

    Args:
        settings: Settings of the deployment.
        sources: Runs that are open from the start, by name.
        make_parameters: Returns the initial parameters of a dashboard.
        watched: A router whose robots are added when they appear, and how they are opened; None for none.
        open_browser: Whether to open the page in the browser of this machine.
        viewer: Whether to print the view-only link.

    Raises:
        StemmapError: The port is in use, or the address is not an address of this machine.
    """

    async def make_app(port: int, token: str) -> FastAPI:
        fleet = Fleet(replace(settings, port=port), port, token, make_parameters, warm=warm_kernels)
        for name, source in sources.items():
            fleet.add(name, source)
        watching: RobotWatch | None = None
        if watched is not None:
            address, source = watched
            watching = RobotWatch(fleet, address, source)
        return build_fleet(settings, port=port, token=token, fleet=fleet, watching=watching)

    return run_server(settings, make_app, open_browser=open_browser, viewer=viewer)
