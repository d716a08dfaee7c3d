"""A leaning cylinder through the visible arc of a trunk.

The axis at height z is c + a (z - z0), with z0 the mean height; the residual of a point is its
distance to the axis minus r. Gauss-Newton on the residuals divided by their sigma, with robust
weights, and weak priors on lean and radius, which keep a short arc from becoming a wall.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int

HUBER, TUKEY = 1.5, 4.7  # sigma
BARK = 0.004  # m; roughness of a trunk
MODEL = 0.003  # m; what a round trunk and a normal error leave out
BEAM = 0.001  # rad; a beam that grazes the edge returns from beside its middle
PRIOR_RADIUS, PRIOR_RADIUS_SIGMA = 0.15, 0.15  # m; half of the stems of a stand lie within
PRIOR_LEAN_SIGMA = 0.05  # 3 degrees
SIGMA_MIN = 0.001  # m; no range is better than that, and weights must stay finite
MOST_POINTS = 500  # of a cluster enter its fit; more would sharpen what bark and lean blur anyway
ITERATIONS = 16
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
    p = np.array([stem[0], stem[1], 0.0, 0.0, min(max(stem[5], 0.03), 0.6)])
    H = np.empty((5, 5))
    scale = 0.0  # Huber's weights first; they need no good start
    for k in range(ITERATIONS):
        g = _normal_equations(points, z0, p, sigma, scale, H)
        step = np.linalg.solve(H, -g)
        # A step longer than the trunk itself would throw the circle to its other side.
        longest = max(abs(step[0]), abs(step[1]), abs(step[4]))
        limit = 0.5 * p[4] + 0.02
        if longest > limit:
            step *= limit / longest
        p += step
        p[4] = max(p[4], 0.005)
        if longest < CONVERGED and scale > 0.0:
            break
        if scale == 0.0 and (longest < 10.0 * CONVERGED or k == ITERATIONS // 2):
            scale = _scale(points, z0, p, sigma)
    _normal_equations(points, z0, p, sigma, scale, H)
    C = np.linalg.inv(H)
    squares = 0.0
    for i in range(n):
        res, _, _, _ = _residual(points, i, z0, p, sigma)
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
def _residual(points: Float, i: int, z0: float, p: Float, sigma: float) -> tuple[float, float, float, float]:
    """Residual of a point [m], its sigma [m], and the outward normal of the circle where its ray hits.

    The residual is the error of the range times cos phi, phi between ray and normal. The normal is
    taken where the ray meets the circle and not at the point: the point's own normal turns with its
    error, which draws the circle towards the sensor. A ray that passes beside the circle is as wrong
    as its distance from it.
    """
    h = points[i, 2] - z0
    dx, dy = points[i, 0] - p[0] - p[2] * h, points[i, 1] - p[1] - p[3] * h
    reach = max(np.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1]), 1e-9)
    ux, uy = points[i, 0] / reach, points[i, 1] / reach
    behind, aside = ux * dx + uy * dy, ux * dy - uy * dx
    sine = min(max(aside / p[4], -1.0), 1.0)
    cosine = np.sqrt(1.0 - sine * sine)
    hits = abs(aside) < p[4]
    residual = -cosine * (behind + cosine * p[4]) if hits else abs(aside) - p[4]
    beam = BEAM * reach * sine
    variance = (sigma * cosine) ** 2 + beam * beam + BARK * BARK
    return residual, np.sqrt(variance), -cosine * ux - sine * uy, -cosine * uy + sine * ux


@compiled
def _behind(points: Float, i: int, h: float, p: Float) -> float:
    """How much farther along its ray a point lies than the axis passes [m]."""
    dx, dy = points[i, 0] - p[0] - p[2] * h, points[i, 1] - p[1] - p[3] * h
    reach = max(np.sqrt(points[i, 0] * points[i, 0] + points[i, 1] * points[i, 1]), 1e-9)
    return float((dx * points[i, 0] + dy * points[i, 1]) / reach)


@compiled
def _scale(points: Float, z0: float, p: Float, sigma: float) -> float:
    """How much larger than its sigma a usual residual is: from their median, at least 1."""
    size = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        res, s, _, _ = _residual(points, i, z0, p, sigma)
        size[i] = abs(res) / s
    return float(max(1.0, np.median(size) / 0.6745))


@compiled
def _normal_equations(points: Float, z0: float, p: Float, sigma: float, scale: float, H: Float) -> Float:
    """Fill H = J^T W J + priors and return the gradient J^T W r + priors, shape (5,).

    With a scale of 0 the weights are Huber's, else Tukey's: what lies far off, as where a beam was
    split at the trunk's edge, then has no weight at all. Nor has what lies farther away than the
    axis: no beam reaches the back of a trunk.
    """
    behind = 0
    for i in range(points.shape[0]):
        if _behind(points, i, points[i, 2] - z0, p) > HUBER * sigma:
            behind += 1
    one_sided = behind < 0.3 * points.shape[0]  # else these are the views of several places
    g = np.zeros(5)
    H[:] = 0.0
    J = np.empty(5)
    for i in range(points.shape[0]):
        r, s, nx, ny = _residual(points, i, z0, p, sigma)
        h = points[i, 2] - z0
        if one_sided and _behind(points, i, h, p) > HUBER * sigma:
            continue
        if scale == 0.0:
            # The edges, which are sharp but may be false, count no more than the rest at first.
            w = min(1.0, HUBER * sigma / max(abs(r), 1e-9)) / (sigma * sigma)
        else:
            u = r / (TUKEY * scale * s)
            w = (1.0 - u * u) ** 2 / (s * s) if abs(u) < 1.0 else 0.0
        J[0], J[1] = -nx, -ny
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
