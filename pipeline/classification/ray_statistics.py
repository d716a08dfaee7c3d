"""Visibility of columns: how high scans looked at them, whether they were present, and how many rays ended at
them or passed them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.classification.column_extraction import RING_NEAR
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.detection.free_space import BEHIND, BINS
from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.scan_ground import ground_at
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int32, UInt16


@dataclass(frozen=True, slots=True, eq=False)
class ScanView:
    """Pose and visibility of a scan.

    Attributes:
        T_map_base: Pose of the base in the map.
        sensor_offset: Position of the sensor in the level base frame, shape (3,) [m].
        clear_range: Free range by direction in the base frame, shape (BINS,) [m].
        steepest: Tangent of the steepest elevation of a return by direction, shape (BINS,).
        depth: Range of the nearest return, see `view_by_direction`.
        terrain: Ground height below the scan, as `Terrain.height`.
    """

    T_map_base: Pose2
    sensor_offset: Float
    clear_range: Float
    steepest: Float
    depth: UInt16
    terrain: Float


ELEVATIONS, LOWEST, STEP = 96, -0.84, 0.0175  # of a depth image, as tangents; a step is about one degree
# m; a ray that ends this near to the axis met the column, one this far behind passed it.
MET, PASSED = RING_NEAR, 0.5
NEAR = 0.6  # m; a return this near to a column belongs to it


@compiled
def view_by_direction(points: Float32, offset: Float, all_around: bool) -> tuple[Float, UInt16]:
    """Return how high a scan looks in each direction, and its depth image.

    Args:
        points: Points in the level sensor frame, shape (N, 3) [m], finite.
        offset: Position of the sensor in the base frame, shape (3,) [m].
        all_around: Whether the sensor has the same elevations in all directions, so that the steepest one
            applies to all.

    Returns:
        Tangent of the steepest elevation of a return in each direction of the base frame, shape (BINS,); -1
        if there is no return beyond 1 m from the sensor, and at least -1. Horizontal distance of the nearest
        return by direction from the sensor and elevation [cm], 0 if there is no return, at most 65535,
        uint16, shape (BINS, ELEVATIONS); returns within 0.3 m of the sensor, or with an elevation outside of
        the image, are ignored.
    """
    steepest, depth = np.full(BINS, -1.0), np.zeros((BINS, ELEVATIONS), np.uint16)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        rho = np.sqrt(x * x + y * y)
        if not rho > 0.3:
            continue
        tangent = points[i, 2] / rho
        if rho > 1.0:
            b = direction_bin(x + offset[0], y + offset[1], BINS)
            steepest[b] = max(steepest[b], tangent)
        e = int(np.floor((tangent - LOWEST) / STEP))
        if 0 <= e < ELEVATIONS:
            b = direction_bin(x, y, BINS)
            before, near = depth[b, e], np.uint16(min(rho * 100.0, 65535.0))
            # A selection instead of an unpredictable branch.
            depth[b, e] = near if (before == 0) | (near < before) else before
    if all_around:
        highest = -1.0
        for b in range(BINS):
            highest = max(highest, steepest[b])
        for b in range(BINS):
            steepest[b] = highest
    return steepest, depth


@compiled
def update_visibility(
    axis: Float,
    viewed: Float,
    present: Float,
    absent: Float,
    absent_lately: Float,
    pose: Float,
    clear_range: Float,
    steepest: Float,
    offset: Float,
    terrain: Float,
    range_max: float,
) -> None:
    """Update for each column in range whether it was present or absent, and how high the scan looked, in
    place.

    A column is present if the free range ends within NEAR of it, absent if it ends more than BEHIND beyond
    it. Otherwise, as when something nearer hides it, neither is counted. `absent_lately` counts the last
    scans that show it absent, and is 0 after one that shows it present. The observed height counts in each
    case.

    Args:
        axis: Axes of the columns, shape (K, 5).
        viewed, present, absent, absent_lately: Statistics of the columns, shape (K,), changed in place.
        pose: Pose x, y [m], yaw [rad] of the base in the map, shape (3,).
        clear_range, steepest: Free range [m] and tangent of the steepest elevation by direction in the base
            frame, shape (BINS,); see `ScanView`.
        offset: Position of the sensor in the base frame, shape (3,) [m].
        terrain: Terrain of this scan, as `Terrain.height`.
        range_max: Columns farther from the base are skipped [m].
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
            absent_lately[k] += 1.0
        elif abs(clear_range[b] - reach) < NEAR:
            present[k] += 1.0
            absent_lately[k] = 0.0


@compiled
def count_rays(
    axis: Float,
    met: Int32,
    passed: Int32,
    pose: Float,
    depth: UInt16,
    offset: Float,
    terrain: Float,
    range_max: float,
) -> None:
    """Count for each column and slice the rays that ended within MET of it, and those that ended more than
    PASSED behind its axis, in place. Rays that end before it, or have no return, do not count. Columns within
    0.3 m of the sensor, or beyond `range_max` from it, are skipped; the lean of a column is not considered.

    Args:
        axis: Axes of the columns, shape (K, 5).
        met, passed: Numbers of rays, shape (K, SLICES), changed in place.
        pose, offset, terrain, range_max: See `update_visibility`.
        depth: See `view_by_direction`.
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
