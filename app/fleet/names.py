"""How the robots and runs of a fleet are called, and what each of them opens."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import urlencode

import msgspec

from app.robot.address import ROOT, ZenohAddress
from app.worker.protocol import Open

#: The name of a robot that has no namespace; with its spaces it is no namespace of another.
NAMELESS = "robot (no namespace)"


def named(sources: Sequence[Open]) -> dict[str, Open]:
    """A short name for each source: of a file its own, with a number where two are alike."""
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
    """The same with a recording of its own beside those of the others.

    Args:
        source, name: What is opened, and how it is called.
        taken: Recordings of the others. Two names that give one file (`a/b` and `a_b`) are numbered.
    """
    if not source.record:
        return source
    path = Path(source.record)
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)
    others = {other.casefold() for other in taken}  # some disks do not tell A from a
    record, k = path.with_name(f"{path.stem}-{safe}{path.suffix}"), 1
    while str(record).casefold() in others:
        k += 1
        record = path.with_name(f"{path.stem}-{safe}-{k}{path.suffix}")
    return msgspec.structs.replace(source, record=str(record))


def address_of(address: ZenohAddress, robot: str) -> str:
    """The address of one robot on a router; "" is the one without a namespace and no other."""
    options = {"robot": robot or ROOT, "domain": str(address.domain) if address.domain else ""}
    options |= address.topics | address.files
    query = urlencode({name: value for name, value in options.items() if value}, safe="/")
    return f"zenoh:{address.endpoint}" + (f"?{query}" if query else "")
