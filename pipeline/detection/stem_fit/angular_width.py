"""Angles: how wide a cluster is as seen from the sensor, and how much of its circle it shows.

For rays and the cylinder p see `pipeline.detection.stem_fit.residuals`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing


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
