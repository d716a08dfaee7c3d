"""Differences between the maps before and after the run was mapped again, with reasons."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np

from pipeline.evaluation import match
from pipeline.types.records import Columns, Float, Frame, Trees, Verdict

SAME = 0.5  # largest distance of the same tree in two maps [m]
MOVED = 0.05  # smallest reported motion [m]


class TreeChange(msgspec.Struct, frozen=True):
    """A tree that differs between the maps.

    Attributes:
        kind: Kind of the difference.
        number: Number in the new map, or in the old one for a tree that vanished.
        x, y: Position in that map [m].
        why: Reason, as text.
    """

    kind: Literal["appeared", "vanished", "moved"]
    number: int
    x: float
    y: float
    why: str


class MapChanges(msgspec.Struct, frozen=True):
    """Differences between two maps.

    Attributes:
        revision: Revision of the parameters.
        scans: Number of scans that were mapped again.
        time_s: Time of the last of them since the first scan [s].
        before, after: Number of trees.
        ghost: x, y [m] and DBH [m] (None where unknown) of each tree of the old map.
        renamed: Old and new number of each tree that stayed.
        followed: The same for the map that was shown last, if it is not the old map.
        changes: Trees that appeared, vanished or moved.
        confirmed: New number of each tree that was confirmed, also of one that vanished later, and the time
            of its confirmation since the first scan [s].
    """

    revision: int
    scans: int
    time_s: float
    before: int
    after: int
    ghost: list[tuple[float, float, float | None]]
    renamed: list[tuple[int, int]]
    followed: list[tuple[int, int]]
    changes: list[TreeChange]
    confirmed: list[tuple[int, float]]


def changes_between(
    before: Frame,
    shown: Frame,
    after: Frame,
    revision: int,
    time_s: float,
    confirmed_s: Mapping[int, float],
) -> MapChanges:
    """Return the differences between two maps of the same scans.

    Args:
        before: Last scan in the old map.
        shown: The same scan in the map that was shown last.
        after: The same scan in the new map.
        revision: Revision of the parameters of the new map.
        time_s: Time of the scan [s since the first scan].
        confirmed_s: Time at which each tree of the new map was confirmed, by its number [s].
    """
    old, new = np.flatnonzero(before.trees.confirmed), np.flatnonzero(after.trees.confirmed)
    old_at, new_at = before.trees.position[old], after.trees.position[new]
    old_of = match(new_at, old_at, SAME)
    stayed = [(k, int(row)) for k, row in enumerate(old_of.tolist()) if row >= 0]
    renamed = _renamed(before.trees, after.trees)
    gone = sorted(set(range(len(old))) - {row for _, row in stayed})
    changes = [
        *(_came(before, after.trees, int(new[k])) for k, row in enumerate(old_of.tolist()) if row < 0),
        *(_went(before.trees, int(old[row]), after) for row in gone),
        *(
            _moved(after.trees, int(new[k]), float(np.hypot(*(new_at[k] - old_at[row]))))
            for k, row in stayed
            if np.hypot(*(new_at[k] - old_at[row])) > MOVED
        ),
    ]
    dbh = before.trees.dbh[old]
    return MapChanges(
        revision=revision,
        scans=after.index + 1,
        time_s=time_s,
        before=len(old),
        after=len(new),
        ghost=[
            (round(float(x), 3), round(float(y), 3), round(float(d), 3) if np.isfinite(d) else None)
            for (x, y), d in zip(old_at, dbh, strict=True)
        ],
        renamed=renamed,
        followed=renamed if shown is before else _renamed(shown.trees, after.trees),
        changes=changes,
        confirmed=sorted(confirmed_s.items(), key=lambda item: (item[1], item[0])),
    )


def _renamed(before: Trees, after: Trees) -> list[tuple[int, int]]:
    """Return old and new number of each tree that is in both maps."""
    old, new = np.flatnonzero(before.confirmed), np.flatnonzero(after.confirmed)
    old_of = match(after.position[new], before.position[old], SAME)
    return [
        (int(before.number[old[row]]), int(after.number[new[k]]))
        for k, row in enumerate(old_of.tolist())
        if row >= 0
    ]


def _came(before: Frame, trees: Trees, row: int) -> TreeChange:
    place = trees.position[row]
    return _change("appeared", trees, row, f"before: {_why_not(before, place)}")


def _went(trees: Trees, row: int, after: Frame) -> TreeChange:
    return _change("vanished", trees, row, f"now: {_why_not(after, trees.position[row])}")


def _moved(trees: Trees, row: int, distance: float) -> TreeChange:
    return _change("moved", trees, row, f"by {100 * distance:.0f} cm")


def _change(kind: Literal["appeared", "vanished", "moved"], trees: Trees, row: int, why: str) -> TreeChange:
    x, y = trees.position[row]
    return TreeChange(kind, int(trees.number[row]), round(float(x), 3), round(float(y), 3), why)


def _why_not(frame: Frame, place: Float) -> str:
    """Return the reason why a map has no tree at a place."""
    if frame.columns is not None:
        near = _nearest(frame.columns.axis[:, :2], place)
        if near >= 0:
            reason = _column(frame.columns, near)
            if reason:
                return reason
    near = _nearest(frame.trees.position, place)
    if near < 0:
        return "no tree was detected there"
    seen = int(frame.trees.observations[near])
    return f"seen {seen} time{'s' * (seen != 1)}, which does not confirm it"


def _column(columns: Columns, row: int) -> str:
    """Return the verdict of a column as text; "" for a tree."""
    verdict = Verdict(int(columns.verdict[row]))
    if verdict is Verdict.TREE:
        return ""
    if verdict in (Verdict.TOO_FEW_POINTS, Verdict.MOVING):
        return f"the object there is classified as {verdict.label!r}"
    share = 100 * float(columns.share[row, 0])
    return f"the object there is classified as {verdict.label!r} ({share:.0f} % of the votes for a tree)"


def _nearest(places: Float, place: Float) -> int:
    """Return the row of the nearest of some positions, shape (K, 2), to a position, shape (2,); -1 if none is
    within SAME."""
    if not len(places):
        return -1
    distance = np.hypot(*(places - place).T)
    row = int(np.argmin(distance))
    return row if distance[row] <= SAME else -1
