"""Pass-through filter and voxel grid filter (section 3.1 of the paper, Eq. 2)."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Filters
from pipeline.jit import compiled
from pipeline.types.records import Float32

# Odd 64-bit constant that distributes neighbouring cells over the hash table (Fibonacci hashing).
_SPREAD = np.uint64(0x9E3779B97F4A7C15)
_AXIS_CELLS = 1 << 21  # three axes of 21 bits fit one 64-bit key


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
    if size == 0.0 or len(points) == 0 or float(np.abs(points).max()) / size >= _AXIS_CELLS // 2 - 1:
        return points  # voxels this small contain one point each
    return _voxel_means(points, size)


@compiled
def _voxel_means(points: Float32, size: float) -> Float32:
    """Return the mean of the points of each cube of the edge length `size` [m], float32, shape (M, 3) [m];
    the points, shape (N, 3) [m], are finite and within 2^20 cubes of the origin. See `voxel_grid`."""
    n = points.shape[0]
    slots = 2
    while slots < 2 * n:
        slots *= 2
    shift = np.uint64(64 - int(np.log2(slots) + 0.5))
    # The hash table stores row numbers; keys are stored per row. Most voxels are new and need no key
    # comparison.
    row_of, keys = np.full(slots, -1, np.int32), np.empty(n, np.int64)
    sums = np.zeros((n, 3))
    counts = np.zeros(n, np.int64)
    rows = 0
    for i in range(n):
        key = np.int64(0)
        for a in range(3):
            key = (key << 21) | (np.int64(np.floor(points[i, a] / size)) + _AXIS_CELLS // 2)
        slot = np.int64((np.uint64(key) * _SPREAD) >> shift)
        while row_of[slot] >= 0 and keys[row_of[slot]] != key:
            slot = (slot + 1) & (slots - 1)
        row = row_of[slot]
        if row < 0:
            row_of[slot] = row = rows
            keys[row] = key
            rows += 1
        counts[row] += 1
        for a in range(3):
            sums[row, a] += points[i, a]
    means = np.empty((rows, 3), np.float32)
    for row in range(rows):
        for a in range(3):
            means[row, a] = sums[row, a] / counts[row]
    return means
