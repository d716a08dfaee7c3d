"""Finds the robots of a Zenoh router as they come, and gives each a dashboard."""

from __future__ import annotations

import asyncio
import time

import msgspec

from app.fleet.fleet import Fleet
from app.fleet.names import NAMELESS, address_of, recorded_apart
from app.fleet.tasks import end
from app.robot.address import ZenohAddress
from app.robot.inbox import Inbox
from app.robot.zenoh import ZenohLink
from app.worker.protocol import Open

_LOOK_S = 0.5
#: A router tells who is there within milliseconds; a robot's nodes come up one after another.
PATIENCE_S, _SETTLED_S = 3.0, 0.7


class Watching:
    """Listens to who is there. Of what they send it hears nothing.

    Args:
        fleet: That gets the robots.
        address: Of the router.
        source: Odometry, seed, recording and publishing for all of them.
    """

    def __init__(self, fleet: Fleet, address: ZenohAddress, source: Open) -> None:
        self._fleet, self._address, self._source = fleet, address, source
        self._link = ZenohLink(address, Inbox())
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin."""
        self._task = asyncio.create_task(self._watch(), name="watch robots")

    async def close(self) -> None:
        """Leave the router."""
        await end(self._task)
        await asyncio.to_thread(self._link.close)

    async def _watch(self) -> None:
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
        """Begin with a robot of this namespace, "" for none, unless it is there already."""
        source, name = self._source, robot or NAMELESS
        if name in self._fleet.members:
            return
        own = msgspec.structs.replace(source, uri=address_of(self._address, robot))
        taken = [member.source.record for member in self._fleet.members.values()]
        self._fleet.add(name, recorded_apart(own, name, taken))


def robots_at(address: ZenohAddress) -> list[str]:
    """The robots that are at a router now, asked before anything is served; [] when it does not answer."""
    link = ZenohLink(address, Inbox())
    end = time.monotonic() + PATIENCE_S
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
