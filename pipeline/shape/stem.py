"""A leaning cylinder through the visible arc of a trunk.

The axis at height z is c + a (z - z0), with z0 the mean height; the residual of a point is its
distance to the axis minus r. Gauss-Newton on the residuals divided by their sigma, with robust
weights, and weak priors on lean and radius, which keep a short arc from becoming a wall.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int

HUBER, TUKEY = 1.5, 4.7  # sigma
BARK = 0.004  # m; roughness of a trunk
MODEL = 0.003  # m; what a round trunk and a normal error leave out
BEAM = 0.0015  # rad; half a beam's divergence: so far beside the trunk its middle may pass
PRIOR_RADIUS, PRIOR_RADIUS_SIGMA = 0.15, 0.15  # m; half of the stems of a stand lie within
PRIOR_LEAN_SIGMA = 0.05  # 3 degrees
SIGMA_MIN = 0.001  # m; no range is better than that, and weights must stay finite
MOST_POINTS = 500  # of a cluster enter its fit; more would sharpen what bark and lean blur anyway
ENOUGH = 60  # points, of which a third still is an arc
ITERATIONS = 16
NEARLY, CONVERGED = 5e-3, 3e-4  # m; the latter is a tenth of what the best arc allows
COLUMNS = 9  # cx, cy, var x, cov xy, var y, radius, sigma of radius, radial deviation, arc


@compiled
def fit_stems(points: Float, bounds: Int, range_sigma: float, azimuth_step: float) -> Float:
    """Fit each cluster.

    Args:
        points: shape (N, 3) [m], level sensor frame, cluster after cluster.
        bounds: shape (K + 1,): where each begins.
        range_sigma: [m].
        azimuth_step: [rad].

    Returns:
        Shape (K, 9): centre x, y; its variances xx, xy, yy; radius; its sigma; standard deviation of
        the residuals; visible arc [rad]. Below five points radius and sigma are NaN, and
        the centre lies behind the points by the radius that their angular width tells.
    """
    clusters = bounds.shape[0] - 1
    stems = np.empty((clusters, COLUMNS))
    for k in range(clusters):
        # Odd, because points come ring after ring: an even stride would always skip the same rings.
        stride = 1 + (bounds[k + 1] - bounds[k] - 1) // MOST_POINTS
        stride += 1 - stride % 2
        members = points[bounds[k] : bounds[k + 1] : stride]
        _start_from_width(members, azimuth_step, stems[k])
        if members.shape[0] >= 5:
            _fit(members, range_sigma, stems[k])
        else:
            stems[k, 5] = np.nan
    return stems


@compiled
def _start_from_width(points: Float, azimuth_step: float, stem: Float) -> None:
    """r = R sin w / (1 - sin w), with w half the angle that the cluster fills, R its mean range."""
    n = points.shape[0]
    mean_x, mean_y = points[:, 0].mean(), points[:, 1].mean()
    middle = np.arctan2(mean_y, mean_x)
    cosine, sine = np.cos(middle), np.sin(middle)
    left, right, distance = -np.inf, np.inf, 0.0
    for i in range(n):
        along = cosine * points[i, 0] + sine * points[i, 1]
        across = cosine * points[i, 1] - sine * points[i, 0]
        turn = np.arctan2(across, along)
        left, right = max(left, turn), min(right, turn)
        distance += np.hypot(points[i, 0], points[i, 1]) / n
    w = min(0.5 * (left - right) + 0.5 * azimuth_step, 1.0)
    r = min(distance * np.sin(w) / (1.0 - np.sin(w)), 1.0)
    turn = middle + 0.5 * (left + right)
    # The mean range of an arc lies about a fifth of the radius behind its nearest point.
    reach = distance + 0.8 * r
    sigma_along, sigma_across = 0.05 + 0.3 * r, 0.02 + 0.5 * azimuth_step * distance
    c, s = np.cos(turn), np.sin(turn)
    stem[0], stem[1] = reach * c, reach * s
    stem[2] = (c * sigma_along) ** 2 + (s * sigma_across) ** 2
    stem[3] = c * s * (sigma_along**2 - sigma_across**2)
    stem[4] = (s * sigma_along) ** 2 + (c * sigma_across) ** 2
    stem[5], stem[6] = r, np.nan
    stem[7], stem[8] = 0.0, 0.0


@compiled
def _fit(points: Float, range_sigma: float, stem: Float) -> None:
    n = points.shape[0]
    sigma = max(range_sigma, SIGMA_MIN)
    z0 = points[:, 2].mean()
    rays = _rays(points, z0)
    used = np.ones(n, np.bool_)
    # A third of the points leads near the circle; all of them then make it sharp.
    some = rays[::3].copy() if n > ENOUGH else rays
    every = np.ones(some.shape[0], np.bool_)
    p = np.array([stem[0], stem[1], 0.0, 0.0, min(max(stem[5], 0.03), 0.6)])
    g, H, step = np.empty(5), np.empty((5, 5)), np.empty(5)
    scale = 0.0  # Huber's weights first; they need no good start
    for k in range(ITERATIONS):
        if scale == 0.0:
            _normal_equations(some, every, p, sigma, scale, g, H)
        else:
            _normal_equations(rays, used, p, sigma, scale, g, H)
        _solve(H, g, step)
        # A step longer than the trunk itself would throw the circle to its other side.
        longest = max(abs(step[0]), abs(step[1]), abs(step[4]))
        limit = 0.5 * p[4] + 0.02
        if longest > limit:
            step *= limit / longest
        p += step
        p[4] = max(p[4], 0.005)
        if longest < CONVERGED and scale > 0.0:
            break
        if scale == 0.0 and (longest < NEARLY or k == ITERATIONS // 2):
            scale = _settle(rays, p, sigma, used)
    _normal_equations(rays, used, p, sigma, scale, g, H)
    C = np.linalg.inv(H)
    squares = 0.0
    for i in range(n):
        res, _, _, _ = _residual(rays, i, p, sigma)
        squares += res * res
    deviation = np.sqrt(squares / n)
    # A poor fit knows less than the sensor's sigma promises.
    inflate = max(1.0, scale) ** 2
    stem[0], stem[1] = p[0], p[1]
    stem[2], stem[4] = C[0, 0] * inflate + MODEL * MODEL, C[1, 1] * inflate + MODEL * MODEL
    stem[3] = C[0, 1] * inflate
    stem[5], stem[6] = p[4], np.sqrt(C[4, 4] * inflate + MODEL * MODEL)
    stem[7], stem[8] = deviation, _arc(points, z0, p)


@compiled
def _solve(H: Float, g: Float, step: Float) -> None:
    """Fill step with -H^-1 g by Cholesky, H positive definite; the library's call costs ten times more."""
    n = g.shape[0]
    L = np.empty((5, 5))
    for a in range(n):
        for b in range(a + 1):
            total = H[a, b]
            for k in range(b):
                total -= L[a, k] * L[b, k]
            L[a, b] = np.sqrt(total) if a == b else total / L[b, b]
    for a in range(n):
        total = -g[a]
        for k in range(a):
            total -= L[a, k] * step[k]
        step[a] = total / L[a, a]
    for a in range(n - 1, -1, -1):
        total = step[a]
        for k in range(a + 1, n):
            total -= L[k, a] * step[k]
        step[a] = total / L[a, a]


@compiled
def _rays(points: Float, z0: float) -> Float:
    """Direction x, y, length and height of each point's ray, shape (N, 4)."""
    rays = np.empty((points.shape[0], 4))
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        reach = max(np.sqrt(x * x + y * y), 1e-9)
        rays[i, 0], rays[i, 1], rays[i, 2], rays[i, 3] = x / reach, y / reach, reach, points[i, 2] - z0
    return rays


@compiled
def _residual(rays: Float, i: int, p: Float, sigma: float) -> tuple[float, float, float, float]:
    """Residual of a point [m], its variance [m^2], sine of the angle phi between its ray and the normal
    where the ray meets the circle, and how much farther than the axis it lies along the ray [m].

    The residual is the error of the range times cos phi. The normal is taken where the ray meets the
    circle and not at the point: the point's own normal turns with its error, which draws the circle
    towards the sensor. A ray whose middle passes beside the circle still returns from it with its
    edge; farther out it is as wrong as its distance from where it would.
    """
    ux, uy, reach, h = rays[i, 0], rays[i, 1], rays[i, 2], rays[i, 3]
    cx, cy = p[0] + p[2] * h, p[1] + p[3] * h
    behind, aside = reach - (ux * cx + uy * cy), uy * cx - ux * cy
    sine = min(max(aside / p[4], -1.0), 1.0)
    cosine = np.sqrt(1.0 - sine * sine)
    beam = BEAM * reach
    beside = abs(aside) - p[4]
    residual = -cosine * (behind + cosine * p[4]) if beside < 0.0 else max(beside - beam, 0.0)
    variance = (sigma * cosine) ** 2 + (beam * sine) ** 2 + BARK * BARK
    return residual, variance, sine, behind


@compiled
def _settle(rays: Float, p: Float, sigma: float, used: Bool) -> float:
    """Once the circle is nearly found: leave out what lies farther away than the axis, for no beam
    reaches the back of a trunk; and tell how much larger than its sigma a usual residual is, from
    their median, at least 1."""
    size = np.empty(rays.shape[0])
    farther = 0
    for i in range(rays.shape[0]):
        res, variance, _, behind = _residual(rays, i, p, sigma)
        size[i] = abs(res) / np.sqrt(variance)
        used[i] = behind <= HUBER * sigma
        farther += not used[i]
    if farther > 0.3 * rays.shape[0]:  # these are views from several places
        used[:] = True
    return float(max(1.0, np.median(size) / 0.6745))


@compiled
def _normal_equations(
    rays: Float, used: Bool, p: Float, sigma: float, scale: float, g: Float, H: Float
) -> None:
    """Fill H = J^T W J + priors and the gradient g = J^T W r + priors, shapes (5, 5) and (5,).

    With a scale of 0 the weights are Huber's, else Tukey's: what lies far off, as where a beam was
    split at the trunk's edge, then has no weight at all.
    """
    g[:] = 0.0
    H[:] = 0.0
    J = np.empty(5)
    for i in range(rays.shape[0]):
        if not used[i]:
            continue
        r, variance, sine, _ = _residual(rays, i, p, sigma)
        if scale == 0.0:
            # The edges, which are sharp but may be false, count no more than the rest at first.
            w = min(1.0, HUBER * sigma / max(abs(r), 1e-9)) / (sigma * sigma)
        else:
            u2 = r * r / ((TUKEY * scale) ** 2 * variance)
            if u2 >= 1.0:
                continue
            w = (1.0 - u2) ** 2 / variance
        if abs(sine) == 1.0 and r == 0.0:
            continue  # within the beam's width of the edge: it says nothing more
        ux, uy, h = rays[i, 0], rays[i, 1], rays[i, 3]
        cosine = np.sqrt(1.0 - sine * sine)
        J[0], J[1] = cosine * ux + sine * uy, cosine * uy - sine * ux  # the normal looks towards us
        J[2], J[3], J[4] = J[0] * h, J[1] * h, -1.0
        for a in range(5):
            wJ = w * J[a]
            g[a] += wJ * r
            for b in range(a, 5):
                H[a, b] += wJ * J[b]
    for a in range(5):
        for b in range(a):
            H[a, b] = H[b, a]
    lean, radius = 1.0 / PRIOR_LEAN_SIGMA**2, 1.0 / PRIOR_RADIUS_SIGMA**2
    for a in (2, 3):
        H[a, a] += lean
        g[a] += lean * p[a]
    H[4, 4] += radius
    g[4] += radius * (p[4] - PRIOR_RADIUS)
    # The centre has no prior; this only keeps a degenerate cluster solvable (sigma of 10 m).
    H[0, 0] += 0.01
    H[1, 1] += 0.01


@compiled
def _arc(points: Float, z0: float, p: Float) -> float:
    """The angle around the axis that the points fill: full turn minus the largest gap [rad]."""
    n = points.shape[0]
    angle = np.empty(n)
    for i in range(n):
        h = points[i, 2] - z0
        angle[i] = np.arctan2(points[i, 1] - p[1] - p[3] * h, points[i, 0] - p[0] - p[2] * h)
    angle.sort()
    gap = angle[0] + 2.0 * np.pi - angle[n - 1]
    for i in range(1, n):
        gap = max(gap, angle[i] - angle[i - 1])
    return float(2.0 * np.pi - gap)
