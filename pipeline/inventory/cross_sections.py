"""Circles in the horizontal slices of a plot, which may be cross-sections of stems, with branches and bark
next to them.

The positions of the scanner are unknown, so the residual of a point is its distance from the circle. The
start is the best of many circles through three points; then follows a robust geometric fit (Gauss-Newton with
Tukey weights).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.detection.clustering import dbscan_grid
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int

TRIES = 160  # circles through three points
MOST_POINTS = 250  # of a cluster that vote
TUKEY = 4.7  # sigma
BARK = 0.004  # m; roughness of a trunk, the smallest scatter
SECTORS = 36
FIGURES = 11  # cx, cy, r, var x, cov xy, var y, var r, scatter, coverage, inliers, contrast
BESIDE, BESIDE_OF_RADIUS = 0.1, 0.5  # m, and share of the radius; width of the ring around a circle


@compiled
def best_circle(xy: Float, tolerance: float, r_min: float, r_max: float, out: Float) -> float:
    """Find the circle through three of the points that has the most other points on it. Return the number of
    points on it minus the number inside, where a point on it counts less the farther it is from the circle; 0
    without a circle with a positive result.

    Points inside count against a circle, because the cross-section of a trunk is hollow and that of a bush is
    not. TRIES circles are tried; of many points only some are counted, and the result is scaled up. The same
    points give the same circle.

    Args:
        xy: Points, shape (N, 2) [m], N at least 1.
        tolerance: Maximum distance of a point on the circle [m].
        r_min, r_max: Minimum and maximum radius [m].
        out: Its first three values receive x, y and radius of the circle [m]; unchanged if the result is 0.
    """
    n = xy.shape[0]
    best = 0.0
    stride = max(n // MOST_POINTS, 1)
    draw = np.uint64(0x9E3779B97F4A7C15)
    pick = np.empty(3, np.int64)
    for _ in range(TRIES):
        for k in range(3):  # own random numbers: the same points give the same circle
            draw = draw * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            pick[k] = np.int64((draw >> np.uint64(33)) % np.uint64(n))
        x, y, r = _through_three(xy[pick[0]], xy[pick[1]], xy[pick[2]])
        if not r_min <= r <= r_max:
            continue
        votes = 0.0
        for i in range(0, n, stride):
            off = np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) - r
            if abs(off) < tolerance:
                votes += 1.0 - abs(off) / tolerance
            elif off < 0.0:
                votes -= 1.0
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
    """Fit a circle geometrically. Return whether there is one within the bounds with at least five points on
    it; if not, `out` is undefined.

    Args:
        xy: Points, shape (N, 2) [m].
        reach: Points farther from the circle are ignored [m].
        r_min, r_max: Minimum and maximum radius [m].
        out: Initial x, y and radius in `out[:3]`; filled with the result, shape (FIGURES,): x, y, radius [m],
            variances and covariance xx, xy, yy, rr [m^2], scatter [m], coverage, number of points on the
            circle, and contrast.
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
    """Return radii without the bias that the scatter of the points causes [m], shape (N,), at least half of
    the fitted ones; NaN stays NaN.

    Points with an error of s in both directions are on average s^2 / 2 r farther from the centre (Rice).

    Args:
        radius: Fitted radii, shape (N,) [m].
        scatter: Standard deviations of the points from the circles, shape (N,) [m].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.maximum(radius - 0.5 * scatter * scatter / radius, 0.5 * radius)


@compiled
def _coverage(xy: Float, x: float, y: float, r: float, tolerance: float) -> tuple[float, float]:
    """Return the angle of a circle that points on it cover [rad], in steps of 2 pi / SECTORS, and the number
    of these points.

    Args:
        xy: Points, shape (N, 2) [m].
        x, y, r: Centre and radius of the circle [m].
        tolerance: Maximum distance of a point on the circle [m].
    """
    filled = np.zeros(SECTORS, np.bool_)
    on = 0.0
    for i in range(xy.shape[0]):
        dx, dy = xy[i, 0] - x, xy[i, 1] - y
        if abs(np.sqrt(dx * dx + dy * dy) - r) < tolerance:
            on += 1.0
            filled[int((np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5) * SECTORS) % SECTORS] = True
    # A sector between two filled ones counts as filled, because points have gaps.
    count = 0
    for k in range(SECTORS):
        both = filled[k - 1] and filled[(k + 1) % SECTORS]
        count += filled[k] or both
    return 2.0 * np.pi * count / SECTORS, on


@compiled
def _contrast(xy: Float, x: float, y: float, r: float, tolerance: float, covered: float, on: float) -> float:
    """Return the ratio of the densities of points on the visible part of a circle and in the ring around it;
    NaN without points on it.

    Args:
        xy, x, y, r, tolerance: As in `_coverage`.
        covered, on: Result of `_coverage`.
    """
    near, far = r + tolerance, r + tolerance + max(BESIDE, BESIDE_OF_RADIUS * r)
    in_ring = 0.0
    for i in range(xy.shape[0]):
        in_ring += near <= np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) < far
    band = near * near - max(r - tolerance, 0.0) ** 2
    # One more point in the ring, so that a single leaf next to a thin stem has no effect.
    return (on / (0.5 * covered * band)) / ((in_ring + 1.0) / (np.pi * (far * far - near * near)))


@compiled
def share_inside(xy: Float, x: float, y: float, r: float) -> float:
    """Return the share of the points within 1.3 r of the centre of a circle that is within 0.7 r; 0 without
    points.

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


@compiled
def on_circle(xy: Float, x: float, y: float, r: float, tolerance: float) -> Bool:
    """Return which points, shape (N, 2) [m], are on or inside a circle, closer to its centre than r +
    tolerance, shape (N,); arguments as in `_coverage`."""
    on = np.empty(xy.shape[0], np.bool_)
    for i in range(xy.shape[0]):
        on[i] = np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) < r + tolerance
    return on


LOWEST, HIGHEST = 0.2, 6.2  # m above the ground; heights in which stems are traced
STEP = 0.2  # m; between slices
THICK = 2  # thickness of a slice in steps; neighbours overlap
LEAST = 8  # points on a circle
WINDOW = 0.6  # m; wider clusters are searched in windows of twice this width
WIDE = 1.6  # m
CIRCLES = 3  # in one cluster
HOLLOW = 0.25  # largest share of points inside of a circle
SCATTER, SCATTER_OF_RADIUS = 0.05, 0.3  # m, and share of the radius
ARC = np.radians(70.0)  # least arc of a circle of a stem
NEAREST, EPS_MIN, EPS_MAX = 8, 0.05, 0.25  # neighbours; m
SLAB, INSIDE = FIGURES, FIGURES + 1  # further columns of a circle


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """The points between LOWEST and HIGHEST above the ground, sorted into slices.

    Attributes:
        points: x, y [m], height above the ground [m], lowest slice first, shape (N, 3).
        bounds: First row of each step of height, shape (S + 1,).
        spacing: Median distance to the eighth neighbour [m].
    """

    points: Float
    bounds: Int
    spacing: float

    def slab(self, k: int) -> Float:
        """Return the points of slice k (THICK steps from step k on, so that neighbours overlap): x, y, height
        above the ground, shape (M, 3) [m], a view."""
        return self.points[self.bounds[k] : self.bounds[min(k + THICK, len(self.bounds) - 1)]]

    @property
    def count(self) -> int:
        """Number of slices."""
        return len(self.bounds) - THICK

    @staticmethod
    def middle(k: Float | Int) -> Float:
        """Return the height above the ground of the middle of slice `k` [m], for one number or an array of
        them."""
        return LOWEST + STEP * (np.asarray(k, np.float64) + 0.5 * THICK)


def cut(points: Float32) -> Slices:
    """Return the points sorted into slices; points below LOWEST, from HIGHEST on or of unknown height (NaN)
    are left out.

    Args:
        points: x, y, z, height above the ground [m], shape (N, 4); may be empty.
    """
    steps = round((HIGHEST - LOWEST) / STEP)
    step = np.floor((points[:, 3] - LOWEST) / STEP).astype(np.int64)
    order, bounds = group_rows(np.where(step < steps, step, -1), steps)
    chosen = points[order][:, [0, 1, 3]].astype(np.float64)
    return Slices(chosen, bounds, _spacing(chosen))


def _spacing(points: Float) -> float:
    """Return the median distance of points, shape (N, 3) [m], to their eighth neighbour, estimated from a
    part of them [m]; EPS_MAX with too few points."""
    from scipy.spatial import cKDTree

    if len(points) <= NEAREST:
        return EPS_MAX
    part = points[:400_000] if len(points) <= 400_000 else points[:: len(points) // 400_000 + 1]
    thinned = (len(points) / len(part)) ** 0.5  # points are on surfaces
    some = part[:: max(len(part) // 2000, 1)]
    distance: Float = cKDTree(part).query(some, k=NEAREST + 1)[0][:, -1]
    return float(np.median(distance) / thinned)


def find_circles(slices: Slices, r_min: float, r_max: float) -> Iterator[Float]:
    """Yield the circles of each slice, lowest first, that may be stems: at least LEAST points on the arc ARC
    or more, hollow, and with little scatter.

    Each array has the values of `fit_circle`, the slice, and the share of the points inside, shape (K,
    FIGURES + 2); K may be 0. One trunk may give several circles in a slice.

    Args:
        slices: Slices of the plot.
        r_min, r_max: Smallest and largest radius [m].
    """
    eps = float(np.clip(1.3 * slices.spacing, EPS_MIN, EPS_MAX))
    tolerance = float(np.clip(0.3 * slices.spacing, 0.01, 0.03))
    for k in range(slices.count):
        xy = np.ascontiguousarray(slices.slab(k)[:, :2])
        label = dbscan_grid(xy, eps, 4)[0]
        order, bounds = group_rows(label, int(label.max(initial=-1)) + 1)
        yield _circles(xy[order], bounds, tolerance, r_min, r_max, float(k))


@compiled
def _circles(xy: Float, bounds: Int, tolerance: float, r_min: float, r_max: float, k: float) -> Float:
    """Return the circles of the clusters of one slice, shape (K, FIGURES + 2). Clusters with fewer than LEAST
    points are skipped; those wider than WIDE are searched in overlapping windows.

    Args:
        xy: Points sorted by cluster, shape (N, 2) [m].
        bounds: First point of each cluster, and N, shape (clusters + 1,).
        tolerance: Maximum distance of a point on the circle [m].
        r_min, r_max: Minimum and maximum radius [m].
        k: Number of the slice, which is written into the result.
    """
    out = np.empty((64, FIGURES + 2))
    n = 0
    for c in range(bounds.shape[0] - 1):
        members = xy[bounds[c] : bounds[c + 1]]
        if members.shape[0] < LEAST:
            continue
        x0, y0 = members[:, 0].min(), members[:, 1].min()
        wide = max(members[:, 0].max() - x0, members[:, 1].max() - y0)
        if wide <= WIDE:
            n, out = _peel(members, tolerance, r_min, r_max, k, n, out)
            continue
        order, cells, across = _in_windows(members, x0, y0, wide)
        for a in range(across):
            for b in range(across):
                part = _window(members, order, cells, across, a, b)
                if part.shape[0] >= LEAST:
                    n, out = _peel(part, tolerance, r_min, r_max, k, n, out)
    return out[:n]


@compiled
def _in_windows(xy: Float, x0: float, y0: float, wide: float) -> tuple[Int, Int, int]:
    """Return the order of points by square cells with sides of WINDOW, the first row of each cell in this
    order, and the number of cells per side of the grid.

    Args:
        xy: Points, shape (N, 2) [m].
        x0, y0: Corner of the grid [m].
        wide: Side of the grid [m].
    """
    across = int(wide / WINDOW) + 1
    cell = np.empty(xy.shape[0], np.int64)
    for i in range(xy.shape[0]):
        cell[i] = int((xy[i, 0] - x0) / WINDOW) * across + int((xy[i, 1] - y0) / WINDOW)
    order, cells = group_rows(cell, across * across)
    return order, cells, across


@compiled
def _window(xy: Float, order: Int, cells: Int, across: int, a: int, b: int) -> Float:
    """Return the points of cell (a, b) and of the next cells along x and y, shape (M, 2) [m].

    Args:
        xy: Points, shape (N, 2) [m].
        order, cells, across: Results of `_in_windows`.
        a, b: Column and row of the cell.
    """
    n = 0
    for i in range(a, min(a + 2, across)):
        n += cells[i * across + min(b + 2, across)] - cells[i * across + b]
    part = np.empty((n, 2))
    n = 0
    for i in range(a, min(a + 2, across)):
        for m in range(cells[i * across + b], cells[i * across + min(b + 2, across)]):
            part[n] = xy[order[m]]
            n += 1
    return part


@compiled
def _peel(
    xy: Float, tolerance: float, r_min: float, r_max: float, k: float, n: int, out: Float
) -> tuple[int, Float]:
    """Find the circles of a cluster one after the other, at most CIRCLES; the points on or inside a circle
    are removed before the next is sought. Circles that cannot be stems (see `find_circles`) are not added.
    Return the number of circles in `out`, and `out`, which may have been enlarged.

    Args:
        xy: Points of the cluster, shape (N, 2) [m].
        tolerance: Maximum distance of a point on the circle [m].
        r_min, r_max: Minimum and maximum radius [m].
        k: Number of the slice.
        n: Number of circles in `out`.
        out: Circles so far, shape (M, FIGURES + 2); changed in place.
    """
    rest = xy
    row = np.zeros(FIGURES + 2)
    for _ in range(CIRCLES):
        if rest.shape[0] < LEAST or best_circle(rest, tolerance, r_min, r_max, row) < 0.5 * LEAST:
            break
        x, y, r = row[0], row[1], row[2]
        if fit_circle(rest, max(3.0 * tolerance, 0.25 * r), r_min, r_max, row):
            x, y, r = row[0], row[1], row[2]
            row[SLAB], row[INSIDE] = k, share_inside(rest, x, y, r)
            clear = row[7] <= min(SCATTER, max(SCATTER_OF_RADIUS * r, 0.01))
            if row[9] >= LEAST and row[8] >= ARC and row[INSIDE] <= HOLLOW and clear:
                if n == out.shape[0]:
                    out = np.concatenate((out, np.empty_like(out)))
                out[n] = row
                n += 1
        rest = rest[~on_circle(rest, x, y, r, 2.0 * tolerance)]
    return n, out
