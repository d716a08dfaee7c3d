"""Terrain: the height of the ground around the sensor, and of each point above it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.compiled import compiled
from pipeline.direction import direction_bin
from pipeline.geometry import Float
from pipeline.records import Float32

SECTORS = 72
BIN = 0.5  # m


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


def height_above(points: Float32, terrain: Terrain) -> Float32:
    """Height of each point above the terrain, float32, shape (N,) [m]."""
    return _height_above(points, terrain.height)


@compiled
def ground_at(height: Float, x: float, y: float) -> float:
    """Height of the ground at a place [m] of the level sensor frame; `height` is a Terrain's."""
    sector, position = direction_bin(x, y, SECTORS), np.sqrt(x * x + y * y) / BIN
    # A cell's lowest return lies anywhere in it; interpolating between the centres of two
    # cells keeps a slope from becoming a staircase.
    bins = height.shape[1]
    k = min(max(int(position - 0.5), 0), bins - 1)
    f = min(max(position - 0.5 - k, 0.0), 1.0)
    return float((1.0 - f) * height[sector, k] + f * height[sector, min(k + 1, bins - 1)])


@compiled
def _height_above(points: Float32, height: Float) -> Float32:
    above = np.empty(points.shape[0], np.float32)
    for i in range(points.shape[0]):
        above[i] = points[i, 2] - ground_at(height, points[i, 0], points[i, 1])
    return above
