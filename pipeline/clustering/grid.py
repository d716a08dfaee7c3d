"""DBSCAN on a grid of cells whose diagonal is eps (Gunawan 2013), compiled.

Two points of one cell are always neighbours, so a cell with `min_points` is all core, all cores of
a cell are one cluster, and clusters grow by joining cells. That saves nearly all distances where
trunks are dense, which is where the others are slow.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int, Int32

_AXIS_BITS = 21
_FARTHEST = float(1 << _AXIS_BITS)
_DIGIT_BITS = 10  # of a counting sort: its table stays in the nearest cache
_DIGIT = 1 << _DIGIT_BITS
_ROUNDING = 1.0 - 1e-9  # keeps the diagonal of a cell below eps in floating point


def dbscan_grid(
    points: Float, eps: float, min_points: int, weight: Int32 | None = None
) -> tuple[Int32, Bool]:
    """Cluster points of shape (N, 2) or (N, 3) [m]; neighbours are at most `eps` apart.

    Args:
        points, eps, min_points: As DBSCAN has them.
        weight: int32, shape (N,), at least 1: for how many points each counts among the neighbours of a
            core; None for 1 each. The result is that of a cloud which repeats the points so often.

    Returns:
        Labels, int32, shape (N,), in the order of first points, -1 for noise; and which are cores.

    Raises:
        ValueError: The cloud is wider than 2^21 cells.
    """
    n, dimensions = points.shape
    if n == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.bool_)
    side = eps / np.sqrt(dimensions) * _ROUNDING
    cells = _cells(points, side)
    if int(cells.max()) + 2 >= 1 << _AXIS_BITS:
        raise ValueError("the cloud is too wide for cells of this eps")
    offsets, opposite = _neighbour_offsets(dimensions)
    weight = np.ones(n, np.int32) if weight is None else weight
    return _cluster(points, cells, offsets, opposite, eps * eps, min_points, weight)


@cache
def _neighbour_offsets(dimensions: int) -> tuple[Int, Int]:
    """Key differences of the cells that can hold a neighbour, nearest first, the cell itself left out; and
    where the opposite of each stands in that list."""
    reach = np.arange(-2, 3)
    grid = np.stack(np.meshgrid(*([reach] * dimensions), indexing="ij"), axis=-1).reshape(-1, dimensions)
    gap = np.maximum(np.abs(grid) - 1, 0)
    near = ((gap**2).sum(axis=1) <= dimensions) & (np.abs(grid).sum(axis=1) > 0)
    grid = grid[near][np.argsort((grid[near] ** 2).sum(axis=1), kind="stable")]
    weights = np.array([1 << (_AXIS_BITS * (dimensions - 1 - axis)) for axis in range(dimensions)], np.int64)
    offsets: Int = grid @ weights
    opposite = np.argmax(offsets[:, None] == -offsets[None, :], axis=0)
    return offsets, opposite


@compiled
def _cells(points: Float, side: float) -> Int32:
    """The cell of each point along each axis, shape (N, dimensions).

    Two cells of margin on every side, so that a neighbour's key never wraps into another row. One farther
    than any that is allowed stands for all that are.
    """
    cells = np.empty(points.shape, np.int32)
    for a in range(points.shape[1]):
        low = points[0, a]
        for i in range(points.shape[0]):
            low = min(low, points[i, a])
        for i in range(points.shape[0]):
            cells[i, a] = np.int32(min((points[i, a] - low) / side, _FARTHEST)) + 2
    return cells


@compiled
def _by_key(cells: Int32) -> Int:
    """Rows in the order of their cells, the first axis first, rows of one cell in their own order.

    A counting sort from the least digit to the greatest; an axis of few cells has one digit.
    """
    n = cells.shape[0]
    order, other = np.arange(n), np.empty(n, np.int64)
    place = np.empty(_DIGIT + 1, np.int64)
    for a in range(cells.shape[1] - 1, -1, -1):
        most = 0
        for i in range(n):
            most = max(most, cells[i, a])
        shift = 0
        while most >> shift > 0:
            place[:] = 0
            for i in range(n):
                place[((cells[i, a] >> shift) & (_DIGIT - 1)) + 1] += 1
            for d in range(_DIGIT):
                place[d + 1] += place[d]
            for k in range(n):
                d = (cells[order[k], a] >> shift) & (_DIGIT - 1)
                other[place[d]] = order[k]
                place[d] += 1
            order, other = other, order
            shift += _DIGIT_BITS
    return order


@compiled
def _cluster(
    points: Float, cells: Int32, offsets: Int, opposite: Int, eps2: float, min_points: int, weight: Int32
) -> tuple[Int32, Bool]:
    """Lay the points cell by cell, and label them there."""
    n = points.shape[0]
    order = _by_key(cells)
    keys, bounds = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    laid, weight_laid = np.empty_like(points), np.empty_like(weight)
    last, filled = np.int64(-1), 0
    for k in range(n):
        i = order[k]
        key = np.int64(0)
        for a in range(points.shape[1]):
            key = (key << _AXIS_BITS) | np.int64(cells[i, a])
            laid[k, a] = points[i, a]
        weight_laid[k] = weight[i]
        if key != last:
            keys[filled], bounds[filled], last = key, k, key
            filled += 1
    bounds[filled] = n
    near = _neighbours(keys[:filled], offsets, opposite)
    return _label(laid, bounds[: filled + 1], near, eps2, min_points, order, weight_laid)


@compiled
def _close(points: Float, i: int, j: int, eps2: float) -> bool:
    d2 = 0.0
    for a in range(points.shape[1]):
        d = points[i, a] - points[j, a]
        d2 += d * d
    return d2 <= eps2


@compiled
def _root(parent: Int, c: int) -> int:
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@compiled
def _neighbours(keys: Int, offsets: Int, opposite: Int) -> Int32:
    """Row of the neighbouring cell at each offset, -1 where it is empty; shape (cells, offsets)."""
    found = np.full((keys.shape[0], offsets.shape[0]), -1, np.int32)
    for o in range(offsets.shape[0]):
        if offsets[o] < 0:
            continue  # found from the other cell
        j = 0
        for c in range(keys.shape[0]):  # keys ascend, so the wanted keys do too: one sweep
            wanted = keys[c] + offsets[o]
            while j < keys.shape[0] and keys[j] < wanted:
                j += 1
            if j == keys.shape[0]:
                break
            if keys[j] == wanted:
                found[c, o], found[j, opposite[o]] = j, c
    return found


@compiled
def _find_cores(points: Float, bounds: Int, near: Int32, eps2: float, min_points: int, weight: Int32) -> Bool:
    core = np.zeros(points.shape[0], np.bool_)
    for c in range(near.shape[0]):
        count_here = 0
        for i in range(bounds[c], bounds[c + 1]):
            count_here += weight[i]
        for i in range(bounds[c], bounds[c + 1]):
            count = count_here
            for o in range(near.shape[1]):
                if count >= min_points:
                    break
                d = near[c, o]
                if d >= 0:
                    for j in range(bounds[d], bounds[d + 1]):
                        if _close(points, i, j, eps2):
                            count += weight[j]
            core[i] = count >= min_points
    return core


@compiled
def _touch(points: Float, bounds: Int, core: Bool, c: int, d: int, eps2: float) -> bool:
    for i in range(bounds[c], bounds[c + 1]):
        if core[i]:
            for j in range(bounds[d], bounds[d + 1]):
                if core[j] and _close(points, i, j, eps2):
                    return True
    return False


@compiled
def _label(
    points: Float, bounds: Int, near: Int32, eps2: float, min_points: int, order: Int, weight: Int32
) -> tuple[Int32, Bool]:
    core = _find_cores(points, bounds, near, eps2, min_points, weight)
    cells = near.shape[0]
    parent = np.arange(cells)
    for c in range(cells):
        for o in range(near.shape[1]):
            d = near[c, o]
            if d > c:
                a, b = _root(parent, c), _root(parent, d)
                if a != b and _touch(points, bounds, core, c, d, eps2):
                    parent[max(a, b)] = min(a, b)

    n = points.shape[0]
    cell_of = np.full(n, -1, np.int64)  # the cell whose cluster a point joins
    for c in range(cells):
        for i in range(bounds[c], bounds[c + 1]):
            if core[i]:
                cell_of[i] = c
            else:
                cell_of[i] = _cell_of_nearest_core(points, bounds, core, near, c, i, eps2)

    at = np.empty(n, np.int64)
    for i in range(n):
        at[order[i]] = i
    number = np.full(cells, -1, np.int32)
    label = np.full(n, -1, np.int32)
    core_out = np.empty(n, np.bool_)
    clusters = 0
    for k in range(n):
        i = at[k]
        core_out[k] = core[i]
        if cell_of[i] >= 0:
            root = _root(parent, cell_of[i])
            if number[root] < 0:
                number[root] = clusters
                clusters += 1
            label[k] = number[root]
    return label, core_out


@compiled
def _cell_of_nearest_core(
    points: Float, bounds: Int, core: Bool, near: Int32, c: int, i: int, eps2: float
) -> int:
    best, best2 = -1, eps2
    for o in range(-1, near.shape[1]):
        d = c if o < 0 else near[c, o]
        if d < 0:
            continue
        for j in range(bounds[d], bounds[d + 1]):
            if core[j]:
                d2 = 0.0
                for a in range(points.shape[1]):
                    step = points[i, a] - points[j, a]
                    d2 += step * step
                if d2 < best2 or (d2 == best2 and best < 0):
                    best, best2 = d, d2
    return best
