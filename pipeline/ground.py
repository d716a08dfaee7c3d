"""Ground: the terrain under one scan, and the height of each point above it."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.direction import direction_bin
from pipeline.geometry import Float
from pipeline.parameters.stages import Ground
from pipeline.records import Float32
from pipeline.terrain import BIN, SECTORS, Terrain, height_above

__all__ = ["Terrain", "find_terrain", "height_above", "in_band"]

NEAR = 8.0  # m; here the sensor surely sees the ground it stands on
GHOST = 0.4  # m; ground returns of one cell lie nearer to one another than this
WIDEST = 1.4  # a sector of the diamond against one of the circle
TOLERANCE = 0.15  # m; grass and noise over the steepest slope


def find_terrain(points: Float32, parameters: Ground) -> Terrain:
    """The terrain of one scan: the lowest returns of a polar grid, outwards, with a limited slope.

    Args:
        points: float32, shape (N, 3) [m], level sensor frame, the whole scan.
        parameters: Of this stage.
    """
    lowest = _lowest(points, int(_reach(points) / BIN) + 1)
    slope = float(np.tan(np.radians(parameters.slope_max)))
    _forget_what_overhangs(lowest, slope)
    return Terrain(*_walk_outwards(lowest, _start_height(lowest), slope))


def in_band(points: Float32, height: Float32, parameters: Ground) -> Float32:
    """The points whose height above the ground lies in the band. Shape (N, 3) -> (M, 3)."""
    inside: Float32 = points[(height >= parameters.height_min) & (height <= parameters.height_max)]
    return inside


def _start_height(lowest: Float) -> float:
    """Height of the ground under the sensor: the median of the sectors' lowest near returns."""
    near = lowest[:, : int(NEAR / BIN)]
    by_sector = near.min(axis=1, initial=np.inf)
    known = by_sector[np.isfinite(by_sector)]
    return float(np.median(known)) if len(known) else 0.0


@compiled
def _reach(points: Float32) -> float:
    square = 0.0
    for i in range(points.shape[0]):
        square = max(square, points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1])
    return float(np.sqrt(square))


@compiled
def _lowest(points: Float32, bins: int) -> Float:
    """The lowest return of each cell; one that lies alone far below the next is an echo's ghost."""
    lowest = np.full((SECTORS, bins), np.inf)
    second = np.full((SECTORS, bins), np.inf)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        s = direction_bin(x, y, SECTORS)
        k = min(int(np.sqrt(x * x + y * y) / BIN), bins - 1)
        if z < lowest[s, k]:
            second[s, k] = lowest[s, k]
            lowest[s, k] = z
        elif z < second[s, k]:
            second[s, k] = z
    for s in range(SECTORS):
        for k in range(bins):
            if lowest[s, k] + GHOST < second[s, k] < np.inf:
                lowest[s, k] = second[s, k]
    return lowest


@compiled
def _forget_what_overhangs(lowest: Float, slope: float) -> None:
    """Take away cells that rise steeper than `slope` above a lower cell near by: hedges and crowns.

    Two sweeps there and back carry each cell's cone of the steepest slope over the whole grid.
    """
    sectors, bins = lowest.shape
    cone = lowest.copy()
    rise = slope * BIN
    across = rise * (np.arange(bins) + 0.5) * (WIDEST * 2.0 * np.pi / sectors)
    for _ in range(2):
        for s in range(sectors):
            for k in range(1, bins):
                cone[s, k] = min(cone[s, k], cone[s, k - 1] + rise)
            for k in range(bins - 2, -1, -1):
                cone[s, k] = min(cone[s, k], cone[s, k + 1] + rise)
        for there in (1, -1):  # around the circle, twice, so that the seam is none
            for turn in range(2 * sectors):
                s = (there * turn) % sectors
                before = (s - there) % sectors
                for k in range(bins):
                    cone[s, k] = min(cone[s, k], cone[before, k] + across[k])
    for s in range(sectors):
        for k in range(bins):
            if lowest[s, k] > cone[s, k] + TOLERANCE + rise:
                lowest[s, k] = np.inf


@compiled
def _walk_outwards(
    lowest: Float, start: float, slope: float
) -> tuple[Float, np.ndarray[tuple[int, int], np.dtype[np.bool_]]]:
    sectors, bins = lowest.shape
    height = np.empty((sectors, bins))
    seen = np.zeros((sectors, bins), np.bool_)
    for s in range(sectors):
        last, last_k = start, -1
        for k in range(bins):
            rise = lowest[s, k] - last
            if abs(rise) <= slope * BIN * (k - last_k) + TOLERANCE:
                # Between two seen cells the ground is a straight line.
                for j in range(last_k + 1, k):
                    height[s, j] = last + rise * (j - last_k) / (k - last_k)
                last, last_k = lowest[s, k], k
                seen[s, k] = True
                height[s, k] = last
        for j in range(last_k + 1, bins):
            height[s, j] = last
    return height, seen
