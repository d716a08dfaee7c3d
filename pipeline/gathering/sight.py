"""Sight: how high a scan looked at each place, and whether something stood there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.compiled import compiled
from pipeline.direction import direction_bin
from pipeline.gathering.memory import SLICE, SLICES
from pipeline.geometry import Float, Pose2
from pipeline.records import Float32
from pipeline.terrain import ground_at
from pipeline.visibility import BEHIND, BINS


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """From where a scan looked, and how far and high.

    Attributes:
        T_map_base: The pose.
        sensor_offset: The sensor in the level base frame, shape (3,) [m].
        clear_range: How far the view was free by direction of the base frame, shape (BINS,) [m].
        steepest: Tangent of the steepest elevation of a return by direction, shape (BINS,).
        terrain: The ground under this scan, as `Terrain.height`.
    """

    T_map_base: Pose2
    sensor_offset: Float
    clear_range: Float
    steepest: Float
    terrain: Float


NEAR = 0.6  # m; what is seen so near to a column is the column


@compiled
def steepest_by_direction(points: Float32, offset: Float, all_around: bool) -> Float:
    """Tangent of the steepest elevation seen in each direction of the base frame, shape (BINS,).

    Args:
        points: Level sensor frame, shape (N, 3) [m]; offset: the sensor in the base frame, shape (3,).
        all_around: Whether the sensor looks equally high in all directions, so that one tells for all.
    """
    steepest = np.full(BINS, -1.0)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        rho = np.sqrt(x * x + y * y)
        if rho > 1.0:
            b = direction_bin(x + offset[0], y + offset[1], BINS)
            steepest[b] = max(steepest[b], points[i, 2] / rho)
    if all_around:
        steepest[:] = steepest.max()
    return steepest


@compiled
def look(
    axis: Float,
    viewed: Float,
    present: Float,
    absent: Float,
    pose: Float,
    clear_range: Float,
    steepest: Float,
    offset: Float,
    terrain: Float,
    range_max: float,
) -> None:
    """Count for each column in view whether something stood there, and how high the scan looked.

    Args:
        axis: Columns, shape (K, 5); viewed, present, absent: shape (K,), changed in place.
        pose: x, y [m], yaw [rad] of the base; offset: the sensor in the base frame, shape (3,) [m].
        clear_range, steepest: By direction of the base frame, shape (BINS,).
        terrain: Of this scan, as `Terrain.height`.
        range_max: Columns farther away are not asked for [m].
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for k in range(axis.shape[0]):
        dx, dy = axis[k, 0] - pose[0], axis[k, 1] - pose[1]
        reach = np.sqrt(dx * dx + dy * dy)
        if reach > range_max:
            continue
        x, y = c * dx + s * dy, c * dy - s * dx
        b = direction_bin(x, y, BINS)
        x, y = x - offset[0], y - offset[1]
        up = np.sqrt(x * x + y * y) * steepest[b] - ground_at(terrain, x, y)
        viewed[k] = max(viewed[k], min(up, SLICES * SLICE))
        if clear_range[b] > reach + BEHIND:
            absent[k] += 1.0
        elif abs(clear_range[b] - reach) < NEAR:
            present[k] += 1.0
