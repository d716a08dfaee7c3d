"""Fit of a leaning cylinder to the visible arc of a trunk: centre, radius, lean and their covariance.

The axis at height z is c + a (z - z0), where z0 is the mean height of the points; the residual of a point is
its horizontal distance to the axis minus the radius r. The parameters are p = (x and y of the axis at z0,
shift of x and y per metre of height, r).

The fit is Gauss-Newton with Tukey weights. It starts from the quartiles of the returns, which branches beside
the trunk do not change. A weak prior on the lean, and one on the width that the returns cover, prevent that a
short arc becomes a plane and that a trunk with a branch becomes too wide.

The error of a return is along its ray, not perpendicular to the bark. At the true circle, the residuals and
the gradient therefore do not have zero mean; their expected values are subtracted (corrected score, Nakamura
1990). Using the normal at the intersection of ray and circle would need no correction, but returns beside the
trunk would then enlarge the circle without a counterforce: on real bark, diameters were 13 cm too large.

Rays are stored as rows over the returns, shape (RAY, capacity): direction x, direction y, horizontal length
and height above z0 [m]. Only the first n columns are valid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import factorise, solve
from pipeline.geometry.ordering import ascending, quantile
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_sums
from pipeline.types.records import Int, Sensor

RAY = 4
TUKEY = 3.0  # sigma; residuals beyond have no weight
BARK = 0.01  # m; roughness of the bark
BEAM = 0.0015  # rad; half the beam divergence
#: Of the radius that the returns cover: the lines of a coarse sensor climb, and cross a thin stem from edge
#: to edge, so that little beside them is not hit.
COARSE_MOST = 0.5
PRIOR_LEAN_SIGMA = 0.08  # 4.6 degrees; stems beyond twice that are windthrow


@compiled_sums
def normal_equations(
    rays: Float, n: int, p: Float, sigma: float, within: float, back: float, g: Float, H: Float
) -> tuple[float, float]:
    """Compute the normal equations of the cylinder fit, with the prior on the lean.

    Fills the lower triangle of H = J^T W J, shape (5, 5), and the gradient g = J^T W r, shape (5,), in place.
    The Jacobian of a return is (nx, ny, nx h, ny h, -1), where n is the normal from the return to the axis;
    its weight is Tukey's weight divided by the variance. With the range error sigma and the angle phi between
    ray and normal, E[r] = sigma^2 sin^2 phi / 2 r and, beyond that, E[n r] = sigma^2 / r cos phi (u - n cos
    phi).

    Args:
        rays: Rays, see `_to_rays`, shape (RAY, capacity), of which n columns are valid.
        n: Number of returns.
        p: Parameters of the cylinder, shape (5,); the radius p[4] is positive.
        sigma: Standard deviation of a range, above 0 [m].
        within: Returns with a larger residual have no weight [m].
        back: Returns farther behind the axis have no weight [m], since no beam reaches the back of a trunk;
            may be infinite.
        g: Filled with the gradient.
        H: The lower triangle is filled; the upper one is not written.

    Returns:
        Sum of all squared residuals, and the sum of squared residuals clipped to `within` [m^2].
    """
    xx0, xx1, xx2, xy0, xy1, xy2, yy0, yy1, yy2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x0, x1, y0, y1, n0 = 0.0, 0.0, 0.0, 0.0, 0.0
    gx0, gx1, gy0, gy1, gr, squares, kept = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cx, cy, ax, ay, radius = p[0], p[1], p[2], p[3], p[4]
    lift, pull, farthest = 0.5 * sigma * sigma / radius, sigma * sigma / radius, within * within
    per, slim = 1.0 / farthest, 1.0 / (radius * radius)
    directions_x, directions_y, lengths, heights = rays[0], rays[1], rays[2], rays[3]
    for i in range(n):
        ux, uy, reach, h = directions_x[i], directions_y[i], lengths[i], heights[i]
        axis_x, axis_y = cx + ax * h, cy + ay * h
        behind, across = reach - (ux * axis_x + uy * axis_y), uy * axis_x - ux * axis_y
        # A beam that hits the trunk partially returns the middle of the part that hits.
        beam, aside = BEAM * reach, abs(across)
        part = 0.5 * (max(aside - beam, -radius) + min(aside + beam, radius))
        aside = max(part, aside - beam)
        away = np.sqrt(behind * behind + aside * aside) + 1e-9
        cosine, sine = -behind / away, aside / away
        sine = sine if across >= 0.0 else -sine
        r = away - radius - lift * min(aside * aside * slim, 1.0)
        square = r * r
        squares += square
        kept += min(square, farthest)
        near = max(1.0 - square * per, 0.0)
        w = near * near if behind <= back else 0.0
        nx, ny = cosine * ux + sine * uy, cosine * uy - sine * ux
        k = w * pull * max(cosine, 0.0)
        wx, wy, wr, hh = w * nx, w * ny, w * r, h * h
        xx, xy, yy = wx * nx, wx * ny, wy * ny
        rx, ry = wr * nx - k * (ux - cosine * nx), wr * ny - k * (uy - cosine * ny)
        xx0 += xx
        xx1 += xx * h
        xx2 += xx * hh
        xy0 += xy
        xy1 += xy * h
        xy2 += xy * hh
        yy0 += yy
        yy1 += yy * h
        yy2 += yy * hh
        x0 += wx
        x1 += wx * h
        y0 += wy
        y1 += wy * h
        n0 += w
        gx0 += rx
        gx1 += rx * h
        gy0 += ry
        gy1 += ry * h
        gr += wr
    precision = 1.0 / (sigma * sigma + BARK * BARK)
    lean = 1.0 / PRIOR_LEAN_SIGMA**2
    # The centre has no prior; 0.01 (a sigma of 10 m) keeps degenerate clusters solvable.
    H[0, 0] = precision * xx0 + 0.01
    H[1, 0], H[1, 1] = precision * xy0, precision * yy0 + 0.01
    H[2, 0], H[2, 1], H[2, 2] = precision * xx1, precision * xy1, precision * xx2 + lean
    H[3, 0], H[3, 1], H[3, 2] = precision * xy1, precision * yy1, precision * xy2
    H[3, 3] = precision * yy2 + lean
    H[4, 0], H[4, 1], H[4, 2], H[4, 3] = -precision * x0, -precision * y0, -precision * x1, -precision * y1
    H[4, 4] = precision * n0
    g[0], g[1] = precision * gx0, precision * gy0
    g[2], g[3] = precision * gx1 + lean * ax, precision * gy1 + lean * ay
    g[4] = -precision * gr
    return squares, kept


@compiled
def angular_width(rays: Float, n: int) -> tuple[float, float]:
    """Return the bearing half-way between the outermost rays of a cluster, not wrapped, and the angle between
    them [rad], 0 for one return.

    Args:
        rays: Direction x, y of each return, its horizontal range [m] and height [m]; shape (RAY, capacity),
            of which n columns are valid.
        n: Number of returns, at least 1.
    """
    mean_x, mean_y = 0.0, 0.0
    for i in range(n):
        mean_x += rays[0, i] * rays[2, i]
        mean_y += rays[1, i] * rays[2, i]
    middle = np.arctan2(mean_y, mean_x)
    c, s = np.cos(middle), np.sin(middle)
    least, most, ahead = 1.0, -1.0, True
    for i in range(n):
        sine = c * rays[1, i] - s * rays[0, i]
        least, most = min(least, sine), max(most, sine)
        ahead = ahead and c * rays[0, i] + s * rays[1, i] > 0.0
    if ahead:  # sines are sufficient: two arcsines serve all rays
        right, left = np.arcsin(max(least, -1.0)), np.arcsin(min(most, 1.0))
    else:
        right, left = np.inf, -np.inf
        for i in range(n):
            turn = np.arctan2(c * rays[1, i] - s * rays[0, i], c * rays[0, i] + s * rays[1, i])
            right, left = min(right, turn), max(left, turn)
    return middle + 0.5 * (left + right), left - right


class MiddleHalf(NamedTuple):
    """Initial estimate of a trunk from the middle half of a cluster's returns, ordered from side to side.

    Attributes:
        c, s: Cosine and sine of the bearing of the cluster.
        across: Lateral offset of the median return from that bearing, positive to the left [m].
        x, y: Position of the front of the trunk at the median return, sensor frame [m].
        radius: Interquartile range of the lateral offsets [m].
    """

    c: float
    s: float
    across: float
    x: float
    y: float
    radius: float


@compiled
def middle_half(rays: Float, n: int, lean_x: float, lean_y: float) -> MiddleHalf:
    """Return the initial estimate of a trunk; quartiles are robust against branches beside the trunk.

    Args:
        rays: Rays, see `_to_rays`, shape (RAY, capacity), of which n columns are valid.
        n: Number of returns, at least 1.
        lean_x, lean_y: Shift of the axis per metre of height, which is removed before the width is measured.
    """
    x, y = 0.0, 0.0
    for i in range(n):
        x += rays[0, i] * rays[2, i]
        y += rays[1, i] * rays[2, i]
    away = max(np.sqrt(x * x + y * y), 1e-9)
    c, s = x / away, y / away
    across, front = np.empty(n), np.empty(n)
    shift = c * lean_y - s * lean_x
    for i in range(n):
        across[i] = rays[2, i] * (c * rays[1, i] - s * rays[0, i]) - shift * rays[3, i]
    ordered = across.copy()
    first, middle = quantile(ordered, 0.25), quantile(ordered, 0.5)
    radius = quantile(ordered, 0.75) - first
    m = 0
    for i in range(n):
        if abs(across[i] - middle) <= max(0.5 * radius, 0.02):
            front[m] = rays[2, i] * (c * rays[0, i] + s * rays[1, i])
            m += 1
    if m == 0:
        for i in range(n):
            front[i] = rays[2, i] * (c * rays[0, i] + s * rays[1, i])
        m = n
    reach = quantile(front[:m], 0.5)
    return MiddleHalf(c, s, middle, c * reach - s * middle, s * reach + c * middle, radius)


@compiled
def visible_arc(rays: Float, n: int, p: Float) -> float:
    """Return the visible arc around the axis [rad], 0 to 2 pi: 2 pi minus the largest gap between returns.

    Args:
        rays: Rays, see `_to_rays`, shape (RAY, capacity), of which n columns are valid.
        n: Number of returns, at least 1.
        p: x, y of the axis at z0 [m] and its shift in x and y per metre of height; further values are not
            used.
    """
    away = max(np.sqrt(p[0] * p[0] + p[1] * p[1]), 1e-9)
    c, s = -p[0] / away, -p[1] / away  # from the axis to the sensor
    least, most = np.inf, -np.inf
    for i in range(n):
        x, y = _from_axis(rays, i, p)
        towards = c * x + s * y
        if towards <= 0.0:
            return _full_turn_less_largest_gap(rays, n, p)
        tangent = (c * y - s * x) / towards
        least, most = min(least, tangent), max(most, tangent)
    # All returns are on the side of the sensor, so the largest gap is behind the trunk.
    return float(np.arctan(most) - np.arctan(least))


@compiled
def _from_axis(rays: Float, i: int, p: Float) -> tuple[float, float]:
    """Return the horizontal vector x, y [m] from the axis to a return, at the height of the return.

    Args:
        rays: Returns, shape (RAY, capacity).
        i: Column of the return.
        p: x, y of the axis at z0 [m] and its shift in x and y per metre of height; further values are not
            used.
    """
    reach, h = rays[2, i], rays[3, i]
    return rays[0, i] * reach - p[0] - p[2] * h, rays[1, i] * reach - p[1] - p[3] * h


@compiled
def _full_turn_less_largest_gap(rays: Float, n: int, p: Float) -> float:
    """Return the visible arc [rad] for returns on any side of the axis: 2 pi minus the largest gap between
    returns; 0 for one return.

    Args:
        rays: Rays, see `_to_rays`, shape (RAY, capacity), of which n columns are valid.
        n: Number of returns, at least 1.
        p: x, y of the axis at z0 [m] and its shift in x and y per metre of height.
    """
    angle = np.empty(n)
    for i in range(n):
        x, y = _from_axis(rays, i, p)
        angle[i] = np.arctan2(y, x)
    angle = ascending(angle)
    gap = angle[0] + 2.0 * np.pi - angle[n - 1]
    for i in range(1, n):
        gap = max(gap, angle[i] - angle[i - 1])
    return float(2.0 * np.pi - gap)


MODEL = 0.003  # m; model error of a circular section
RADIUS_MIN = 0.03  # m; lower bound of the initial radius
SIGMA_MIN = 0.001  # m; lower bound of the range sigma, which keeps weights finite
# Maximum number of points of a fit; bark and lean limit the accuracy beyond it. A prime number, because
# points may be ordered by ring: a stride of 16 would select a single ring.
MOST_POINTS = 499
ENOUGH = 60  # points above which the first iterations use a third of them
ITERATIONS = 20
SMOOTH = 0.8  # lower bound of the variance factor; few points may look smoother by chance
BACK = 1.5  # sigma; returns farther behind the axis do not belong to the trunk
NEARLY, CONVERGED = 1e-2, 3e-4  # m; step lengths that end the first and the second phase
NEGLIGIBLE = 0.2  # sigma; a shorter step is not significant
WIDTH_SIGMA, WIDTH_SIGMA_LEAST = 0.2, 0.01  # fraction of the radius, and m: sigma of the width prior
COLUMNS = 11  # cx, cy, var x, cov xy, var y, radius, sigma of radius, radial deviation, arc, lean x, lean y


@compiled
def fit_stems(points: Float, bounds: Int, range_sigma: float, azimuth_step: float, lift: Float) -> Float:
    """Fit a leaning cylinder to each cluster.

    Args:
        points: Points in the level sensor frame, sorted by cluster, shape (N, 3) [m]; of each cluster at most
            MOST_POINTS evenly sampled points are used.
        bounds: Index of the first point of each cluster, and N, shape (K + 1,); no cluster is empty.
        range_sigma: Standard deviation of a range [m]; at least SIGMA_MIN is used.
        azimuth_step: Angle between successive shots [rad].
        lift: Height above the mean height of the points at which the centre of each cluster is wanted, shape
            (K,) [m]. The uncertain lean widens the covariance there.

    Returns:
        Stems, shape (K, 11): centre x, y of the axis at that height [m]; covariance xx, xy, yy of the centre
        [m^2]; radius and sigma of the radius [m]; root mean square of the residuals, outliers included [m];
        visible arc [rad]; shift of the axis in x and y per metre of height. For clusters with fewer than five
        points, the radius and its sigma are NaN, the last four columns are 0, and the centre is estimated
        from the angular width, without lift. A poor fit is not reported as such: it shows in the residuals
        and the sigmas.
    """
    clusters = bounds.shape[0] - 1
    stems = np.empty((clusters, COLUMNS))
    rays, some = np.empty((RAY, MOST_POINTS)), np.empty((RAY, MOST_POINTS))
    for k in range(clusters):
        n = _to_rays(points, bounds[k], bounds[k + 1], rays)
        if n >= 5:
            _fit(rays, n, some, max(range_sigma, SIGMA_MIN), azimuth_step, lift[k], stems[k])
        else:
            _place_by_width(rays, n, azimuth_step, stems[k])
    return stems


@compiled
def _to_rays(points: Float, begin: int, end: int, rays: Float) -> int:
    """Fill `rays` from points begin..end-1, at most MOST_POINTS evenly sampled ones: rows are x and y of the
    horizontal direction, horizontal range [m], and height above the mean of the sampled points [m]. Return
    the number of rays.

    Args:
        points: Points in the sensor frame, shape (N, 3) [m].
        begin, end: Range of the points, not empty.
        rays: Rays, shape (RAY, MOST_POINTS), changed in place; columns beyond the result are not written.
    """
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
    """Estimate the centre of a trunk with too few points for a circle from its angular width.

    The radius is r = R sin w / (1 - sin w), at most 1 m, where w is half the angular width and R the mean
    range.

    Args:
        rays: Rays, see `_to_rays`.
        n: Number of rays, at least 1.
        azimuth_step: Azimuth step of the sensor [rad].
        stem: Row of the result of `fit_stems`, changed in place: centre and covariance; radius and sigma of
            the radius become NaN, the columns after them 0.
    """
    distance = 0.0
    for i in range(n):
        distance += rays[2, i] / n
    middle, width = angular_width(rays, n)
    w = min(0.5 * width + 0.5 * azimuth_step, 1.0)
    r = min(distance * np.sin(w) / (1.0 - np.sin(w)), 1.0)
    # The mean range of an arc is about a fifth of the radius behind its nearest point.
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
def _fit(
    rays: Float, n: int, some: Float, sigma: float, azimuth_step: float, lift: float, stem: Float
) -> None:
    """Fit one cluster by a robust circle with lean and write the result to `stem`, a row of the result of
    `fit_stems`. At most ITERATIONS steps are made; whether they converged is not reported.

    Args:
        rays: Rays, see `_to_rays`.
        n: Number of rays, at least 5.
        some: Buffer of the shape of `rays` for a subset; overwritten.
        sigma: Standard deviation of the ranges, at least SIGMA_MIN [m].
        azimuth_step: Azimuth step of the sensor [rad].
        lift: Height above the mean height of the rays at which the centre is wanted [m].
        stem: Filled with the result, shape (COLUMNS,).
    """
    half = middle_half(rays, n, 0.0, 0.0)
    away = np.hypot(half.x, half.y)
    # Between the outermost beam and the next one, a part of the trunk is not hit, less the width of the
    # beams.
    coarse = min(0.5 * max(azimuth_step - 2.0 * BEAM, 0.0) * away, COARSE_MOST * half.radius)
    width = half.radius + coarse
    p = np.array([half.x, half.y, 0.0, 0.0, max(width, RADIUS_MIN)])
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
        # The width prior holds where the middle of the returns is the middle of the trunk; if one side is
        # hidden, the returns do not determine the width.
        beside = half.c * p[1] - half.s * p[0] - half.across
        weight = 1.0 / (least * least + beside * beside)
        H[4, 4] += weight
        g[4] += weight * (p[4] - width)
        factorise(H, L)
        solve(L, g, step)
        gain = 0.0  # squared length of the step in units of its sigma
        for a in range(5):
            gain += g[a] * step[a]
        # A longer step could move the circle to the other side of the returns.
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
            # Lean widens the returns; it is known now and removed.
            half = middle_half(rays, n, p[2], p[3])
            width = half.radius + coarse
            least = WIDTH_SIGMA_LEAST + WIDTH_SIGMA * width + 0.3 * azimuth_step * away
    # Rough bark or a poor fit inflates the covariance by the ratio of the residual variance to the expected
    # one.
    _write(p, L, max(SMOOTH, kept / (n * (sigma * sigma + BARK * BARK))), lift, stem)
    stem[7], stem[8] = np.sqrt(squares / n), visible_arc(rays, n, p)
    stem[9], stem[10] = p[2], p[3]


@compiled
def _some(rays: Float, n: int, some: Float) -> int:
    """Fill `some` with every third ray, or with all rays up to ENOUGH, and return their number; the first
    iterations use this subset.

    Args:
        rays: Rays, see `_to_rays`, shape (RAY, capacity), of which n columns are valid.
        n: Number of rays.
        some: Selected rays, same shape as `rays`, changed in place.
    """
    stride = 3 if n > ENOUGH else 1
    few = (n + stride - 1) // stride
    for row in range(RAY):
        for k in range(few):
            some[row, k] = rays[row, k * stride]
    return few


@compiled
def _write(p: Float, L: Float, inflate: float, lift: float, stem: Float) -> None:
    """Write centre, radius and their covariance to the first seven values of `stem`, a row of the result of
    `fit_stems`. The covariance of the parameters is (L L^T)^-1 times `inflate`; the variance MODEL^2 is added
    to those of centre and radius.

    Args:
        p: x, y [m], lean x, lean y, radius [m], shape (5,).
        L: Cholesky factor of the normal equations, shape (5, 5).
        inflate: Factor of the covariance.
        lift: Height above that of x and y at which the centre is wanted [m].
        stem: Row that is changed.
    """
    stem[0], stem[1], stem[5] = p[0] + lift * p[2], p[1] + lift * p[3], p[4]
    # The centre is J p, with the rows (1, 0, lift, 0, 0) and (0, 1, 0, lift, 0) of J.
    unit, column, model = np.zeros(5), np.empty(5), MODEL * MODEL
    unit[0], unit[2] = 1.0, lift
    solve(L, unit, column)
    stem[2] = (column[0] + lift * column[2]) * inflate + model
    stem[3] = (column[1] + lift * column[3]) * inflate
    unit[:] = 0.0
    unit[1], unit[3] = 1.0, lift
    solve(L, unit, column)
    stem[4] = (column[1] + lift * column[3]) * inflate + model
    unit[:] = 0.0
    unit[4] = 1.0
    solve(L, unit, column)
    stem[6] = np.sqrt(column[4] * inflate + model)


@dataclass(frozen=True, slots=True, eq=False)
class StemFit:
    """Leaning cylinder through the points of one cluster, in the level sensor frame.

    Attributes:
        centre: Position x, y of the axis at the mean height of the points, shape (2,) [m].
        lean: Shift of the axis in x and y per metre of height, shape (2,).
        radius, radius_sigma: Radius and its standard deviation [m].
        arc: Visible part of the circle [rad].
        arc_start: Direction from the axis at which the visible arc begins, counter-clockwise [rad].
        offset: Horizontal vector from the axis to each point, shape (N, 2) [m].
        residual: Distance of each point from the cylinder surface, positive outside, shape (N,) [m].
    """

    centre: Float
    lean: Float
    radius: float
    radius_sigma: float
    arc: float
    arc_start: float
    offset: Float
    residual: Float


def fit_one(points: Float, sensor: Sensor) -> StemFit | None:
    """Return the fit for the points of one cluster, or None with fewer than five points or if its radius is
    not finite.

    Args:
        points: Points in the level sensor frame, shape (N, 3) [m]; `offset` and `residual` of the result have
            the same rows.
        sensor: Range sigma and azimuth step of the LiDAR.
    """
    if not len(points):
        return None
    one = np.array([0, len(points)])
    stem = fit_stems(points, one, sensor.range_sigma, sensor.azimuth_step, np.zeros(1))[0]
    if not np.isfinite(stem[5]):
        return None
    lean = stem[9:11]
    n = min(len(points), MOST_POINTS)
    fitted = np.arange(n) * len(points) // n  # the points that the fit uses
    height = points[:, 2] - points[fitted, 2].mean()
    offset: Float = points[:, :2] - stem[:2] - height[:, None] * lean
    return StemFit(
        centre=stem[:2],
        lean=lean,
        radius=float(stem[5]),
        radius_sigma=float(stem[6]),
        arc=float(stem[8]),
        arc_start=arc_start(np.arctan2(offset[fitted, 1], offset[fitted, 0])),
        offset=offset,
        residual=np.hypot(offset[:, 0], offset[:, 1]) - stem[5],
    )


def arc_start(angle: Float) -> float:
    """Return the direction [rad] at which the arc covered by angles begins, counter-clockwise: the first
    angle after the largest gap.

    Args:
        angle: Angles in [-pi, pi], shape (N,), N at least 1.
    """
    ordered = np.sort(angle)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    return float(ordered[(int(np.argmax(gaps)) + 1) % len(ordered)])
