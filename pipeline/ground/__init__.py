"""Ground: the terrain under one scan, and the height of each point above it."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Ground
from pipeline.ground.ground_candidates import evidence, forget_what_overhangs, lowest_returns
from pipeline.ground.surface import smooth_surface, trend
from pipeline.ground.terrain import Terrain, height_above
from pipeline.jit import compiled
from pipeline.types.records import Float32

__all__ = ["Terrain", "find_terrain", "height_above", "in_band"]


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
