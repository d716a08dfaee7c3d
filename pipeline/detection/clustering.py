"""Clustering of the points of one scan (section 3.2 of the paper): DBSCAN, or range jumps of a planar laser.

DBSCAN (Ester et al. 1996) runs on one of three engines, which agree on core points, noise and core clusters.
A border point within reach of two clusters is assigned to the nearest core point by the compiled grid; in
scikit-learn and Open3D its cluster depends on the order of the points.

The compiled grid (Gunawan 2013) has cells with a diagonal of eps. Two points of one cell are always
neighbours, so all points of a cell with `min_points` points are core points, all core points of a cell form
one cluster, and clusters grow by joining cells. Most distances between points of dense trunks are therefore
never computed. The points are sorted by cell with the last axis fastest, so that the neighbourhood of a cell
consists of few rows of cells and each row is one contiguous range of memory.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, Protocol

import numpy as np

from pipeline.config.stages import Clustering
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Bool, Float32, Int, Int32, Labels, Sensor

_AXIS_BITS = 21
_FARTHEST = float(1 << _AXIS_BITS)
_ROUNDING = 1.0 - 1e-9  # keeps the diagonal of a cell below eps in floating point
_REACH = 2  # cells along each axis
_AXES = 3


class Cores(NamedTuple):
    """Core points sorted by cell.

    Attributes:
        place: Coordinates of the core points, shape (_AXES, cores) [m].
        bounds: Index of the first core point of each cell, shape (cells + 1,).
        box: Minimum, then maximum coordinates of the core points of each cell, shape (cells, 2 * _AXES) [m].
    """

    place: Float
    bounds: Int
    box: Float


def dbscan_grid(
    points: Float, eps: float, min_points: int, weight: Int32 | None = None
) -> tuple[Int32, Bool]:
    """Cluster points with DBSCAN on the compiled grid.

    Args:
        points: Points, shape (N, 2) or (N, 3) [m], finite; may be empty.
        eps: Maximum distance between neighbours, inclusive [m].
        min_points: Minimum number of neighbours of a core point, including the point itself.
        weight: Number of neighbours that each point counts for, at least 1, int32, shape (N,); None means 1.
            The result equals that of a cloud in which each point is repeated this many times.

    Returns:
        Cluster labels, int32, shape (N,), numbered in the order of their first point, -1 for noise; and a
        mask of the core points, shape (N,).

    Raises:
        ValueError: The cloud is wider than about 2^21 cells (eps / sqrt(axes)) along an axis.
    """
    n, dimensions = points.shape
    if n == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.bool_)
    side = eps / np.sqrt(dimensions) * _ROUNDING
    # A margin of two cells on every side prevents that the key of a neighbour wraps into another row.
    cells = np.minimum((points - points.min(axis=0)) / side, _FARTHEST).astype(np.int64) + _REACH
    if int(cells.max()) + _REACH >= 1 << _AXIS_BITS:
        raise ValueError("the cloud is too wide for cells of this eps")
    key = cells @ np.array([1 << (_AXIS_BITS * axis) for axis in reversed(range(dimensions))], np.int64)
    weight = np.ones(n, np.int32) if weight is None else weight
    order = np.argsort(key, kind="stable")
    return _cluster(points, key, order, _row_offsets(dimensions), eps * eps, min_points, weight)


@cache
def _row_offsets(dimensions: int) -> Int:
    """Return the key offsets from a cell to the rows of cells along the last axis that can contain a
    neighbour, int64, shape (5,) for 2 and (25,) for 3 `dimensions`: the key plus an offset is that of the
    cell in this row with the same last coordinate. They are sorted by distance, the row of the cell itself
    (0) first. The array is cached and must not be changed."""
    reach = np.arange(-_REACH, _REACH + 1)
    rows = np.stack(np.meshgrid(*([reach] * (dimensions - 1)), indexing="ij"), -1).reshape(-1, dimensions - 1)
    rows = rows[np.argsort((rows**2).sum(axis=1), kind="stable")]
    keys: Int = rows @ np.array([1 << (_AXIS_BITS * axis) for axis in range(dimensions - 1, 0, -1)], np.int64)
    return keys


@compiled
def _cluster(
    points: Float, key_of: Int, order: Int, rows: Int, eps2: float, min_points: int, weight: Int32
) -> tuple[Int32, Bool]:
    """Sort the points by cell and label them; see `dbscan_grid`.

    Args:
        points: Points, shape (N, 2 or 3) [m], N at least 1.
        key_of: Key of the cell of each point, not negative, shape (N,).
        order: Rows of the points by ascending key, shape (N,).
        rows: Result of `_row_offsets`.
        eps2: Square of the radius [m^2].
        min_points: Minimum weight within the radius of a core point, including its own.
        weight: Weight of each point, shape (N,).

    Returns:
        Cluster of each point, numbered in the order of their first point, -1 for noise, and whether it is a
        core point, shape (N,).
    """
    n = points.shape[0]
    keys, bounds = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    # A third axis of zeros does not change distances in the plane.
    laid, weight_laid = np.zeros((_AXES, n)), np.empty_like(weight)
    last, filled = np.int64(-1), 0
    for k in range(n):
        i = order[k]
        for a in range(points.shape[1]):
            laid[a, k] = points[i, a]
        weight_laid[k] = weight[i]
        if key_of[i] != last:
            keys[filled] = last = key_of[i]
            bounds[filled] = k
            filled += 1
    bounds[filled] = n
    keys, bounds = keys[:filled], bounds[: filled + 1]
    reach = _in_reach(keys, rows)
    core = _find_cores(laid, bounds, reach, eps2, min_points, weight_laid)
    cores = _lay_cores(laid, bounds, core)
    parent = _join(cores, rows, reach, eps2)
    label, core_out = np.full(n, -1, np.int32), np.empty(n, np.bool_)
    for c in range(filled):
        root = root_of(parent, c)
        for i in range(bounds[c], bounds[c + 1]):
            core_out[order[i]] = core[i]
            if core[i]:
                label[order[i]] = root
                continue
            d = _cell_of_nearest_core(laid, i, cores, c, reach, eps2)
            if d >= 0:
                label[order[i]] = root_of(parent, d)
    return number_by_first_point(label), core_out


@compiled
def number_by_first_point(label: Int32) -> Int32:
    """Return the labels, int32, shape (N,), renumbered 0, 1, ... in the order of their first point; negative
    labels become -1. The argument is not changed."""
    most = 0
    for each in label:
        most = max(most, each)
    number, ordered, clusters = np.full(most + 1, -1, np.int32), np.full_like(label, -1), 0
    for k in range(label.shape[0]):
        if label[k] >= 0:
            if number[label[k]] < 0:
                number[label[k]] = clusters
                clusters += 1
            ordered[k] = number[label[k]]
    return ordered


@compiled
def _in_reach(keys: Int, rows: Int) -> Int32:
    """Return, for each cell and row, the range of filled cells that can contain a neighbour.

    Args:
        keys: Ascending keys of the filled cells, shape (cells,).
        rows: Result of `_row_offsets`, shape (rows,).

    Returns:
        First cell and one past the last cell (equal for none), int32, shape (cells, rows, 2).
    """
    cells = keys.shape[0]
    reach = np.empty((cells, rows.shape[0], 2), np.int32)
    for r in range(rows.shape[0]):
        first = after = 0
        for c in range(cells):  # keys ascend, and so do the searched keys: one pass
            least = keys[c] + rows[r] - _REACH
            while first < cells and keys[first] < least:
                first += 1
            while after < cells and keys[after] <= least + 2 * _REACH:
                after += 1
            reach[c, r, 0], reach[c, r, 1] = first, after
    return reach


@compiled
def _find_cores(laid: Float, bounds: Int, reach: Int32, eps2: float, min_points: int, weight: Int32) -> Bool:
    """Return whether each point is a core point: the weight within the radius, including its own, is at least
    `min_points`; shape (N,), in the order of `laid`.

    Args:
        laid: Points sorted by cell, shape (_AXES, N) [m].
        bounds: First point of each cell, and N, shape (cells + 1,).
        reach: Result of `_in_reach`.
        eps2: Square of the radius [m^2].
        min_points: Minimum weight.
        weight: Weight of each point in the order of `laid`, shape (N,).
    """
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
                else:  # the cell itself is in the middle of its row and already counted
                    count += _weight_within(x, y, z, weight, first, begin, i, eps2)
                    count += _weight_within(x, y, z, weight, end, after, i, eps2)
            core[i] = count >= min_points
    return core


@compiled_borrowing
def _weight_within(
    x: Float, y: Float, z: Float, weight: Int32, first: int, after: int, i: int, eps2: float
) -> int:
    """Return the total weight of the points first..after-1 within eps (inclusive) of point i.

    Args:
        x, y, z: Coordinates of all points, shape (N,) [m].
        weight: Weights, shape (N,).
        first, after: Range of the points.
        i: Row of the centre; it is counted if it is in the range.
        eps2: Square of the radius [m^2].
    """
    count = 0
    # An unsigned index avoids the check for negative (wrap-around) indexing.
    for j in range(np.uint64(first), np.uint64(after)):
        dx, dy, dz = x[i] - x[j], y[i] - y[j], z[i] - z[j]
        if dx * dx + dy * dy + dz * dz <= eps2:
            count += weight[j]
    return count


@compiled
def _lay_cores(laid: Float, bounds: Int, core: Bool) -> Cores:
    """Return the core points sorted by cell with the bounding boxes of the cells; the box of a cell without a
    core point is empty (inf to -inf).

    Args:
        laid: Points sorted by cell, shape (_AXES, N) [m].
        bounds: First point of each cell, and N, shape (cells + 1,).
        core: Whether each point is a core point, shape (N,).
    """
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
    """Return the parent of each cell in a disjoint-set structure with one set per cluster of cells, int64,
    shape (cells,).

    The cell with the smallest index of a cluster is its root; a cell without core points is its own root.
    Near rows are joined first.

    Args:
        cores: Core points by cell.
        rows: Result of `_row_offsets`, shape (rows,).
        reach: Result of `_in_reach`, shape (cells, rows, 2).
        eps2: Square of the radius [m^2].
    """
    cells = cores.box.shape[0]
    parent = np.arange(cells)
    for r in range(rows.shape[0]):
        if rows[r] < 0:
            continue  # joined when the other cell is visited
        for c in range(cells):
            if cores.bounds[c] == cores.bounds[c + 1]:
                continue
            for d in range(max(reach[c, r, 0], c + 1), reach[c, r, 1]):
                if cores.bounds[d] == cores.bounds[d + 1]:
                    continue
                a, b = root_of(parent, c), root_of(parent, d)
                if a != b and _touch(cores, c, d, eps2):
                    parent[max(a, b)] = min(a, b)
    return parent


@compiled
def root_of(parent: Int, c: int) -> int:
    """Return the root of cell c in a disjoint-set structure, and halve the path to the root in `parent`,
    int64, shape (C,)."""
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@compiled_borrowing
def _touch(cores: Cores, c: int, d: int, eps2: float) -> bool:
    """Return whether a core point of cell c is within eps (inclusive) of a core point of cell d; False if
    either has none. `eps2` is the square of eps [m^2]."""
    place, box = cores.place, cores.box
    for i in range(cores.bounds[c], cores.bounds[c + 1]):
        x, y, z = place[0, i], place[1, i], place[2, i]
        # Rounding is monotonic: no point in the box is closer than the box.
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
def _cell_of_nearest_core(laid: Float, i: int, cores: Cores, c: int, reach: Int32, eps2: float) -> int:
    """Return the cell of the core point nearest to point i of cell c, or -1 if none is within eps
    (inclusive).

    Of several cells at the same distance, the first in the order of the keys is returned.

    Args:
        laid: Points sorted by cell, shape (_AXES, N) [m].
        i: Column of the point in `laid`.
        cores: Core points by cell.
        c: Cell of the point.
        reach: Result of `_in_reach`.
        eps2: Square of eps [m^2].
    """
    best, best2 = -1, eps2
    x, y, z = laid[0, i], laid[1, i], laid[2, i]
    for r in range(reach.shape[1]):
        for d in range(reach[c, r, 0], reach[c, r, 1]):
            for j in range(cores.bounds[d], cores.bounds[d + 1]):
                dx, dy, dz = x - cores.place[0, j], y - cores.place[1, j], z - cores.place[2, j]
                d2 = dx * dx + dy * dy + dz * dz
                if d2 < best2 or (d2 == best2 and (best < 0 or d < best)):
                    best, best2 = d, d2
    return best


# Ring spacing [rad] of a solid-state sensor with 24,000 returns in a cone of 70 degrees, used for sensors
# without rings.
UNKNOWN_RING_STEP = float(np.radians(0.8))


def weigh(points: Float32, sensor: Sensor, parameters: Clustering) -> Int32:
    """Return the number of neighbours that each point counts for, int32, shape (N,), 1 to `weight_max`.

    A visible stem area A gives n(r) = A / (r^2 da de) returns at the horizontal range r, where da and de are
    the angles between successive shots and between rings. Where n(r) is below `min_points`, a return has the
    weight min_points / n(r), rounded down. Elsewhere the weight is 1.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m], finite.
        sensor: Angles between shots and between rings; UNKNOWN_RING_STEP for a sensor without rings.
        parameters: `stem_area` is A [m^2], above 0.
    """
    rings = sensor.ring_step if sensor.ring_step > 0.0 else UNKNOWN_RING_STEP
    scale = parameters.min_points * sensor.azimuth_step * rings / parameters.stem_area
    return _weigh(points, scale, parameters.weight_max)


@compiled
def _weigh(points: Float32, scale: float, most: int) -> Int32:
    """Return scale * (x^2 + y^2) of each point, rounded down and limited to 1..most, int32, shape (N,);
    `scale` [1/m^2] is that of `weigh`."""
    weight = np.empty(points.shape[0], np.int32)
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        weight[i] = int(min(max(scale * (x * x + y * y), 1.0), float(most)))
    return weight


def range_jump(points: Float32, jump: float, min_points: int, azimuth_step: float) -> tuple[Int32, Bool]:
    """Cluster the beams of a planar laser: a cluster ends where the range jumps or more than one beam is
    missing. The beams are sorted by azimuth; the circle is closed, so that a cluster may extend over the seam
    behind the sensor.

    Args:
        points: Points in the sensor frame, float32, shape (N, 3) [m]; z is ignored.
        jump: Maximum difference in range between neighbouring beams of one cluster [m].
        min_points: Minimum number of points of a cluster; smaller ones are noise.
        azimuth_step: Angle between neighbouring beams [rad]; beams up to 2.5 steps apart are neighbours.

    Returns:
        Labels, int32, shape (N,), -1 for noise, numbered counter-clockwise; and for each cluster whether the
        return of a neighbouring beam is closer and hides one of its edges, shape (clusters,). A cluster that
        surrounds the sensor without a gap counts as hidden if the ranges at its seam differ.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.bool_)
    x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    azimuth = np.arctan2(y, x)
    order = np.argsort(azimuth, kind="stable")
    return _cut(azimuth[order], np.hypot(x, y)[order], order, jump, min_points, 2.5 * azimuth_step)


@compiled
def _cut(
    azimuth: Float, distance: Float, order: Int, jump: float, min_points: int, gap: float
) -> tuple[Int32, Bool]:
    """Cluster beams in the order of their azimuth; result as in `range_jump`.

    Args:
        azimuth: Ascending azimuth of each beam, shape (N,), N at least 1 [rad].
        distance: Horizontal range of each beam in the same order, shape (N,) [m].
        order: Row of each beam in the scan, in which the labels are returned.
        jump: Maximum difference in range between neighbours of one cluster [m].
        min_points: Minimum number of points of a cluster; smaller ones are noise.
        gap: Maximum angle between neighbours [rad].
    """
    n = azimuth.shape[0]
    # neighbours[i], begins[i]: relation of beam i to beam i - 1. The circle is closed: the first beam follows
    # the last one.
    neighbours = np.zeros(n, np.bool_)
    begins = np.zeros(n, np.bool_)
    for i in range(n):
        turn = azimuth[i] - azimuth[i - 1] + (2.0 * np.pi if i == 0 else 0.0)
        neighbours[i] = n > 1 and turn <= gap
        begins[i] = not (neighbours[i] and abs(distance[i] - distance[i - 1]) <= jump)
    first = 0
    while first < n - 1 and not begins[first]:
        first += 1
    label = np.full(n, -1, np.int32)
    hidden = np.zeros(n, np.bool_)
    clusters = 0
    start = first
    for k in range(first + 1, first + n + 1):
        if k < first + n and not begins[k % n]:
            continue
        if k - start >= min_points:
            for i in range(start, k):
                label[order[i % n]] = clusters
            a, b = start % n, (k - 1) % n
            before = neighbours[a] and distance[a - 1] < distance[a]
            after = neighbours[k % n] and distance[k % n] < distance[b]
            hidden[clusters] = before or after
            clusters += 1
        start = k
    return label, hidden[:clusters].copy()


class Engine(Protocol):
    """DBSCAN on points of shape (N, 2 or 3) [m] with weights, int32, shape (N,), None for 1 each. It returns
    the cluster of each point, int32, shape (N,), numbered in the order of the first points, -1 for noise."""

    def __call__(
        self, points: Float32, eps: float, min_points: int, weight: Int32 | None = None
    ) -> Int32: ...


def _grid(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Int32:
    """Return the labels of `dbscan_grid`, see `Engine`.

    Raises:
        ValueError: The cloud is too wide for the cells, see `dbscan_grid`.
    """
    return dbscan_grid(points.astype(np.float64), eps, min_points, weight)[0]


def _sklearn(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Int32:
    """Return the labels of DBSCAN of scikit-learn, see `Engine`; no points give an empty array."""
    from sklearn.cluster import DBSCAN

    if len(points) == 0:
        return np.zeros(0, np.int32)
    fitted = DBSCAN(eps=eps, min_samples=min_points).fit(points.astype(np.float64), sample_weight=weight)
    return number_by_first_point(fitted.labels_.astype(np.int32))


def _open3d(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Int32:
    """Return the labels of DBSCAN of Open3D, see `Engine`; no points give an empty array. Memory grows with
    the sum of the weights, because Open3D gets each point repeated."""
    import open3d

    if len(points) == 0:
        return np.zeros(0, np.int32)
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points
    # Open3D has no weights; repeated points have the same effect.
    times = np.ones(len(points), np.int32) if weight is None else weight
    space, first = np.repeat(space, times, axis=0), np.cumsum(times) - times
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(space))
    # Open3D uses distance < radius, the other engines distance <= radius.
    radius = float(np.nextafter(eps, np.inf))
    label = np.asarray(cloud.cluster_dbscan(radius, min_points), np.int32)[first]
    return number_by_first_point(label)


ENGINES: dict[str, Engine] = {
    "grid": _grid,
    "sklearn": _sklearn,
    "open3d": _open3d,
}


#: A coarse sensor (Mid-360: one degree between returns) must not cut a stem in two at this range: `eps` is at
#: least the distance of its returns there, up to EPS_MOST, above which undergrowth joins the stems [m].
COARSE_RANGE, EPS_MOST = 12.0, 0.25


def cluster(points: Float32, sensor: Sensor, parameters: Clustering) -> Labels:
    """Cluster the points of a scan.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m], finite; may be empty.
        sensor: The LiDAR, whose angular resolution sets weights, beam gaps and the least `eps`.
        parameters: Method and thresholds. The method "range_jump" uses `eps` as the maximum jump; otherwise
            `engine` runs DBSCAN on the first two or three coordinates, with weights if `stem_area` is above
            0.

    Returns:
        Cluster of each point, -1 for noise, and for each cluster whether one of its edges is hidden, which
        only "range_jump" finds (False for DBSCAN).

    Raises:
        ValueError: The cloud is too wide for the cells of the engine "grid", see `dbscan_grid`.
    """
    if parameters.method == "range_jump":
        label, hidden = range_jump(points, parameters.eps, parameters.min_points, sensor.azimuth_step)
        return Labels(label, len(hidden), hidden)
    eps = max(parameters.eps, min(sensor.azimuth_step * COARSE_RANGE, EPS_MOST))
    plane = np.ascontiguousarray(points[:, : parameters.dimensions])
    weight = weigh(points, sensor, parameters) if parameters.stem_area > 0.0 else None
    label = ENGINES[parameters.engine](plane, eps, parameters.min_points, weight)
    clusters = int(label.max(initial=-1)) + 1
    return Labels(label, clusters, np.zeros(clusters, np.bool_))
