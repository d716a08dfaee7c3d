"""Visibility: how far the view is free in each direction, so that a missing tree can be told from a
hidden one."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Float32

BINS = 360
BEHIND = 1.0  # m; what is seen this far behind a tree's place proves that nothing stands there
FIELD = 10  # bins; a direction is looked at when any return of the scan lies this near to it


@compiled
def clear_range(raw: Float32, filtered: Float32, sensor_offset: Float) -> Float:
    """Free distance by direction of the base frame, shape (BINS,), from -pi on [m].

    It is the distance to the nearest filtered point; infinite where none is; and 0 where the scan
    has no return at all in the neighbourhood, because there the sensor may not look.

    Args:
        raw, filtered: float32, shape (N, 3) and (M, 3) [m], level sensor frame.
        sensor_offset: shape (3,) [m].
    """
    looked = np.zeros(BINS, np.bool_)
    for i in range(raw.shape[0]):
        looked[_bin(raw[i, 0] + sensor_offset[0], raw[i, 1] + sensor_offset[1])] = True
    free = np.full(BINS, np.inf)
    for i in range(filtered.shape[0]):
        x, y = filtered[i, 0] + sensor_offset[0], filtered[i, 1] + sensor_offset[1]
        k = _bin(x, y)
        free[k] = min(free[k], np.hypot(x, y))
    for k in range(BINS):
        near = False
        for j in range(-FIELD, FIELD + 1):
            near = near or looked[(k + j) % BINS]
        if not near:
            free[k] = 0.0
    # A trunk's edge lies in two bins; the nearer of neighbours is the safe answer.
    safe = free.copy()
    for k in range(BINS):
        safe[k] = min(free[k], free[(k + 1) % BINS], free[k - 1])
    return safe


@compiled
def _bin(x: float, y: float) -> int:
    return min(int((np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * BINS), BINS - 1)


@compiled
def in_free_view(place: Float, pose: Float, clear_range: Float, view_range: float) -> bool:
    """Whether the scan saw past a place, so that a tree there would have been seen.

    Args:
        place: shape (2,) [m]; pose: x, y [m], yaw [rad], shape (3,), both in the frame of the map.
        clear_range: As `clear_range` gives it.
        view_range: Places farther than this are never asked for [m].
    """
    dx, dy = place[0] - pose[0], place[1] - pose[1]
    reach = np.hypot(dx, dy)
    if reach > view_range:
        return False
    turn = (np.arctan2(dy, dx) - pose[2] + np.pi) % (2.0 * np.pi)
    k = min(int(turn / (2.0 * np.pi) * BINS), BINS - 1)
    return bool(clear_range[k] > reach + BEHIND)
