"""Visibility: how far the view is free in each direction, so that a missing tree can be told from a
hidden one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Bool, Float32

BINS = 360  # of about a degree each
BEHIND = 1.0  # m; what is seen this far behind a tree's place proves that nothing stands there
FIELD = 10  # bins; a direction is looked at when any return of the scan lies this near to it


@compiled
def clear_range(raw: Float32, filtered: Float32, sensor_offset: Float) -> Float:
    """Free distance by direction of the base frame, shape (BINS,), in the order of `direction_bin` [m].

    It is the distance to the nearest filtered point; infinite where none is; and 0 where the scan
    has no return at all in the neighbourhood, because there the sensor may not look.

    Args:
        raw, filtered: float32, shape (N, 3) and (M, 3) [m], level sensor frame.
        sensor_offset: shape (3,) [m].
    """
    looked = np.zeros(BINS, np.bool_)
    for k in directions(raw, sensor_offset):
        looked[k] = True
    free = np.full(BINS, np.inf)
    for i in range(filtered.shape[0]):
        x, y = filtered[i, 0] + sensor_offset[0], filtered[i, 1] + sensor_offset[1]
        k = direction_bin(x, y, BINS)
        free[k] = min(free[k], np.sqrt(x * x + y * y))
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
def directions(points: Float32, sensor_offset: Float) -> NDArray[np.uint16]:
    """The `direction_bin` of each point, written without branches over plain rows, so that the processor
    takes several at once."""
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
        bins[i] = min(np.int32(turn * BINS), last)  # never negative, so that cutting off rounds down
    return bins


@compiled
def in_free_view(place: Float, pose: Float, clear_range: Float, view_range: float) -> Bool:
    """Whether the scan saw past each place, so that a tree there would have been seen, shape (N,).

    Args:
        place: shape (N, 2) [m]; pose: x, y [m], yaw [rad], shape (3,), both in the frame of the map.
        clear_range: As `clear_range` gives it.
        view_range: Places farther than this are never asked for [m].
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    free = np.zeros(place.shape[0], np.bool_)
    for i in range(place.shape[0]):
        free[i] = is_in_free_view(place[i], pose, c, s, clear_range, view_range)
    return free


@compiled_borrowing
def is_in_free_view(
    place: Float, pose: Float, c: float, s: float, clear_range: Float, view_range: float
) -> bool:
    """The same for one place; c and s are the cosine and sine of the yaw."""
    dx, dy = place[0] - pose[0], place[1] - pose[1]
    reach = np.sqrt(dx * dx + dy * dy)
    if reach > view_range:
        return False
    k = direction_bin(c * dx + s * dy, c * dy - s * dx, BINS)
    return bool(clear_range[k] > reach + BEHIND)
