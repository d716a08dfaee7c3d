"""Repairs as records and as files; this module imports no stage."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any, Literal, get_args
from zlib import crc32

import msgspec
import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Path, Trees

Kind = Literal["merge", "split", "move", "class", "delete", "tie", "forbid"]
KINDS: tuple[Kind, ...] = get_args(Kind)
CLASSES = ("tree", "pole", "person", "bush", "other")
#: Largest distance between the position in a repair and its tree [m], as for annotations.
GATE = 0.5
#: Number of positions and of times of each kind.
PLACES: Mapping[Kind, int] = {
    "merge": 2, "split": 2, "move": 2, "class": 1, "delete": 1, "tie": 2, "forbid": 0,
}  # fmt: skip
MOST = 1000
#: Largest |x| and |y| of a position [m]: northings of UTM are at most 1e7.
FARTHEST = 1e7
#: Times are int64.
LATEST_NS = 2**63


class Repair(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A repair of the map.

    The kinds are: "merge" the second tree into the first; "split" a tree, with a second one at the second
    position; "move" a tree to the second position; set the "class" of a tree; "delete" a tree; "tie" two
    places of the path, because the stem seen at the first time is the stem seen at the second one; "forbid" a
    loop between two times.

    Attributes:
        kind: One of KINDS.
        places: Positions x, y [m], as many as PLACES tells: in the map after the repairs before this one; of
            "tie", in the frame of the robot at each time.
        stamps_ns: Times of two scans [ns], for "tie" and "forbid".
        value: The class, one of CLASSES, for "class".
    """

    kind: Kind
    places: tuple[tuple[float, float], ...] = ()
    stamps_ns: tuple[int, ...] = ()
    value: str = ""

    @property
    def is_of_loop(self) -> bool:
        """Whether it changes the path."""
        return self.kind in ("tie", "forbid")

    @property
    def problem(self) -> str:
        """Why it is not valid; empty if it is."""
        if len(self.places) != PLACES[self.kind] or not np.isfinite(self.places).all():
            return f"{self.kind} needs {PLACES[self.kind]} positions"
        if len(self.stamps_ns) != (2 if self.is_of_loop else 0):
            return f"{self.kind} needs {2 if self.is_of_loop else 0} times"
        if any(not abs(v) <= FARTHEST for place in self.places for v in place):
            return f"a position is farther than {FARTHEST:.0f} m"
        if any(not 0 <= stamp < LATEST_NS for stamp in self.stamps_ns):
            return "a time is not between 0 and 2^63 ns"
        if (self.value in CLASSES) != (self.kind == "class"):
            return f"the class of {self.kind} is {self.value or 'missing'}"
        return ""


def repairs_text(repairs: Sequence[Repair]) -> str:
    """Return repairs as the text of a file, which `read_repairs` reads."""
    rows = ",\n".join("  " + msgspec.json.encode(repair).decode() for repair in repairs)
    return f'{{"repairs": [\n{rows}\n]}}\n' if repairs else '{"repairs": []}\n'


def identity_of(repairs: Sequence[Repair]) -> int:
    """Return a number from 0 to 2^32 - 1 that is the same for equal repairs in the same order."""
    return crc32(msgspec.json.encode(repairs))


def parse_repairs(text: str, where: str) -> tuple[Repair, ...]:
    """Return the repairs of a text.

    Args:
        text: Content of the file.
        where: Name of the file for messages.

    Raises:
        SourceError: The text has another form, a repair is not valid, or there are more than MOST.
    """
    remedy = "Save the file again on the page, in the tab Repair"
    try:
        given: dict[str, Any] = json.loads(text)
        repairs = msgspec.convert(given["repairs"], tuple[Repair, ...])
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise SourceError(f"these are no repairs of a map: {error}", where=where, remedy=remedy) from None
    if len(repairs) > MOST:
        raise SourceError(f"there are more than {MOST} repairs", where=where)
    for number, repair in enumerate(repairs, start=1):
        if repair.problem:
            raise SourceError(f"repair {number}: {repair.problem}", where=where, remedy=remedy)
    return repairs


def repairs_record(repairs: Sequence[Repair], problems: Sequence[str]) -> dict[str, Any]:
    """Return repairs for run.json: `applied`, a dict from kinds to numbers of repairs; and `not_applied`, a
    list of dicts with the fields of the repair and `problem`.

    Args:
        repairs: The repairs.
        problems: Why each does not apply; "" if it does.
    """
    applied: dict[str, int] = {}
    for repair, problem in zip(repairs, problems, strict=True):
        if not problem:
            applied[repair.kind] = applied.get(repair.kind, 0) + 1
    left = [
        {**msgspec.to_builtins(repair), "problem": problem}
        for repair, problem in zip(repairs, problems, strict=True)
        if problem
    ]
    return {"applied": dict(sorted(applied.items())), "not_applied": left}


def repairs_words(repairs: Sequence[Repair], problems: Sequence[str]) -> str:
    """Return how many repairs apply, as text; arguments as in `repairs_record`."""
    return f"repairs: {len(repairs) - sum(map(bool, problems))} of {len(repairs)} applied"


def unapplied(repairs: Sequence[Repair], problems: Sequence[str]) -> list[str]:
    """Return a warning for each repair that does not apply; arguments as in `repairs_record`."""
    return [
        f"repair {number} ({repair.kind}) does not apply: {problem}"
        for number, (repair, problem) in enumerate(zip(repairs, problems, strict=True), start=1)
        if problem
    ]


def read_repairs(file: FilePath) -> tuple[Repair, ...]:
    """Return the repairs of a file; raises SourceError if it cannot be read, see `parse_repairs`."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"the file cannot be read: {error}", where=str(file)) from None
    return parse_repairs(text, str(file))


def seen_from(trees: Trees, path: Path, place: tuple[float, float]) -> tuple[int, tuple[float, float]] | None:
    """Return the time [ns] of the scan nearest to a tree among those from its first to its last observation,
    and the position of the tree in the frame of the robot at this time [m]; None if no confirmed tree is
    within GATE.

    Args:
        trees, path: The map.
        place: Position of the tree, x, y [m].
    """
    row = nearest_tree(trees, place, confirmed=True)
    if row is None or not len(path.x):
        return None
    first, last = np.searchsorted(path.stamp_ns, [trees.first_seen_ns[row], trees.last_seen_ns[row]])
    scans = np.arange(min(int(first), len(path.x) - 1), min(int(last), len(path.x) - 1) + 1)
    away = np.hypot(path.x[scans] - trees.position[row, 0], path.y[scans] - trees.position[row, 1])
    scan = int(scans[np.argmin(away)])
    T_base_map = Pose2(float(path.x[scan]), float(path.y[scan]), float(path.yaw[scan])).inverse()
    x, y = T_base_map.apply(trees.position[row]).tolist()
    return int(path.stamp_ns[scan]), (x, y)


def tied_numbers(trees: Trees, path: Path, repair: Repair) -> tuple[int, ...]:
    """Return the numbers of the trees of a map that a "tie" makes one; those not in the map, and those seen
    when it has no scan, are left out."""
    places = list[tuple[float, float]]()
    for stamp, place in zip(repair.stamps_ns, repair.places, strict=False):  # "forbid" has no places
        if not len(path.x) or not path.stamp_ns[0] <= stamp <= path.stamp_ns[-1]:
            continue
        scan = int(np.searchsorted(path.stamp_ns, stamp))
        pose = Pose2(float(path.x[scan]), float(path.y[scan]), float(path.yaw[scan]))
        x, y = pose.apply(np.array(place)).tolist()
        places.append((x, y))
    return numbers_at(trees, places, confirmed=True)


def numbers_at(trees: Trees, places: Sequence[tuple[float, float]], *, confirmed: bool) -> tuple[int, ...]:
    """Return the number of the tree at each position, see `nearest_tree`; positions without one are left
    out."""
    rows = [nearest_tree(trees, place, confirmed=confirmed) for place in places]
    return tuple(int(trees.number[row]) for row in rows if row is not None)


def nearest_tree(trees: Trees, place: tuple[float, float], *, confirmed: bool) -> int | None:
    """Return the row of the tree that is nearest to a position among those that are confirmed, or among the
    others; None if none is within GATE."""
    rows = np.flatnonzero(trees.confirmed == confirmed)
    if not len(rows):
        return None
    away = np.hypot(*(trees.position[rows] - place).T)
    row = int(np.argmin(away))
    return int(rows[row]) if away[row] <= GATE else None
