"""How far each return lies from a leaning cylinder, and what that says about the cylinder.

A cylinder is p = (x, y of its axis at the mean height, shift of x and y per metre of height, radius).
Rays are rows over the returns: direction x, y, length and height above the mean height [m]; shape
(RAY, room), of which the first n columns count.

The residual of a return is its distance from the axis less the radius. Its error lies along the ray and
not across the bark, so that even at the true circle neither the residuals nor what they pull have the mean
zero; what the error is expected to add is taken off (a corrected score, Nakamura 1990). With the normal
where the ray meets the circle in place of the return's own, which needs no such correction, returns beside
the trunk pull the circle wider and nothing holds against them: on real bark diameters were 13 cm too large.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled_sums

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
