"""Robots that map by themselves, on the page of a fleet: their results are heard, their scans are not."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
import time
from collections.abc import Sequence
from typing import Any

import msgspec

from app.fleet.fleet import Fleet
from app.fleet.names import NAMELESS
from app.fleet.tasks import end

_log = logging.getLogger(__name__)

HEARING = (sys.executable, "-P", "-m", "app.fleet.hearing")
_LONGEST_LINE = 32 << 20
_RETRY_S = 2.0
#: Nothing for so long is worth a word.
SILENT_S = 3.0


class _Robot(msgspec.Struct, frozen=True):
    """What `app.fleet.hearing` says of a robot."""

    silence_s: float | None
    rate_hz: float
    distance_m: float
    clearance: dict[str, Any] | None
    unreadable: int
    map: dict[str, Any]
    alive: bool


class _Said(msgspec.Struct, frozen=True):
    problem: str
    place: str
    robots: dict[str, _Robot]


class RemoteRobots:
    """Keeps the process that hears them, and tells the fleet.

    Args:
        fleet: That shows them.
        uri: Address of the router.
        command: The process.
    """

    def __init__(self, fleet: Fleet, uri: str, command: Sequence[str] = HEARING) -> None:
        self._fleet, self._uri, self._command = fleet, uri, command
        self._task: asyncio.Task[None] | None = None
        self._known: dict[str, tuple[_Robot, float]] = {}  # and when it was said [s]

    def start(self) -> None:
        """Begin."""
        self._task = asyncio.create_task(self._keep(), name="hear robots")

    async def close(self) -> None:
        """End the process."""
        await end(self._task)

    async def _keep(self) -> None:
        while True:
            try:
                await self._hear()
                self._fleet.notice = "Waiting: what hears the robots ended and is started again"
            except OSError as error:
                _log.exception("no process hears the robots")
                reason = error.strerror or type(error).__name__
                self._fleet.notice = f"Waiting: what hears the robots cannot be started ({reason})"
            self._show(hearing=False)
            await asyncio.sleep(_RETRY_S)

    async def _hear(self) -> None:
        process = await asyncio.create_subprocess_exec(
            *self._command,
            self._uri,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=_LONGEST_LINE,
            start_new_session=True,  # Ctrl-C in the terminal is for the server
        )
        assert process.stdout is not None  # noqa: S101 - it was asked for
        try:
            while line := await process.stdout.readline():
                self._take(msgspec.json.decode(line, type=_Said))
        except (msgspec.MsgspecError, ValueError):  # a line that is no word of ours, or far too long
            return
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    def _take(self, said: _Said) -> None:
        self._fleet.notice = f"Waiting: {said.problem}" if said.problem else ""
        if not said.robots and not said.problem:
            self._fleet.notice = f"Waiting: {said.place}; no robot publishes a map of its own"
        now_s = time.monotonic()
        for name, robot in self._known.items():
            if name not in said.robots:  # a process that began anew has not heard of it
                self._known[name] = (msgspec.structs.replace(_aged(*robot, now_s), alive=False), now_s)
        for name, new in said.robots.items():
            if new.silence_s is None and name in self._known:  # nor of its map: the last picture stays
                new = msgspec.structs.replace(_aged(*self._known[name], now_s), alive=new.alive)
            self._known[name] = (new, now_s)
        self._show(hearing=True)

    def _show(self, *, hearing: bool) -> None:
        """Hand the cards and maps to the fleet; while nobody hears, none of them is live."""
        now_s = time.monotonic()
        self._fleet.remote = {}
        for robot, known in self._known.items():
            name, aged = robot or NAMELESS, _aged(*known, now_s)
            self._fleet.remote[name] = (card_of(name, self._uri, aged, hearing=hearing), aged.map)


def _aged(robot: _Robot, said_s: float, now_s: float) -> _Robot:
    """What was said of a robot then, as it is now when nothing came since."""
    silence_s = None if robot.silence_s is None else robot.silence_s + now_s - said_s
    return msgspec.structs.replace(robot, silence_s=silence_s)


def card_of(name: str, uri: str, robot: _Robot, *, hearing: bool) -> dict[str, Any]:
    """The card of a robot, as `app.fleet.payload.card` makes it of a dashboard."""
    silent = not hearing or robot.silence_s is None or robot.silence_s > SILENT_S
    since = "" if robot.silence_s is None else f"Nothing heard for {robot.silence_s:.0f} s: "
    reason = "it is announced and silent" if robot.alive else "its mapping is gone"
    if not hearing:
        reason = "what hears the robots ended"
    return {
        "name": name,
        "source": f"{uri}, mapped on the robot",
        "remote": True,
        "state": "waiting" if silent else "playing",
        "detail": f"{since}{reason}" if silent else "",
        "live": True,
        "time_s": 0.0,
        "rate_hz": robot.rate_hz,
        "mapping_ms": 0.0,
        "behind": None,
        "health": None,
        "trees": len(robot.map["trees"]),
        "distance_m": robot.distance_m,
        "recording": "",
        "warnings": robot.unreadable,
        "clearance": robot.clearance,
    }
