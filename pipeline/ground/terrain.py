"""Terrain of a scan on a polar grid, and heights of points above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.azimuth_bins import direction_turn
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32

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
    not."""
    seen = int(np.count_nonzero(terrain.seen))
    return seen >= LEAST_SEEN and ground_at(terrain.height, 0.0, 0.0) < 0.0


@compiled
def heights_of_places(places: Float, height: Float) -> Float:
    """Return the heights of places above the ground, shape (N,) [m].

    Args:
        places: Level sensor frame, shape (N, 3) [m]; x and y are finite.
        height: `Terrain.height`.
    """
    above = np.empty(places.shape[0])
    for i in range(places.shape[0]):
        above[i] = places[i, 2] - ground_at(height, places[i, 0], places[i, 1])
    return above


def height_above(points: Float32, terrain: Terrain) -> Float32:
    """Return the height of each point above the terrain, float32, shape (N,) [m]; NaN for a point that is not
    finite. Beyond the last ring, the height of the last ring counts as ground.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        terrain: Terrain of the scan.
    """
    return _height_above(points, terrain.height)


@compiled
def ring_at(distance: float) -> float:
    """Return the (fractional) number of rings within a distance from the sensor, 0 or more [m]; less than
    RINGS."""
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
    float32, shape (N,) [m], by bilinear interpolation of the nodes `Terrain.height`; NaN for a point that is
    not finite."""
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
