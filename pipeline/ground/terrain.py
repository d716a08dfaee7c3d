"""Terrain: the height of the ground around the sensor, and of each point above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.azimuth_bins import direction_turn
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32

SECTORS = 72
RINGS = 48  # would reach to infinity
HALF_WAY = 20.0  # m; half of them lie nearer
LEAST_SEEN = 60  # cells; the foot of walls around a sensor fills up to 50, ground that is seen over 400
NO_GROUND = (
    "a scan shows no ground (a wall or a ceiling only?): heights are guesses, and diameters are not told "
    "for breast height"
)


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights of the ground around the sensor, in the level sensor frame.

    The nodes stand in the middle of the cells of a polar grid, whose rings grow wider with the distance as
    its sectors do: 0.4 m at the sensor, 0.9 m at 10 m, 1.7 m at 20 m.

    Attributes:
        height: shape (SECTORS, rings) [m]: the ground at each node.
        seen: shape (SECTORS, rings): whether returns of the ground lay in the cell; elsewhere the height
            goes on smoothly from the cells around.
    """

    height: Float
    seen: Bool


def shows_ground(terrain: Terrain) -> bool:
    """Whether a scan saw ground at all, not only the foot of a wall, a ceiling or a heap of points."""
    seen = int(np.count_nonzero(terrain.seen))
    return seen >= LEAST_SEEN and ground_at(terrain.height, 0.0, 0.0) < 0.0


@compiled
def heights_of_places(places: Float, height: Float) -> Float:
    """Height of places (N, 3) [m] of the level sensor frame above the ground, shape (N,) [m]; `height` is
    a Terrain's."""
    above = np.empty(places.shape[0])
    for i in range(places.shape[0]):
        above[i] = places[i, 2] - ground_at(height, places[i, 0], places[i, 1])
    return above


def height_above(points: Float32, terrain: Terrain) -> Float32:
    """Height of each point above the terrain, float32, shape (N,) [m]."""
    return _height_above(points, terrain.height)


@compiled
def ring_at(distance: float) -> float:
    """How many rings lie within a distance from the sensor [m]; never as many as RINGS."""
    return float(RINGS * distance / (distance + HALF_WAY))


@compiled
def ring_distance(ring: float) -> float:
    """The distance from the sensor [m] within which so many rings lie, the inverse of `ring_at`."""
    return float(HALF_WAY * ring / (RINGS - ring))


@compiled
def ground_at(height: Float, x: float, y: float) -> float:
    """Height of the ground at a place [m] of the level sensor frame; `height` is a Terrain's.

    Between nodes it is interpolated along both directions; beyond the last ring it stays as it is there.
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
    """Of each point how many sectors and how many rings lie before it, both float32, shape (N,).

    Two plain loops over plain rows, so that the processor takes eight points at once. What is not finite
    or farther than a number can tell has no ring: NaN, or all RINGS of them.
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
    """Of each node, sector times rings plus ring, its height, that of the next one around, and of the two
    beyond these: float32, shape (N, 4) [m], in one row, so that a point touches one place."""
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
    """The node before each point, and which part of the way to the next one it lies around and outwards; of
    what has no ring that is not a number.

    A plain loop over plain rows, so that the processor takes eight points at once; the parts are left in
    the two rows that are given, which come from `on_the_grid`.
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
