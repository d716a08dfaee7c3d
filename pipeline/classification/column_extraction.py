"""Extraction of columns: upright runs of voxels that may be stems, each with its axis and its profile over
height."""

from __future__ import annotations

import numpy as np

from pipeline.classification.voxel_map import SIDE, SLICE, SLICES
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import RING_FAR, Float32, Int, Int32

BREAST = 1.3  # m above the ground; height of the position of an axis, also in the examples of the classifier
BUCKET = RING_FAR  # m; radius of the neighbourhood of a column
MARGIN = 1.2  # m around a tile in which neighbours are considered
MOVES = 0.5  # m; a column outside of a tile may move into it by this distance when its axis is fitted
LOW, LOW_HIGH, HIGH = 1, 7, 15  # slices: 0.2 to 1.4 m, and to 3 m, in which a column has returns
LEAST = 3  # slices with returns
TWIN = 0.02  # m; axes within this distance are the same
APART = 0.2  # m; of two columns within this distance along x and y the weaker one is dropped
INSIDE, RING_NEAR = 0.3, 0.45  # m around the axis
OCTANTS = 8
ARC = 11  # first column of the moments of an arc, see `profile`
PROFILE = ARC + 9  # columns of a profile, see `profile`


@compiled
def find_columns(mean: Float32, returns: Int32, low: Float, side: float) -> Float:
    """Return the candidates for columns with their foot in or near a square tile.

    The search uses all heights up to 3 m, and then the low ones only, where a trunk is visible below a crown
    that dominates the count over all heights. A candidate of both searches is returned once.

    Args:
        mean: Voxels in and around the tile: x, y in the map and height above the ground, shape (N, 3) [m].
        returns: Number of returns of each voxel, shape (N,).
        low: Corner of the tile with the minimum x and y, shape (2,) [m].
        side: Side of the tile [m].

    Returns:
        Axis (x, y at 1.3 m above the ground at the middle of a cell of SIDE, and shift per metre of height,
        which is 0) and strength, shape (K, 5).
    """
    cells = int(np.ceil((side + 2 * MARGIN) / SIDE))
    reach, border = round(APART / SIDE), round((MARGIN - MOVES) / SIDE)
    columns = np.empty((cells * cells // 4, 5))
    n = 0
    strength, below = _strengths(mean, returns, low, cells)
    for search in range(2):
        searched = strength if search == 0 else below
        for i in range(border, cells - border):
            for j in range(border, cells - border):
                if searched[i, j] == 0.0 or not _is_peak(searched, i, j, reach):
                    continue
                if search == 1 and strength[i, j] > 0.0 and _is_peak(strength, i, j, reach):
                    continue
                columns[n, 0] = low[0] - MARGIN + (i + 0.5) * SIDE
                columns[n, 1] = low[1] - MARGIN + (j + 0.5) * SIDE
                columns[n, 2], columns[n, 3], columns[n, 4] = 0.0, 0.0, searched[i, j]
                n += 1
    return columns[:n]


@compiled
def _is_peak(strength: Float, i: int, j: int, reach: int) -> bool:
    """Return whether no cell within a square of half side `reach` is stronger than cell i, j; of equal cells,
    the first in the order of rows and columns is the peak.

    Args:
        strength: A result of `_strengths`, shape (cells, cells).
        i, j: Row and column of the cell, at least `reach` from the border.
        reach: Half side in cells.
    """
    for di in range(-reach, reach + 1):
        for dj in range(-reach, reach + 1):
            other = strength[
                min(max(i + di, 0), strength.shape[0] - 1), min(max(j + dj, 0), strength.shape[1] - 1)
            ]
            later = di > 0 or (di == 0 and dj > 0)
            if other > strength[i, j] or (other == strength[i, j] and not later and (di != 0 or dj != 0)):
                return False
    return True


@compiled
def _strengths(mean: Float32, returns: Int32, low: Float, cells: int) -> tuple[Float, Float]:
    """Return for each cell the sum over the slices from LOW to below HIGH of log(1 + n), where n is the
    number of returns in the cell and its eight neighbours; 0 if fewer than LEAST slices have returns, and at
    the border. The second result is the same for the slices below LOW_HIGH. Shapes (cells, cells).

    Args:
        mean, returns, low: See `find_columns`.
        cells: Number of cells per side of the tile with its margin.
    """
    around = np.zeros((cells, cells, HIGH - LOW), np.int32)
    filled = np.zeros((cells, cells), np.int32)
    for i in range(mean.shape[0]):
        a = int(np.floor((mean[i, 0] - low[0] + MARGIN) / SIDE))
        b = int(np.floor((mean[i, 1] - low[1] + MARGIN) / SIDE))
        h = int(mean[i, 2] / SLICE) - LOW
        if 0 <= a < cells and 0 <= b < cells and 0 <= h < HIGH - LOW:
            for c in range(max(a - 1, 1), min(a + 2, cells - 1)):
                for d in range(max(b - 1, 1), min(b + 2, cells - 1)):
                    filled[c, d] += around[c, d, h] == 0
                    around[c, d, h] += returns[i]
    strength, below = np.zeros((cells, cells)), np.zeros((cells, cells))
    for a in range(1, cells - 1):
        for b in range(1, cells - 1):
            if filled[a, b] < LEAST:
                continue
            total, found = 0.0, 0
            for h in range(HIGH - LOW):
                if around[a, b, h] > 0:
                    found += 1
                    total += np.log(1.0 + around[a, b, h])
                if h == LOW_HIGH - LOW - 1 and found >= LEAST:
                    below[a, b] = total
            strength[a, b] = total
    return strength, below


@compiled
def in_buckets(mean: Float32, low: Float, side: float) -> tuple[Int, Int]:
    """Sort the voxels into horizontal buckets of side `BUCKET` over the tile with MARGIN; a voxel outside
    counts to the nearest bucket.

    Args:
        mean: Voxels, x, y first, shape (N, 3) [m].
        low: Corner of the tile, shape (2,) [m].
        side: Side of the tile [m].

    Returns:
        Order of the voxels by bucket, shape (N,), and the first row of each bucket in this order, shape
        (buckets + 1,).
    """
    across = int(np.ceil((side + 2 * MARGIN) / BUCKET))
    bucket = np.empty(mean.shape[0], np.int64)
    for i in range(mean.shape[0]):
        a = min(max(int((mean[i, 0] - low[0] + MARGIN) / BUCKET), 0), across - 1)
        b = min(max(int((mean[i, 1] - low[1] + MARGIN) / BUCKET), 0), across - 1)
        bucket[i] = a * across + b
    return group_rows(bucket, across * across)


@compiled
def near_rows(x: float, y: float, low: Float, bounds: Int) -> Int:
    """Return the rows of the three by three buckets around a position as runs (first, one past the last; 0, 0
    for a row of buckets outside), int64, shape (3, 2). A position outside counts to the nearest bucket.

    Args:
        x, y: The position [m].
        low: Corner of the tile, shape (2,) [m].
        bounds: Second result of `in_buckets`.
    """
    across = int(np.sqrt(bounds.shape[0] - 1) + 0.5)
    a = min(max(int((x - low[0] + MARGIN) / BUCKET), 0), across - 1)
    b = min(max(int((y - low[1] + MARGIN) / BUCKET), 0), across - 1)
    runs = np.zeros((3, 2), np.int64)
    for k in range(3):
        if 0 <= a + k - 1 < across:
            runs[k, 0] = bounds[(a + k - 1) * across + max(b - 1, 0)]
            runs[k, 1] = bounds[(a + k - 1) * across + min(b + 1, across - 1) + 1]
    return runs


@compiled
def examine(mean: Float32, returns: Int32, low: Float, side: float) -> tuple[Float, Float]:
    """Return the columns of a tile and their profiles. The axis of each candidate of `find_columns` is
    refined; duplicates and those that leave the tile are dropped.

    Args:
        mean, returns, low, side: See `find_columns`.

    Returns:
        Columns whose axis at 1.3 m is in the tile, shape (K, 5), with the columns of `find_columns`, and
        their profiles, shape (K, SLICES, PROFILE), see `profile`.
    """
    found = find_columns(mean, returns, low, side)
    order, bounds = in_buckets(mean, low, side)
    sorted_mean, sorted_returns = mean[order], returns[order]
    profiles = np.zeros((found.shape[0], SLICES, PROFILE))
    kept = 0
    for c in range(found.shape[0]):
        axis = found[c]
        for turn in range(4):
            runs = near_rows(axis[0], axis[1], low, bounds)
            _fit_line(axis, sorted_mean, sorted_returns, runs, 0.35 if turn < 2 else 0.25)
        here = low[0] <= axis[0] < low[0] + side and low[1] <= axis[1] < low[1] + side
        if here and not _is_known(axis, found, kept):
            found[kept] = axis
            profile(
                axis, sorted_mean, sorted_returns, near_rows(axis[0], axis[1], low, bounds), profiles[kept]
            )
            kept += 1
    return found[:kept].copy(), profiles[:kept].copy()


@compiled
def _is_known(axis: Float, found: Float, kept: int) -> bool:
    """Return whether one of the first `kept` rows of `found` is the same axis as `axis`: x and y, the first
    two values, both differ by less than TWIN [m]."""
    known = False
    for k in range(kept):
        known |= abs(axis[0] - found[k, 0]) < TWIN and abs(axis[1] - found[k, 1]) < TWIN
    return known


@compiled
def _fit_line(axis: Float, mean: Float32, returns: Int32, runs: Int, reach: float) -> None:
    """Refine an axis, in place; it is unchanged if there are no returns at the axis. The weight of a slice
    depends mainly on the share of its returns that is at the axis, less on their number, so that foliage does
    not shift the axis. A weak prior keeps it upright, and the shift per metre is limited to 0.5.

    Args:
        axis: See `find_columns`; position and shift per metre are changed.
        mean, returns: Voxels in the order of buckets.
        runs: Result of `near_rows`.
        reach: Distance within which a return is at the axis [m].
    """
    w, x, y, around = np.zeros(SLICES), np.zeros(SLICES), np.zeros(SLICES), np.zeros(SLICES)
    for run in range(runs.shape[0]):
        for i in range(runs[run, 0], runs[run, 1]):
            h = mean[i, 2]
            s = int(h / SLICE)
            if s < LOW or s >= HIGH:
                continue
            dx = mean[i, 0] - axis[0] - axis[2] * (h - BREAST)
            dy = mean[i, 1] - axis[1] - axis[3] * (h - BREAST)
            r2 = dx * dx + dy * dy
            if r2 < reach * reach:
                w[s] += returns[i]
                x[s] += returns[i] * mean[i, 0]
                y[s] += returns[i] * mean[i, 1]
            elif r2 < RING_FAR * RING_FAR:
                around[s] += returns[i]
    n, sh, shh, sx, sy, shx, shy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(SLICES):
        if w[s] > 0.0:
            h = (s + 0.5) * SLICE - BREAST
            clean = w[s] / (w[s] + around[s])
            v = w[s] / (w[s] + 2.0) * clean * clean
            n += v
            sh += v * h
            shh += v * h * h
            sx += v * x[s] / w[s]
            sy += v * y[s] / w[s]
            shx += v * h * x[s] / w[s]
            shy += v * h * y[s] / w[s]
    if n < 1e-3:
        return
    det = n * (shh + 0.5) - sh * sh
    axis[2] = min(max((n * shx - sh * sx) / det, -0.5), 0.5)
    axis[3] = min(max((n * shy - sh * sy) / det, -0.5), 0.5)
    axis[0] = (sx - axis[2] * sh) / n
    axis[1] = (sy - axis[3] * sh) / n


@compiled
def profile(axis: Float, mean: Float32, returns: Int32, runs: Int, rows: Float) -> None:
    """Fill `rows` of zeros, shape (SLICES, PROFILE), with the profile of a column.

    By distance from the axis, returns are inside (up to INSIDE), between (up to RING_NEAR) or in the ring (up
    to RING_FAR). Columns: returns inside, returns between, returns in the ring, voxels inside, filled octants
    of the ring, middle of the inside (x, y from the axis) [m], rms distance of the inside from the axis [m],
    and the second moments xx, xy, yy of the inside about its middle [m^2]. From ARC onwards sums over the
    returns within RING_NEAR for a circle fit (Kasa 1976), with z = x^2 + y^2 from the axis: 1, x, y, xx, xy,
    yy, xz, yz, zz.

    Args:
        axis: See `find_columns`.
        mean, returns: Voxels in the order of buckets.
        runs: See `near_rows`.
        rows: Filled with the profile.
    """
    octants = np.zeros((SLICES, OCTANTS), np.bool_)
    for run in range(runs.shape[0]):
        for i in range(runs[run, 0], runs[run, 1]):
            h = mean[i, 2]
            s = int(h / SLICE)
            dx = mean[i, 0] - axis[0] - axis[2] * (h - BREAST)
            dy = mean[i, 1] - axis[1] - axis[3] * (h - BREAST)
            n, r2 = float(returns[i]), dx * dx + dy * dy
            if s < 0 or s >= SLICES or r2 >= RING_FAR * RING_FAR:
                continue
            if r2 >= RING_NEAR * RING_NEAR:
                rows[s, 2] += n
                octants[s, (dx > 0.0) * 4 + (dy > 0.0) * 2 + (abs(dx) > abs(dy))] = True
                continue
            rows[s, ARC] += n
            rows[s, ARC + 1] += n * dx
            rows[s, ARC + 2] += n * dy
            rows[s, ARC + 3] += n * (dx * dx)
            rows[s, ARC + 4] += n * (dx * dy)
            rows[s, ARC + 5] += n * (dy * dy)
            rows[s, ARC + 6] += n * (dx * r2)
            rows[s, ARC + 7] += n * (dy * r2)
            rows[s, ARC + 8] += n * (r2 * r2)
            if r2 >= INSIDE * INSIDE:
                rows[s, 1] += n
                continue
            rows[s, 0] += n
            rows[s, 3] += 1.0
            rows[s, 5] += n * dx
            rows[s, 6] += n * dy
            rows[s, 7] += n * r2
            rows[s, 8] += n * dx * dx
            rows[s, 9] += n * dx * dy
            rows[s, 10] += n * dy * dy
    for s in range(SLICES):
        rows[s, 4] = octants[s].sum()
        if rows[s, 0] > 0.0:
            for a in range(5, ARC):
                rows[s, a] /= rows[s, 0]
            rows[s, 7] = np.sqrt(rows[s, 7])
            rows[s, 8] -= rows[s, 5] * rows[s, 5]
            rows[s, 9] -= rows[s, 5] * rows[s, 6]
            rows[s, 10] -= rows[s, 6] * rows[s, 6]
