"""Ground: the terrain under one scan, and the height of each point above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.compiled import compiled
from pipeline.direction import direction_bin
from pipeline.geometry import Float
from pipeline.parameters.stages import Ground
from pipeline.records import Float32

SECTORS = 72
BIN = 0.5  # m
NEAR = 8.0  # m; here the sensor surely sees the ground it stands on
TOLERANCE = 0.15  # m; grass and noise over the steepest slope


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights of the ground around the sensor, in the level sensor frame.

    Attributes:
        height: shape (SECTORS, bins) [m]: the ground in each polar cell.
        seen: shape (SECTORS, bins): whether a return of the ground lay in the cell; elsewhere the
            height goes on from the nearest cell nearer to the sensor.
    """

    height: Float
    seen: np.ndarray[tuple[int, int], np.dtype[np.bool_]]


def find_terrain(points: Float32, parameters: Ground) -> Terrain:
    """The terrain of one scan: the lowest returns of a polar grid, outwards, with a limited slope.

    Args:
        points: float32, shape (N, 3) [m], level sensor frame, the whole scan.
        parameters: Of this stage.
    """
    lowest = _lowest(points, int(_reach(points) / BIN) + 1)
    start = _start_height(lowest)
    return Terrain(*_walk_outwards(lowest, start, float(np.tan(np.radians(parameters.slope_max)))))


def height_above(points: Float32, terrain: Terrain) -> Float32:
    """Height of each point above the terrain, float32, shape (N,) [m]."""
    return _height_above(points, terrain.height)


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
    lowest = np.full((SECTORS, bins), np.inf)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        sector = direction_bin(x, y, SECTORS)
        k = min(int(np.sqrt(x * x + y * y) / BIN), bins - 1)
        lowest[sector, k] = min(lowest[sector, k], points[i, 2])
    return lowest


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


@compiled
def _height_above(points: Float32, height: Float) -> Float32:
    above = np.empty(points.shape[0], np.float32)
    bins = height.shape[1]
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        sector, position = direction_bin(x, y, SECTORS), np.sqrt(x * x + y * y) / BIN
        # A cell's lowest return lies anywhere in it; interpolating between the centres of two
        # cells keeps a slope from becoming a staircase.
        k = min(max(int(position - 0.5), 0), bins - 1)
        f = min(max(position - 0.5 - k, 0.0), 1.0)
        ground = (1.0 - f) * height[sector, k] + f * height[sector, min(k + 1, bins - 1)]
        above[i] = points[i, 2] - ground
    return above
