"""Ground of one scan: a smooth surface through the lowest returns of a polar grid, and heights of points
above it.

The lowest return of each cell is a ground candidate unless it is steeper than the maximum slope above another
candidate. A plane through the candidates is the trend; a membrane on the trend follows the candidates with
weights that express how likely each of them is ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.config.stages import Ground
from pipeline.geometry.azimuth_bins import direction_turn
from pipeline.geometry.ordering import median
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int32

SECTORS = 72
RINGS = 48  # the last ring is at infinity
HALF_WAY = 20.0  # m; half of the rings are closer
LEAST_SEEN = 60  # cells with ground; walls around a sensor give up to 50, visible ground over 400
NO_GROUND = (
    "a scan shows no ground (only a wall or a ceiling?): heights are uncertain, and no diameters at breast "
    "height are reported"
)


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights of the ground around the sensor, in the level sensor frame.

    The nodes are the middles of the cells of a polar grid. The ring width grows with the distance like the
    sector width: 0.4 m at the sensor, 0.9 m at 10 m, 1.7 m at 20 m.

    Attributes:
        height: Height of the ground at each node, shape (SECTORS, rings) [m].
        seen: Whether the cell contains ground returns, shape (SECTORS, rings); other heights are extrapolated
            smoothly.
    """

    height: Float
    seen: Bool


def shows_ground(terrain: Terrain) -> bool:
    """Return whether a scan shows the ground: LEAST_SEEN cells or more with ground returns, and a ground
    height below 0, i.e. below the sensor, at the sensor. A scan of a wall, a ceiling or scattered points does
    not.

    Args:
        terrain: Ground of the scan in the level sensor frame; extrapolated cells do not count.
    """
    seen = int(np.count_nonzero(terrain.seen))
    return seen >= LEAST_SEEN and ground_at(terrain.height, 0.0, 0.0) < 0.0


@compiled
def heights_of_places(places: Float, height: Float) -> Float:
    """Return the heights of positions above the ground, shape (N,) [m].

    Args:
        places: Positions in the level sensor frame, shape (N, 3) [m]; x and y are finite.
        height: `Terrain.height`.
    """
    above = np.empty(places.shape[0])
    for i in range(places.shape[0]):
        above[i] = places[i, 2] - ground_at(height, places[i, 0], places[i, 1])
    return above


def height_above(points: Float32, terrain: Terrain) -> Float32:
    """Return the height of each point above the terrain, float32, shape (N,) [m]; NaN where a coordinate is
    NaN or x or y is infinite, and infinite where only z is. Beyond the last ring, the height of the last ring
    counts as ground.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        terrain: Terrain of the scan.
    """
    return _height_above(points, terrain.height)


@compiled
def ring_at(distance: float) -> float:
    """Return the (fractional) number of rings within a distance from the sensor [m], which is 0 or more; the
    result is less than RINGS."""
    return float(RINGS * distance / (distance + HALF_WAY))


@compiled
def ring_distance(ring: float) -> float:
    """Return the distance from the sensor [m] that contains the given number of rings, 0 or more and less
    than RINGS: the inverse of `ring_at`."""
    return float(HALF_WAY * ring / (RINGS - ring))


@compiled
def ground_at(height: Float, x: float, y: float) -> float:
    """Return the height of the ground at a finite position x, y [m], level sensor frame, by bilinear
    interpolation between the nodes.

    Beyond the last ring, the height of the last ring is used, and within half a ring of the sensor that of
    the first one.

    Args:
        height: `Terrain.height`, shape (SECTORS, rings) [m].
        x, y: The position [m]; not checked.
    """
    sectors, rings = height.shape
    turn = direction_turn(x, y) * sectors - 0.5
    before = int(np.floor(turn))
    f = turn - before
    after = before + 1 if before + 1 < sectors else 0
    before = before if before >= 0 else sectors - 1
    ring = min(max(ring_at(np.sqrt(x * x + y * y)) - 0.5, 0.0), rings - 1.0)
    k = int(ring)
    g, beyond = ring - k, min(k + 1, rings - 1)
    near = (1.0 - f) * height[before, k] + f * height[after, k]
    far = (1.0 - f) * height[before, beyond] + f * height[after, beyond]
    return float((1.0 - g) * near + g * far)


@compiled
def on_the_grid(points: Float32) -> tuple[Float32, Float32]:
    """Return the (fractional) sector, 0 to SECTORS, and ring, 0 to RINGS, of each point, both float32, shape
    (N,). `points` has the shape (N, 2 or 3) [m], level sensor frame.

    The loops are simple so that the compiler vectorises them. The ring of a point that is not finite is NaN
    or RINGS.
    """
    n = points.shape[0]
    xs, ys = np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        xs[i], ys[i] = points[i, 0], points[i, 1]
    sector, ring = np.empty(n, np.float32), np.empty(n, np.float32)
    one, quarter = np.float32(1.0), np.float32(0.25 * SECTORS)
    rings, half_way = np.float32(RINGS), np.float32(HALF_WAY)
    for i in range(n):
        x, y = xs[i], ys[i]
        side = y / (abs(x) + abs(y) + np.float32(1e-30))
        behind = -one - side if y < np.float32(0.0) else np.float32(3.0) - side
        turn = one + side if x >= np.float32(0.0) else behind  # see `direction_turn`
        sector[i] = (turn + one) * quarter
        distance = np.sqrt(x * x + y * y)
        ring[i] = rings * distance / (distance + half_way)
    return sector, ring


@compiled
def _height_above(points: Float32, height: Float) -> Float32:
    """Return the height of each point (float32, shape (N, 3) [m], level sensor frame) above the ground,
    float32, shape (N,) [m], by bilinear interpolation of the nodes `Terrain.height`; NaN where a coordinate
    is NaN or x or y is infinite, and infinite where only z is."""
    rings = height.shape[1]
    corners = _corners(height)
    node, f, g = _nodes(*on_the_grid(points), height.shape[0], rings)
    one = np.float32(1.0)
    above = np.empty(points.shape[0], np.float32)
    for i in range(points.shape[0]):
        j = node[i]
        near = (one - f[i]) * corners[j, 0] + f[i] * corners[j, 1]
        far = (one - f[i]) * corners[j, 2] + f[i] * corners[j, 3]
        above[i] = points[i, 2] - ((one - g[i]) * near + g[i] * far)
    return above


@compiled
def _corners(height: Float) -> Float32:
    """Return the four corner heights of each grid cell, float32, shape (sectors * rings, 4) [m].

    A row holds the heights of the node, the next node around, and the two nodes beyond them, so that the
    interpolation of a point accesses one row.
    """
    sectors, rings = height.shape
    corners = np.empty((sectors * rings, 4), np.float32)
    for s in range(sectors):
        after = s + 1 if s + 1 < sectors else 0
        for k in range(rings):
            row, beyond = corners[s * rings + k], min(k + 1, rings - 1)
            row[0], row[1] = height[s, k], height[after, k]
            row[2], row[3] = height[s, beyond], height[after, beyond]
    return corners


@compiled
def _nodes(
    sector: Float32, ring: Float32, sectors: int, rings: int
) -> tuple[NDArray[np.uint32], Float32, Float32]:
    """Return the grid cell of each point (row of the result of `_corners`), uint32, and its fractional
    position along the circle and along the ray in it, 0 to 1, float32, each of shape (N,). For a point
    without a ring (NaN), the cell is 0 and the position along the ray is NaN.

    Args:
        sector, ring: Results of `on_the_grid`; the fractions overwrite them.
        sectors, rings: Shape of `Terrain.height`.
    """
    node = np.empty(sector.shape[0], np.uint32)
    zero, half, last = np.float32(0.0), np.float32(0.5), np.float32(rings - 1)
    shift, nan = np.float32(sectors - 0.5), np.float32(np.nan)
    circle, ray = np.int32(sectors), np.int32(rings)
    for i in range(sector.shape[0]):
        known = ring[i] >= zero
        turn = sector[i] + shift if known else zero
        around = np.int32(turn)
        sector[i] = turn - np.float32(around)
        around = around - circle if around >= circle else around
        out = min(max(ring[i] - half, zero), last) if known else zero
        k = np.int32(out)
        ring[i] = out - np.float32(k) if known else nan
        node[i] = np.uint32(around * ray + k)
    return node, sector, ring


GHOST = 0.4  # m; a return this far below the second lowest one of its cell is a ghost echo
WIDEST = 1.4  # ratio of the widest diamond sector to the mean sector
TOLERANCE = 0.15  # m; grass and noise above the maximum slope
LAYER = 0.2  # m; returns up to this height above the lowest return of a cell are ground
OBJECT_BOTTOM, OBJECT_TOP = 0.3, 2.0  # m; height range of objects on the ground, for example trunks
WIDE = 0.4  # m; a ground layer with this spread is wider than a trunk
WIDE_WEIGHT = 0.6  # minimum weight of a layer with the spread WIDE, proportional below it
FARTHEST = np.float32(1e6)  # m; returns with a larger |z| are ignored
X, Y, Z = 0, 1, 2
# Columns of the sums of `evidence`.
LOW, AT_X, AT_Y, TOTAL, COUNT, ABOVE_LAYER, SPREAD = range(7)


@compiled
def lowest_returns(points: Float32) -> tuple[Int32, Float]:
    """Return the cell of each point and the lowest return of each cell, without ghost echoes: a return more
    than GHOST below the second lowest one of its cell is replaced by that one. The result does not depend on
    the order of the points.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].

    Returns:
        Cell of each point (sector * RINGS + ring), int32, shape (N,), -1 for a point that is not finite or
        has |z| >= FARTHEST; and x, y, z [m] of the lowest return of each cell, shape (SECTORS, rings, 3), all
        infinite for an empty cell. `rings` is the number of rings up to the farthest point, at least 1.
    """
    cell, rings = _cell_of(points)
    row = np.full((SECTORS * RINGS, 2), -1, np.int32)  # rows of the lowest and second lowest return
    bottom = np.full((SECTORS * RINGS, 2), np.float32(np.inf))
    for i in range(points.shape[0]):
        c = cell[i]
        if c < 0:
            continue
        z, low, next_low, r, next_r = points[i, Z], bottom[c, 0], bottom[c, 1], row[c, 0], row[c, 1]
        # Selection without a branch, which would be unpredictable.
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
                i = row[c, 1] if ghost else row[c, 0]
                for a in range(3):
                    lowest[s, k, a] = points[i, a]
    return cell, lowest


@compiled
def _cell_of(points: Float32) -> tuple[Int32, int]:
    """Return the cell of each point (shape (N, 3) [m]), sector * RINGS + ring, int32, shape (N,), -1 for a
    point that is not finite or has |z| >= FARTHEST; and the number of rings up to the farthest valid point,
    at least 1."""
    n = points.shape[0]
    sector, ring = on_the_grid(points)
    cell = np.empty(n, np.int32)
    last, outermost = np.int32(SECTORS - 1), np.int32(0)
    for i in range(n):
        k = np.int32(ring[i])
        c = min(np.int32(sector[i]), last) * np.int32(RINGS) + k
        # A NaN coordinate fails these comparisons.
        known = ring[i] < np.float32(RINGS) and abs(points[i, Z]) < FARTHEST
        cell[i] = c if known else np.int32(-1)
        outermost = max(outermost, k if known else np.int32(0))
    return cell, int(outermost) + 1


@compiled
def _comes_first(points: Float32, i: int, other: int) -> bool:
    """Return whether point i is first of two points of equal height, by x and then by y, so that the result
    does not depend on the order of the points.

    Args:
        points: Points, shape (N, 3) [m].
        i, other: Rows of the two points.
    """
    x, y = points[i, X], points[i, Y]
    return bool(x < points[other, X] or (x == points[other, X] and y < points[other, Y]))


@compiled
def remove_overhanging(lowest: Float, slope: float) -> None:
    """Remove ground candidates that are steeper than a slope above another candidate, such as hedges and
    crowns.

    The limit of a cell is the lowest height that any other candidate plus the slope times the distance gives,
    computed by two passes in each direction over the grid; TOLERANCE and the rise over one ring are added. A
    removed candidate gets an infinite z, its x and y remain.

    Args:
        lowest: Lowest returns, see `lowest_returns`, shape (SECTORS, rings, 3) [m]; changed in place.
        slope: Tangent of the maximum slope.
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
        for there in (1, -1):  # twice around the circle, so that the seam has no effect
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
    """Return the height of the ground candidate of each cell and its weight.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        cell, lowest: Results of `lowest_returns`, after `remove_overhanging`.
        plane: Trend: height at the origin [m] and slopes along x and y, shape (3,).

    Returns:
        Mean height of the lowest layer above the plane, shape (SECTORS, rings) [m], NaN if there is no
        candidate; and its weight from 0 (also without a candidate) to 1, same shape. With n returns in the
        layer and m returns above it between OBJECT_BOTTOM and OBJECT_TOP, the weight is (n / (n + 2 m))^2;
        the spread of the layer gives a lower limit, which rises to WIDE_WEIGHT for a layer wider than a
        trunk.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    # One row per cell, so that each point accesses one cache line: residual, x and y of the lowest return;
    # for the layer the sum of residuals, the number of returns, the returns above it and the sum of squared
    # distances.
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
        # Zeros are added instead of an unpredictable branch.
        layer, above_layer = -LAYER < up < LAYER, OBJECT_BOTTOM < up <= OBJECT_TOP
        sums[c, TOTAL] += up if layer else zero
        sums[c, COUNT] += one if layer else zero
        sums[c, ABOVE_LAYER] += one if above_layer else zero
        sums[c, SPREAD] += x * x + y * y if layer else zero
    height, weight = np.full((sectors, rings), np.nan), np.zeros((sectors, rings))
    for s in range(sectors):
        for k in range(rings):
            row = sums[s * RINGS + k]
            n = np.float64(row[COUNT])
            if n > 0.0:
                height[s, k] = row[LOW] + row[TOTAL] / n
                part = n / (n + 2.0 * row[ABOVE_LAYER])
                weight[s, k] = max(part * part, WIDE_WEIGHT * min(1.0, row[SPREAD] / (n * WIDE * WIDE)))
    return height, weight


@compiled
def _above_plane(points: Float32, plane: Float) -> Float32:
    """Return the height of each point (shape (N, 3) [m]) above a plane, float32, shape (N,) [m]; `plane` is
    the height at the origin [m] and the slopes along x and y, shape (3,)."""
    above = np.empty(points.shape[0], np.float32)
    at, along, across = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    for i in range(points.shape[0]):
        above[i] = points[i, Z] - at - along * points[i, X] - across * points[i, Y]
    return above


FAR = 12.0  # m; distance beyond which candidates lose weight in the trend
LEVEL = 4.0  # m^2; prior of a level trend, in candidates at a distance of 1 m
STIFFNESS = 0.15  # of the membrane, relative to a cell with weight 1
ABOVE, BELOW = 0.08, 0.25  # m; residual above which the force of a candidate is constant (Huber)
FIRM = 0.7  # weight of a candidate below the surface
SEEN_WITHIN = 0.15  # m; maximum residual of a cell whose ground counts as seen
ROUNDS, TREND_ROUNDS = 3, 4
X, Y, Z = 0, 1, 2


@compiled
def trend(lowest: Float, slope: float) -> Float:
    """Fit a plane through the candidates by iteratively reweighted least squares with asymmetric Huber
    weights and a prior of a level plane.

    Args:
        lowest: Ground candidates, shape (SECTORS, rings, 3) [m], with infinite z for none.
        slope: Tangent of the maximum slope; a steeper plane is flattened to it.

    Returns:
        Height at the origin [m] and slopes along x and y, shape (3,); zeros if there are no candidates.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    rows, height = np.empty((sectors * rings, 3)), np.empty(sectors * rings)
    n = 0
    for s in range(sectors):
        for k in range(rings):
            if lowest[s, k, Z] < np.inf:
                for a in range(3):
                    rows[n, a] = lowest[s, k, a]
                height[n] = rows[n, Z]
                n += 1
    plane: Float = np.zeros(3)
    if n == 0:
        return plane
    plane[0] = median(height[:n])
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
        solution = np.linalg.solve(A, b)
        for a in range(3):
            plane[a] = solution[a]
    steep = np.sqrt(plane[1] ** 2 + plane[2] ** 2)
    if steep > slope:
        plane[1] *= slope / steep
        plane[2] *= slope / steep
    return plane


@compiled
def smooth_surface(height: Float, weight: Float, plane: Float) -> tuple[Float, Bool]:
    """Return the trend plus the membrane h that minimises sum w (h - z)^2 + sum c (h_i - h_j)^2 over
    neighbouring cells i, j. If there are no candidates, it is the trend.

    Rays and circles are solved in turn (alternating direction). Residuals have asymmetric Huber weights.

    Args:
        height, weight: Heights of the candidates above the trend [m] and their weights, shape (SECTORS,
            rings), see `evidence`.
        plane: Trend, shape (3,).

    Returns:
        Heights of the nodes in the level sensor frame [m], trend included, and whether the ground was seen
        there (a candidate of weight above 0.25 within SEEN_WITHIN of the surface), both of shape (SECTORS,
        rings).
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
    """Return the stiffness of the membrane between neighbouring nodes along a ray (from ring k to k + 1) and
    along a circle, each of shape (rings,): STIFFNESS times width by length of the connection."""
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
    """Solve the membrane along each ray by the Thomas algorithm, with the neighbouring rays fixed.

    Args:
        h: Heights above the trend, shape (SECTORS, rings) [m]; changed in place.
        w, wz: Weights of the candidates, and weights times heights, same shape.
        along, across: Results of `_couplings`.
    """
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
    """Solve the membrane along all circles, with the neighbouring rings fixed, in place. At the seam the
    previous heights are used.

    Args:
        h: Heights above the trend, shape (SECTORS, rings) [m]; changed in place.
        w, wz: Weights of the candidates, and weights times heights, same shape.
        along, across: Stiffness to the next ring and to the next sector, shape (rings,).
    """
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
    """Return the position x, y of a node in the sensor frame [m]: the inverse of `direction_turn` at the
    middle of its cell.

    Args:
        sector: Number of the sector, 0 to SECTORS - 1.
        ring: Number of the ring, less than RINGS - 0.5.
    """
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
    """Return the terrain of one scan: for a scan without finite points, it is level at height 0 and `seen` is
    False everywhere.

    A cell with many returns above its lowest layer has a small weight, since that layer may belong to a
    trunk. The force that pulls the surface down to a candidate below it is stronger than the one that lifts
    it (Huber weights).

    Args:
        points: The whole scan, float32, shape (N, 3) [m], level sensor frame; points that are not finite or
            have |z| >= FARTHEST are ignored.
        parameters: `slope_max` is used.
    """
    slope = float(np.tan(np.radians(parameters.slope_max)))
    cell, lowest = lowest_returns(points)
    remove_overhanging(lowest, slope)
    plane = trend(lowest, slope)
    height, weight = evidence(points, cell, lowest, plane)
    return Terrain(*smooth_surface(height, weight, plane))


def in_band(points: Float32, height: Float32, parameters: Ground) -> Float32:
    """Return the points whose height above the ground is in [height_min, height_max], float32, shape (M, 3)
    [m], in their order; points of unknown height (NaN) are removed.

    Args:
        points: Points, float32, shape (N, 3) [m].
        height: Heights of the points above the ground, float32, shape (N,) [m].
        parameters: The height band, which is compared in float32.
    """
    return _between(points, height, np.array([parameters.height_min, parameters.height_max], np.float32))


@compiled
def _between(points: Float32, height: Float32, band: Float32) -> Float32:
    """Return the points with band[0] <= height <= band[1], float32, shape (M, 3) [m]; NaN is outside.

    Args:
        points: Points, shape (N, 3) [m].
        height: Height of each point, shape (N,) [m].
        band: Lowest and highest height, shape (2,) [m].
    """
    low, high = band[0], band[1]
    inside = np.empty_like(points)
    n = 0
    for i in range(points.shape[0]):
        inside[n, 0], inside[n, 1], inside[n, 2] = points[i, 0], points[i, 1], points[i, 2]
        # Counted without an unpredictable branch.
        n += low <= height[i] <= high
    return inside[:n].copy()
