"""Pass-through filter and voxel grid filter (section 3.1 of the paper, Eq. 2)."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Filters
from pipeline.geometry.voxel_grid import AXIS_CELLS, add_to_voxels
from pipeline.jit import compiled
from pipeline.types.records import Float32


def pass_through(points: Float32, parameters: Filters) -> Float32:
    """Return the points inside the box including its faces, float32, shape (M, 3) [m], in their order; points
    with NaN are removed.

    Args:
        points: float32, shape (N, 3) [m].
        parameters: Limits of the box in the frame of the points; they are compared in float32.
    """
    p = parameters
    low = np.array([p.x_min, p.y_min, p.z_min], np.float32)
    high = np.array([p.x_max, p.y_max, p.z_max], np.float32)
    return _box(points, low, high)


@compiled
def _box(points: Float32, low: Float32, high: Float32) -> Float32:
    """Return the points, float32, shape (M, 3) [m], with low <= point <= high on each axis; low and high have
    the shape (3,) [m]. Points with NaN are removed."""
    inside = np.empty_like(points)
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
            inside[n, 0], inside[n, 1], inside[n, 2] = x, y, z
            n += 1
    return inside[:n].copy()


def voxel_grid(points: Float32, parameters: Filters) -> Float32:
    """Replace the points of each voxel by their mean, in the order of the first point of each voxel.

    The borders of the voxels are multiples of their size in the frame of the points. The points are returned
    unchanged (the same array) if the voxel size is 0, if there are none, or if a coordinate is farther than
    about a million voxels from the origin.

    Args:
        points: float32, shape (N, 3) [m], finite.
        parameters: `voxel_size` is the edge length of a voxel [m].

    Returns:
        Means, float32, shape (M, 3) [m].
    """
    size = parameters.voxel_size
    if size == 0.0 or len(points) == 0 or float(np.abs(points).max()) / size >= AXIS_CELLS // 2 - 1:
        return points  # voxels this small contain one point each
    n = len(points)
    sums, counts = np.zeros((n, 3)), np.zeros(n, np.int64)
    slots = np.full(2 << (n - 1).bit_length(), -1, np.int32)
    of = np.ones(n, np.int64)
    _, rows = add_to_voxels(points, of, 0, size, np.empty(n, np.int64), sums, counts, slots, 0)
    return (sums[:rows] / counts[:rows, None]).astype(np.float32)
