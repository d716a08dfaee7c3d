"""DBSCAN on a grid of cells whose diagonal is eps (Gunawan 2013), compiled.

Two points of one cell are always neighbours, so a cell with `min_points` is all core, all cores of
a cell are one cluster, and clusters grow by joining cells. That saves nearly all distances where
trunks are dense, which is where the others are slow.

Points are laid cell by cell, the last axis running fastest: what can be near a cell lies in few rows of
cells, and each row is one stretch of memory.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Bool, Int, Int32

_AXIS_BITS = 21
_FARTHEST = float(1 << _AXIS_BITS)
_DIGIT_BITS = 10  # of a counting sort: its table stays in the nearest cache
_DIGIT = 1 << _DIGIT_BITS
_ROUNDING = 1.0 - 1e-9  # keeps the diagonal of a cell below eps in floating point
_REACH = 2  # cells along each axis
_AXES = 3


class Cores(NamedTuple):
    """The cores, cell by cell.

    Attributes:
        place: shape (_AXES, cores) [m].
        bounds: shape (cells + 1,): where those of each cell begin.
        box: shape (cells, 2 * _AXES): least and greatest coordinates of each cell's [m].
    """

    place: Float
    bounds: Int
    box: Float


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
    rows, offsets = _offsets(dimensions)
    weight = np.ones(n, np.int32) if weight is None else weight
    return _cluster(points, cells, rows, offsets, eps * eps, min_points, weight)


@cache
def _offsets(dimensions: int) -> tuple[Int, Int]:
    """Key differences of the cells that can hold a neighbour: the middles of their rows along the last axis,
    the cell's own row first; and all of them, nearest first, without the cell itself."""
    reach = np.arange(-_REACH, _REACH + 1)
    grid = np.stack(np.meshgrid(*([reach] * dimensions), indexing="ij"), axis=-1).reshape(-1, dimensions)
    grid = grid[np.argsort((grid**2).sum(axis=1), kind="stable")]
    weights = np.array([1 << (_AXIS_BITS * (dimensions - 1 - axis)) for axis in range(dimensions)], np.int64)
    keys: Int = grid @ weights
    return keys[grid[:, -1] == 0], keys[1:]


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
    points: Float, cells: Int32, rows: Int, offsets: Int, eps2: float, min_points: int, weight: Int32
) -> tuple[Int32, Bool]:
    """Lay the points cell by cell, and label them there."""
    n = points.shape[0]
    order = _by_key(cells)
    keys, bounds = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    # A third axis of zeros adds nothing to a distance in the plane.
    laid, weight_laid = np.zeros((_AXES, n)), np.empty_like(weight)
    last, filled = np.int64(-1), 0
    for k in range(n):
        i = order[k]
        key = np.int64(0)
        for a in range(points.shape[1]):
            key = (key << _AXIS_BITS) | np.int64(cells[i, a])
            laid[a, k] = points[i, a]
        weight_laid[k] = weight[i]
        if key != last:
            keys[filled], bounds[filled], last = key, k, key
            filled += 1
    bounds[filled] = n
    keys, bounds = keys[:filled], bounds[: filled + 1]
    reach = _in_reach(keys, rows)
    core = _find_cores(laid, bounds, reach, eps2, min_points, weight_laid)
    cores = _lay_cores(laid, bounds, core)
    parent = _join(cores, rows, reach, eps2)
    label, core_out = np.full(n, -1, np.int32), np.empty(n, np.bool_)
    for c in range(filled):
        root = _root(parent, c)
        for i in range(bounds[c], bounds[c + 1]):
            core_out[order[i]] = core[i]
            if core[i]:
                label[order[i]] = root
                continue
            d = _cell_of_nearest_core(laid, i, cores, keys, c, reach, offsets, eps2)
            if d >= 0:
                label[order[i]] = _root(parent, d)
    _number(label, filled)
    return label, core_out


@compiled
def _number(label: Int32, most: int) -> None:
    """Number the labels, which are less than `most`, in the order of first points."""
    number, clusters = np.full(most, -1, np.int32), 0
    for k in range(label.shape[0]):
        root = label[k]
        if root >= 0:
            if number[root] < 0:
                number[root] = clusters
                clusters += 1
            label[k] = number[root]


@compiled
def _in_reach(keys: Int, rows: Int) -> Int32:
    """In each row of cells around each cell, the first that can hold a neighbour and the one after the last;
    shape (cells, rows, 2)."""
    cells = keys.shape[0]
    reach = np.empty((cells, rows.shape[0], 2), np.int32)
    for r in range(rows.shape[0]):
        first = after = 0
        for c in range(cells):  # keys ascend, so the wanted keys do too: one sweep
            least = keys[c] + rows[r] - _REACH
            while first < cells and keys[first] < least:
                first += 1
            while after < cells and keys[after] <= least + 2 * _REACH:
                after += 1
            reach[c, r, 0], reach[c, r, 1] = first, after
    return reach


@compiled
def _find_cores(laid: Float, bounds: Int, reach: Int32, eps2: float, min_points: int, weight: Int32) -> Bool:
    core = np.zeros(laid.shape[1], np.bool_)
    x, y, z = laid[0], laid[1], laid[2]
    for c in range(reach.shape[0]):
        begin, end = bounds[c], bounds[c + 1]
        here = 0
        for i in range(begin, end):
            here += weight[i]
        for i in range(begin, end):
            count = here
            for r in range(reach.shape[1]):
                if count >= min_points:
                    break
                first, after = bounds[reach[c, r, 0]], bounds[reach[c, r, 1]]
                if r > 0:
                    count += _weight_within(x, y, z, weight, first, after, i, eps2)
                else:  # the cell itself lies in the middle of its row, and is counted
                    count += _weight_within(x, y, z, weight, first, begin, i, eps2)
                    count += _weight_within(x, y, z, weight, end, after, i, eps2)
            core[i] = count >= min_points
    return core


@compiled_borrowing
def _weight_within(
    x: Float, y: Float, z: Float, weight: Int32, first: int, after: int, i: int, eps2: float
) -> int:
    """What the points of a stretch that are near to point i count together."""
    count = 0
    # An index without a sign needs no look whether it counts from the end.
    for j in range(np.uint64(first), np.uint64(after)):
        dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
        if dx * dx + dy * dy + dz * dz <= eps2:
            count += weight[j]
    return count


@compiled
def _lay_cores(laid: Float, bounds: Int, core: Bool) -> Cores:
    cells = bounds.shape[0] - 1
    place, first = np.empty((_AXES, core.sum())), np.empty(cells + 1, np.int64)
    box = np.empty((cells, 2 * _AXES))
    n = 0
    for c in range(cells):
        first[c] = n
        for a in range(_AXES):
            box[c, a], box[c, _AXES + a] = np.inf, -np.inf
        for i in range(bounds[c], bounds[c + 1]):
            if core[i]:
                for a in range(_AXES):
                    at = laid[a, i]
                    place[a, n] = at
                    box[c, a], box[c, _AXES + a] = min(box[c, a], at), max(box[c, _AXES + a], at)
                n += 1
    first[cells] = n
    return Cores(place, first, box)


@compiled
def _join(cores: Cores, rows: Int, reach: Int32, eps2: float) -> Int:
    """A tree of cells for each cluster: the parent of each cell, the least cell of a cluster being its own.

    Rows near by first: after them nearly all that belong together are, and need no distance.
    """
    cells = cores.box.shape[0]
    parent = np.arange(cells)
    for r in range(rows.shape[0]):
        if rows[r] < 0:
            continue  # joined from the other cell
        for c in range(cells):
            if cores.bounds[c] == cores.bounds[c + 1]:
                continue
            for d in range(max(reach[c, r, 0], c + 1), reach[c, r, 1]):
                if cores.bounds[d] == cores.bounds[d + 1]:
                    continue
                a, b = _root(parent, c), _root(parent, d)
                if a != b and _touch(cores, c, d, eps2):
                    parent[max(a, b)] = min(a, b)
    return parent


@compiled
def _root(parent: Int, c: int) -> int:
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@compiled_borrowing
def _touch(cores: Cores, c: int, d: int, eps2: float) -> bool:
    """Whether a core of one cell is near to one of the other."""
    place, box = cores.place, cores.box
    for i in range(cores.bounds[c], cores.bounds[c + 1]):
        x, y, z = place[0, i], place[1, i], place[2, i]
        # Rounding keeps the order of numbers: nothing in the box is nearer than the box.
        dx = max(max(box[d, 0] - x, x - box[d, 3]), 0.0)
        dy = max(max(box[d, 1] - y, y - box[d, 4]), 0.0)
        dz = max(max(box[d, 2] - z, z - box[d, 5]), 0.0)
        if dx * dx + dy * dy + dz * dz > eps2:
            continue
        for j in range(cores.bounds[d], cores.bounds[d + 1]):
            dx, dy, dz = x - place[0, j], y - place[1, j], z - place[2, j]
            if dx * dx + dy * dy + dz * dz <= eps2:
                return True
    return False


@compiled_borrowing
def _cell_of_nearest_core(
    laid: Float, i: int, cores: Cores, keys: Int, c: int, reach: Int32, offsets: Int, eps2: float
) -> int:
    """The cell of the core that is nearest to point i of cell c, -1 where none is near; of cells that are as
    near the first in the order of `offsets`."""
    best, best2 = -1, eps2
    x, y, z = laid[0, i], laid[1, i], laid[2, i]
    for r in range(reach.shape[1]):
        for d in range(reach[c, r, 0], reach[c, r, 1]):
            for j in range(cores.bounds[d], cores.bounds[d + 1]):
                dx, dy, dz = x - cores.place[0, j], y - cores.place[1, j], z - cores.place[2, j]
                d2 = dx * dx + dy * dy + dz * dz
                if d2 < best2 or (
                    d2 == best2
                    and d != best
                    and (best < 0 or _turn(offsets, keys[d] - keys[c]) < _turn(offsets, keys[best] - keys[c]))
                ):
                    best, best2 = d, d2
    return best


@compiled_borrowing
def _turn(offsets: Int, offset: int) -> int:
    """When a cell is asked: the cell itself first."""
    for k in range(offsets.shape[0]):
        if offsets[k] == offset:
            return k + 1
    return 0
