"""Cells of the polar grid: which return may be the ground in each, and how much speaks for it."""

from __future__ import annotations

import numpy as np

from pipeline.ground.terrain import RINGS, SECTORS, on_the_grid, ring_distance
from pipeline.jit import compiled
from pipeline.types.records import Float, Float32, Int32

GHOST = 0.4  # m; ground returns of one cell lie nearer to one another than this
WIDEST = 1.4  # a sector of the diamond against one of the circle
TOLERANCE = 0.15  # m; grass and noise over the steepest slope
LAYER = 0.2  # m above a cell's lowest return; what lies there is ground as well
STANDS, STANDS_UP_TO = 0.3, 2.0  # m above it; what lies there stands on the ground, or is a trunk
WIDE = 0.4  # m; a layer that is spread so far is no trunk's,
WIDELY = 0.6  # and weighs so much, whatever stands on it
FARTHEST = np.float32(1e6)  # m
X, Y, Z = 0, 1, 2
LOW, AT_X, AT_Y, TOTAL, COUNT, STANDING, SPREAD = range(7)


@compiled
def lowest_returns(points: Float32) -> tuple[Int32, Float]:
    """The lowest return of each cell; one that lies alone far below the next is an echo's ghost.

    Returns:
        cell: int32, shape (N,), of each point, sector times RINGS plus ring; -1 where it has none.
        lowest: shape (SECTORS, rings, 3): x, y, z [m] of the lowest return; z is inf where none is.
    """
    cell, rings = _cell_of(points)
    row = np.full((SECTORS * RINGS, 2), -1, np.int32)  # of the lowest return and the next one
    bottom = np.full((SECTORS * RINGS, 2), np.float32(np.inf))
    for i in range(points.shape[0]):
        c = cell[i]
        if c < 0:
            continue
        z, low, next_low, r, next_r = points[i, Z], bottom[c, 0], bottom[c, 1], row[c, 0], row[c, 1]
        # Chosen without a branch, which the processor could not foresee.
        lower, between = z < low, z < next_low
        as_low, as_next = z == low, z == next_low
        if as_low or as_next:
            lower = lower or (as_low and _comes_first(points, i, r))
            between = between or (as_next and _comes_first(points, i, next_r))
        bottom[c, 0], row[c, 0] = (z, np.int32(i)) if lower else (low, r)
        bottom[c, 1] = low if lower else (z if between else next_low)
        row[c, 1] = r if lower else (np.int32(i) if between else next_r)
    lowest = np.full((SECTORS, rings, 3), np.inf)
    for s in range(SECTORS):
        for k in range(rings):
            c = s * RINGS + k
            if row[c, 0] >= 0:
                ghost = bottom[c, 0] + GHOST < bottom[c, 1] < np.inf
                lowest[s, k] = points[row[c, 1] if ghost else row[c, 0]]
    return cell, lowest


@compiled
def _cell_of(points: Float32) -> tuple[Int32, int]:
    """The cell of each point, see `lowest_returns`, and how many rings there are."""
    n = points.shape[0]
    sector, ring = on_the_grid(points)
    cell = np.empty(n, np.int32)
    last, outermost = np.int32(SECTORS - 1), np.int32(0)
    for i in range(n):
        k = np.int32(ring[i])
        c = min(np.int32(sector[i]), last) * np.int32(RINGS) + k
        # Written so that a coordinate that is not a number fails it.
        known = ring[i] < np.float32(RINGS) and abs(points[i, Z]) < FARTHEST
        cell[i] = c if known else np.int32(-1)
        outermost = max(outermost, k if known else np.int32(0))
    return cell, int(outermost) + 1


@compiled
def _comes_first(points: Float32, i: int, other: int) -> bool:
    """Of two returns of the same height the order of the points must not decide."""
    x, y = points[i, X], points[i, Y]
    return bool(x < points[other, X] or (x == points[other, X] and y < points[other, Y]))


@compiled
def forget_what_overhangs(lowest: Float, slope: float) -> None:
    """Take away cells that rise steeper than `slope` above a lower cell near by: hedges and crowns.

    Two sweeps there and back carry each cell's cone of the steepest slope over the whole grid.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    cone = lowest[:, :, Z].copy()
    rise, across = np.empty(rings), np.empty(rings)
    for k in range(rings):
        rise[k] = slope * (ring_distance(k + 0.5) - ring_distance(k - 0.5))
        across[k] = slope * ring_distance(k + 0.5) * (WIDEST * 2.0 * np.pi / sectors)
    for _ in range(2):
        for s in range(sectors):
            for k in range(1, rings):
                cone[s, k] = min(cone[s, k], cone[s, k - 1] + rise[k])
            for k in range(rings - 2, -1, -1):
                cone[s, k] = min(cone[s, k], cone[s, k + 1] + rise[k + 1])
        for there in (1, -1):  # around the circle, twice, so that the seam is none
            for turn in range(2 * sectors):
                s = (there * turn) % sectors
                before = (s - there) % sectors
                for k in range(rings):
                    cone[s, k] = min(cone[s, k], cone[before, k] + across[k])
    for s in range(sectors):
        for k in range(rings):
            if lowest[s, k, Z] > cone[s, k] + TOLERANCE + rise[k]:
                lowest[s, k, Z] = np.inf


@compiled
def evidence(points: Float32, cell: Int32, lowest: Float, plane: Float) -> tuple[Float, Float]:
    """What the returns of each cell say of the ground in it.

    Args:
        points: shape (N, 3) [m]; cell, lowest: from `lowest_returns`.
        plane: The trend: its height at the origin [m] and its slopes along x and y.

    Returns:
        height: shape (SECTORS, rings) [m], mean height above the plane of the lowest layer, NaN where the
            cell has no candidate.
        weight: The same shape, 0 to 1: how much of what lies low in the cell is that layer.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    # One row a cell, so that a point touches one line of the cache: residual, x and y of the lowest
    # return; sum of the layer's residuals, its returns, what stands on it, squared distances from it.
    sums = np.zeros((SECTORS * RINGS, 8), np.float32)
    sums[:, LOW] = np.inf
    for s in range(sectors):
        for k in range(rings):
            x, y, z = lowest[s, k]
            if z < np.inf:
                c = s * RINGS + k
                sums[c, LOW], sums[c, AT_X], sums[c, AT_Y] = z - plane[0] - plane[1] * x - plane[2] * y, x, y
    residual, zero, one = _above_plane(points, plane), np.float32(0.0), np.float32(1.0)
    for i in range(points.shape[0]):
        c = cell[i]
        if c < 0:
            continue
        up = residual[i] - sums[c, LOW]
        x, y = points[i, X] - sums[c, AT_X], points[i, Y] - sums[c, AT_Y]
        # Zeros are added where nothing is to be: a branch here could not be foreseen.
        layer, standing = -LAYER < up < LAYER, STANDS < up <= STANDS_UP_TO
        sums[c, TOTAL] += up if layer else zero
        sums[c, COUNT] += one if layer else zero
        sums[c, STANDING] += one if standing else zero
        sums[c, SPREAD] += x * x + y * y if layer else zero
    height, weight = np.full((sectors, rings), np.nan), np.zeros((sectors, rings))
    for s in range(sectors):
        for k in range(rings):
            row = sums[s * RINGS + k]
            n = np.float64(row[COUNT])
            if n > 0.0:
                height[s, k] = row[LOW] + row[TOTAL] / n
                part = n / (n + 2.0 * row[STANDING])
                weight[s, k] = max(part * part, WIDELY * min(1.0, row[SPREAD] / (n * WIDE * WIDE)))
    return height, weight


@compiled
def _above_plane(points: Float32, plane: Float) -> Float32:
    above = np.empty(points.shape[0], np.float32)
    at, along, across = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    for i in range(points.shape[0]):
        above[i] = points[i, Z] - at - along * points[i, X] - across * points[i, Y]
    return above
