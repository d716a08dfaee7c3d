"""Robots and runs of a fleet: their names, what each of them opens, and robots that appear at a router."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import urlencode

import msgspec

from app.fleet.fleet import Fleet, end
from app.robot.address import ROOT, ZenohAddress
from app.robot.inbox import Inbox
from app.robot.zenoh import ZenohLink
from app.worker.protocol import Open

#: The name of a robot without a namespace; a namespace contains no spaces.
NAMELESS = "robot (no namespace)"


def named(sources: Sequence[Open]) -> dict[str, Open]:
    """Sources by a short name: for a file its stem, with a number appended where two are equal."""
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
    """A source whose recording has the robot's name in its file name.

    Args:
        source, name: The run that is opened, and the robot's name.
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
    """The address of one robot at a router; "" is the robot without a namespace."""
    options = {"robot": robot or ROOT, "domain": str(address.domain) if address.domain else ""}
    options |= address.topics | address.files
    query = urlencode({name: value for name, value in options.items() if value}, safe="/")
    return f"zenoh:{address.endpoint}" + (f"?{query}" if query else "")


_LOOK_S = 0.5
#: A router lists its publishers within milliseconds; the nodes of a robot start one after another [s].
PATIENCE_S, _SETTLED_S = 3.0, 0.7


class Watching:
    """Adds each robot that appears at a router to a fleet. It receives no messages of theirs.

    Args:
        fleet: Gets the robots.
        address: Of the router.
        source: Odometry, seed, recording and publishing for all of them.
    """

    def __init__(self, fleet: Fleet, address: ZenohAddress, source: Open) -> None:
        self._fleet, self._address, self._source = fleet, address, source
        self._link = ZenohLink(address, Inbox())
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start to look."""
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
        """Add the robot of a namespace, "" for none, unless it is in the fleet already."""
        source, name = self._source, robot or NAMELESS
        if name in self._fleet.members:
            return
        own = msgspec.structs.replace(source, uri=address_of(self._address, robot))
        taken = [member.source.record for member in self._fleet.members.values()]
        self._fleet.add(name, recorded_apart(own, name, taken))


def robots_at(address: ZenohAddress) -> list[str]:
    """The namespaces of the robots at a router, asked before the server starts; [] if it does not answer."""
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
