"""Hash grids: chains of positions by square cells of the plane, for searches within a radius, and sums of
points in the cubes of a voxel grid.

A search of the radius r uses cells with a side of 2 r (`per_metre`), so that all positions within r of a
point are in two by two cells. The plane is folded into SIDE x SIDE cells. `group_rows` sorts rows by cell or
by cluster instead, for loops over whole groups. The voxels of `add_to_voxels` are found by a hash table.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Int32 = NDArray[np.int32]

SIDE = 32  # cells per side; the plane is folded into these cells, because a search covers fewer
WIDER = 1.0 + 1e-6  # factor of the cell size, so that rounding at a border loses no position


class Cells(NamedTuple):
    """Chains of positions, one per cell.

    Attributes:
        head: First position of a cell, -1 for none, int32, shape (SIDE * SIDE,).
        following: Next position in the chain, -1 for none, int32, shape (L,).
        cell: Cell of each position, int32, shape (L,).
    """

    head: Int32
    following: Int32
    cell: Int32


@compiled
def cells_for(places: int) -> Cells:
    """Return empty cells with room for `places` positions."""
    return Cells(np.full(SIDE * SIDE, -1, np.int32), np.empty(places, np.int32), np.empty(places, np.int32))


@compiled_borrowing
def per_metre(radius: float) -> float:
    """Return the number of cells per metre for searches of a radius above 0 [m]: two by two cells contain all
    positions within it."""
    return 0.5 / (WIDER * radius)


@compiled_borrowing
def cell_of(u: int, v: int) -> int:
    """Return the index of a cell in `Cells.head` by its row u and its column v in the plane, which may be
    negative."""
    return (u & (SIDE - 1)) * SIDE + (v & (SIDE - 1))


@compiled_borrowing
def first_of_four(x: float, y: float, scale: float) -> tuple[int, int]:
    """Return row and column (see `cell_of`) of the first of the two by two cells that contain all positions
    within the radius of x, y [m]; the others have a row, a column or both larger by 1. `scale` are the cells
    per metre for this radius."""
    return int(np.floor(scale * x - 0.5)), int(np.floor(scale * y - 0.5))


@compiled_borrowing
def fill(cells: Cells, mean: Float, known: int, scale: float) -> None:
    """Put positions into empty cells, in place, the lowest row first in each chain.

    Args:
        cells: Empty cells with room for `known` positions.
        mean: Finite positions, x, y first, shape (L, 2 or more) [m].
        known: Number of rows of `mean` to put in, from row 0 on.
        scale: Cells per metre, the result of `per_metre` for the largest radius of later searches.
    """
    for j in range(known - 1, -1, -1):
        put_in(cells, mean, j, scale)


@compiled_borrowing
def put_in(cells: Cells, mean: Float, j: int, scale: float) -> None:
    """Put row j of `mean`, finite positions with x, y first, shape (L, 2 or more) [m], which is in no cell,
    into its cell, in place, at the start of the chain; `scale` are the cells per metre."""
    at = cell_of(int(np.floor(scale * mean[j, 0])), int(np.floor(scale * mean[j, 1])))
    cells.cell[j] = at
    cells.following[j] = cells.head[at]
    cells.head[at] = j


@compiled_borrowing
def take_out(cells: Cells, j: int) -> None:
    """Remove row j, which `put_in` added and which was not removed since, from its cell, in place."""
    before = cells.head[cells.cell[j]]
    if before == j:
        cells.head[cells.cell[j]] = cells.following[j]
        return
    while cells.following[before] != j:
        before = cells.following[before]
    cells.following[before] = cells.following[j]


@compiled_borrowing
def clear(cells: Cells, known: int) -> None:
    """Empty the cells of rows 0 to known - 1, in place; a cell is emptied with all rows of its chain."""
    for j in range(known):
        cells.head[cells.cell[j]] = -1


@compiled_borrowing
def holds_unseen(
    cells: Cells, mean: Float, seen: Bool, x: float, y: float, radius2: float, scale: float
) -> bool:
    """Return whether a position that was not seen is within a radius of x, y [m], the border included.

    Args:
        cells, scale: Grid of the positions, and its cells per metre for searches within this radius.
        mean: Positions, x, y first, shape (L, 2 or more) [m].
        seen: Whether each position was seen, shape (L,).
        x, y: Centre [m].
        radius2: Square of the radius [m^2].
    """
    u, v = first_of_four(x, y, scale)
    for quarter in range(4):
        at = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
        while at >= 0:
            dx, dy = mean[at, 0] - x, mean[at, 1] - y
            if not seen[at] and dx * dx + dy * dy <= radius2:
                return True
            at = cells.following[at]
    return False


@compiled_borrowing
def nearest_in(cells: Cells, mean: Float, x: float, y: float, reach: float, scale: float) -> int:
    """Return the row of the position nearest to x, y [m], the lowest of equally near ones; -1 for none within
    a reach.

    Args:
        cells: Grid of the positions.
        mean: Positions, x, y first, shape (L, 2 or more) [m].
        x, y: Centre of the search [m].
        reach: Maximum distance [m], exclusive, at most the radius of `scale`.
        scale: Cells per metre of the grid, see `per_metre`.
    """
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


@compiled
def nearest_other(place: Float, other: Float, reach: float) -> Int:
    """Return for each row of `place` the row of the nearest position in `other` within a reach, int64, shape
    (N,); -1 for none.

    Args:
        place: Positions to search from, x, y first, shape (N, 2 or more) [m].
        other: Other positions, x, y first, shape (M, 2 or more) [m]. The lowest row is returned of equally
            near ones.
        reach: Distance [m] above 0; a nearest position at this distance or farther does not count.
    """
    nearest = np.empty(place.shape[0], np.int64)
    cells, scale = cells_for(other.shape[0]), per_metre(reach)
    fill(cells, other, other.shape[0], scale)
    for a in range(place.shape[0]):
        nearest[a] = nearest_in(cells, other, place[a, 0], place[a, 1], reach, scale)
    return nearest


@compiled
def group_rows(label: Int | Int32, groups: int) -> tuple[Int, Int]:
    """Sort rows by their group; rows with a negative label are left out.

    Args:
        label: Group of each row, less than `groups`, shape (N,).
        groups: Number of groups; a group may be empty.

    Returns:
        Rows sorted by group, stable, int64, one for each label >= 0; and the index of the first row of each
        group in that order and the total, int64, shape (groups + 1,).
    """
    bounds = np.zeros(groups + 1, np.int64)
    for k in label:
        if k >= 0:
            bounds[k + 1] += 1
    for k in range(groups):
        bounds[k + 1] += bounds[k]
    place = bounds[:-1].copy()
    order = np.empty(bounds[groups], np.int64)
    for i in range(label.shape[0]):
        if label[i] >= 0:
            order[place[label[i]]] = i
            place[label[i]] += 1
    return order, bounds


AXIS_CELLS = 1 << 21  # three axes of 21 bits fit one 64-bit key
# Odd 64-bit constant that distributes neighbouring cells over the hash table (Fibonacci hashing).
SPREAD = np.uint64(0x9E3779B97F4A7C15)


@compiled
def add_to_voxels(
    points: Float32,
    weight: Int,
    begin: int,
    size: float,
    keys: Int,
    sums: Float,
    counts: Int,
    slots: Int32,
    used: int,
) -> tuple[int, int]:
    """Add points to the voxels of a grid until no voxel is free; return the index of the first point that was
    not added (the number of points if all were), and the number of voxels in use.

    Args:
        points: Points within AXIS_CELLS / 2 voxels of the origin, x, y, z first, float32, shape (N, 3 or
            more) [m].
        weight: Number of points that each point represents, shape (N,).
        begin: First point to add.
        size: Side of a voxel [m].
        keys, sums, counts: Key, weighted sums of the columns, and weight of each voxel in the order of their
            first points, shapes (M,), (M, columns) and (M,), changed in place.
        slots: Hash table, -1 where empty; its length is a power of two and more than M. Changed in place.
        used: Number of voxels in use.
    """
    mask = slots.shape[0] - 1
    shift = np.uint64(64 - int(np.log2(slots.shape[0]) + 0.5))
    for i in range(begin, points.shape[0]):
        key = np.int64(0)
        for a in range(3):
            cell = np.int64(np.floor(points[i, a] / size)) + AXIS_CELLS // 2
            key = (key << 21) | (cell & (AXIS_CELLS - 1))
        # The hash table stores row numbers; keys are stored per row. Most voxels are new and need no key
        # comparison.
        slot = np.int64((np.uint64(key) * SPREAD) >> shift)
        while slots[slot] >= 0 and keys[slots[slot]] != key:
            slot = (slot + 1) & mask
        row = slots[slot]
        if row < 0:
            if used == keys.shape[0]:
                return i, used
            slots[slot] = row = np.int32(used)
            keys[row] = key
            used += 1
        counts[row] += weight[i]
        for a in range(points.shape[1]):
            sums[row, a] += weight[i] * np.float64(points[i, a])
    return points.shape[0], used
