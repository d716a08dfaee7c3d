"""Which runs or robots a fleet shows, and their names. Each `stemmap serve` imports it."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import msgspec

from app.sources.live_address import ALL_ROBOTS, ROOT, ZenohAddress, is_live, parse_address
from app.worker.protocol import Open

#: A router lists its publishers within milliseconds; the nodes of a robot start one after another [s].
_DISCOVERY_S, _SETTLED_S = 3.0, 0.7
#: The name of a robot without a namespace; a namespace contains no spaces.
NAMELESS = "robot (no namespace)"


def named(sources: Sequence[Open]) -> dict[str, Open]:
    """Return the sources by short names: the whole URI of a simulated run or of a URI with "?", the last part
    of any other address, the stem of any other file, with " (2)" and so on appended if two are equal. With
    several sources, the names of their recordings get the name, see `recorded_apart`."""
    found: dict[str, Open] = {}
    for source in sources:
        short = source.uri
        if "?" not in short and not short.startswith("sim:"):
            short = (Path(short).name if is_live(short) else Path(short).stem) or short
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
    """Return the address of one robot at a router, with the topics and files of `address`, and its domain
    unless that is 0; an empty `robot` is the robot without a namespace."""
    options = {"robot": robot or ROOT, "domain": str(address.domain) if address.domain else ""}
    options |= address.topics | address.files
    query = urlencode({name: value for name, value in options.items() if value}, safe="/")
    return f"zenoh:{address.endpoint}" + (f"?{query}" if query else "")


def robots_at(address: ZenohAddress) -> list[str]:
    """Return the namespaces of the robots at a router; [] if the router does not answer. It blocks until
    _SETTLED_S after the connection, or after the second robot appeared, and without a connection for
    _DISCOVERY_S."""
    from app.robot.link import Inbox
    from app.robot.zenoh import ZenohLink

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


def watched_router(sources: Sequence[Open]) -> tuple[ZenohAddress, Open] | None:
    """Return the router whose robots are all shown and how they are opened, if the only source is a Zenoh
    address with robot=*, or one that names neither a robot nor topics and several robots are found; else
    None. To find them the router is asked, which takes up to 3 s."""
    if len(sources) != 1 or not is_live(sources[0].uri):
        return None
    address = parse_address(sources[0].uri)
    if not isinstance(address, ZenohAddress) or address.robot not in ("", ALL_ROBOTS):
        return None
    if address.robot == ALL_ROBOTS:
        return replace(address, robot=""), sources[0]
    if address.topics:  # a topic belongs to one robot
        return None
    return (address, sources[0]) if len(robots_at(address)) > 1 else None
