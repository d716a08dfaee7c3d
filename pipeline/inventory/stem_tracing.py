"""Stems: upright columns of voxels, which the random forest classifies, and circles along their axes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.classification.column_extraction import BREAST, HIGH, MARGIN, examine
from pipeline.classification.features import COUNT, features
from pipeline.classification.voxel_map import SIDE, SLICE, SLICES, TILE, VoxelMap
from pipeline.geometry.poses import Float
from pipeline.inventory.cross_sections import (
    FIGURES,
    LOWEST,
    STEP,
    THICK,
    Slices,
    best_circle,
    fit_circle,
    points_around,
    share_inside,
    slice_heights,
)
from pipeline.jit import compiled
from pipeline.types.records import Float32

LEAST = 12  # points on a circle; with fewer, chance places circles above one another
ARC = np.radians(70.0)  # least arc of a circle of a stem
HOLLOW = 0.25  # largest share of points inside of a circle
NOISE = 0.03  # m; noise of mobile scanners
ALIKE = 0.3  # largest change of centre and radius between neighbouring slices, as a share of the radius
LOST = 5  # slices (1 m) without a circle after which a stem ends
OFTEN = 50.0  # number of scans in which a column counts as present


def find_columns(points: Float32) -> Iterator[tuple[Float, Float]]:
    """Yield the upright columns of voxels, and their features for the random forest, by square tiles.

    A whole cloud is treated as if a robot had seen it from everywhere: each position was visible up to the
    height in which stems are traced, and no column was ever absent.

    Args:
        points: Points x, y, z and height above the ground, shape (N, 4) [m]; may be empty.

    Yields:
        Axes: x, y at 1.3 m above the ground [m], shift in x and y per metre of height, strength, shape (K,
            5); and features, shape (K, COUNT). A tile without a column gives no rows.
    """
    memory = VoxelMap.empty()
    room = 1 << max(len(points) - 1, 0).bit_length()  # a full map would forget voxels; there is one per point
    memory.add(np.ascontiguousarray(points[:, [0, 1, 3]]), 0, room)
    for tile in memory.due_tiles(1.0):
        mean, returns = memory.around(tile, MARGIN)
        axis, profiles = examine(mean, returns, tile * TILE, TILE)
        n = len(axis)
        row = np.zeros((n, COUNT))
        met = (profiles[:, :, 0] > 0.0).astype(np.int32)
        always = (np.full(n, SLICES * SLICE), np.full(n, OFTEN), np.zeros(n))
        features(axis, profiles, *always, met, 1 - met, row)
        yield axis, row


def strongest_first(tiles: Sequence[tuple[Float, Float]]) -> tuple[Float, Float]:
    """Return axes, shape (K, 5), and features, shape (K, COUNT), of the columns of all tiles (results of
    `find_columns`), strongest first; without tiles, no rows."""
    axes = np.concatenate([np.zeros((0, 5)), *(axes for axes, _ in tiles)])
    rows = np.concatenate([np.zeros((0, COUNT)), *(rows for _, rows in tiles)])
    order = np.argsort(-axes[:, 4], kind="stable")
    return axes[order], rows[order]


def trace(slices: Slices, axes: Float, r_min: float, r_max: float) -> Float:
    """Return the circles along the axes of K columns in each of S slices, with the values of `fit_circle`,
    shape (K, S, FIGURES); NaN in slices without a circle. After more than LOST slices in a row without a
    circle none follows; a column without a first circle has none.

    The first circle is that of all points up to the height in which columns are found, moved along the axis
    to breast height. From there the circle of each slice is fitted, upwards and downwards; it begins with the
    last one, moved along the axis. This is done with the points near the axis, where a thin stem is not
    outnumbered by its surroundings, and with those of twice and four times the radius. Of these three
    results, the one with the largest sum of visible arcs is returned.

    Args:
        slices: Slices of the plot.
        axes: Columns, see `find_columns`.
        r_min, r_max: Minimum and maximum radius [m].
    """
    return _trace(slices, axes, slice_heights(), r_min, r_max)


@compiled
def _trace(slices: Slices, axes: Float, height: Float, r_min: float, r_max: float) -> Float:
    """Return the circles along the axes of K columns, see `trace`, shape (K, S, FIGURES); NaN for slices
    without a circle and for columns without a first circle.

    Args:
        slices: Slices of the plot.
        axes: Axes of the columns, see `find_columns`.
        height: Result of `slice_heights`: heights of S slices above the ground, shape (S,) [m].
        r_min, r_max: Minimum and maximum radius [m].
    """
    out = np.full((axes.shape[0], height.shape[0], FIGURES), np.nan)
    circles = np.empty((height.shape[0], FIGURES))
    for s in range(axes.shape[0]):
        most = 0.0
        for part in (4.0, 2.0, 1.0):
            largest = max(r_max / part, r_min)
            circles[:] = np.nan
            _trace_column(slices, axes[s], height, r_min, largest, r_max, circles)
            seen = np.nansum(circles[:, 8])
            if seen > most:
                most = seen
                out[s] = circles
    return out


@compiled
def _trace_column(
    slices: Slices, axis: Float, height: Float, r_min: float, largest: float, r_max: float, circles: Float
) -> None:
    """Fill the circles along an axis, see `trace`.

    Args:
        slices: Slices of the plot.
        axis: Axis of the column, see `find_columns`.
        height: Result of `slice_heights`.
        r_min, largest, r_max: Minimum radius, and maximum radius of the first circle and of all others [m].
        circles: NaN, shape (S, FIGURES), changed in place.
    """
    row, shifted = np.empty(FIGURES), np.zeros((0, 2))
    for step in range(int((HIGH * SLICE - LOWEST) / STEP)):
        at = axis[:2] + axis[2:4] * (LOWEST + (step + 0.5) * STEP - BREAST)
        # The axis of a column is inside of the stem or on its bark.
        near = points_around(slices, step, step + 1, at[0], at[1], 2.0 * largest + SIDE)
        shifted = np.concatenate((shifted, near - at))
    if shifted.shape[0] < LEAST or best_circle(shifted, NOISE, r_min, largest, row) < LEAST:
        return
    breast = int(np.argmin(np.abs(height - BREAST)))
    x, y = axis[:2] + axis[2:4] * (height[breast] - BREAST) + row[:2]
    first = row[2]
    for way in (1, -1):
        row[0], row[1], row[2] = x, y, first
        k, missed = breast, 0
        while 0 <= k < height.shape[0] and missed <= LOST:
            if _fits(slices, k, row, r_min, r_max):
                circles[k] = row
                missed = 0
            else:
                missed += 1
            row[0] += way * axis[2] * STEP
            row[1] += way * axis[3] * STEP
            k += way


@compiled
def _fits(slices: Slices, k: int, row: Float, r_min: float, r_max: float) -> bool:
    """Fit the circle of a slice; return whether it can belong to the stem. If not, the position and the
    radius are unchanged, and the other values are undefined.

    Args:
        slices: Slices of the plot.
        k: Index of the slice.
        row: Predicted x, y, radius first [m]; filled with the result, shape (FIGURES,).
        r_min, r_max: Minimum and maximum radius [m].
    """
    x, y, r = row[0], row[1], row[2]
    slack = ALIKE * r + NOISE
    near = points_around(slices, k, k + THICK, x, y, 2.0 * r + 0.2)
    good = near.shape[0] >= LEAST and fit_circle(near, slack, r_min, r_max, row)
    good = good and np.sqrt((row[0] - x) ** 2 + (row[1] - y) ** 2) < slack and abs(row[2] - r) < slack
    good = good and row[9] >= LEAST and row[8] >= ARC and row[7] < ALIKE * row[2]
    good = good and share_inside(near, row[0], row[1], row[2]) <= HOLLOW
    if not good:
        row[0], row[1], row[2] = x, y, r
    return good
