"""Sight: how high a scan looked at each place, whether something stood there, and what its rays met on the
way: the column, or what stands behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.detection.free_space import BEHIND, BINS
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.terrain import ground_at
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int32, UInt16


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """From where a scan looked, and how far and high.

    Attributes:
        T_map_base: The pose.
        sensor_offset: The sensor in the level base frame, shape (3,) [m].
        clear_range: How far the view was free by direction of the base frame, shape (BINS,) [m].
        steepest: Tangent of the steepest elevation of a return by direction, shape (BINS,).
        depth: How far away the nearest return lies, see `depth_image`.
        terrain: The ground under this scan, as `Terrain.height`.
    """

    T_map_base: Pose2
    sensor_offset: Float
    clear_range: Float
    steepest: Float
    depth: UInt16
    terrain: Float


ELEVATIONS, LOWEST, STEP = 96, -0.84, 0.0175  # of a depth image: tangents, so that a step is about a degree
MET, PASSED = 0.45, 0.5  # m; so near to the axis a ray met the column, so far behind it passed
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


@compiled
def depth_image(points: Float32) -> UInt16:
    """Horizontal distance of the nearest return by direction and elevation in centimetres, 0 where none is,
    uint16, shape (BINS, ELEVATIONS): a run keeps these for all gathered scans.

    Args:
        points: Level sensor frame, shape (N, 3) [m].
    """
    depth = np.zeros((BINS, ELEVATIONS), np.uint16)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        rho = np.sqrt(x * x + y * y)
        if rho > 0.3:
            e = int(np.floor((points[i, 2] / rho - LOWEST) / STEP))
            if 0 <= e < ELEVATIONS:
                b = direction_bin(x, y, BINS)
                near = np.uint16(min(rho * 100.0, 65535.0))
                if depth[b, e] == 0 or near < depth[b, e]:
                    depth[b, e] = near
    return depth


@compiled
def look_through(
    axis: Float,
    met: Int32,
    passed: Int32,
    pose: Float,
    depth: UInt16,
    offset: Float,
    terrain: Float,
    range_max: float,
) -> None:
    """Count for each column and slice the rays that ended at it, and those that passed its axis and ended
    behind it. A ray that ends before it, or nowhere, tells nothing.

    Args:
        axis: Columns, shape (K, 5); met, passed: shape (K, SLICES), changed in place.
        depth: See `depth_image`; all else: see `look`.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for k in range(axis.shape[0]):
        dx, dy = axis[k, 0] - pose[0], axis[k, 1] - pose[1]
        x, y = c * dx + s * dy - offset[0], c * dy - s * dx - offset[1]
        rho = np.sqrt(x * x + y * y)
        if rho > range_max or rho < 0.3:
            continue
        b, ground = direction_bin(x, y, BINS), ground_at(terrain, x, y)
        first = max(int(np.floor((ground / rho - LOWEST) / STEP)), 0)
        last = min(int(np.ceil(((ground + SLICES * SLICE) / rho - LOWEST) / STEP)), ELEVATIONS - 1)
        for e in range(first, last + 1):
            h = (LOWEST + (e + 0.5) * STEP) * rho - ground
            behind = 0.01 * depth[b, e] - rho
            if depth[b, e] > 0 and 0.0 <= h < SLICES * SLICE and behind >= -MET:
                if behind <= MET:
                    met[k, int(h / SLICE)] += 1
                elif behind > PASSED:
                    passed[k, int(h / SLICE)] += 1
