"""How far a plot reaches: the squares that hold points, without the few that lie far from all others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Float
from pipeline.types.records import Float32

SQUARE = 8.0  # m
LEAST = 20  # points of a square that is part of the plot; so are its neighbours
MOST_SQUARES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Corners of a plot, shape (2,) [m]; all its points, and those that lie apart from it."""

    low: Float
    high: Float
    points: int
    apart: int


def find_extent(parts: Iterable[Float32], where: str) -> Extent:
    """The extent of a cloud that comes in parts of shape (N, 3) [m].

    Raises:
        SourceError: There are no points, or they are strewn over too many squares.
    """
    squares: dict[int, tuple[int, Float]] = {}
    for part in parts:
        if len(part):
            _count(part, squares)
        if len(squares) > MOST_SQUARES:
            raise SourceError("the points are strewn too wide for a plot", where=where)
    if not squares:
        raise SourceError("the cloud has no points", where=where, remedy="Export it again")
    count = np.array([n for n, _ in squares.values()])
    bounds = np.array([bound for _, bound in squares.values()])
    key = np.array(list(squares))
    dense = set(key[count >= LEAST].tolist()) or set(key.tolist())
    steps = [(a << 32) + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
    part_of = np.array([any(k + step in dense for step in steps) for k in key.tolist()])
    total = int(count.sum())
    return Extent(
        bounds[part_of, :2].min(axis=0),
        bounds[part_of, 2:].max(axis=0),
        total,
        total - int(count[part_of].sum()),
    )


def _count(part: Float32, squares: dict[int, tuple[int, Float]]) -> None:
    cell = np.floor(part[:, :2] / SQUARE).astype(np.int64) + (1 << 30)
    key = (cell[:, 0] << 32) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    key, xy = key[order], part[order, :2].astype(np.float64)
    starts = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    low, high = np.minimum.reduceat(xy, starts), np.maximum.reduceat(xy, starts)
    sizes = np.diff(np.append(starts, len(key)))
    for k, n, a, b in zip(key[starts].tolist(), sizes.tolist(), low, high, strict=True):
        before, bound = squares.get(k, (0, np.append(a, b)))
        squares[k] = (before + n, np.append(np.minimum(bound[:2], a), np.maximum(bound[2:], b)))
