"""A leaning cylinder through the visible arc of a trunk.

The axis at height z is c + a (z - z0), with z0 the mean height; the residual of a point is its
distance to the axis minus r. Gauss-Newton with Huber's weights on the residuals divided by the
sensor's sigma, and weak priors on lean and radius, which keep a short arc from becoming a wall.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int

HUBER = 1.5  # sigma
PRIOR_RADIUS, PRIOR_RADIUS_SIGMA = 0.15, 0.15  # m; half of the stems of a stand lie within
PRIOR_LEAN_SIGMA = 0.05  # 3 degrees
SIGMA_MIN = 0.001  # m; no range is better than that, and weights must stay finite
MOST_POINTS = 500  # of a cluster enter its fit; more would sharpen what bark and lean blur anyway
ITERATIONS = 12
CONVERGED = 1e-4  # m; a hundredth of what the noise allows
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
        the residuals; visible arc [rad]. Below five points the radius is the one that the angular
        width tells, its sigma NaN, and the centre lies so far behind the points.
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
    p = np.array([stem[0], stem[1], 0.0, 0.0, min(max(stem[5], 0.03), 0.6)])
    H = np.empty((5, 5))
    for _ in range(ITERATIONS):
        g = _normal_equations(points, z0, p, sigma, H)
        step = np.linalg.solve(H, -g)
        # A step longer than the trunk itself would throw the circle to its other side.
        longest = max(abs(step[0]), abs(step[1]), abs(step[4]))
        limit = 0.5 * p[4] + 0.02
        if longest > limit:
            step *= limit / longest
        p += step
        p[4] = max(p[4], 0.005)
        if longest < CONVERGED:
            break
    _normal_equations(points, z0, p, sigma, H)
    C = np.linalg.inv(H)
    squares = 0.0
    for i in range(n):
        res = _residual(points, i, z0, p)
        squares += res * res
    deviation = np.sqrt(squares / n)
    # A poor fit knows less than the sensor's sigma promises.
    inflate = max(1.0, deviation / sigma) ** 2
    stem[0], stem[1] = p[0], p[1]
    stem[2], stem[3], stem[4] = C[0, 0] * inflate, C[0, 1] * inflate, C[1, 1] * inflate
    stem[5], stem[6] = p[4], np.sqrt(C[4, 4] * inflate)
    stem[7], stem[8] = deviation, _arc(points, z0, p)


@compiled
def _residual(points: Float, i: int, z0: float, p: Float) -> float:
    h = points[i, 2] - z0
    dx, dy = points[i, 0] - p[0] - p[2] * h, points[i, 1] - p[1] - p[3] * h
    return float(np.sqrt(dx * dx + dy * dy) - p[4])


@compiled
def _normal_equations(points: Float, z0: float, p: Float, sigma: float, H: Float) -> Float:
    """Fill H = J^T W J + priors and return the gradient J^T W r + priors, shape (5,)."""
    g = np.zeros(5)
    H[:] = 0.0
    J = np.empty(5)
    for i in range(points.shape[0]):
        h = points[i, 2] - z0
        dx, dy = points[i, 0] - p[0] - p[2] * h, points[i, 1] - p[1] - p[3] * h
        d = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        r = d - p[4]
        w = 1.0 / (sigma * sigma)
        if abs(r) > HUBER * sigma:
            w *= HUBER * sigma / abs(r)
        J[0], J[1] = -dx / d, -dy / d
        J[2], J[3], J[4] = J[0] * h, J[1] * h, -1.0
        for a in range(5):
            g[a] += w * J[a] * r
            for b in range(a, 5):
                H[a, b] += w * J[a] * J[b]
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
    return g


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
