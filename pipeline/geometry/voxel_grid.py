"""Voxel grid: sums of the points in the cubes of a grid, found by a hash table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled

Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Int32 = NDArray[np.int32]

AXIS_CELLS = 1 << 21  # three axes of 21 bits fit one 64-bit key
# Odd 64-bit constant that distributes neighbouring cells over the hash table (Fibonacci hashing).
SPREAD = np.uint64(0x9E3779B97F4A7C15)


@compiled
def add_to_voxels(
    points: Float32,
    weight: Int,
    begin: int,
    size: float,
    keys: Int,
    sums: Float,
    counts: Int,
    slots: Int32,
    used: int,
) -> tuple[int, int]:
    """Add points to the voxels of a grid until no voxel is free; return the index of the first point that was
    not added (the number of points if all were), and the number of voxels in use.

    Args:
        points: Points within AXIS_CELLS / 2 voxels of the origin, x, y, z first, float32, shape (N, 3 or
            more) [m].
        weight: Number of points that each point represents, shape (N,).
        begin: First point to add.
        size: Side of a voxel [m].
        keys, sums, counts: Key, weighted sums of the columns, and weight of each voxel in the order of their
            first points, shapes (M,), (M, columns) and (M,), changed in place.
        slots: Hash table, -1 where empty; its length is a power of two and more than M. Changed in place.
        used: Number of voxels in use.
    """
    mask = slots.shape[0] - 1
    shift = np.uint64(64 - int(np.log2(slots.shape[0]) + 0.5))
    for i in range(begin, points.shape[0]):
        key = np.int64(0)
        for a in range(3):
            cell = np.int64(np.floor(points[i, a] / size)) + AXIS_CELLS // 2
            key = (key << 21) | (cell & (AXIS_CELLS - 1))
        # The hash table stores row numbers; keys are stored per row. Most voxels are new and need no key
        # comparison.
        slot = np.int64((np.uint64(key) * SPREAD) >> shift)
        while slots[slot] >= 0 and keys[slots[slot]] != key:
            slot = (slot + 1) & mask
        row = slots[slot]
        if row < 0:
            if used == keys.shape[0]:
                return i, used
            slots[slot] = row = np.int32(used)
            keys[row] = key
            used += 1
        counts[row] += weight[i]
        for a in range(points.shape[1]):
            sums[row, a] += weight[i] * np.float64(points[i, a])
    return points.shape[0], used
