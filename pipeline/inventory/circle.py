"""A circle through the points of one slice of a stem, where branches and bark stand beside it.

Nobody knows from where these points were seen, so a point's residual is its distance from the circle
and nothing else. The start is the best of many circles through three points; the end is a geometric fit
with weights that forget what lies off it (Gauss-Newton, Tukey).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool

TRIES = 160  # circles through three points
MOST_POINTS = 250  # of a cluster vote for them
TUKEY = 4.7  # sigma
BARK = 0.004  # m; roughness of a trunk, the least scatter that is believed
SECTORS = 36
FIGURES = 11  # cx, cy, r, var x, cov xy, var y, var r, scatter, coverage, inliers, contrast
BESIDE, BESIDE_OF_RADIUS = 0.1, 0.5  # m, and part of the radius: the ring around it that is looked at


@compiled
def best_circle(xy: Float, tolerance: float, r_min: float, r_max: float, out: Float) -> float:
    """The circle through three of the points on which most others lie.

    What lies inside a circle speaks against it, as much as what lies on it speaks for it: a trunk is
    hollow, a bush is not.

    Args:
        xy: shape (N, 2) [m]; tolerance: how far from the circle a point is on it [m].
        r_min, r_max: Radii that are looked for [m].
        out: Filled with x, y, r.

    Returns:
        Points on it minus points inside, 0 where there is no circle.
    """
    n = xy.shape[0]
    best = 0.0
    stride = max(n // MOST_POINTS, 1)
    draw = np.uint64(0x9E3779B97F4A7C15)
    pick = np.empty(3, np.int64)
    for _ in range(TRIES):
        for k in range(3):  # a generator of its own: the same points give the same circle
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
    bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
    d = 2.0 * (bx * cy - by * cx)
    if abs(d) < 1e-9:
        return 0.0, 0.0, -1.0
    b2, c2 = bx * bx + by * by, cx * cx + cy * cy
    x, y = (cy * b2 - by * c2) / d, (bx * c2 - cx * b2) / d
    return a[0] + x, a[1] + y, np.sqrt(x * x + y * y)


@compiled
def fit_circle(xy: Float, reach: float, r_min: float, r_max: float, out: Float) -> bool:
    """A geometric fit that starts from x, y, r in `out[:3]` and fills `out`, shape (FIGURES,).

    Args:
        xy: shape (N, 2) [m]; what lies farther than `reach` from the start's circle is not looked at [m].

    Returns:
        Whether there is a circle between the radii with at least five points on it.
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
    """Radii [m] less what the points' scatter [m] has added to them.

    Points that err by s in both directions lie s^2 / 2 r farther from the middle, in the mean (Rice).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.maximum(radius - 0.5 * scatter * scatter / radius, 0.5 * radius)


@compiled
def _coverage(xy: Float, x: float, y: float, r: float, tolerance: float) -> tuple[float, float]:
    """The angle around the circle that points on it fill [rad], and how many they are."""
    filled = np.zeros(SECTORS, np.bool_)
    on = 0.0
    for i in range(xy.shape[0]):
        dx, dy = xy[i, 0] - x, xy[i, 1] - y
        if abs(np.sqrt(dx * dx + dy * dy) - r) < tolerance:
            on += 1.0
            filled[int((np.arctan2(dy, dx) / (2.0 * np.pi) + 0.5) * SECTORS) % SECTORS] = True
    # A sector between two filled ones is filled: points lie a little apart.
    count = 0
    for k in range(SECTORS):
        both = filled[k - 1] and filled[(k + 1) % SECTORS]
        count += filled[k] or both
    return 2.0 * np.pi * count / SECTORS, on


@compiled
def _contrast(xy: Float, x: float, y: float, r: float, tolerance: float, covered: float, on: float) -> float:
    """How much denser points lie on the seen part of a circle than in the ring around all of it."""
    near, far = r + tolerance, r + tolerance + max(BESIDE, BESIDE_OF_RADIUS * r)
    beside = 0.0
    for i in range(xy.shape[0]):
        beside += near <= np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) < far
    band = near * near - max(r - tolerance, 0.0) ** 2
    # One point more in the ring: a single leaf beside a thin stem tells nothing.
    return (on / (0.5 * covered * band)) / ((beside + 1.0) / (np.pi * (far * far - near * near)))


@compiled
def share_inside(xy: Float, x: float, y: float, r: float) -> float:
    """Points well inside a circle (nearer to its centre than 0.7 r) against all within 1.3 r."""
    inside, all_of_it = 0, 0
    for i in range(xy.shape[0]):
        d = np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2)
        inside += d < 0.7 * r
        all_of_it += d < 1.3 * r
    return inside / max(all_of_it, 1)


@compiled
def on_circle(xy: Float, x: float, y: float, r: float, tolerance: float) -> Bool:
    """Which points lie on or in a circle, shape (N,)."""
    on = np.empty(xy.shape[0], np.bool_)
    for i in range(xy.shape[0]):
        on[i] = np.sqrt((xy[i, 0] - x) ** 2 + (xy[i, 1] - y) ** 2) < r + tolerance
    return on
