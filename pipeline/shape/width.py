"""Angles: how wide a cluster is as seen from the sensor, and how much of its circle it shows.

For rays and the cylinder p see `pipeline.shape.residuals`.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float


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
