"""Clusters of a planar laser: runs of neighbouring beams without a jump in range."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int, Int32


def range_jump(points: Float32, jump: float, min_points: int, azimuth_step: float) -> tuple[Int32, Bool]:
    """Cut the beams, ordered by azimuth, wherever the range jumps or more than one beam is missing.

    Args:
        points: float32, shape (N, 3) [m], sensor frame.
        jump: Largest change of range between neighbours of one cluster [m].
        min_points: Smaller clusters are noise.
        azimuth_step: Angle between neighbouring beams [rad].

    Returns:
        Labels, int32, shape (N,), -1 for noise, and for each cluster whether a neighbouring beam
        that ended nearer hides one of its edges.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.bool_)
    x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    azimuth = np.arctan2(y, x)
    order = np.argsort(azimuth, kind="stable")
    return _cut(azimuth[order], np.hypot(x, y)[order], order, jump, min_points, 2.5 * azimuth_step)


@compiled
def _cut(
    azimuth: Float, distance: Float, order: Int, jump: float, min_points: int, gap: float
) -> tuple[Int32, Bool]:
    n = azimuth.shape[0]
    # Beam i and the one before it: are they neighbours, and do they belong together? The circle is
    # closed, so the first beam follows the last one.
    neighbours = np.zeros(n, np.bool_)
    begins = np.zeros(n, np.bool_)
    for i in range(n):
        turn = azimuth[i] - azimuth[i - 1] + (2.0 * np.pi if i == 0 else 0.0)
        neighbours[i] = n > 1 and turn <= gap
        begins[i] = not (neighbours[i] and abs(distance[i] - distance[i - 1]) <= jump)
    first = 0
    while first < n - 1 and not begins[first]:
        first += 1
    label = np.full(n, -1, np.int32)
    hidden = np.zeros(n, np.bool_)
    clusters = 0
    start = first
    for k in range(first + 1, first + n + 1):
        if k < first + n and not begins[k % n]:
            continue
        if k - start >= min_points:
            for i in range(start, k):
                label[order[i % n]] = clusters
            a, b = start % n, (k - 1) % n
            before = neighbours[a] and distance[a - 1] < distance[a]
            after = neighbours[k % n] and distance[k % n] < distance[b]
            hidden[clusters] = before or after
            clusters += 1
        start = k
    return label, hidden[:clusters].copy()
