"""Free space of a scan by direction, which distinguishes a missing tree from an occluded one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Float32

BINS = 360  # sectors of about one degree
BEHIND = 1.0  # m; a return this far behind the position of a tree shows that the tree is absent
# Share of the directions outside of the largest gap that have a return. Sparser returns, for example of a
# planar laser in the open, do not show the edges of the field of view.
DENSE = 0.9
FIELD = 10  # bins; a direction without a return within this distance may be outside of the field of view


@compiled
def clear_range(raw: Float32, filtered: Float32, sensor_offset: Float) -> Float:
    """Return the free distance from the base by direction in the base frame, shape (BINS,), in the order of
    `direction_bin` [m].

    The free distance is the distance to the nearest filtered point in the direction or one of its two
    neighbours; infinite without a point; and 0 where one of the three may be outside of the field of view:
    without a return within FIELD bins, or in the largest gap between dense returns, which a sensor that looks
    one way does not observe. It is 0 everywhere for an empty scan.

    Args:
        raw: Points before the filters in the level sensor frame, float32, shape (N, 3) [m].
        filtered: Points after the filters in the same frame, float32, shape (M, 3) [m].
        sensor_offset: Position of the sensor in the level base frame, shape (3,) [m].
    """
    bins = directions(raw, sensor_offset)
    looked = np.zeros(BINS, np.bool_)
    for k in bins:
        looked[k] = True
    free = np.full(BINS, np.inf)
    for i in range(filtered.shape[0]):
        x, y = filtered[i, 0] + sensor_offset[0], filtered[i, 1] + sensor_offset[1]
        k = direction_bin(x, y, BINS)
        free[k] = min(free[k], np.sqrt(x * x + y * y))
    first, largest = widest_gap(bins)
    if np.count_nonzero(looked) >= DENSE * (BINS - largest):
        for k in range(first, first + largest):
            free[k % BINS] = 0.0
    for k in range(BINS):
        near = False
        for j in range(-FIELD, FIELD + 1):
            near = near or looked[(k + j) % BINS]
        if not near:
            free[k] = 0.0
    # The edge of a trunk may be in either of two bins; the minimum over neighbouring bins is conservative.
    safe = free.copy()
    for k in range(BINS):
        safe[k] = min(free[k], free[(k + 1) % BINS], free[k - 1])
    return safe


@compiled
def seen_range(
    points: Float32,
    height: Float32,
    sensor_offset: Float,
    sensor_height: float,
    band: tuple[float, float],
    free: Float,
) -> Float:
    """Return how far from the base stems are in view at some height, by direction in the base frame, shape
    (BINS,), in the order of `direction_bin` [m].

    This is the free range or, if it is longer, the length over which the farthest ray of the direction is in
    the band of heights: undergrowth hides a stem only as high as it grows. The ground is taken as plane below
    a ray.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        height: Their heights above the ground, float32, shape (N,) [m].
        sensor_offset: Position of the sensor in the level base frame, shape (3,) [m].
        sensor_height: Height of the sensor above the ground [m].
        band: Lowest and highest height at which stems are looked for [m].
        free: Free range by direction [m], see `clear_range`.
    """
    low, high = band
    seen = free.copy()
    for i in range(points.shape[0]):
        part = 1.0  # of the ray, up to where it leaves the band; 0 if it is never in it
        if height[i] > high:
            part = (high - sensor_height) / (height[i] - sensor_height) if sensor_height < high else 0.0
        elif height[i] < low:
            part = (sensor_height - low) / (sensor_height - height[i]) if sensor_height > low else 0.0
        if part > 0.0:
            x, y = part * points[i, 0] + sensor_offset[0], part * points[i, 1] + sensor_offset[1]
            k = direction_bin(x, y, BINS)
            seen[k] = max(seen[k], np.sqrt(x * x + y * y))
    return seen


@compiled
def widest_gap(bins: NDArray[np.uint16]) -> tuple[int, int]:
    """Return the first bin and the length of the longest run of bins without a return, which may extend over
    the seam; length 0 for an empty scan. `bins` are the bins of the returns, see `directions`, shape (N,)."""
    lit = np.zeros(BINS, np.bool_)
    for k in bins:
        lit[k] = True
    first, most, run = 0, 0, 0
    for k in range(2 * BINS):  # two turns, so that a run across the seam counts once
        run = 0 if lit[k % BINS] else run + 1
        if most < run <= BINS:
            first, most = k + 1 - run, run
    return first % BINS, most if most < BINS else 0


@compiled
def directions(points: Float32, sensor_offset: Float) -> NDArray[np.uint16]:
    """Return the `direction_bin` (of BINS) of each point as seen from the base, uint16, shape (N,).

    A point at the base itself has the direction (1, 0).

    Args:
        points: Points in the level sensor frame, float32, shape (N, 2 or 3) [m], finite.
        sensor_offset: Position of the sensor in the level base frame, x, y first [m]; zeros for directions
            from the sensor.
    """
    n = points.shape[0]
    xs, ys = np.empty(n), np.empty(n)
    for i in range(n):
        xs[i], ys[i] = points[i, 0], points[i, 1]
    bins = np.empty(n, np.uint16)
    at_x, at_y, last = sensor_offset[0], sensor_offset[1], np.int32(BINS - 1)
    for i in range(n):
        x, y = xs[i] + at_x, ys[i] + at_y
        length = abs(x) + abs(y)
        side = y / length if length > 0.0 else 0.0
        behind = -1.0 - side if y < 0.0 else 3.0 - side
        turn = ((1.0 + side if x >= 0.0 else behind) + 1.0) * 0.25
        bins[i] = min(np.int32(turn * BINS), last)  # never negative, so that truncation rounds down
    return bins
