"""Columns: upright runs of voxels that may be stems, each with its axis and its profile over height.

Everything of one tile is laid into a dense block of cells first, because a column is asked for its
neighbourhood again and again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.gathering.memory import SIDE, SLICE, SLICES
from pipeline.records import Float32, Int, Int32

MARGIN = 1.2  # m around a tile; a column looks so far for its neighbours
LOW, LOW_HIGH, HIGH = 1, 7, 15  # slices: 0.2 to 1.4 m and to 3 m, where a column must show
LEAST = 3  # of them hold returns
APART = 0.3  # m; of two columns nearer than that the weaker one is the same thing
INSIDE, RING_NEAR, RING_FAR = 0.3, 0.45, 0.9  # m around the axis
OCTANTS = 8
PROFILE = 11  # figures of a slice, see `profile`


@compiled
def find_columns(mean: Float32, returns: Int32, low: Float, side: float) -> Float:
    """Columns whose foot lies in a square tile or near to it.

    They are looked for twice, over all heights and over the low ones, where a trunk shows below a crown
    that hides it from a count over all.

    Args:
        mean: Voxels in and around the tile, shape (N, 3): x, y, height [m]; returns: shape (N,).
        low: Corner of the tile, shape (2,) [m]; side: its length [m].

    Returns:
        Shape (K, 5): the axis, x, y at 1.3 m above the ground and its shift per metre of height, and
        the strength.
    """
    cells = int(np.ceil((side + 2 * MARGIN) / SIDE))
    reach, border = int(APART / SIDE), int(MARGIN / SIDE) - 4
    columns = np.empty((cells * cells // 4, 5))
    n = 0
    for high in (HIGH, LOW_HIGH):
        strength = _strength(mean, returns, low, cells, high)
        for i in range(border, cells - border):
            for j in range(border, cells - border):
                if strength[i, j] > 0.0 and _is_peak(strength, i, j, reach):
                    columns[n, 0] = low[0] - MARGIN + (i + 0.5) * SIDE
                    columns[n, 1] = low[1] - MARGIN + (j + 0.5) * SIDE
                    columns[n, 2], columns[n, 3], columns[n, 4] = 0.0, 0.0, strength[i, j]
                    n += 1
    return columns[:n]


@compiled
def _is_peak(strength: Float, i: int, j: int, reach: int) -> bool:
    for di in range(-reach, reach + 1):
        for dj in range(-reach, reach + 1):
            other = strength[min(max(i + di, 0), strength.shape[0] - 1), min(max(j + dj, 0), strength.shape[1] - 1)]
            later = di > 0 or (di == 0 and dj > 0)
            if other > strength[i, j] or (other == strength[i, j] and not later and (di != 0 or dj != 0)):
                return False
    return True


@compiled
def _strength(mean: Float32, returns: Int32, low: Float, cells: int, high: int) -> Float:
    """Sum over the slices of the logarithm of the returns in the cell and its eight neighbours; 0 where
    fewer than `LEAST` slices hold any."""
    block = np.zeros((cells, cells, high))
    for i in range(mean.shape[0]):
        a = int(np.floor((mean[i, 0] - low[0] + MARGIN) / SIDE))
        b = int(np.floor((mean[i, 1] - low[1] + MARGIN) / SIDE))
        h = int(mean[i, 2] / SLICE)
        if 0 <= a < cells and 0 <= b < cells and LOW <= h < high:
            block[a, b, h] += returns[i]
    strength = np.zeros((cells, cells))
    for a in range(1, cells - 1):
        for b in range(1, cells - 1):
            total, filled = 0.0, 0
            for h in range(LOW, high):
                n = 0.0
                for da in range(-1, 2):
                    for db in range(-1, 2):
                        n += block[a + da, b + db, h]
                if n > 0.0:
                    filled += 1
                    total += np.log(1.0 + n)
            if filled >= LEAST:
                strength[a, b] = total
    return strength


@compiled
def straighten(columns: Float, mean: Float32, returns: Int32) -> None:
    """Lay each column's axis through the middles of its slices, in four rounds."""
    for c in range(columns.shape[0]):
        for turn in range(4):
            _fit_line(columns[c], mean, returns, 0.35 if turn < 2 else 0.25)


@compiled
def _fit_line(axis: Float, mean: Float32, returns: Int32, reach: float) -> None:
    """One round; a slice weighs by how much of what is around the axis lies at it, however many returns
    it has, so that foliage does not draw the axis away. A weak prior keeps it upright."""
    w, x, y, around = np.zeros(SLICES), np.zeros(SLICES), np.zeros(SLICES), np.zeros(SLICES)
    for i in range(mean.shape[0]):
        h = mean[i, 2]
        s = int(h / SLICE)
        if s < LOW or s >= HIGH:
            continue
        dx = mean[i, 0] - axis[0] - axis[2] * (h - 1.3)
        dy = mean[i, 1] - axis[1] - axis[3] * (h - 1.3)
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
            h = (s + 0.5) * SLICE - 1.3
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
def profile(axis: Float, mean: Float32, returns: Int32) -> Float:
    """What stands around an axis, slice by slice, shape (SLICES, PROFILE).

    Columns: returns inside, returns between, returns in the ring, voxels inside, filled octants of the
    ring, middle of the inside (x, y from the axis) [m], rms distance of the inside from the axis [m],
    and the second moments xx, xy, yy of the inside about its middle [m^2].
    """
    rows = np.zeros((SLICES, PROFILE))
    octants = np.zeros((SLICES, OCTANTS))
    for i in range(mean.shape[0]):
        h = mean[i, 2]
        s = int(h / SLICE)
        if s < 0 or s >= SLICES:
            continue
        dx = mean[i, 0] - axis[0] - axis[2] * (h - 1.3)
        dy = mean[i, 1] - axis[1] - axis[3] * (h - 1.3)
        r2 = dx * dx + dy * dy
        if r2 < INSIDE * INSIDE:
            rows[s, 0] += returns[i]
            rows[s, 3] += 1.0
            rows[s, 5] += returns[i] * dx
            rows[s, 6] += returns[i] * dy
            rows[s, 7] += returns[i] * r2
            rows[s, 8] += returns[i] * dx * dx
            rows[s, 9] += returns[i] * dx * dy
            rows[s, 10] += returns[i] * dy * dy
        elif r2 < RING_NEAR * RING_NEAR:
            rows[s, 1] += returns[i]
        elif r2 < RING_FAR * RING_FAR:
            rows[s, 2] += returns[i]
            k = int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * OCTANTS)
            octants[s, min(k, OCTANTS - 1)] += 1.0
    for s in range(SLICES):
        for k in range(OCTANTS):
            rows[s, 4] += octants[s, k] > 0.0
        if rows[s, 0] > 0.0:
            for a in range(5, PROFILE):
                rows[s, a] /= rows[s, 0]
            rows[s, 7] = np.sqrt(rows[s, 7])
            rows[s, 8] -= rows[s, 5] * rows[s, 5]
            rows[s, 9] -= rows[s, 5] * rows[s, 6]
            rows[s, 10] -= rows[s, 6] * rows[s, 6]
    return rows


@compiled
def distinct(columns: Float) -> NDArray[np.bool_]:
    """Which columns are no weaker copy of another within `APART`, shape (K,)."""
    kept = np.ones(columns.shape[0], np.bool_)
    for a in range(columns.shape[0]):
        for b in range(columns.shape[0]):
            dx, dy = columns[a, 0] - columns[b, 0], columns[a, 1] - columns[b, 1]
            if a != b and dx * dx + dy * dy < APART * APART:
                if columns[b, 4] > columns[a, 4] or (columns[b, 4] == columns[a, 4] and b < a):
                    kept[a] = False
    return kept
