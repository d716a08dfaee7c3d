"""Stems: circles of several slices above one another, traced upwards and downwards; and upright columns of
voxels, which the random forest classifies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.classification.column_extraction import MARGIN, examine
from pipeline.classification.features import COUNT, features
from pipeline.classification.forest import CLASSES, Forest, vote
from pipeline.classification.voxel_map import SLICE, SLICES, TILE, VoxelMap
from pipeline.detection.clustering import root_of
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.poses import Float
from pipeline.inventory.cross_sections import (
    ARC,
    FIGURES,
    HOLLOW,
    INSIDE,
    LEAST,
    SLAB,
    STEP,
    THICK,
    TUKEY,
    Slices,
    fit_circle,
    share_inside,
)
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int

BREAST = 1.3  # m above the ground
LINK_STEPS = 3  # largest distance of two circles of one stem in slices
LINK, LINK_LEAN = 0.06, 0.25  # m, and metres per metre of height
ALIKE = 0.4  # largest relative difference of the radii of neighbours
LEAST_SLICES = 4
REACH = 0.25  # m around the circle of the previous slice in which points are used
WANDER, WANDER_OF_RADIUS = 0.06, 0.25  # m, and share of the radius; largest offset of the next circle
LOST = 5  # slices without a circle after which a stem ends
BUCKET = 0.5  # m


def chain(circles: Float) -> tuple[Int, int]:
    """Return the number of the stem of each circle, -1 for none, int64, shape (K,), and the number of stems.
    A stem has circles in LEAST_SLICES or more slices; stems with the most visible arc come first.

    Args:
        circles: Result of `find_circles`, in the order of slices; may be empty.
    """
    if len(circles) == 0:
        return np.zeros(0, np.int64), 0
    slabs = circles[:, SLAB].astype(np.int64)
    bounds = np.searchsorted(slabs, np.arange(int(slabs.max()) + 2))
    root = _link(circles, bounds)
    size = np.bincount(root, minlength=len(root))
    levels = np.bincount(np.unique(root * 1000 + slabs) // 1000, minlength=len(root))
    # Best first, so that the better one of two chains of a stem is traced first.
    worth = np.bincount(root, weights=circles[:, 8], minlength=len(root))
    keep = np.flatnonzero((size > 0) & (levels >= LEAST_SLICES))
    keep = keep[np.argsort(-worth[keep], kind="stable")]
    number = np.full(len(root), -1, np.int64)
    number[keep] = np.arange(len(keep))
    return number[root], len(keep)


@compiled
def _link(circles: Float, bounds: Int) -> Int:
    """Return for each circle the lowest row of a circle of its chain, int64, shape (K,). Circles up to
    LINK_STEPS slices apart are linked if their centres are near and their radii alike.

    Args:
        circles: Result of `find_circles`, shape (K, FIGURES + 2).
        bounds: First circle of each slice, and K, shape (slices + 1,).
    """
    n = circles.shape[0]
    parent = np.arange(n)
    for i in range(n):
        k = int(circles[i, SLAB])
        for j in range(i + 1, bounds[min(k + LINK_STEPS + 1, bounds.shape[0] - 1)]):
            rise = STEP * (circles[j, SLAB] - circles[i, SLAB])
            dx, dy = circles[j, 0] - circles[i, 0], circles[j, 1] - circles[i, 1]
            near = LINK + LINK_LEAN * rise
            if dx * dx + dy * dy < near * near:
                r, s = circles[i, 2], circles[j, 2]
                if abs(r - s) < ALIKE * max(r, s) + 0.01:
                    a, b = root_of(parent, i), root_of(parent, j)
                    parent[max(a, b)] = min(a, b)
    for i in range(n):
        parent[i] = root_of(parent, i)
    return parent


def follow(slices: Slices, circles: Float, number: Int, stems: int, r_min: float, r_max: float) -> Float:
    """Trace each stem from its best circle upwards and downwards; the next circle is fitted to the points
    around the predicted one.

    Args:
        slices: Slices of the plot.
        circles: Result of `find_circles`.
        number, stems: Result of `chain`.
        r_min, r_max: Minimum and maximum radius [m].

    Returns:
        Values of `fit_circle`, NaN in slices without a circle, shape (stems, slices, FIGURES). Two stems may
        follow the same trunk; a stem may have no circle at all.
    """
    return _follow(_buckets_of(slices), slices.count, circles, number, stems, r_min, r_max)


class _Buckets(NamedTuple):
    """The points of each step of height in horizontal square buckets.

    Attributes:
        xy: Points sorted by step and bucket, shape (N, 2) [m].
        start: First point of each bucket of each step, shape (steps * buckets + 1,).
        low: Corner of the first bucket, shape (2,) [m].
        across: Number of buckets along x and y, shape (2,).
    """

    xy: Float
    start: Int
    low: Float
    across: Int


def _buckets_of(slices: Slices) -> _Buckets:
    """Return the points of slices in horizontal buckets of side BUCKET; without points, one empty bucket per
    step."""
    xy = slices.points[:, :2]
    steps = len(slices.bounds) - 1
    low = xy.min(axis=0) if len(xy) else np.zeros(2)
    high = xy.max(axis=0) if len(xy) else np.zeros(2)
    across = np.floor((high - low) / BUCKET).astype(np.int64) + 1
    cell = np.floor((xy - low) / BUCKET).astype(np.int64)
    step = np.repeat(np.arange(steps), np.diff(slices.bounds))
    each = int(across[0] * across[1])
    order, start = group_rows(step * each + cell[:, 0] * across[1] + cell[:, 1], steps * each)
    return _Buckets(np.ascontiguousarray(xy[order]), start, low, across)


@compiled
def _around(buckets: _Buckets, k: int, x: float, y: float, reach: float) -> Float:
    """Return the points of slice k within `reach` [m] of x, y [m], shape (M, 2), M may be 0.

    Args:
        buckets: Points of all slices.
        k: Number of the slice.
        x, y: The position [m]; may be outside of the plot.
        reach: Radius, exclusive [m].
    """
    xy, start, low, across = buckets
    a0, a1 = int((x - reach - low[0]) / BUCKET), int((x + reach - low[0]) / BUCKET)
    b0, b1 = int((y - reach - low[1]) / BUCKET), int((y + reach - low[1]) / BUCKET)
    a0, a1, b0, b1 = max(a0, 0), min(a1, across[0] - 1), max(b0, 0), min(b1, across[1] - 1)
    near = np.empty((64, 2))
    n = 0
    for step in range(k, k + THICK):
        for a in range(a0, a1 + 1):
            at = (step * across[0] + a) * across[1]
            for i in range(start[at + b0], start[at + b1 + 1] if b1 >= b0 else start[at + b0]):
                if (xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2 < reach * reach:
                    if n == near.shape[0]:
                        near = np.concatenate((near, np.empty_like(near)))
                    near[n] = xy[i]
                    n += 1
    return near[:n]


@compiled
def _follow(
    buckets: _Buckets,
    slabs: int,
    circles: Float,
    number: Int,
    stems: int,
    r_min: float,
    r_max: float,
) -> Float:
    """Return the result of `follow`; a stem ends after more than LOST slices without a circle.

    Args:
        buckets: Points of all slices.
        slabs: Number of slices.
        circles, number, stems, r_min, r_max: See `follow`.
    """
    out = np.full((stems, slabs, FIGURES), np.nan)
    best = np.full(stems, -1, np.int64)
    for i in range(circles.shape[0]):
        s = number[i]
        if s >= 0 and (best[s] < 0 or _worth(circles[i]) > _worth(circles[best[s]])):
            best[s] = i
    row = np.empty(FIGURES)
    for s in range(stems):
        seed = circles[best[s]]
        k0 = int(seed[SLAB])
        for way in (1, -1):
            x, y, r = seed[0], seed[1], seed[2]
            lean_x, lean_y, missed = 0.0, 0.0, 0
            k = k0 if way == 1 else k0 - 1
            while 0 <= k < slabs and missed <= LOST:
                x, y = x + lean_x, y + lean_y
                near = _around(buckets, k, x, y, r + REACH)
                row[0], row[1], row[2] = x, y, r
                if _fits(near, row, r_min, r_max, missed):
                    out[s, k] = row
                    # The prediction follows the found circles smoothly.
                    lean_x += 0.2 * (row[0] - x)
                    lean_y += 0.2 * (row[1] - y)
                    x, y, r = x + 0.7 * (row[0] - x), y + 0.7 * (row[1] - y), r + 0.5 * (row[2] - r)
                    missed = 0
                else:
                    missed += 1
                k += way
    return out


@compiled
def _worth(circle: Float) -> float:
    """Return how good a circle (row of `find_circles`) is as the start of a stem; more is better: visible
    arc, number of points up to 60, few points inside, little scatter."""
    return float(circle[8] * (1.0 - circle[INSIDE]) * min(circle[9], 60.0) / (0.01 + circle[7]))


@compiled
def _fits(near: Float, row: Float, r_min: float, r_max: float, missed: int) -> bool:
    """Fit a circle from the predicted one; return whether it can be the next circle of the stem. If not,
    `row` is undefined.

    Args:
        near: Points around the predicted circle, shape (N, 2) [m].
        row: Predicted x, y, radius first [m]; filled with the result, shape (FIGURES,).
        r_min, r_max: Minimum and maximum radius [m].
        missed: Number of slices without a circle since the last one; more of them allow a larger offset.
    """
    x, y, r = row[0], row[1], row[2]
    if near.shape[0] < LEAST or not fit_circle(near, max(0.04, 0.4 * r), r_min, r_max, row):
        return False
    off = np.sqrt((row[0] - x) ** 2 + (row[1] - y) ** 2)
    may = (WANDER + WANDER_OF_RADIUS * r) * (1.0 + 0.3 * missed)
    alike = abs(row[2] - r) < 0.3 * r + 0.01
    return bool(
        off < may
        and alike
        and row[9] >= LEAST
        and row[8] >= ARC
        and row[7] < max(0.3 * r, 0.012)
        and share_inside(near, row[0], row[1], row[2]) <= HOLLOW
    )


@compiled
def lines(height: Float, value: Float, weight: Float) -> tuple[float, float, float, float]:
    """Fit a line through values over height robustly. Return the value at breast height, its change per
    metre, and the standard deviations of both. A weak prior keeps the slope near 0.

    Args:
        height: Heights above the ground, shape (N,) [m], N at least 1.
        value, weight: Values and their weights, shape (N,); the sum of weights is positive.
    """
    n = height.shape[0]
    a, b, scale = np.median(value), 0.0, 1.0
    saa, sab, sbb = 1.0, 0.0, 1.0
    for turn in range(12):
        off = np.abs(value - a - b * (height - BREAST))
        scale = max(np.median(off) / 0.6745, 0.001)
        saa, sab, sbb, ta, tb = 0.0, 0.0, (scale / 0.1) ** 2, 0.0, 0.0
        for i in range(n):
            u2 = (off[i] / (TUKEY * scale)) ** 2 if turn > 0 else 0.0
            if u2 >= 1.0:
                continue
            w, t = weight[i] * (1.0 - u2) ** 2, height[i] - BREAST
            saa += w
            sab += w * t
            sbb += w * t * t
            ta += w * value[i]
            tb += w * t * value[i]
        D = saa * sbb - sab * sab
        a, b = (sbb * ta - sab * tb) / D, (saa * tb - sab * ta) / D
    D = saa * sbb - sab * sab
    return a, b, scale * np.sqrt(sbb / D), scale * np.sqrt(saa / D)


TWICE = 0.3  # m; columns within this distance are one
OFTEN = 50.0  # number of scans in which a column counts as present


def find_upright(points: Float32, forest: Forest) -> tuple[Float, Float]:
    """Return upright columns of voxels and the votes of a forest on them.

    A whole cloud is treated as if a robot had seen it from everywhere: each position was visible up to the
    height in which stems are traced, and no column was ever absent. Of columns within TWICE of each other the
    strongest is kept.

    Args:
        points: x, y, z, height above the ground [m], shape (N, 4); may be empty.
        forest: The forest.

    Returns:
        Positions at 1.3 m above the ground, strongest column first, shape (K, 2) [m], and class shares in the
        order of CLASSES, shape (K, 6).
    """
    memory = VoxelMap.empty()
    room = 1 << max(len(points) - 1, 0).bit_length()  # a full map would forget voxels; there is one per point
    memory.add(np.ascontiguousarray(points[:, [0, 1, 3]]), 0, room)
    axes, figures = [np.zeros((0, 5))], [np.zeros((0, COUNT))]
    for tile in memory.due_tiles(1.0):
        mean, returns = memory.around(tile, MARGIN)
        axis, profiles = examine(mean, returns, tile * TILE, TILE)
        n = len(axis)
        row = np.zeros((n, COUNT))
        met = (profiles[:, :, 0] > 0.0).astype(np.int32)
        always = (np.full(n, SLICES * SLICE), np.full(n, OFTEN), np.zeros(n))
        features(axis, profiles, *always, met, 1 - met, row)
        axes.append(axis)
        figures.append(row)
    axis = np.concatenate(axes)
    share = vote(np.concatenate(figures), forest)
    strongest = np.argsort(-axis[:, 4], kind="stable")
    kept = _apart(axis[strongest, :2])
    return axis[strongest, :2][kept], share[strongest][kept]


def _apart(places: Float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which positions are kept if, in their order, each one removes the later ones within TWICE, shape
    (K,), for positions of shape (K, 2) [m]."""
    from scipy.spatial import cKDTree

    kept = np.ones(len(places), np.bool_)
    if len(places) > 1:
        pairs = cKDTree(places).query_pairs(TWICE, output_type="ndarray")
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        for first, second in pairs:  # few: only repeated columns
            if kept[first]:
                kept[second] = False
    return kept


__all__ = ["CLASSES", "find_upright"]
