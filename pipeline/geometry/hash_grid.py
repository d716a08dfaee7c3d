"""Places in cells, so that only those near another one are asked for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within

Bool = NDArray[np.bool_]
Int32 = NDArray[np.int32]

SIDE = 32  # cells; the plane is folded into so many squared, for what is in reach spans fewer
WIDER = 1.0 + 1e-6  # than the search, so that rounding at a border loses nobody


class Cells(NamedTuple):
    """Chains of places, one a cell.

    Attributes:
        head: int32, shape (SIDE * SIDE,): the first place of a cell, -1 for none.
        following: int32, shape (L,): the one after each; cell: int32, shape (L,): where each one is.
    """

    head: Int32
    following: Int32
    cell: Int32


@compiled
def cells_for(places: int) -> Cells:
    """Empty cells with room for so many places."""
    return Cells(np.full(SIDE * SIDE, -1, np.int32), np.empty(places, np.int32), np.empty(places, np.int32))


@compiled_borrowing
def per_metre(radius: float) -> float:
    """Cells a metre for searches of this radius [m]: four of them hold all within it of a place."""
    return 0.5 / (WIDER * radius)


@compiled_within
def cell_of(u: int, v: int) -> int:
    """The number of a cell in a row and a column of the plane."""
    return (u & (SIDE - 1)) * SIDE + (v & (SIDE - 1))


@compiled_within
def first_of_four(x: float, y: float, scale: float) -> tuple[int, int]:
    """Row and column of the first of the two by two cells that hold all within the radius of a place."""
    return int(np.floor(scale * x - 0.5)), int(np.floor(scale * y - 0.5))


@compiled_within
def fill(cells: Cells, mean: Float, known: int, scale: float) -> None:
    """Put the first rows of `mean`, shape (L, 2 or more) [m], into empty cells, `scale` of them a metre."""
    for j in range(known - 1, -1, -1):
        put_in(cells, mean, j, scale)


@compiled_within
def put_in(cells: Cells, mean: Float, j: int, scale: float) -> None:
    """File a place under the cell that it lies in."""
    at = cell_of(int(np.floor(scale * mean[j, 0])), int(np.floor(scale * mean[j, 1])))
    cells.cell[j] = at
    cells.following[j] = cells.head[at]
    cells.head[at] = j


@compiled_within
def take_out(cells: Cells, j: int) -> None:
    """Take a place out of the cell that it is filed under."""
    before = cells.head[cells.cell[j]]
    if before == j:
        cells.head[cells.cell[j]] = cells.following[j]
        return
    while cells.following[before] != j:
        before = cells.following[before]
    cells.following[before] = cells.following[j]


@compiled_within
def clear(cells: Cells, known: int) -> None:
    """Empty the cells again, of so many places."""
    for j in range(known):
        cells.head[cells.cell[j]] = -1


@compiled_within
def holds_unseen(
    cells: Cells, mean: Float, seen: Bool, x: float, y: float, radius2: float, scale: float
) -> bool:
    """Whether a landmark that was not seen stands within a radius (its square is given) of a place."""
    u, v = first_of_four(x, y, scale)
    for quarter in range(4):
        at = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
        while at >= 0:
            dx, dy = mean[at, 0] - x, mean[at, 1] - y
            if not seen[at] and dx * dx + dy * dy <= radius2:
                return True
            at = cells.following[at]
    return False


@compiled_within
def nearest_in(cells: Cells, mean: Float, x: float, y: float, reach: float, scale: float) -> int:
    """The place nearest to another one, the first of equals; -1 where none is nearer than the reach."""
    u, v = first_of_four(x, y, scale)
    best, nearest = reach * reach, -1
    for quarter in range(4):
        at = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
        while at >= 0:
            dx, dy = mean[at, 0] - x, mean[at, 1] - y
            d = dx * dx + dy * dy
            if d < best or (d == best and at < nearest):
                best, nearest = d, at
            at = cells.following[at]
    return nearest
