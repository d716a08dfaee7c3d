"""Free space of a scan by direction, which distinguishes a missing tree from an occluded one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Float32

BINS = 360  # sectors of about one degree
BEHIND = 1.0  # m; a return this far behind the position of a tree shows that the tree is absent
# Share of the directions outside of the largest gap that have a return. Sparser returns, for example of a
# planar laser in the open, do not show the edges of the field of view.
DENSE = 0.9
FIELD = 10  # bins; a direction without a return within this distance may be outside of the field of view


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
    looked[bins] = True
    place = filtered[:, :2] + sensor_offset[:2]
    free = np.full(BINS, np.inf)
    np.minimum.at(free, directions(filtered, sensor_offset), np.sqrt((place * place).sum(axis=1)))
    first, largest = widest_gap(bins)
    if np.count_nonzero(looked) >= DENSE * (BINS - largest):
        free[(first + np.arange(largest)) % BINS] = 0.0
    around = np.concatenate([looked[-FIELD:], looked, looked[:FIELD]])
    free[~np.lib.stride_tricks.sliding_window_view(around, 2 * FIELD + 1).any(axis=1)] = 0.0
    # The edge of a trunk may be in either of two bins; the minimum over neighbouring bins is conservative.
    safe: Float = np.minimum(free, np.minimum(np.roll(free, 1), np.roll(free, -1)))
    return safe


def widest_gap(bins: NDArray[np.uint16]) -> tuple[int, int]:
    """Return the first bin and the length of the longest run of bins without a return, which may extend over
    the seam; length 0 for an empty scan. `bins` are the bins of the returns, see `directions`, shape (N,)."""
    lit = np.flatnonzero(np.bincount(bins, minlength=BINS))
    if not len(lit):
        return 0, 0
    first, gaps = (lit + 1) % BINS, np.diff(lit, append=lit[0] + BINS) - 1
    widest = np.lexsort((first, -gaps))[0]  # of equal ones that with the smallest first bin
    return int(first[widest]), int(gaps[widest])


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
