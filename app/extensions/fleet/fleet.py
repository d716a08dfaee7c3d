"""Several robots or runs at once: each has a dashboard with a worker and a map on a port of its own; one page
on the first port shows all of them."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import uvicorn
from fastapi import APIRouter, FastAPI, Request
from starlette.responses import Response
from starlette.websockets import WebSocket

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.common.settings import Settings
from app.common.timers import cancel
from app.dashboard.broadcast import Broadcast
from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import ParameterState
from app.dashboard.payload import clearance_payload, trees_payload
from app.extension import page_folder
from app.extensions.fleet.members import NAMELESS, address_of, recorded_apart
from app.robot.link import Inbox
from app.robot.zenoh import ZenohLink
from app.sources import opening
from app.sources.live_address import ZenohAddress
from app.web.app import MakeScene, MakeWorker, build, guarded
from app.web.auth import AccessTokens, role_of
from app.web.responses import error_reply, json_reply
from app.web.routes.access import ConnectionLimit
from app.web.routes.page import access, lead_on, page_answer, page_file, telling
from app.web.serving import first_free, run_server, uvicorn_config
from app.worker.numba_warmup import PATIENCE_S
from app.worker.protocol import Open
from app.worker.supervisor import WorkerProcess
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2

_log = logging.getLogger(__name__)


#: So many trees more than at the last try make another worth its second of computing.
MORE_TREES = 4
#: Fewer stems fix no pose.
LEAST_TREES = 6
_LEAST_SIGMA = 0.02  # of the position of a stem [m]

Map = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _MapFrame:
    """The frame of a map.

    Attributes:
        digest: Digest of its run.
        trees: Number of its trees when it was aligned.
        pose: Pose in the common frame; None if the alignment failed.
        how: How the pose was found, or why it is unknown.
    """

    digest: str
    trees: int
    pose: Pose2 | None
    how: str


class Frames:
    """Poses of the maps of a fleet in one common frame; one map is aligned at a time.

    The first map with enough trees is the common frame. Two replays of one recording share their frame,
    because each begins at the start of the recording. All other maps are aligned by their stems. A pose
    remains valid until its robot opens another source.
    """

    def __init__(self) -> None:
        self._found: dict[str, _MapFrame] = {}
        self._few: set[str] = set()  # names of maps with too few trees
        self._first = ""  # name of the map whose frame is the common one

    def pose(self, name: str) -> Pose2 | None:
        """Return the pose of the frame of a map in the common frame; None if it is unknown."""
        return self._found[name].pose if name in self._found else None

    def how(self, name: str) -> str:
        """Return how the pose of a map was found, or why it is unknown, as text; also for unknown names."""
        if name in self._found:
            return self._found[name].how
        return f"its frame is not known yet{': too few trees' if name in self._few else ''}"

    async def try_one(self, maps: dict[str, tuple[str, Map]]) -> bool:
        """Try to align one more map; return whether an alignment was computed, successful or not. Maps that
        need no computation (the first with enough trees, the same recording) get their pose in passing.

        A map is tried only with at least LEAST_TREES trees, and after a failure again with MORE_TREES more. A
        map with a pose is not tried again.
        Poses of runs that are not in `maps` any more are removed; without the run of the common frame, all
        are.

        Args:
            maps: By name: digest of the run, and the map with a list of trees as on the page.
        """
        self._found = {
            name: frame
            for name, frame in self._found.items()
            if name in maps and maps[name][0] == frame.digest
        }
        if self._first not in self._found:  # all other frames are poses in this one
            self._first, self._found = "", {}
        self._few = {name for name, (_, shown) in maps.items() if len(shown["trees"]) < LEAST_TREES}
        for name, (digest, shown) in maps.items():
            known, count = self._found.get(name), len(shown["trees"])
            if not self._first and count >= LEAST_TREES:
                self._first = name
                self._found[name] = _MapFrame(digest, count, Pose2(), "the common frame")
            elif not self._first or (known is not None and known.pose is not None):
                continue
            elif digest and digest == self._found[self._first].digest:
                how = f"the same recording as {self._first}"
                self._found[name] = _MapFrame(digest, count, Pose2(), how)
            elif count >= (LEAST_TREES if known is None else known.trees + MORE_TREES):
                pose, how = await _aligned(maps[self._first][1], shown)
                how = how if pose is None else f"{how} of {self._first}"
                self._found[name] = _MapFrame(digest, count, pose, how)
                return True
        return False


async def _aligned(reference: Map, local: Map) -> tuple[Pose2 | None, str]:
    """Return the pose of a map in a reference map and how it was found as text; where it is unknown, None and
    the reason. It is computed in a child process; its errors are returned as the reason."""
    question = {"ask": "alignment", "local": _stems(local), "reference": _stems(reference)}
    try:
        found = await opening.ask(question)
    except StemmapError as error:
        return None, error.what
    if found["pose"] is None:
        return None, f"their stems do not agree with certainty ({found['reason']})"
    return Pose2(*found["pose"]), f"aligned by {found['stems']} stems"


def _stems(shown: Map) -> list[list[float | None]]:
    """Return x, y, sigma, DBH and its sigma [m] of each tree of a map; the last two are None unless both are
    known. Sigma is the longer semi-axis of the ellipse, at least 0.02 m."""
    rows = []
    for tree in shown["trees"]:
        known = tree["dbh_cm"] is not None and tree["sigma_dbh_cm"] is not None
        dbh = [tree["dbh_cm"] / 100.0, tree["sigma_dbh_cm"] / 100.0] if known else [None, None]
        rows.append([tree["x"], tree["y"], max(tree["ellipse"][0], _LEAST_SIGMA), *dbh])
    return rows


#: Points of a path: enough for a picture of some hundred pixels.
MOST_POINTS = 400


def card(name: str, dashboard: Dashboard) -> dict[str, Any]:
    """Return the state of a robot for the page: `name`, `source`, `rate_hz`, `behind` (scans that wait),
    `warnings` (their number), `clearance` (see `clearance_payload`), and as in `Status` `state`, `detail`,
    `live`, `time_s`, `mapping_ms`, `health`, `trees`, `distance_m` and `recording`. Without an open run, the
    source is the one that the dashboard will open.

    Args:
        name: Name of the robot on the page.
        dashboard: Its dashboard.
    """
    status = dashboard.status
    clearance = None if dashboard.shown is None else dashboard.shown.frame.clearance
    return {
        "name": name,
        "source": status.source or dashboard.source.uri,
        "state": status.state,
        "detail": status.detail,
        "live": status.live,
        "time_s": round(status.time_s, 1),
        "rate_hz": round(status.scan_rate_hz, 1),
        "mapping_ms": round(status.mapping_ms, 1),
        "behind": status.scans_behind,
        "health": status.health,
        "trees": status.trees,
        "distance_m": round(status.distance_m, 1),
        "recording": status.recording,
        "warnings": len(status.warnings),
        "clearance": clearance_payload(clearance),
    }


def shown_map(dashboard: Dashboard) -> dict[str, Any] | None:
    """Return a dict of JSON values in the frame of the map of a dashboard: `trees` (see `trees_payload`),
    `path`, a list of [x, y] [m], and `pose`, [x [m], y [m], yaw [rad]]; None before the first scan. The path
    is thinned to about MOST_POINTS points; the last one is the newest."""
    shown = dashboard.shown
    if shown is None:
        return None
    pose = shown.frame.estimate.T_map_base
    step = max(1, -(-len(dashboard.path_xy) // MOST_POINTS))
    path = np.vstack([dashboard.path_xy[::step], dashboard.path_xy[-1:]])
    return {
        "trees": trees_payload(shown.frame.trees, start_ns=dashboard.start_ns),
        "path": np.round(path, 2).tolist(),
        "pose": [round(pose.x, 3), round(pose.y, 3), round(pose.yaw, 4)],
    }


def drawn(own: dict[str, Any], pose: Pose2 | None, how: str) -> dict[str, Any]:
    """Return a map for the fleet page as a dict of JSON values. The keys are `trees`, a list of [x [m], y
    [m], DBH [cm] or None] in the frame of the map; `path` and `pose`, as in `shown_map`; `common`, the pose
    [x [m], y [m], yaw [rad]] of this frame in the common frame, or None; and `how`.

    Args:
        own: Result of `shown_map`.
        pose: Result of `Frames.pose`, None if unknown.
        how: Result of `Frames.how`.
    """
    return {
        "trees": [[round(t["x"], 2), round(t["y"], 2), t["dbh_cm"]] for t in own["trees"]],
        "path": own["path"],
        "pose": own["pose"],
        "common": None if pose is None else [pose.x, pose.y, pose.yaw],
        "how": how,
    }


#: Ports after that of the fleet that are tried, so that a firewall can be opened for a known range.
PORTS_TRIED = 100


class Member:
    """The dashboard of one robot or run, with its server.

    Args:
        name: Name of the robot or run on the page.
        source: The run that the dashboard opens.
        listening: Listening socket of its port.
        app: Application of the dashboard.
    """

    def __init__(self, name: str, source: Open, listening: socket.socket, app: FastAPI) -> None:
        self.name, self.source = name, source
        self.port = int(listening.getsockname()[1])
        self.dashboard: Dashboard = app.state.dashboard
        self._listening = listening
        self._server = _Server(uvicorn_config(app))
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the server as a task of the running event loop."""
        self._task = asyncio.create_task(self._server.serve([self._listening]), name=f"serve {self.name}")

    @property
    def started(self) -> bool:
        """Whether the server accepts requests."""
        return self._server.started

    @property
    def ended(self) -> bool:
        """Whether the server has ended; without a call of `close` this is a fault."""
        return self._task is not None and self._task.done()

    @property
    def answers(self) -> bool:
        """Whether the page can be opened. The port accepts connections earlier and lets them wait."""
        return self.started and not self.ended

    async def close(self) -> None:
        """End the server and the worker, wait for them, and close the socket. Errors of the server are
        ignored."""
        self._server.should_exit = True
        if self._task is not None:
            with contextlib.suppress(Exception):
                await self._task
        self._listening.close()


class _Server(uvicorn.Server):
    """A uvicorn server that handles no signals, because the server of the fleet does."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signal."""
        yield


def next_port(settings: Settings, after: int) -> socket.socket:
    """Return a listening socket on the first free port after port `after`; at most PORTS_TRIED ports are
    tried.

    Raises:
        StemmapError: No port is free.
    """
    listening = first_free(settings.host, range(after + 1, min(after + 1 + PORTS_TRIED, 1 << 16)))
    if isinstance(listening, OSError):
        where, reason = f"{settings.host}, ports after {after}", str(listening.strerror or listening)
        raise StemmapError("no port is free for another robot", where=where, remedy=reason)
    return listening


COMPILING = "Getting ready; on a new machine this compiles for some minutes, and only the first time"
#: Each robot needs a worker process and a port.
MOST_ROBOTS = 16
_CARDS_S, _MAPS_EACH, _FRAMES_EACH = 0.5, 2, 10  # maps and frames every so many rounds


class Fleet:
    """The dashboards of all robots, by name, in the order in which they were added.

    Args:
        settings: Settings of the deployment.
        port: Port of the page of the fleet.
        tokens: Tokens of the links, also for the dashboards.
        make_parameters: Returns the initial parameters of a dashboard.
        make_scene, make_worker: Replacements of viser and of the worker process, for tests.
        warm: Task after which the dashboards start; None starts them at once.

    Attributes:
        live: Broadcast of states and maps to the connected pages.
        pages: Limit of the number of connected pages.
        members: Dashboard by name.
        notice: Message for the page, "" for none.
    """

    def __init__(
        self,
        settings: Settings,
        port: int,
        tokens: AccessTokens,
        make_parameters: Callable[[], ParameterState] = ParameterState,
        make_scene: MakeScene | None = None,
        make_worker: MakeWorker = WorkerProcess,
        warm: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self.live, self.pages = Broadcast(), ConnectionLimit()
        self.members: dict[str, Member] = {}
        self.notice = ""
        self._settings, self._port, self._tokens = settings, port, tokens
        self._make_parameters = make_parameters
        self._make = (make_scene, make_worker)
        self._frames = Frames()
        self._warm, self._is_warm = warm, warm is None
        self._warming: asyncio.Task[None] | None = None
        self._task: asyncio.Task[None] | None = None
        self._aligning: asyncio.Task[None] | None = None

    def add(self, name: str, source: Open) -> bool:
        """Add a robot and start its dashboard (or let it start after `warm`). Return whether the robot is in
        the fleet: True also if it was there before; False with MOST_ROBOTS others or without a free port,
        which `notice` then reports. Without `warm`, or after it, an event loop must run.

        Args:
            name: Name of the robot on the page.
            source: Source that its dashboard opens.
        """
        if name in self.members:
            return True
        if len(self.members) >= MOST_ROBOTS:
            self.notice = f"There are more than {MOST_ROBOTS} robots; {name} and others are not shown"
            return False
        last = max([self._port, *(member.port for member in self.members.values())])
        try:
            listening = next_port(self._settings, last)
        except StemmapError as error:
            self.notice = f"{name} is not shown: {error}"
            return False
        app = build(
            self._settings,
            port=listening.getsockname()[1],
            tokens=self._tokens,
            source=source,
            parameter_state=self._make_parameters(),
            make_scene=self._make[0],
            make_worker=self._make[1],
            open_records=lambda: {each.dashboard.run_recorder.record for each in self.members.values()},
        )
        app.state.fleet_port = self._port
        self.members[name] = Member(name, source, listening, app)
        if self._is_warm:
            self.members[name].start()
        return True

    def start(self) -> None:
        """Start to send states and maps to the pages, and await `warm`. Needs a running event loop."""
        self._task = asyncio.create_task(self._send_states(), name="fleet")
        if self._warm is not None:
            self._warming = asyncio.create_task(self._begin_when_warm(self._warm()), name="warm")

    async def close(self) -> None:
        """Stop sending, and close all dashboards at the same time."""
        for task in (self._warming, self._task, self._aligning):
            await cancel(task)
        await asyncio.gather(*(member.close() for member in self.members.values()))

    async def _begin_when_warm(self, warming: Awaitable[None]) -> None:
        """Await the compilation and start all dashboards; a StemmapError of the compilation is only
        logged."""
        try:
            await warming
        except StemmapError:  # the workers compile then
            _log.exception("the kernels were not compiled before the workers start")
        self._is_warm = True
        for member in self.members.values():
            member.start()

    async def _send_states(self) -> None:
        """Send states every 0.5 s, maps every 1 s, and align a map every 5 s, unless the alignment before is
        in progress, until the task is cancelled. Errors are only logged."""
        rounds = 0
        while True:
            try:
                self.send_cards()
                if rounds % _MAPS_EACH == 0:
                    self.send_maps()
                if rounds % _FRAMES_EACH == 0 and (self._aligning is None or self._aligning.done()):
                    self._aligning = asyncio.create_task(self._align(), name="frames")
            except Exception:  # an error in showing must not end the fleet
                _log.exception("the states of the fleet could not be sent")
            rounds += 1
            await asyncio.sleep(_CARDS_S)

    async def _align(self) -> None:
        """Try to align one map; errors are only logged."""
        try:
            await self._frames.try_one(self._maps())
        except Exception:  # the other maps are still to be aligned
            _log.exception("a map could not be aligned with the common one")

    def send_cards(self) -> None:
        """Send the states of all robots (`members`, see `card`, with `answers`) and the `notice` to the
        pages, as the message "fleet". Before `warm` has ended, and after the end of a dashboard, the state
        says so."""
        cards = [card(name, m.dashboard) | {"answers": m.answers} for name, m in self.members.items()]
        for shown, member in zip(cards, self.members.values(), strict=True):
            if not self._is_warm:
                shown |= {"state": "starting", "detail": COMPILING, "source": member.source.uri}
            if member.ended:
                shown |= {"state": "failed", "detail": "Its dashboard ended; the terminal shows why"}
        self.live.publish("fleet", {"members": cards, "notice": self.notice})

    def send_maps(self) -> None:
        """Send the message "maps" to the pages: {"maps": dict from the name of each robot with a map to the
        result of `drawn`}."""
        maps = {
            name: drawn(own, self._frames.pose(name), self._frames.how(name))
            for name, (_, own) in self._maps().items()
        }
        self.live.publish("maps", {"maps": maps})

    def _maps(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Return the digest of the run and the map, see `shown_map`, of each robot that has one, by name."""
        found = {name: (m.dashboard.digest, shown_map(m.dashboard)) for name, m in self.members.items()}
        return {name: (digest, own) for name, (digest, own) in found.items() if own is not None}


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


_LOOK_S = 0.5


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
        """Add the robots of the router every 0.5 s until the task is cancelled. `notice` has the reason why a
        robot cannot be added, which is logged once. Without such a reason, while the fleet is empty, it has
        the problem of the link, or that no robot is announced."""
        logged: set[str] = set()
        own = ""  # the last notice of this task
        while True:
            now = ""
            for robot in self._link.robots():
                try:
                    self.take(robot)
                except Exception as error:  # the other robots are still to be added
                    if robot not in logged:
                        _log.exception("the robot %r could not be added", robot)
                    logged.add(robot)
                    now = now or f"{robot or NAMELESS} cannot be shown: {error}"
            if not now and not self._fleet.members:
                now = self._link.problem or f"Waiting: no robot is announced at {self._address.endpoint}"
            if now:
                own = self._fleet.notice = now
            elif self._fleet.notice == own:
                self._fleet.notice = ""
            await asyncio.sleep(_LOOK_S)

    def take(self, robot: str) -> None:
        """Add the robot of a namespace, "" for none, unless it is in the fleet already. One that the fleet
        refuses is tried again with the next call."""
        source, name = self._source, robot or NAMELESS
        if name in self._fleet.members:
            return
        own = msgspec.structs.replace(source, uri=address_of(self._address, robot))
        taken = [member.source.record for member in self._fleet.members.values()]
        self._fleet.add(name, recorded_apart(own, name, taken))


_REFUSED = 1003

router = APIRouter()
of_dashboard = APIRouter()


@of_dashboard.get("/robots")
def all_robots(request: Request) -> Response:
    """GET /robots of a dashboard: redirect to the page of the fleet that it belongs to, with a ticket; 404
    without a fleet."""
    port = request.app.state.fleet_port
    if port is None:
        return error_reply(404, "this dashboard belongs to no fleet", remedy="Open / instead")
    return lead_on(request, port)


@of_dashboard.get("/api/fleet")
def fleet_link(request: Request) -> Response:
    """GET /api/fleet of a dashboard: return an object with `page`, the address of the page of its fleet (null
    without a fleet)."""
    return json_reply({"page": None if request.app.state.fleet_port is None else "/robots"})


def build_fleet(
    settings: Settings,
    *,
    port: int,
    tokens: AccessTokens,
    fleet: Fleet,
    watching: RobotWatch | None = None,
) -> FastAPI:
    """Return the application of the page of the fleet. It starts the fleet and `watching` when it starts, and
    closes both when it ends.

    Args:
        settings: Settings of the deployment.
        port: Port on which it is served, to check Host and Origin.
        tokens: Tokens of the links.
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

    app = guarded(settings, port=port, tokens=tokens, lifespan=lifespan)
    app.state.fleet = fleet
    app.include_router(router)
    app.add_api_route("/api/access", access, methods=["GET"])
    app.add_api_route("/static/{path:path}", page_file, methods=["GET"])
    return app


@router.get("/")
def fleet_page(request: Request) -> Response:
    """GET /: return the page of all robots."""
    return page_answer(request, page_folder("fleet") / "fleet.html")


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
    with fleet.pages.place(role_of(browser.scope)):
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
) -> int:
    """Serve until SIGINT or SIGTERM; return the exit code, see `run_server`.

    Args:
        settings: Settings of the deployment.
        sources: Runs that are open from the start, by name.
        make_parameters: Returns the initial parameters of a dashboard.
        watched: A router whose robots are added when they appear, and how they are opened; None for none.

    Raises:
        StemmapError: The port is in use, or the address is not an address of this machine.
        SystemExit: The page fails at its start.
    """

    async def make_app(port: int, tokens: AccessTokens) -> FastAPI:
        fleet = Fleet(replace(settings, port=port), port, tokens, make_parameters, warm=warm_kernels)
        for name, source in sources.items():
            fleet.add(name, source)
        watching: RobotWatch | None = None
        if watched is not None:
            address, source = watched
            watching = RobotWatch(fleet, address, source)
        return build_fleet(settings, port=port, tokens=tokens, fleet=fleet, watching=watching)

    return run_server(settings, make_app)
