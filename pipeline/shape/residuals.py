"""How far each return lies from a leaning cylinder, and what that says about the cylinder.

A cylinder is p = (x, y of its axis at the mean height, shift of x and y per metre of height, radius).
Rays are rows over the returns: direction x, y, length, height above the mean height [m], and 1 where the
return may weigh, else 0; shape (RAY, room), of which the first n columns count.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled, compiled_sums
from pipeline.geometry import Float

RAY = 5
USED = 4  # row of the marks
HUBER, TUKEY = 1.5, 4.7  # sigma
BARK = 0.004  # m; roughness of a trunk
BEAM = 0.0015  # rad; half a beam's divergence: so far beside the trunk its middle may pass
PRIOR_RADIUS, PRIOR_RADIUS_SIGMA = 0.15, 0.15  # m; half of the stems of a stand lie within
PRIOR_LEAN_SIGMA = 0.05  # 3 degrees
MOST_FARTHER = 0.3  # of the points; more than that beyond the axis are views from several places


@compiled
def residual(
    ux: float, uy: float, reach: float, h: float, p: Float, sigma: float
) -> tuple[float, float, float, float, float]:
    """Residual of a return [m], its variance [m^2], sine and cosine of the angle phi between its ray and
    the normal where the ray meets the circle, and how much farther than the axis it lies along it [m].

    The residual is the error of the range times cos phi. The normal is taken where the ray meets the
    circle and not at the point: the point's own normal turns with its error, which draws the circle
    towards the sensor. A ray whose middle passes beside the circle still returns from it with its
    edge; farther out it is as wrong as its distance from where it would.
    """
    cx, cy = p[0] + p[2] * h, p[1] + p[3] * h
    behind, aside = reach - (ux * cx + uy * cy), uy * cx - ux * cy
    sine = min(max(aside / p[4], -1.0), 1.0)
    cosine = np.sqrt(1.0 - sine * sine)
    beam = BEAM * reach
    beside = abs(aside) - p[4]
    # Both are told, so that no branch stands in the way of vector registers.
    on, off = -cosine * (behind + cosine * p[4]), max(beside - beam, 0.0)
    along, across = sigma * cosine, beam * sine
    variance = along * along + across * across + BARK * BARK
    return on if beside < 0.0 else off, variance, sine, cosine, behind


@compiled
def settle(rays: Float, n: int, p: Float, sigma: float) -> float:
    """Once the circle is nearly found: leave out what lies farther away than the axis, for no beam
    reaches the back of a trunk; and tell how much larger than its sigma a usual residual is, from
    their median, at least 1."""
    square = np.empty(n)
    used = 0.0
    for i in range(n):
        r, variance, _, _, behind = residual(rays[0, i], rays[1, i], rays[2, i], rays[3, i], p, sigma)
        square[i] = r * r / variance
        rays[USED, i] = 1.0 if behind <= HUBER * sigma else 0.0
        used += rays[USED, i]
    if n - used > MOST_FARTHER * n:
        rays[USED, :n] = 1.0
    return float(max(1.0, np.sqrt(np.median(square)) / 0.6745))


@compiled_sums
def normal_equations(rays: Float, n: int, p: Float, sigma: float, scale: float, g: Float, H: Float) -> float:
    """Fill H = J^T W J + priors and the gradient g = J^T W r + priors, shapes (5, 5) and (5,); of H the
    lower triangle alone. Returns the sum of all squared residuals [m^2].

    With a scale of 0 the weights are Huber's, else Tukey's: what lies far off, as where a beam was
    split at the trunk's edge, then has no weight at all.

    The Jacobian of a residual is (nx, ny, nx h, ny h, -1), with n the normal that looks towards us.

    Args:
        rays: shape (RAY, room), of which the first n count.
        p: The cylinder, shape (5,); sigma: of a range [m].
    """
    xx0, xx1, xx2, xy0, xy1, xy2, yy0, yy1, yy2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x0, x1, y0, y1, n0 = 0.0, 0.0, 0.0, 0.0, 0.0
    gx0, gx1, gy0, gy1, gr, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    most, precision = HUBER * sigma, 1.0 / (sigma * sigma)
    tukey = 0.0 if scale == 0.0 else 1.0 / (TUKEY * scale) ** 2
    directions_x, directions_y, lengths, heights, used = rays[0], rays[1], rays[2], rays[3], rays[USED]
    for i in range(n):
        ux, uy, h = directions_x[i], directions_y[i], heights[i]
        r, variance, sine, cosine, _ = residual(ux, uy, lengths[i], h, p, sigma)
        squares += r * r
        if scale == 0.0:
            # The edges, which are sharp but may be false, count no more than the rest at first.
            w = min(1.0, most / max(abs(r), 1e-9)) * precision
        else:
            weight = 1.0 / variance
            kept = max(1.0 - r * r * weight * tukey, 0.0)
            w = kept * kept * weight
        # Within the beam's width of the edge a return says nothing more.
        w = 0.0 if r == 0.0 and cosine == 0.0 else w * used[i]
        nx, ny = cosine * ux + sine * uy, cosine * uy - sine * ux
        wx, wy, wr, hh = w * nx, w * ny, w * r, h * h
        xx, xy, yy, rx, ry = wx * nx, wx * ny, wy * ny, wr * nx, wr * ny
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
    lean, radius = 1.0 / PRIOR_LEAN_SIGMA**2, 1.0 / PRIOR_RADIUS_SIGMA**2
    # The centre has no prior; 0.01 only keeps a degenerate cluster solvable (sigma of 10 m).
    H[0, 0] = xx0 + 0.01
    H[1, 0], H[1, 1] = xy0, yy0 + 0.01
    H[2, 0], H[2, 1], H[2, 2] = xx1, xy1, xx2 + lean
    H[3, 0], H[3, 1], H[3, 2], H[3, 3] = xy1, yy1, xy2, yy2 + lean
    H[4, 0], H[4, 1], H[4, 2], H[4, 3], H[4, 4] = -x0, -y0, -x1, -y1, n0 + radius
    g[0], g[1], g[2], g[3] = gx0, gy0, gx1 + lean * p[2], gy1 + lean * p[3]
    g[4] = radius * (p[4] - PRIOR_RADIUS) - gr
    return squares
