"""Fit of a leaning cylinder to the visible arc of a trunk: centre, radius, lean and their covariance.

The axis at height z is c + a (z - z0), where z0 is the mean height of the points; the residual of a point is
its horizontal distance to the axis minus the radius r. The parameters are p = (x and y of the axis at z0,
shift of x and y per metre of height, r).

The fit is Gauss-Newton with Tukey weights. It starts from the quartiles of the returns, which branches beside
the trunk do not change. Weak priors on lean and radius, and on the width that the returns cover, prevent that
a short arc becomes a plane and that a trunk with a branch becomes too wide.

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

from pipeline.geometry.cholesky import factorise, solve
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_sums
from pipeline.types.records import Int, Sensor

RAY = 4
TUKEY = 3.0  # sigma; what lies farther off has no weight
BARK = 0.01  # m; roughness of a trunk
BEAM = 0.0015  # rad; half a beam's divergence: so far beside the trunk its middle may pass
PRIOR_RADIUS, PRIOR_RADIUS_SIGMA = 0.15, 0.15  # m; half of the stems of a stand lie within
PRIOR_LEAN_SIGMA = 0.05  # 3 degrees


@compiled_sums
def normal_equations(
    rays: Float, n: int, p: Float, sigma: float, within: float, back: float, g: Float, H: Float
) -> tuple[float, float]:
    """Fill H = J^T W J and the gradient g = J^T W r, shapes (5, 5) and (5,), with the priors on lean and
    radius; of H the lower triangle alone.

    A return's Jacobian is (nx, ny, nx h, ny h, -1), with n the normal that looks from it to the axis; its
    weight is Tukey's over its variance. With e the error of a range, phi the angle between ray and normal:
    E[r] = sigma^2 sin^2 phi / 2 r, and E[n r] beyond that = sigma^2 / r cos phi (u - n cos phi).

    Args:
        rays: shape (RAY, room), of which the first n count.
        p: The cylinder, shape (5,); sigma: of a range [m].
        within: Returns farther from the cylinder have no weight [m].
        back: Nor have those that lie so much farther away than the axis [m], for no beam reaches the back of
            a trunk.

    Returns:
        Sum of all squared residuals [m^2], and of those that are no larger than `within`, others counted
        as that large.
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
        # Of a beam that meets the trunk in part the middle of that part returns, and not its own.
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
    lean, size = 1.0 / PRIOR_LEAN_SIGMA**2, 1.0 / PRIOR_RADIUS_SIGMA**2
    # The centre has no prior; 0.01 only keeps a degenerate cluster solvable (sigma of 10 m).
    H[0, 0] = precision * xx0 + 0.01
    H[1, 0], H[1, 1] = precision * xy0, precision * yy0 + 0.01
    H[2, 0], H[2, 1], H[2, 2] = precision * xx1, precision * xy1, precision * xx2 + lean
    H[3, 0], H[3, 1], H[3, 2] = precision * xy1, precision * yy1, precision * xy2
    H[3, 3] = precision * yy2 + lean
    H[4, 0], H[4, 1], H[4, 2], H[4, 3] = -precision * x0, -precision * y0, -precision * x1, -precision * y1
    H[4, 4] = precision * n0 + size
    g[0], g[1] = precision * gx0, precision * gy0
    g[2], g[3] = precision * gx1 + lean * ax, precision * gy1 + lean * ay
    g[4] = size * (radius - PRIOR_RADIUS) - precision * gr
    return squares, kept


@compiled
def angular_width(rays: Float, n: int) -> tuple[float, float]:
    """Direction of a cluster's middle and the angle between its outermost rays [rad]."""
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
    if ahead:  # the sine tells all, and two arcsines do for all rays
        right, left = np.arcsin(max(least, -1.0)), np.arcsin(min(most, 1.0))
    else:
        right, left = np.inf, -np.inf
        for i in range(n):
            turn = np.arctan2(c * rays[1, i] - s * rays[0, i], c * rays[0, i] + s * rays[1, i])
            right, left = min(right, turn), max(left, turn)
    return middle + 0.5 * (left + right), left - right


class Middle(NamedTuple):
    """What the middle half of a cluster's returns, counted from side to side, tells of a trunk.

    Attributes:
        c, s: Direction of the cluster, cosine and sine; across: how far to the left of it the middle is [m].
        x, y: Front of the trunk in the middle [m].
        radius: Beams that stand evenly over a trunk fill its radius with their middle half [m].
    """

    c: float
    s: float
    across: float
    x: float
    y: float
    radius: float


@compiled
def middle_half(rays: Float, n: int, lean_x: float, lean_y: float) -> Middle:
    """The quartiles ask nothing of what stands beside the trunk, as branches do.

    The axis shifts by so much in x and y per metre of height, which would else be taken for width.
    """
    x, y = 0.0, 0.0
    for i in range(n):
        x += rays[0, i] * rays[2, i]
        y += rays[1, i] * rays[2, i]
    away = max(np.sqrt(x * x + y * y), 1e-9)
    c, s = x / away, y / away
    across, ordered, front = np.empty(n), np.empty(n), np.empty(n)
    shift = c * lean_y - s * lean_x
    for i in range(n):
        across[i] = rays[2, i] * (c * rays[1, i] - s * rays[0, i]) - shift * rays[3, i]
        ordered[i] = across[i]
    first = quantile(ordered, 0, n, 0.25)
    middle = quantile(ordered, int(0.25 * (n - 1)), n, 0.5)
    radius = quantile(ordered, int(0.5 * (n - 1)), n, 0.75) - first
    m = 0
    for i in range(n):
        if abs(across[i] - middle) <= max(0.5 * radius, 0.02):
            front[m] = rays[2, i] * (c * rays[0, i] + s * rays[1, i])
            m += 1
    if m == 0:
        for i in range(n):
            front[i] = rays[2, i] * (c * rays[0, i] + s * rays[1, i])
        m = n
    reach = quantile(front, 0, m, 0.5)
    return Middle(c, s, middle, c * reach - s * middle, s * reach + c * middle, radius)


@compiled_borrowing
def quantile(numbers: Float, low: int, n: int, part: float) -> float:
    """Of the first n numbers, linear between two of them; they are moved about for it, which takes half the
    time of sorting them.

    Args:
        low: None of the numbers before this row is greater than any from it on: it is that of a smaller part,
            asked for before, or 0.
    """
    at = part * (n - 1)
    k = int(at)
    _put_in_place(numbers, low, n, k)
    after = numbers[k]
    if k + 1 < n:
        after = numbers[k + 1]
        for i in range(k + 2, n):
            after = min(after, numbers[i])
    return float(numbers[k] + (at - k) * (after - numbers[k]))


@compiled_borrowing
def _put_in_place(numbers: Float, low: int, n: int, k: int) -> None:
    """Move the numbers of the rows from low to n so that in row k stands what would if they were sorted, none
    greater before it and none less behind it (Hoare 1961)."""
    high = n - 1
    while low < high:
        pivot, i, j = numbers[k], low, high
        while i <= j:
            while numbers[i] < pivot:
                i += 1
            while pivot < numbers[j]:
                j -= 1
            if i <= j:
                numbers[i], numbers[j] = numbers[j], numbers[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j


@compiled
def visible_arc(rays: Float, n: int, p: Float) -> float:
    """The angle around the axis that the returns fill: full turn minus the largest gap [rad]."""
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
    # All lie on the sensor's side: no gap between them is wider than that behind.
    return float(np.arctan(most) - np.arctan(least))


@compiled
def _from_axis(rays: Float, i: int, p: Float) -> tuple[float, float]:
    reach, h = rays[2, i], rays[3, i]
    return rays[0, i] * reach - p[0] - p[2] * h, rays[1, i] * reach - p[1] - p[3] * h


@compiled
def _full_turn_less_largest_gap(rays: Float, n: int, p: Float) -> float:
    angle = np.empty(n)
    for i in range(n):
        x, y = _from_axis(rays, i, p)
        angle[i] = np.arctan2(y, x)
    angle.sort()
    gap = angle[0] + 2.0 * np.pi - angle[n - 1]
    for i in range(1, n):
        gap = max(gap, angle[i] - angle[i - 1])
    return float(2.0 * np.pi - gap)


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


@dataclass(frozen=True, slots=True, eq=False)
class StemFit:
    """A leaning cylinder through the points of one cluster, in the level sensor frame.

    Attributes:
        centre: Of the axis at the points' mean height, shape (2,) [m].
        lean: Shift of the axis in x and y per metre of height, shape (2,).
        radius, radius_sigma: [m].
        arc: Visible part of the circle [rad]; arc_start: where it begins, counter-clockwise [rad].
        offset: Horizontally from the axis at its own height to each point, shape (N, 2) [m].
        residual: Distance of each point from the cylinder, outside positive, shape (N,) [m].
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
    """The fit of `describe` for the points (N, 3) of one cluster; None where they are too few for it."""
    if not len(points):
        return None
    stem = fit_stems(points, np.array([0, len(points)]), sensor.range_sigma, sensor.azimuth_step)[0]
    if not np.isfinite(stem[5]):
        return None
    lean = stem[9:11]
    n = min(len(points), MOST_POINTS)
    fitted = np.arange(n) * len(points) // n  # the points that the fit itself takes
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
    """Where the arc that directions (N,) fill begins, counter-clockwise: after their largest gap [rad]."""
    ordered = np.sort(angle)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    return float(ordered[(int(np.argmax(gaps)) + 1) % len(ordered)])
