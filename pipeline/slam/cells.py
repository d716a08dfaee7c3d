"""The landmarks of one particle in cells, so that only those near a place are asked for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiled import compiled, compiled_borrowing, compiled_within
from pipeline.geometry import Float
from pipeline.records import Bool, Int32

SIDE = 32  # cells; the plane is folded into so many squared, for what is in reach spans fewer
WIDER = 1.0 + 1e-6  # than the search, so that rounding at a border loses nobody


class Cells(NamedTuple):
    """Chains of landmarks, one a cell.

    Attributes:
        head: int32, shape (SIDE * SIDE,): the first landmark of a cell, -1 for none.
        following: int32, shape (L,): the one after each; cell: int32, shape (L,): where each one is.
    """

    head: Int32
    following: Int32
    cell: Int32


@compiled
def cells_for(landmarks: int) -> Cells:
    """Empty cells with room for so many landmarks."""
    return Cells(
        np.full(SIDE * SIDE, -1, np.int32), np.empty(landmarks, np.int32), np.empty(landmarks, np.int32)
    )


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
    """Put the first rows of `mean`, shape (L, 2) [m], into empty cells, `scale` of them a metre."""
    for j in range(known - 1, -1, -1):
        at = cell_of(int(np.floor(scale * mean[j, 0])), int(np.floor(scale * mean[j, 1])))
        cells.cell[j] = at
        cells.following[j] = cells.head[at]
        cells.head[at] = j


@compiled_within
def clear(cells: Cells, known: int) -> None:
    """Empty the cells again, of so many landmarks."""
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
