"""Ground of one scan: a smooth surface through the lowest returns of a polar grid.

The lowest return of each cell is a ground candidate unless it is steeper than the maximum slope above another
candidate. A plane through the candidates is the trend; a membrane on the trend follows the candidates with
weights that express how likely each of them is ground.
"""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Ground
from pipeline.ground.terrain import RINGS, SECTORS, Terrain, on_the_grid, ring_distance
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float, Float32, Int32

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


FAR = 12.0  # m; candidates farther away say less of the trend
LEVEL = 4.0  # m^2; how surely the trend is level, in candidates a metre away
STIFFNESS = 0.15  # of the membrane, against a cell that surely is ground
ABOVE, BELOW = 0.08, 0.25  # m; farther from the surface a candidate pulls with the same force only
FIRM = 0.7  # weight of a candidate that the surface passes above
SEEN_WITHIN = 0.15  # m
ROUNDS, TREND_ROUNDS = 3, 4
X, Y, Z = 0, 1, 2


@compiled
def trend(lowest: Float, slope: float) -> Float:
    """A plane through the candidates, the lower ones first: shape (3,), height at the origin [m], slopes.

    Least squares, reweighted: what lies above the plane pulls with a force that no longer grows.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    rows = np.empty((sectors * rings, 3))
    n = 0
    for s in range(sectors):
        for k in range(rings):
            if lowest[s, k, Z] < np.inf:
                rows[n] = lowest[s, k]
                n += 1
    plane: Float = np.zeros(3)
    if n == 0:
        return plane
    plane[0] = np.median(rows[:n, Z])
    for _ in range(TREND_ROUNDS):
        A, b = np.zeros((3, 3)), np.zeros(3)
        A[1, 1] = A[2, 2] = LEVEL
        for i in range(n):
            x, y, z = rows[i, X], rows[i, Y], rows[i, Z]
            d = z - plane[0] - plane[1] * x - plane[2] * y
            w = 1.0 / (1.0 + (x * x + y * y) / (FAR * FAR))
            w *= ABOVE / d if d > ABOVE else (BELOW / -d if d < -BELOW else 1.0)
            A[0, 0] += w
            A[0, 1] += w * x
            A[0, 2] += w * y
            A[1, 1] += w * x * x
            A[1, 2] += w * x * y
            A[2, 2] += w * y * y
            b[0] += w * z
            b[1] += w * x * z
            b[2] += w * y * z
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        plane[:] = np.linalg.solve(A, b)
    steep = np.sqrt(plane[1] ** 2 + plane[2] ** 2)
    if steep > slope:
        plane[1] *= slope / steep
        plane[2] *= slope / steep
    return plane


@compiled
def smooth_surface(height: Float, weight: Float, plane: Float) -> tuple[Float, Bool]:
    """The membrane h that minimises sum w (h - z)^2 + sum c (h_i - h_j)^2 over neighbouring cells i, j.

    Lines along and across the rays are solved in turn. Far above or below the surface a candidate's pull
    stops growing; one below it pulls as firmly as the surest.

    Args:
        height, weight: shape (SECTORS, rings), see `evidence`; plane: shape (3,).

    Returns:
        The heights of the nodes [m] and whether the ground was seen there, both of the same shape.
    """
    sectors, rings = height.shape
    along, across = _couplings(rings)
    h = np.zeros((sectors, rings))
    w, wz = np.zeros((sectors, rings)), np.zeros((sectors, rings))
    for turn in range(ROUNDS):
        for s in range(sectors):
            for k in range(rings):
                if height[s, k] == height[s, k]:
                    d = height[s, k] - h[s, k] if turn > 0 else 0.0
                    w[s, k] = weight[s, k] if d >= 0.0 else FIRM
                    w[s, k] *= ABOVE / d if d > ABOVE else (BELOW / -d if d < -BELOW else 1.0)
                    wz[s, k] = w[s, k] * height[s, k]
        _solve_rays(h, w, wz, along, across)
        _solve_circles(h, w, wz, along, across)
    seen = np.zeros((sectors, rings), np.bool_)
    for s in range(sectors):
        for k in range(rings):
            seen[s, k] = weight[s, k] > 0.25 and abs(height[s, k] - h[s, k]) < SEEN_WITHIN
            x, y = _middle(s, k)
            h[s, k] += plane[0] + plane[1] * x + plane[2] * y
    return h, seen


@compiled
def _couplings(rings: int) -> tuple[Float, Float]:
    """Stiffness between a node and the next one outwards, and the next one around, by ring."""
    along, across = np.zeros(rings), np.zeros(rings)
    for k in range(rings):
        wide = ring_distance(k + 0.5) * 2.0 * np.pi / SECTORS
        deep = ring_distance(k + 1.0) - ring_distance(k + 0.0)
        across[k] = STIFFNESS * deep / wide
        if k + 1 < rings:
            between = ring_distance(k + 1.5) - ring_distance(k + 0.5)
            along[k] = STIFFNESS * ring_distance(k + 1.0) * 2.0 * np.pi / SECTORS / between
    return along, across


@compiled
def _solve_rays(h: Float, w: Float, wz: Float, along: Float, across: Float) -> None:
    """Thomas' algorithm along each ray, its neighbours as they are."""
    sectors, rings = h.shape
    upper, right = np.empty(rings), np.empty(rings)
    for s in range(sectors):
        left, after = h[s - 1], h[(s + 1) % sectors]
        inner = 0.0
        for k in range(rings):
            pivot = w[s, k] + 2.0 * across[k] + inner + along[k]
            value = wz[s, k] + across[k] * (left[k] + after[k])
            if k > 0:
                pivot -= inner * upper[k - 1]
                value += inner * right[k - 1]
            upper[k], right[k] = along[k] / pivot, value / pivot
            inner = along[k]
        h[s, rings - 1] = right[rings - 1]
        for k in range(rings - 2, -1, -1):
            h[s, k] = right[k] + upper[k] * h[s, k + 1]


@compiled
def _solve_circles(h: Float, w: Float, wz: Float, along: Float, across: Float) -> None:
    """The same around each circle, all of them at once; the seam is coupled to the values before."""
    sectors, rings = h.shape
    upper, right = np.empty((sectors, rings)), np.empty((sectors, rings))
    for s in range(sectors):
        for k in range(rings):
            pivot = w[s, k] + 2.0 * across[k] + along[k]
            value = wz[s, k]
            if k > 0:
                pivot += along[k - 1]
                value += along[k - 1] * h[s, k - 1]
            if k + 1 < rings:
                value += along[k] * h[s, k + 1]
            if s == 0:
                value += across[k] * h[sectors - 1, k]
            else:
                pivot -= across[k] * upper[s - 1, k]
                value += across[k] * right[s - 1, k]
            if s == sectors - 1:
                value += across[k] * h[0, k]
            upper[s, k], right[s, k] = across[k] / pivot, value / pivot
    for k in range(rings):
        h[sectors - 1, k] = right[sectors - 1, k]
    for s in range(sectors - 2, -1, -1):
        for k in range(rings):
            h[s, k] = right[s, k] + upper[s, k] * h[s + 1, k]


@compiled
def _middle(sector: int, ring: int) -> tuple[float, float]:
    """Place of a node [m]: the inverse of `direction_turn` at the middle of its cell."""
    turn = 4.0 * (sector + 0.5) / SECTORS - 1.0
    if turn < 0.0:
        x, y = -abs(turn), -(1.0 - abs(turn))
    elif turn < 2.0:
        y = turn - 1.0
        x = 1.0 - abs(y)
    else:
        y = 3.0 - turn
        x = -(1.0 - abs(y))
    scale = ring_distance(ring + 0.5) / np.sqrt(x * x + y * y)
    return x * scale, y * scale


def find_terrain(points: Float32, parameters: Ground) -> Terrain:
    """The terrain of one scan: a smooth surface that the lowest returns of a polar grid carry.

    The lowest return of each cell is a candidate unless it rises steeper than `slope_max` above another
    one. A plane below most candidates is the trend; on it a membrane is laid through what lies near
    each candidate. A cell in which much stands above the lowest return carries little, because there
    it may be a trunk's; but no cell lets the surface pass above its lowest return.

    Args:
        points: float32, shape (N, 3) [m], level sensor frame, the whole scan.
        parameters: Of this stage.
    """
    slope = float(np.tan(np.radians(parameters.slope_max)))
    cell, lowest = lowest_returns(points)
    forget_what_overhangs(lowest, slope)
    plane = trend(lowest, slope)
    height, weight = evidence(points, cell, lowest, plane)
    return Terrain(*smooth_surface(height, weight, plane))


def in_band(points: Float32, height: Float32, parameters: Ground) -> Float32:
    """The points whose height above the ground lies in the band. Shape (N, 3) -> (M, 3)."""
    return _between(points, height, np.array([parameters.height_min, parameters.height_max], np.float32))


@compiled
def _between(points: Float32, height: Float32, band: Float32) -> Float32:
    low, high = band[0], band[1]
    inside = np.empty_like(points)
    n = 0
    for i in range(points.shape[0]):
        inside[n, 0], inside[n, 1], inside[n, 2] = points[i, 0], points[i, 1], points[i, 2]
        # Counted without a branch, which the processor could not foresee.
        n += low <= height[i] <= high
    return inside[:n].copy()
