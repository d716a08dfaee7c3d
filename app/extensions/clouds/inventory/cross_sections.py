"""Stems of a plot: upright columns of voxels, which the random forest classifies, horizontal slices, and the
circles along the axes of the columns.

The positions of the scanner are unknown, so the residual of a point is its distance from the circle. The
start is the best of many circles through three points; then follows a robust geometric fit (Gauss-Newton with
Tukey weights).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from app.extensions.clouds.terrain_raster import TerrainRaster
from pipeline.classification.column_extraction import BREAST, HIGH, MARGIN, examine
from pipeline.classification.features import COUNT, features
from pipeline.classification.voxel_map import SIDE, SLICE, SLICES, TILE, VoxelMap
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.tracking.observation import SECTORS
from pipeline.types.records import Float32, Int

TRIES = 500  # circles through three points
MOST_POINTS = 500  # points that vote
TUKEY = 4.7  # sigma; 95 % efficiency for normal errors (Holland and Welsch 1977)
BARK = 0.004  # m; roughness of a trunk, the smallest scatter
FIGURES = 11  # cx, cy, r, var x, cov xy, var y, var r, scatter, coverage, inliers, contrast
RING = 0.5  # width of the ring around a circle, as a share of the radius; at least a tenth of a metre


@compiled
def best_circle(xy: Float, tolerance: float, r_min: float, r_max: float, out: Float) -> float:
    """Find the circle through three of the points that has the most other points on it. Return the number of
    points on it minus the number inside, where a point on it counts less the farther it is from the circle; 0
    if no circle has a positive result.

    Points inside count against a circle, because the cross-section of a trunk is hollow and that of a bush is
    not. TRIES circles are tried, the first ones through the points next to the origin, the last ones through
    any points; of many points only some are counted, and the result is scaled up. The same points give the
    same circle.

    Args:
        xy: Points, shape (N, 2) [m], N at least 1. The origin is inside of the circle, or at most `tolerance`
            outside of it.
        tolerance: Maximum distance of a point on the circle [m]; at most a third of its radius.
        r_min, r_max: Minimum and maximum radius [m].
        out: The first three values are set to x, y and radius of the circle [m]; unchanged if the result is
            0.
    """
    n = xy.shape[0]
    best = 0.0
    stride = max(n // MOST_POINTS, 1)
    nearest = np.argsort(xy[:, 0] ** 2 + xy[:, 1] ** 2)
    draw = np.uint64(0x9E3779B97F4A7C15)
    pick = np.empty(3, np.int64)
    for attempt in range(TRIES):
        among = np.uint64(max(n * (attempt + 1) // TRIES, min(n, 3)))
        for k in range(3):  # own random numbers: the same points give the same circle
            draw = draw * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            pick[k] = nearest[np.int64((draw >> np.uint64(33)) % among)]
        x, y, r = _through_three(xy[pick[0]], xy[pick[1]], xy[pick[2]])
        if not r_min <= r <= r_max or np.sqrt(x * x + y * y) > r + tolerance:
            continue
        near = min(tolerance, r / 3.0)
        inside, outside = (r - near) ** 2, (r + near) ** 2
        votes, left = 0.0, float((n - 1) // stride + 1)
        for i in range(0, n, stride):
            left -= 1.0
            d2 = (xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2
            if d2 < outside:
                votes += 1.0 - abs(np.sqrt(d2) - r) / near if d2 > inside else -1.0
            if votes + left <= best:  # also if all others are on the circle
                break
        if votes > best:
            best = votes
            out[0], out[1], out[2] = x, y, r
    return float(best * stride)


@compiled
def _through_three(a: Float, b: Float, c: Float) -> tuple[float, float, float]:
    """Return x, y and radius [m] of the circle through three points, shape (2,) each; radius -1 if they are
    on a line."""
    bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    d = 2.0 * (bx * cy - by * cx)
    if abs(d) < 1e-9:
        return 0.0, 0.0, -1.0
    b2, c2 = bx * bx + by * by, cx * cx + cy * cy
    x, y = (cy * b2 - by * c2) / d, (bx * c2 - cx * b2) / d
    return a[0] + x, a[1] + y, np.sqrt(x * x + y * y)


@compiled
def fit_circle(xy: Float, reach: float, r_min: float, r_max: float, out: Float) -> bool:
    """Fit a circle geometrically. Return whether the fit stays within the bounds of the radius and has at
    least five points on the circle; if not, `out` is undefined.

    Args:
        xy: Points, shape (N, 2) [m].
        reach: Points farther from the circle are ignored [m].
        r_min, r_max: Minimum and maximum radius [m].
        out: Initial x, y and radius in `out[:3]`; filled with the result, shape (FIGURES,): x, y, radius [m],
            variances and covariance xx, xy, yy, rr [m^2], scatter [m], covered angle [rad], number of points
            on the circle, and contrast (`_contrast`).
    """
    n = xy.shape[0]
    x, y, r = out[0], out[1], out[2]
    off = np.empty(n)
    scatter, near = 0.5 * reach, 0
    H, g = np.empty((3, 3)), np.empty(3)
    for turn in range(20):
        near = 0
        for i in range(n):
            d = abs(np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) - r)
            if d < reach:
                off[near] = d
                near += 1
        if near < 5:
            return False
        scatter = max(np.median(off[:near]) / 0.6745, BARK)
        H[:] = 0.0
        g[:] = 0.0
        for i in range(n):
            dx, dy = xy[i, 0] - x, xy[i, 1] - y
            d = max(np.sqrt(dx * dx + dy * dy), 1e-9)
            e = d - r
            u2 = e * e / (TUKEY * scatter) ** 2
            if u2 >= 1.0 or abs(e) >= reach:
                continue
            w = (1.0 - u2) ** 2
            row = (dx / d, dy / d, 1.0)
            for a in range(3):
                g[a] += w * row[a] * e
                for b in range(3):
                    H[a, b] += w * row[a] * row[b]
        for a in range(3):
            H[a, a] += 1e-6
        step = np.linalg.solve(H, g)
        longest = np.abs(step).max()
        if longest > 0.5 * r:
            step *= 0.5 * r / longest
        x, y, r = x + step[0], y + step[1], r + step[2]
        if not r_min <= r <= r_max:
            return False
        if longest < 1e-5 and turn > 2:
            break
    out[0], out[1], out[2] = x, y, r
    C = np.linalg.inv(H) * scatter * scatter
    out[3], out[4], out[5], out[6] = C[0, 0], C[0, 1], C[1, 1], C[2, 2]
    out[7] = scatter
    out[8], out[9] = _coverage(xy, x, y, r, 3.0 * scatter)
    out[10] = _contrast(xy, x, y, r, 3.0 * scatter, out[8], out[9])
    return bool(out[9] >= 5.0)


def without_scatter(radius: Float, scatter: Float) -> Float:
    """Return the radii minus the bias scatter^2 / (2 radius) that the scatter of the points causes, shape
    (N,) [m]; at least half of each fitted radius. If a radius or its scatter is NaN, the result is NaN.

    Points with an error of s in both directions are on average s^2 / 2 r farther from the centre (Rice).

    Args:
        radius: Fitted radii, shape (N,) [m].
        scatter: Standard deviations of the points from the circles, shape (N,) [m].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.maximum(radius - 0.5 * scatter * scatter / radius, 0.5 * radius)


@compiled
def _coverage(xy: Float, x: float, y: float, r: float, tolerance: float) -> tuple[float, float]:
    """Return the angle of a circle that points on it cover [rad], and the number of these points. The angle
    is counted in SECTORS equal steps, or in 1.5 for each point if these are fewer: finer steps are empty by
    chance.

    Args:
        xy: Points, shape (N, 2) [m].
        x, y, r: Centre and radius of the circle [m].
        tolerance: Maximum distance of a point on the circle [m].
    """
    turn = np.empty(xy.shape[0])
    on = 0
    for i in range(xy.shape[0]):
        dx, dy = xy[i, 0] - x, xy[i, 1] - y
        if abs(np.sqrt(dx * dx + dy * dy) - r) < tolerance:
            turn[on] = np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5
            on += 1
    sectors = max(min(int(1.5 * on), SECTORS), 1)
    filled = np.zeros(sectors, np.bool_)
    for i in range(on):
        filled[int(turn[i] * sectors) % sectors] = True
    # A sector between two filled ones counts as filled, because points have gaps.
    count = 0
    for k in range(sectors):
        both = filled[k - 1] and filled[(k + 1) % sectors]
        count += filled[k] or both
    return 2.0 * np.pi * count / sectors, float(on)


@compiled
def _contrast(xy: Float, x: float, y: float, r: float, tolerance: float, covered: float, on: float) -> float:
    """Return the ratio of the densities of points on the visible part of a circle and in the ring around it;
    NaN if there are no points on the circle.

    Args:
        xy: Points, shape (N, 2) [m].
        x, y, r: Centre and radius of the circle [m].
        tolerance: Maximum distance of a point on the circle [m].
        covered, on: Visible angle [rad] and number of points on the circle, see `_coverage`.
    """
    near, far = r + tolerance, r + tolerance + max(0.1, RING * r)
    in_ring = 0.0
    for i in range(xy.shape[0]):
        in_ring += near <= np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) < far
    band = near * near - max(r - tolerance, 0.0) ** 2
    # One more point in the ring, so that a single leaf next to a thin stem has no effect.
    return (on / (0.5 * covered * band)) / ((in_ring + 1.0) / (np.pi * (far * far - near * near)))


@compiled
def share_inside(xy: Float, x: float, y: float, r: float) -> float:
    """Return the share of the points within 1.3 r of the centre of a circle that is within 0.7 r; 0 if there
    are no points.

    Args:
        xy: Points, shape (N, 2) [m].
        x, y, r: Centre and radius of the circle [m].
    """
    inside, all_of_it = 0, 0
    for i in range(xy.shape[0]):
        d = np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2)
        inside += d < 0.7 * r
        all_of_it += d < 1.3 * r
    return inside / max(all_of_it, 1)


LOWEST, HIGHEST = 0.2, 6.2  # m above the ground; heights in which stems are traced
STEP = SLICE  # m; between slices
THICK = 2  # thickness of a slice in steps; neighbours overlap
BUCKET = 0.5  # m


class Slices(NamedTuple):
    """The points between LOWEST and HIGHEST above the ground by step of height and horizontal square bucket.

    A slice has THICK steps, so that neighbours overlap.

    Attributes:
        xy: Points sorted by step and bucket, shape (N, 2) [m].
        start: First point of each bucket of each step, and N, shape (steps * buckets + 1,).
        low: Corner of the first bucket, shape (2,) [m].
        across: Number of buckets along x and y, shape (2,).
    """

    xy: Float
    start: Int
    low: Float
    across: Int


def slice_heights() -> Float:
    """Return the heights above the ground of the middles of all slices, shape (S,) [m]."""
    return np.asarray(LOWEST + STEP * (np.arange(_STEPS - THICK + 1) + 0.5 * THICK), np.float64)


_STEPS = round((HIGHEST - LOWEST) / STEP)


def cut(points: Float32) -> Slices:
    """Return the points sorted into slices; points below LOWEST, from HIGHEST on or of unknown height (NaN)
    are left out.

    Args:
        points: Points x, y, z and height above the ground, shape (N, 4) [m]; may be empty.
    """
    step = np.floor((points[:, 3] - LOWEST) / STEP)
    chosen = (step >= 0) & (step < _STEPS)
    xy, step = points[chosen, :2].astype(np.float64), step[chosen].astype(np.int64)
    low = xy.min(axis=0) if len(xy) else np.zeros(2)
    across = np.floor((xy.max(axis=0) - low) / BUCKET).astype(np.int64) + 1 if len(xy) else np.ones(2, int)
    cell = np.floor((xy - low) / BUCKET).astype(np.int64)
    each = int(across[0] * across[1])
    order, start = group_rows(step * each + cell[:, 0] * across[1] + cell[:, 1], _STEPS * each)
    return Slices(np.ascontiguousarray(xy[order]), start, low, across)


@compiled
def points_around(slices: Slices, first: int, last: int, x: float, y: float, reach: float) -> Float:
    """Return the points x, y of some steps of height within a reach of a position, shape (M, 2) [m]; M may be
    0.

    Args:
        slices: Points of the plot.
        first, last: First step, and one past the last.
        x, y: The position [m]; may be outside of the plot.
        reach: Radius, exclusive [m].
    """
    xy, start, low, across = slices
    a0, a1 = int((x - reach - low[0]) / BUCKET), int((x + reach - low[0]) / BUCKET)
    b0, b1 = int((y - reach - low[1]) / BUCKET), int((y + reach - low[1]) / BUCKET)
    a0, a1, b0, b1 = max(a0, 0), min(a1, across[0] - 1), max(b0, 0), min(b1, across[1] - 1)
    near = np.empty((64, 2))
    n = 0
    for step in range(first, last):
        for a in range(a0, a1 + 1):
            at = (step * across[0] + a) * across[1]
            for i in range(start[at + b0], start[at + max(b1 + 1, b0)]):
                if (xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2 < reach * reach:
                    if n == near.shape[0]:
                        near = np.concatenate((near, np.empty_like(near)))
                    near[n] = xy[i]
                    n += 1
    return near[:n]


# --- columns and the circles along them ---

MIN_POINTS = 12  # points on a circle; with fewer, chance places circles above one another
ENOUGH_POINTS = 2 * MIN_POINTS  # points that a slice of a sparse cloud shall have
# Steps (0.8 m) up and down from which a slice may take points; a stem tapers little within them.
NEIGHBOUR_STEPS = 4
MIN_OWN_POINTS = 3  # points on the circle at the height of the slice itself, which no neighbour can replace
# Votes of the first circle; points with the noise of a mobile scanner have half a vote each.
VOTES = MIN_POINTS / 2.0
SAMPLED_COLUMNS = 32  # columns in which the cloud is measured
CLEAR_CONTRAST = 10.0  # least contrast of a circle with few points around it; see `_contrast`
BARK_SCATTER = 0.01  # m; a scatter down to this is bark, and not a property of the scanner
MAX_SCATTER = 1.75  # largest scatter of a circle as a multiple of the noise; foliage around a stem adds to it
UNROUND = 0.05  # scatter by the shape of a cross-section, as a share of the radius
MIN_ARC = np.radians(70.0)  # least arc of a circle of a stem
MAX_INSIDE = 0.25  # largest share of points inside of a circle
NOISE = 0.03  # m; noise of mobile scanners
ALIKE = 0.3  # largest change of centre and radius between neighbouring slices, as a share of the radius
LOST = 5  # slices (1 m) without a circle after which a stem ends
#: m; radius of a crown. In a stand, something within it is as high as the cloud is there.
CROWN = 3.0
#: Steps of the heights of the first circle: all in which columns are found; those around breast height, in
#: which a wrong lean of the axis shifts a thin stem by less than its radius; and those of a stump.
WINDOWS = np.array([[0, round((HIGH * SLICE - LOWEST) / STEP)], [3, 8], [0, 3]])
#: m; the maximum radius of the first circle is halved down to this. Few other points are near a thin stem.
THIN_STEM = 0.14
OFTEN = 50.0  # number of scans in which a column counts as present


def upper_end(points: Float32, ground: TerrainRaster) -> Float:
    """Return the height above the ground up to which each cell of the raster of the ground was observed,
    shape (columns, rows) [m]; -inf far from all points.

    It is the height of the highest point within CROWN. The two highest points of each cell do not count:
    single points are noise. Where a level plane cuts the cloud, this is the point with the largest z, and
    where the cut follows the ground that with the largest height above the ground; the lower one counts.

    Args:
        points: Points of all heights: x, y, z and height above the ground, shape (N, 4) [m].
        ground: Height map.
    """
    from scipy.ndimage import maximum_filter

    highest = np.full((*ground.height.shape, 2), -np.inf)
    cell = np.ravel_multi_index(tuple(ground.cell_of(points[:, :2]).T), ground.height.shape)
    for k in range(2):
        order = np.lexsort((points[:, 2 + k], cell))
        c = cell[order]
        third = np.flatnonzero(
            (c[2:] == c[:-2]) & np.append(c[3:] != c[:-3], np.ones(1, np.bool_))[: len(c[2:])]
        )
        highest.reshape(-1, 2)[c[third], k] = points[order[third], 2 + k]
    side = 2 * round(CROWN / ground.cell) + 1
    z, height = np.moveaxis(maximum_filter(highest, size=(side, side, 1)), 2, 0)
    upper: Float = np.minimum(height, z - ground.height)
    return upper


def find_columns(points: Float32, ground: TerrainRaster, end: Float) -> Iterator[tuple[Float, Float, Float]]:
    """Yield the upright columns of voxels, and their features for the random forest, by square tiles.

    A whole cloud is treated as if a robot had seen it from everywhere: each position was visible up to the
    upper end of the cloud around it, and no column was ever absent. Above a cut through the cloud nothing was
    observed, so that the stems which end there are no poles.

    Args:
        points: Points x, y, z and height above the ground, shape (N, 4) [m]; may be empty.
        ground: Height map.
        end: Result of `upper_end`.

    Yields:
        Axes: x, y at 1.3 m above the ground [m], shift in x and y per metre of height, strength, shape (K,
            5); features, shape (K, COUNT); and features as if nothing had been observed above the highest
            return of each column, same shape. A tile without a column gives no rows.
    """
    memory = VoxelMap.empty()
    room = 1 << max(len(points) - 1, 0).bit_length()  # a full map would forget voxels; there is one per point
    memory.add(np.ascontiguousarray(points[:, [0, 1, 3]]), 0, room)
    for tile in memory.due_tiles(1.0):
        mean, returns = memory.around(tile, MARGIN)
        axis, profiles = examine(mean, returns, tile * TILE, TILE)
        n = len(axis)
        met = profiles[:, :, 0] > 0.0
        own = (SLICES - met[:, ::-1].argmax(axis=1)) * SLICE * met.any(axis=1)
        rows = np.zeros((2, n, COUNT))
        for viewed, row in zip((end[tuple(ground.cell_of(axis[:, :2]).T)], own), rows, strict=True):
            visible = np.arange(SLICES) * SLICE < viewed[:, None]
            features(
                axis, profiles, SLICE * visible.sum(axis=1), np.full(n, OFTEN), np.zeros(n),
                met.astype(np.int32), (visible & ~met).astype(np.int32), row,
            )  # fmt: skip
        yield axis, *rows


def strongest_first(tiles: Sequence[tuple[Float, Float, Float]]) -> tuple[Float, Float, Float]:
    """Return the columns of all tiles (results of `find_columns`), strongest first: axes, shape (K, 5), and
    both tables of features, shape (K, COUNT); without tiles, no rows."""
    empty = (np.zeros((0, 5)), np.zeros((0, COUNT)), np.zeros((0, COUNT)))
    axes, rows, unseen = (np.concatenate(parts) for parts in zip(empty, *tiles, strict=True))
    order = np.argsort(-axes[:, 4], kind="stable")
    return axes[order], rows[order], unseen[order]


class Sampling(NamedTuple):
    """How a cloud shows the surface of a stem.

    Attributes:
        noise: Scatter of the points of a clear circle [m].
        few: A slice with fewer points may be fitted with points of its neighbours.
    """

    noise: float
    few: int


def measure_sampling(slices: Slices, axes: Float, r_min: float, r_max: float) -> Sampling:
    """Return the median scatter of the clear circles along the first SAMPLED_COLUMNS columns, at least
    BARK_SCATTER, and the number of points below which a slice takes points of its neighbours: ENOUGH_POINTS
    if half of these circles have fewer points, else MIN_POINTS. Without a clear circle the scatter is NOISE.

    In a dense cloud a slice with few points is the edge of a bush rather than a stem.

    Args:
        slices: Slices of the plot.
        axes: Columns, strongest first, see `find_columns`.
        r_min, r_max: Minimum and maximum radius [m].
    """
    circles = trace(slices, axes[:SAMPLED_COLUMNS], r_min, r_max, Sampling(NOISE, MIN_POINTS))
    with np.errstate(invalid="ignore"):
        clear = circles[circles[..., 10] > CLEAR_CONTRAST]
    if not len(clear):
        return Sampling(NOISE, MIN_POINTS)
    scatter, points = np.median(clear[:, [7, 9]], axis=0).tolist()
    return Sampling(max(scatter, BARK_SCATTER), ENOUGH_POINTS if points < ENOUGH_POINTS else MIN_POINTS)


def trace(slices: Slices, axes: Float, r_min: float, r_max: float, sampling: Sampling) -> Float:
    """Return the circles along the axes of K columns in each of S slices, with the values of `fit_circle`,
    shape (K, S, FIGURES); NaN in slices without a circle. After more than LOST slices in a row without a
    circle none follows; a column without a first circle has none.

    The first circle is that of all points in one of the WINDOWS of heights, moved along the axis to breast
    height. From there the circle of each slice is fitted, upwards and downwards; it begins with the last one,
    moved along the axis. This is done for each window, and with the points within twice the maximum radius of
    the axis, half of it, and so on down to THIN_STEM. Of these results, the one with the largest sum of
    visible arcs is returned; windows after one whose sum is half of the largest possible are not tried.

    Args:
        slices: Slices of the plot.
        axes: Columns, see `find_columns`.
        r_min, r_max: Minimum and maximum radius [m].
        sampling: Result of `measure_sampling`.
    """
    return _trace(slices, axes, slice_heights(), r_min, r_max, sampling)


@compiled
def _trace(
    slices: Slices, axes: Float, height: Float, r_min: float, r_max: float, sampling: Sampling
) -> Float:
    """Return the circles along the axes of K columns, see `trace`, shape (K, S, FIGURES); NaN for slices
    without a circle and for columns without a first circle.

    Args:
        slices: Slices of the plot.
        axes: Axes of the columns, see `find_columns`.
        height: Result of `slice_heights`: heights of S slices above the ground, shape (S,) [m].
        r_min, r_max: Minimum and maximum radius [m].
        sampling: Noise and density of the points.
    """
    out = np.full((axes.shape[0], height.shape[0], FIGURES), np.nan)
    circles = np.empty((height.shape[0], FIGURES))
    breast = int(np.argmin(np.abs(height - BREAST)))
    row = np.empty(FIGURES)
    for s in range(axes.shape[0]):
        axis, most = axes[s], 0.0
        known = np.zeros((0, 3))
        for w in range(WINDOWS.shape[0]):
            if most > np.pi * height.shape[0]:  # half of 2 pi in each slice
                break
            largest = r_max
            while largest == r_max or largest >= max(THIN_STEM, r_min):
                found = _first_circle(slices, axis, WINDOWS[w], r_min, largest, row)
                largest *= 0.5
                row[:2] += axis[:2] + axis[2:4] * (height[breast] - BREAST)
                if not found or _is_close(known, row):
                    continue
                known = np.concatenate((known, row[:3].copy().reshape(1, 3)))
                circles[:] = np.nan
                _trace_column(slices, axis, breast, row, r_min, r_max, sampling, circles)
                seen = np.nansum(circles[:, 8])
                if seen > most:
                    most = seen
                    out[s] = circles
    return out


@compiled
def _first_circle(slices: Slices, axis: Float, window: Int, r_min: float, largest: float, row: Float) -> bool:
    """Set the first values of `row` to x and y from the axis and the radius of the circle of all points in a
    window of heights, moved along the axis; return whether there is one.

    Args:
        slices: Slices of the plot.
        axis: Axis of the column, see `find_columns`.
        window: First step of the heights, and one past the last.
        r_min, largest: Minimum and maximum radius [m].
        row: Changed in place.
    """
    shifted = np.zeros((0, 2))
    for step in range(window[0], window[1]):
        at = axis[:2] + axis[2:4] * (LOWEST + (step + 0.5) * STEP - BREAST)
        # The axis of a column is inside of the stem or on its bark.
        near = points_around(slices, step, step + 1, at[0], at[1], 2.0 * largest + SIDE)
        shifted = np.concatenate((shifted, near - at))
    return bool(shifted.shape[0] >= MIN_POINTS and best_circle(shifted, NOISE, r_min, largest, row) >= VOTES)


@compiled
def _is_close(known: Float, row: Float) -> bool:
    """Return whether a circle differs from one of the known ones, shape (N, 3), by less than BARK in x, y and
    radius, so that the same stem is traced from it."""
    close = False
    for k in range(known.shape[0]):
        close |= bool(np.abs(known[k] - row[:3]).max() < BARK)
    return close


@compiled
def _trace_column(
    slices: Slices,
    axis: Float,
    breast: int,
    first: Float,
    r_min: float,
    r_max: float,
    sampling: Sampling,
    circles: Float,
) -> None:
    """Fill the circles along an axis, see `trace`.

    Args:
        slices: Slices of the plot.
        axis: Axis of the column, see `find_columns`.
        breast: Index of the slice at breast height.
        first: x, y and radius of the first circle, at breast height [m].
        r_min, r_max: Minimum and maximum radius [m].
        sampling: Noise and density of the points.
        circles: NaN, shape (S, FIGURES), changed in place.
    """
    row = np.empty(FIGURES)
    for way in (1, -1):
        row[:3] = first[:3]
        k, missed = breast, 0
        while 0 <= k < circles.shape[0] and missed <= LOST:
            if _fits(slices, k, row, axis[2:4], r_min, r_max, sampling):
                circles[k] = row
                missed = 0
            else:
                missed += 1
            row[0] += way * axis[2] * STEP
            row[1] += way * axis[3] * STEP
            k += way


@compiled
def _upright(slices: Slices, k: int, more: int, row: Float, lean: Float) -> Float:
    """Return the points near a circle that a slice has in its own steps (`more` is 0), or in the two steps
    that are `more` steps below and above them, moved along the lean to the height of the slice, shape (M, 2)
    [m]."""
    out = np.zeros((0, 2))
    for step in range(k, k + THICK):
        at = step + more if step > k else step - more
        if 0 <= at < _STEPS:
            shift = lean * ((at - k - 0.5 * (THICK - 1)) * STEP)
            near = points_around(slices, at, at + 1, row[0] + shift[0], row[1] + shift[1], 2.0 * row[2] + 0.2)
            out = np.concatenate((out, near - shift))
    return out


@compiled
def _fits(
    slices: Slices, k: int, row: Float, lean: Float, r_min: float, r_max: float, sampling: Sampling
) -> bool:
    """Fit the circle of a slice; return whether it can belong to the stem. If not, the position and the
    radius are unchanged, and the other values are undefined. A slice with few points in which no circle fits
    takes those of its neighbours, up to ENOUGH_POINTS points or NEIGHBOUR_STEPS steps.

    Args:
        slices: Slices of the plot.
        k: Index of the slice.
        row: Predicted x, y, radius first [m]; filled with the result, shape (FIGURES,).
        lean: Shift of the axis per metre of height, shape (2,).
        r_min, r_max: Minimum and maximum radius [m].
        sampling: Noise and density of the points.
    """
    x, y, r = row[0], row[1], row[2]
    near = _upright(slices, k, 0, row, lean)
    own = near.shape[0]
    for more in range(NEIGHBOUR_STEPS + 1):
        if more > 0:
            near = np.concatenate((near, _upright(slices, k, more, row, lean)))
        full = near.shape[0] >= ENOUGH_POINTS
        if near.shape[0] >= MIN_POINTS and (more == 0 or full or more == NEIGHBOUR_STEPS):
            if _continues(near, own, row, r_min, r_max, sampling.noise):
                return True
            row[0], row[1], row[2] = x, y, r
        if full or own >= sampling.few:
            break
    return False


@compiled
def _continues(near: Float, own: int, row: Float, r_min: float, r_max: float, noise: float) -> bool:
    """Fit a circle; return whether it is that of a hollow cross-section like the predicted one, whose scatter
    the noise explains.

    Args:
        near: Points, shape (N, 2) [m]; the first `own` are those of the slice itself.
        own: Number of points of the slice.
        row: Predicted x, y, radius first [m]; changed, shape (FIGURES,).
        r_min, r_max: Minimum and maximum radius [m].
        noise: Scatter of clear circles [m].
    """
    x, y, r = row[0], row[1], row[2]
    slack = ALIKE * r + NOISE
    return bool(
        fit_circle(near, slack, r_min, r_max, row)
        and np.sqrt((row[0] - x) ** 2 + (row[1] - y) ** 2) < slack
        and abs(row[2] - r) < slack
        and row[9] >= MIN_POINTS
        and row[8] >= MIN_ARC
        and row[7] < np.sqrt((MAX_SCATTER * noise) ** 2 + (UNROUND * row[2]) ** 2)
        and share_inside(near, row[0], row[1], row[2]) <= MAX_INSIDE
        and _coverage(near[:own], row[0], row[1], row[2], 3.0 * row[7])[1] >= MIN_OWN_POINTS
    )
