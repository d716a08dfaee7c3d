"""Hypotheses of a pose: each pair of local stems aligned with each pair of the map of equal length.

The pairs of the map are sorted by length. Each hypothesis is verified by the number of other stems that find
a partner. The search is exhaustive, so that the second best pose is known as well.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int, Int32

KEPT = 48  # hypotheses that are refined
MOST_CELLS = 1_000_000
BINS = 256  # bins of the lengths of pairs, by which the longest are omitted if there are too many
DBH_SLACK = 0.05  # m; difference of diameters by another height, season or instrument


@compiled
def pairs_within(position: Float, shortest: float, longest: float, most: int) -> tuple[Int32, Float]:
    """Return the pairs of stems with a distance in [shortest, longest), sorted by distance: rows, int32,
    shape (K, 2), and lengths, shape (K,) [m].

    Args:
        position: Stems, shape (N, 2) [m].
        shortest, longest: Bounds of the distance [m].
        most: Maximum number of pairs. Of more pairs the longest are omitted, in whole bins of length.
    """
    order = np.argsort(position[:, 0], kind="mergesort")
    bins = np.zeros(BINS, np.int64)
    nothing, no_length = np.empty((0, 2), np.int32), np.empty(0)
    _walk_pairs(position, order, shortest, longest, bins, BINS, nothing, no_length)
    total, taken = 0, 0
    while taken < BINS and total + bins[taken] <= most:
        total += bins[taken]
        taken += 1
    row, length = np.empty((total, 2), np.int32), np.empty(total)
    bins[:] = 0
    _walk_pairs(position, order, shortest, longest, bins, taken, row, length)
    by_length = np.argsort(length, kind="mergesort")
    return row[by_length], length[by_length]


@compiled
def _walk_pairs(
    position: Float, order: Int, shortest: float, longest: float,
    bins: Int, taken: int, row: Int32, length: Float,
) -> None:  # fmt: skip
    """Count the pairs by bins of their length, and write those of the first `taken` bins as far as there is
    room.

    Args:
        position: Stems, shape (N, 2) [m].
        order: Rows of the stems by ascending x.
        shortest, longest: Bounds of the distance [m].
        bins: Number of pairs per bin, shape (BINS,); increased.
        taken: Number of bins whose pairs are written.
        row, length: Filled with rows, int32, shape (K, 2), and lengths, shape (K,) [m], in the order of
            `order`.
    """
    n = 0
    for a in range(order.shape[0]):
        i = order[a]
        for b in range(a + 1, order.shape[0]):
            j = order[b]
            dx, dy = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            if dx > longest:
                break
            d = np.sqrt(dx * dx + dy * dy)
            if not shortest <= d < longest:
                continue
            at = min(int((d - shortest) / (longest - shortest) * BINS), BINS - 1)
            bins[at] += 1
            if at < taken and n < row.shape[0]:
                row[n, 0], row[n, 1], length[n] = i, j, d
                n += 1


@compiled
def cells_of(position: Float, cell: float) -> tuple[Float, Int32, Int32]:
    """Return a grid over stems, shape (N, 2) [m], N > 0: low corner x, y and cell size, shape (3,) [m]; first
    stem of each cell, int32, shape (W, H); and next stem in the same cell of each stem, int32, shape (N,); -1
    without one. The cell is doubled from `cell` [m] until at most MOST_CELLS are needed."""
    grid = np.empty(3)
    grid[0], grid[1], grid[2] = position[:, 0].min(), position[:, 1].min(), cell
    width = np.floor((position[:, 0].max() - grid[0]) / grid[2]) + 1.0
    height = np.floor((position[:, 1].max() - grid[1]) / grid[2]) + 1.0
    while width * height > MOST_CELLS:
        grid[2] *= 2.0
        width = np.floor((position[:, 0].max() - grid[0]) / grid[2]) + 1.0
        height = np.floor((position[:, 1].max() - grid[1]) / grid[2]) + 1.0
    first = np.full((int(width), int(height)), -1, np.int32)
    following = np.full(position.shape[0], -1, np.int32)
    for j in range(position.shape[0] - 1, -1, -1):
        a = int((position[j, 0] - grid[0]) / grid[2])
        b = int((position[j, 1] - grid[1]) / grid[2])
        following[j] = first[a, b]
        first[a, b] = j
    return grid, first, following


@compiled
def nearest(
    x: float, y: float, reach: float, position: Float, grid: Float, first: Int32, following: Int32
) -> tuple[int, float]:
    """Return row and squared distance [m^2] of the nearest stem nearer than a reach; the row -1 without one,
    where the distance has no meaning.

    Args:
        x, y: Position [m].
        reach: Maximum distance [m], at most one cell.
        position: Stems, shape (N, 2) [m].
        grid, first, following: See `cells_of`.
    """
    best, best2 = -1, reach * reach
    fa, fb = np.floor((x - grid[0]) / grid[2]), np.floor((y - grid[1]) / grid[2])
    if not (-2.0 < fa < first.shape[0] + 1.0 and -2.0 < fb < first.shape[1] + 1.0):
        return -1, 0.0
    ia, ib = int(fa), int(fb)
    for a in range(max(ia - 1, 0), min(ia + 2, first.shape[0])):
        for b in range(max(ib - 1, 0), min(ib + 2, first.shape[1])):
            j = first[a, b]
            while j >= 0:
                dx, dy = position[j, 0] - x, position[j, 1] - y
                if dx * dx + dy * dy < best2:
                    best, best2 = int(j), dx * dx + dy * dy
                j = following[j]
    return best, best2


@compiled
def alike(dbh: float, sigma: float, other: float, other_sigma: float) -> bool:
    """Return whether two diameters [m] may be of the same stem: their difference is at most three sigma, with
    DBH_SLACK added. An unknown diameter (NaN or not positive) fits any other; an unknown sigma counts as 0.
    """
    if not (dbh > 0.0 and other > 0.0):
        return True
    slack = DBH_SLACK * DBH_SLACK + (sigma * sigma if sigma > 0.0 else 0.0)
    slack += other_sigma * other_sigma if other_sigma > 0.0 else 0.0
    return bool((dbh - other) ** 2 <= 9.0 * slack)


@compiled
def search(
    local: Float, local_sigma: Float, local_dbh: Float, local_dbh_sigma: Float, base: Int32,
    reference: Float, sigma: Float, dbh: Float, dbh_sigma: Float, pair: Int32, length: Float,
    grid: Float, first: Int32, following: Int32,
    slack: float, reach: float, least: int, most: int,
) -> tuple[Float, Int, int]:  # fmt: skip
    """Align each base pair with all pairs of the map of equal length, and count the stems that agree.

    Args:
        local, local_sigma, local_dbh, local_dbh_sigma: Local stems, shape (L, 2) [m], relative to their mean,
            and their other columns, shape (L,), see `MapStems`.
        base: Pairs of local rows, int32, shape (B, 2).
        reference, sigma, dbh, dbh_sigma: Stems of the map, likewise, N > 0.
        pair, length: Pairs of the map, see `pairs_within`.
        slack: Standard deviation of the deformation of a map within a constellation [m].
        reach: Largest distance of two stems that agree [m], at most one cell of the grid.
        least: Hypotheses with fewer stems in agreement are dropped.
        most: Number of hypotheses after which no further base pair is tried.
        grid, first, following: Grid of the map, see `cells_of`.

    Returns:
        The best distinct poses x, y [m], yaw [rad], shape (K, 3), at most KEPT, in no particular order; the
        number of stems that agree in each, int64, shape (K,); and the number of hypotheses.
    """
    pose = np.empty((KEPT, 3))
    agree = np.zeros(KEPT, np.int64)
    kept, looked, floor = 0, 0, least
    count = local.shape[0]
    for k in range(base.shape[0]):
        i, j = base[k, 0], base[k, 1]
        bx, by = local[j, 0] - local[i, 0], local[j, 1] - local[i, 1]
        span = np.sqrt(bx * bx + by * by)
        bearing = np.arctan2(by, bx)
        if looked >= most:
            break
        variance = local_sigma[i] ** 2 + local_sigma[j] ** 2 + 2.0 * slack * slack
        widest = 3.0 * np.sqrt(variance + 2.0 * sigma.max() ** 2)
        at = np.searchsorted(length, span - widest)
        while at < length.shape[0] and length[at] <= span + widest:
            a0, b0 = pair[at, 0], pair[at, 1]
            v = variance + sigma[a0] ** 2 + sigma[b0] ** 2
            off = length[at] - span
            at += 1
            if off * off > 9.0 * v:
                continue
            for turned in range(2):
                a, b = (b0, a0) if turned else (a0, b0)
                if not (
                    alike(local_dbh[i], local_dbh_sigma[i], dbh[a], dbh_sigma[a])
                    and alike(local_dbh[j], local_dbh_sigma[j], dbh[b], dbh_sigma[b])
                ):
                    continue
                looked += 1
                rx, ry = reference[b, 0] - reference[a, 0], reference[b, 1] - reference[a, 1]
                yaw = np.arctan2(ry, rx) - bearing
                c, s = np.cos(yaw), np.sin(yaw)
                mx, my = 0.5 * (local[i, 0] + local[j, 0]), 0.5 * (local[i, 1] + local[j, 1])
                x = 0.5 * (reference[a, 0] + reference[b, 0]) - c * mx + s * my
                y = 0.5 * (reference[a, 1] + reference[b, 1]) - s * mx - c * my
                found = 0
                for m in range(count):
                    if found + count - m < floor:
                        break
                    ax, ay = local[m, 0] - mx, local[m, 1] - my
                    lever2 = (ax * ax + ay * ay) / (span * span)
                    tolerance = 2.0 * np.sqrt(local_sigma[m] ** 2 + slack * slack + v * (0.25 + lever2))
                    wx, wy = x + c * local[m, 0] - s * local[m, 1], y + s * local[m, 0] + c * local[m, 1]
                    n, _ = nearest(wx, wy, min(tolerance, reach), reference, grid, first, following)
                    if n >= 0 and alike(local_dbh[m], local_dbh_sigma[m], dbh[n], dbh_sigma[n]):
                        found += 1
                if found >= floor:
                    kept = _keep(pose, agree, kept, x, y, yaw, found, reach)
                    # A hypothesis with fewer than half cannot make the best one ambiguous.
                    floor = max(floor, found // 2 + 1)
                    if kept == KEPT:
                        floor = max(floor, int(agree.min()) + 1)
    return pose[:kept], agree[:kept], looked


@compiled
def _keep(
    pose: Float, agree: Int, kept: int, x: float, y: float, yaw: float, found: int, reach: float
) -> int:
    """Store a hypothesis, unless a stored one with at least as many stems has the same pose, or KEPT better
    ones are stored; return the number of stored ones.

    Args:
        pose, agree: Stored poses, shape (KEPT, 3), and their numbers of stems, shape (KEPT,); changed in
            place.
        kept: Number of stored hypotheses.
        x, y, yaw: Pose of the hypothesis [m, m, rad].
        found: Number of stems that agree.
        reach: Poses within half of it [m] and within 0.05 rad are the same.
    """
    worst = 0
    for k in range(kept):
        dx, dy = pose[k, 0] - x, pose[k, 1] - y
        turn = (pose[k, 2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        if dx * dx + dy * dy < 0.25 * reach * reach and abs(turn) < 0.05:
            if found > agree[k]:
                agree[k] = found
                pose[k, 0], pose[k, 1], pose[k, 2] = x, y, yaw
            return kept
        if agree[k] < agree[worst]:
            worst = k
    if kept < pose.shape[0]:
        worst = kept
        kept += 1
    elif agree[worst] >= found:
        return kept
    agree[worst] = found
    pose[worst, 0], pose[worst, 1], pose[worst, 2] = x, y, yaw
    return kept


@compiled
def partners(
    pose: Float,
    local: Float, local_sigma: Float, local_dbh: Float, local_dbh_sigma: Float,
    reference: Float, sigma: Float, dbh: Float, dbh_sigma: Float,
    grid: Float, first: Int32, following: Int32,
    slack: float, reach: float, of: Int,
) -> int:  # fmt: skip
    """Pair each local stem with the nearest stem of the map within three sigma, one to one; return the number
    of pairs. Of local stems with the same stem of the map, the nearest one gets it and the others none.

    Args:
        pose: x, y [m], yaw [rad] of the local frame in the map, shape (3,).
        local, local_sigma, local_dbh, local_dbh_sigma, reference, sigma, dbh, dbh_sigma: See `search`.
        grid, first, following: Grid of the map, see `cells_of`.
        slack: Standard deviation of the deformation of the map [m].
        reach: Maximum distance [m].
        of: Filled with the row of the map of each local stem, -1 for none, int64, shape (L,).
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    distance2 = np.full(local.shape[0], np.inf)
    owner = np.full(reference.shape[0], -1, np.int64)
    found = 0
    for m in range(local.shape[0]):
        of[m] = -1
        wx = pose[0] + c * local[m, 0] - s * local[m, 1]
        wy = pose[1] + s * local[m, 0] + c * local[m, 1]
        n, d2 = nearest(wx, wy, reach, reference, grid, first, following)
        if n < 0 or d2 > 9.0 * (local_sigma[m] ** 2 + sigma[n] ** 2 + slack * slack):
            continue
        if not alike(local_dbh[m], local_dbh_sigma[m], dbh[n], dbh_sigma[n]):
            continue
        rival = owner[n]
        if rival >= 0:
            if distance2[rival] <= d2:
                continue
            of[rival] = -1
            found -= 1
        of[m], owner[n], distance2[m] = n, m, d2
        found += 1
    return found


@compiled
def crowding(pose: Float, local: Float, reference: Float, window: float) -> tuple[float, int]:
    """Return the mean density of the map around the aligned local stems [1/m^2], and the number of local
    stems with a stem of the map within the window.

    Args:
        pose: x, y [m], yaw [rad] of the local frame in the map, shape (3,).
        local, reference: Stems, shapes (L, 2) and (N, 2) [m], L > 0.
        window: Radius [m].
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    total, inside = 0, 0
    for m in range(local.shape[0]):
        wx = pose[0] + c * local[m, 0] - s * local[m, 1]
        wy = pose[1] + s * local[m, 0] + c * local[m, 1]
        near = 0
        for n in range(reference.shape[0]):
            dx, dy = reference[n, 0] - wx, reference[n, 1] - wy
            if dx * dx + dy * dy < window * window:
                near += 1
        total += near
        inside += near > 0
    return total / (local.shape[0] * np.pi * window * window), inside
