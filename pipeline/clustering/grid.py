"""DBSCAN on a grid of cells whose diagonal is eps (Gunawan 2013), compiled.

Two points of one cell are always neighbours, so a cell with `min_points` is all core, all cores of
a cell are one cluster, and clusters grow by joining cells. That saves nearly all distances where
trunks are dense, which is where the others are slow.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int, Int32

_AXIS_BITS = 21
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
    low = points.min(axis=0)
    # Two cells of margin on every side, so that a neighbour's key never wraps into another row.
    cells = np.floor((points - low) / side).astype(np.int64) + 2
    if int(cells.max()) + 2 >= 1 << _AXIS_BITS:
        raise ValueError("the cloud is too wide for cells of this eps")
    key = np.zeros(n, np.int64)
    for axis in range(dimensions):
        key = (key << _AXIS_BITS) | cells[:, axis]
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    starts = np.flatnonzero(np.concatenate(([True], sorted_key[1:] != sorted_key[:-1])))
    bounds = np.append(starts, n)
    label, core = _label(
        points[order],
        bounds,
        sorted_key[starts],
        _neighbour_offsets(dimensions),
        eps * eps,
        min_points,
        order,
        np.ones(n, np.int32) if weight is None else weight[order],
    )
    return label, core


@cache
def _neighbour_offsets(dimensions: int) -> Int:
    """Key differences of the cells that can hold a neighbour, nearest first, the cell itself left out."""
    reach = np.arange(-2, 3)
    grid = np.stack(np.meshgrid(*([reach] * dimensions), indexing="ij"), axis=-1).reshape(-1, dimensions)
    gap = np.maximum(np.abs(grid) - 1, 0)
    near = ((gap**2).sum(axis=1) <= dimensions) & (np.abs(grid).sum(axis=1) > 0)
    grid = grid[near][np.argsort((grid[near] ** 2).sum(axis=1), kind="stable")]
    weights = np.array([1 << (_AXIS_BITS * (dimensions - 1 - axis)) for axis in range(dimensions)], np.int64)
    offsets: Int = grid @ weights
    return offsets


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
def _neighbours(keys: Int, offsets: Int) -> NDArray[np.int64]:
    """Row of the neighbouring cell at each offset, -1 where it is empty; shape (cells, offsets)."""
    found = np.full((keys.shape[0], offsets.shape[0]), -1, np.int64)
    for o in range(offsets.shape[0]):
        j = 0
        for c in range(keys.shape[0]):  # keys ascend, so the wanted keys do too: one sweep
            wanted = keys[c] + offsets[o]
            while j < keys.shape[0] and keys[j] < wanted:
                j += 1
            if j < keys.shape[0] and keys[j] == wanted:
                found[c, o] = j
    return found


@compiled
def _find_cores(points: Float, bounds: Int, near: Int, eps2: float, min_points: int, weight: Int32) -> Bool:
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
    points: Float,
    bounds: Int,
    keys: Int,
    offsets: Int,
    eps2: float,
    min_points: int,
    order: Int,
    weight: Int32,
) -> tuple[Int32, Bool]:
    near = _neighbours(keys, offsets)
    core = _find_cores(points, bounds, near, eps2, min_points, weight)
    cells = keys.shape[0]
    parent = np.arange(cells)
    for c in range(cells):
        for o in range(offsets.shape[0]):
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
    points: Float, bounds: Int, core: Bool, near: Int, c: int, i: int, eps2: float
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
