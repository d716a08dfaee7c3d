"""A leaning cylinder through the visible arc of a trunk.

The axis at height z is c + a (z - z0), with z0 the mean height; the residual of a point is its
distance to the axis minus r. Gauss-Newton with robust weights, from a start that asks the middle half of
the returns alone, and weak priors: on lean and radius, and that the returns fill the width of the trunk,
unless they stand to one side of it. These keep a short arc from becoming a wall, and a trunk with a branch
from becoming a wide one.
"""

from __future__ import annotations

import numpy as np

from pipeline.detection.stem_fit.angular_width import angular_width, middle_half, visible_arc
from pipeline.detection.stem_fit.residuals import BARK, BEAM, RAY, TUKEY, normal_equations
from pipeline.geometry.cholesky import factorise, solve
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int

MODEL = 0.003  # m; what a round trunk and a normal error leave out
RADIUS_MIN, RADIUS_MAX = 0.03, 0.6  # m; within these a fit begins
SIGMA_MIN = 0.001  # m; no range is better than that, and weights must stay finite
# Of a cluster enter its fit; more would sharpen what bark and lean blur anyway. A prime, because points
# may come ring after ring: every 16th of them would be of one ring.
MOST_POINTS = 499
ENOUGH = 60  # points, of which a third still is an arc
ITERATIONS = 20
SMOOTH = 0.8  # of the variance that is taken for bark and sensor; few points may look smoother by chance
BACK = 1.5  # sigma; what lies so much farther away than the axis is not of the trunk
NEARLY, CONVERGED = 1e-2, 3e-4  # m; the latter is a tenth of what the best arc allows
NEGLIGIBLE = 0.2  # sigma; a step so short against what the points tell gains nothing
WIDTH_SIGMA, WIDTH_SIGMA_LEAST = 0.2, 0.01  # of the radius, and m: how far the width is to be believed
COLUMNS = 11  # cx, cy, var x, cov xy, var y, radius, sigma of radius, radial deviation, arc, lean x, lean y


@compiled
def fit_stems(points: Float, bounds: Int, range_sigma: float, azimuth_step: float) -> Float:
    """Fit each cluster.

    Args:
        points: shape (N, 3) [m], level sensor frame, cluster after cluster.
        bounds: shape (K + 1,): where each begins.
        range_sigma: [m].
        azimuth_step: [rad].

    Returns:
        Shape (K, 11): centre x, y; its variances xx, xy, yy; radius; its sigma; standard deviation of
        the residuals; visible arc [rad]; shift of the axis in x and y per metre of height. Below five
        points radius and sigma are NaN, and the centre lies behind the points by the radius that
        their angular width tells.
    """
    clusters = bounds.shape[0] - 1
    stems = np.empty((clusters, COLUMNS))
    rays, some = np.empty((RAY, MOST_POINTS)), np.empty((RAY, MOST_POINTS))
    for k in range(clusters):
        n = _to_rays(points, bounds[k], bounds[k + 1], rays)
        if n >= 5:
            _fit(rays, n, some, max(range_sigma, SIGMA_MIN), azimuth_step, stems[k])
        else:
            _place_by_width(rays, n, azimuth_step, stems[k])
    return stems


@compiled
def _to_rays(points: Float, begin: int, end: int, rays: Float) -> int:
    """Fill rays (see the module `residuals`) from points, at most MOST_POINTS; returns how many."""
    n = min(end - begin, MOST_POINTS)
    z0 = 0.0
    for k in range(n):
        i = begin + k * (end - begin) // n
        x, y = points[i, 0], points[i, 1]
        reach = max(np.sqrt(x * x + y * y), 1e-9)
        rays[0, k], rays[1, k], rays[2, k], rays[3, k] = x / reach, y / reach, reach, points[i, 2]
        z0 += points[i, 2]
    for k in range(n):
        rays[3, k] -= z0 / n
    return n


@compiled
def _place_by_width(rays: Float, n: int, azimuth_step: float, stem: Float) -> None:
    """Too few points for a circle lie before their centre by r = R sin w / (1 - sin w), with w half the angle
    that they fill and R their mean range."""
    distance = 0.0
    for i in range(n):
        distance += rays[2, i] / n
    middle, width = angular_width(rays, n)
    w = min(0.5 * width + 0.5 * azimuth_step, 1.0)
    r = min(distance * np.sin(w) / (1.0 - np.sin(w)), 1.0)
    # The mean range of an arc lies about a fifth of the radius behind its nearest point.
    reach = distance + 0.8 * r
    sigma_along, sigma_across = 0.05 + 0.3 * r, 0.02 + 0.5 * azimuth_step * distance
    c, s = np.cos(middle), np.sin(middle)
    stem[0], stem[1] = reach * c, reach * s
    stem[2] = (c * sigma_along) ** 2 + (s * sigma_across) ** 2
    stem[3] = c * s * (sigma_along**2 - sigma_across**2)
    stem[4] = (s * sigma_along) ** 2 + (c * sigma_across) ** 2
    stem[5], stem[6] = np.nan, np.nan
    stem[7:] = 0.0


@compiled
def _fit(rays: Float, n: int, some: Float, sigma: float, azimuth_step: float, stem: Float) -> None:
    """The answer into `stem`; `some` is room for a part of the rays."""
    half = middle_half(rays, n, 0.0, 0.0)
    away = np.hypot(half.x, half.y)
    # The outermost beams leave a part of the trunk between them and the next, less what their width catches.
    coarse = 0.5 * max(azimuth_step - 2.0 * BEAM, 0.0) * away
    width = half.radius + coarse
    p = np.array([half.x, half.y, 0.0, 0.0, min(max(width, RADIUS_MIN), RADIUS_MAX)])
    p[0] += half.c * p[4]
    p[1] += half.s * p[4]
    least = WIDTH_SIGMA_LEAST + WIDTH_SIGMA * width + 0.3 * azimuth_step * away
    g, H, step, L = np.empty(5), np.empty((5, 5)), np.empty(5), np.empty((5, 5))
    few = _some(rays, n, some)
    within = TUKEY * np.sqrt(sigma * sigma + BARK * BARK)
    back = BACK * sigma
    nearly, squares, kept = False, 0.0, 0.0
    for k in range(ITERATIONS):
        if nearly:
            squares, kept = normal_equations(rays, n, p, sigma, within, back, g, H)
        else:
            normal_equations(some, few, p, sigma, within, np.inf, g, H)
        # The returns fill a trunk's width where its middle is theirs; what is hidden on one side is not told.
        beside = half.c * p[1] - half.s * p[0] - half.across
        told = 1.0 / (least * least + beside * beside)
        H[4, 4] += told
        g[4] += told * (p[4] - width)
        factorise(H, L)
        solve(L, g, step)
        gain = 0.0  # squared length of the step in its own sigma
        for a in range(5):
            gain += g[a] * step[a]
        # A step longer than the trunk itself would throw the circle to its other side.
        longest = max(abs(step[0]), abs(step[1]), abs(step[4]))
        limit = 0.5 * p[4] + 0.02
        if longest > limit:
            step *= limit / longest
        p -= step
        p[4] = max(p[4], 0.005)
        if nearly and (longest < CONVERGED or gain < NEGLIGIBLE**2):
            break
        if not nearly and (longest < NEARLY or k >= ITERATIONS // 2):
            nearly = True
            # A leaning trunk fills more than its width; now that the lean is known, it is taken out.
            half = middle_half(rays, n, p[2], p[3])
            width = half.radius + coarse
            least = WIDTH_SIGMA_LEAST + WIDTH_SIGMA * width + 0.3 * azimuth_step * away
    # The residuals tell how rough the bark is, and a poor fit knows less than the sensor's sigma promises.
    _write(p, L, max(SMOOTH, kept / (n * (sigma * sigma + BARK * BARK))), stem)
    stem[7], stem[8] = np.sqrt(squares / n), visible_arc(rays, n, p)
    stem[9], stem[10] = p[2], p[3]


@compiled
def _some(rays: Float, n: int, some: Float) -> int:
    """Fill `some` with a third of the rays, which leads near the circle; all of them then make it sharp.
    Few enough are all taken. Returns how many."""
    stride = 3 if n > ENOUGH else 1
    few = (n + stride - 1) // stride
    for row in range(RAY):
        for k in range(few):
            some[row, k] = rays[row, k * stride]
    return few


@compiled
def _write(p: Float, L: Float, inflate: float, stem: Float) -> None:
    """Centre, radius and their covariance, that of the last step: (L L^T)^-1 times `inflate`."""
    unit, column = np.zeros(5), np.empty(5)
    stem[0], stem[1], stem[5] = p[0], p[1], p[4]
    unit[0] = 1.0
    solve(L, unit, column)
    stem[2], stem[3] = column[0] * inflate + MODEL * MODEL, column[1] * inflate
    unit[0], unit[1] = 0.0, 1.0
    solve(L, unit, column)
    stem[4] = column[1] * inflate + MODEL * MODEL
    unit[1], unit[4] = 0.0, 1.0
    solve(L, unit, column)
    stem[6] = np.sqrt(column[4] * inflate + MODEL * MODEL)
