"""Robots that map by themselves, on the page of a fleet. Their results are received; their scans are not."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from typing import Any

import msgspec

from app.common.child_process import ChildProcess, python_module
from app.common.timers import cancel
from app.fleet.fleet import NAMELESS, Fleet
from app.fleet.hearing import FleetReport, RobotReport
from pipeline.errors import StemmapError

_log = logging.getLogger(__name__)

HEARING = python_module("app.fleet.hearing")
_LONGEST_LINE = 32 << 20
_RETRY_S = 2.0
#: A longer silence is shown [s].
SILENT_S = 3.0


class RemoteRobots:
    """Runs the process that receives the maps, and passes its reports to the fleet.

    Args:
        fleet: The fleet that shows the robots.
        uri: Address of the router.
        command: Program and arguments of the process.
    """

    def __init__(self, fleet: Fleet, uri: str, command: Sequence[str] = HEARING) -> None:
        self._fleet, self._uri, self._command = fleet, uri, command
        self._task: asyncio.Task[None] | None = None
        self._known: dict[str, tuple[RobotReport, float]] = {}  # with the time of the report [s]

    def start(self) -> None:
        """Start the process."""
        self._task = asyncio.create_task(self._keep(), name="hear robots")

    async def close(self) -> None:
        """End the process."""
        await cancel(self._task)

    async def _keep(self) -> None:
        while True:
            try:
                await self._receive()
                self._fleet.notice = "Waiting: the process that receives the maps ended and is started again"
            except StemmapError as error:
                _log.exception("the process that receives the maps failed")
                self._fleet.notice = f"Waiting: {error}"
            self._show(receiving=False)
            await asyncio.sleep(_RETRY_S)

    async def _receive(self) -> None:
        command = (*self._command, self._uri)
        async with await ChildProcess.start(command, line_limit=_LONGEST_LINE) as child:
            while (report := await child.receive(FleetReport)) is not None:
                self._take(report)

    def _take(self, report: FleetReport) -> None:
        self._fleet.notice = f"Waiting: {report.problem}" if report.problem else ""
        if not report.robots and not report.problem:
            self._fleet.notice = f"Waiting: {report.place}; no robot publishes a map of its own"
        now_s = time.monotonic()
        for name, robot in self._known.items():
            if name not in report.robots:  # a process that was started again does not know it
                self._known[name] = (msgspec.structs.replace(_aged(*robot, now_s), alive=False), now_s)
        for name, new in report.robots.items():
            if new.silence_s is None and name in self._known:  # nor its map: the last one stays
                new = msgspec.structs.replace(_aged(*self._known[name], now_s), alive=new.alive)
            self._known[name] = (new, now_s)
        self._show(receiving=True)

    def _show(self, *, receiving: bool) -> None:
        """Pass cards and maps to the fleet; without `receiving`, no robot counts as live."""
        now_s = time.monotonic()
        self._fleet.remote = {}
        for robot, known in self._known.items():
            name, aged = robot or NAMELESS, _aged(*known, now_s)
            self._fleet.remote[name] = (card_of(name, self._uri, aged, receiving=receiving), aged.map)


def _aged(robot: RobotReport, reported_s: float, now_s: float) -> RobotReport:
    """Return a report of an earlier time, with its silence extended to `now_s`."""
    silence_s = None if robot.silence_s is None else robot.silence_s + now_s - reported_s
    return msgspec.structs.replace(robot, silence_s=silence_s)


def card_of(name: str, uri: str, robot: RobotReport, *, receiving: bool) -> dict[str, Any]:
    """Return the card of a robot, in the form of `app.fleet.fleet.card`.

    Args:
        name: Name of the robot.
        uri: Address of the router.
        robot: Its newest report.
        receiving: Whether the process that receives the reports runs.
    """
    silent = not receiving or robot.silence_s is None or robot.silence_s > SILENT_S
    since = "" if robot.silence_s is None else f"Nothing heard for {robot.silence_s:.0f} s: "
    reason = "it is announced and silent" if robot.alive else "its mapping is gone"
    if not receiving:
        reason = "the process that receives the maps ended"
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
