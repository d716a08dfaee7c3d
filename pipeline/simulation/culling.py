"""Which rays of a sweep can meet a shape at all: an interval of columns and one of rings, compiled."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.types.records import Float


@compiled
def clip_to_view(a: Float, b: Float, r: float, lowest: float, highest: float) -> float:
    """Cut the segment from a to b (3,) to what lies between the lowest and highest beam, in place.

    Of a tall trunk that is a small part. Returns how far it reaches from the axis of the sensor [m], or
    -1 when nothing of it, thickened by r, is in view.
    """
    reach = 0.0
    for _ in range(2):
        reach = max(np.sqrt(a[0] * a[0] + a[1] * a[1]), np.sqrt(b[0] * b[0] + b[1] * b[1])) + r
        floor, ceiling = np.tan(lowest) * reach - r, np.tan(highest) * reach + r
        rise = b[2] - a[2]
        if max(a[2], b[2]) < floor or min(a[2], b[2]) > ceiling:
            return -1.0
        if abs(rise) > 1e-9:
            s1, s2 = (floor - a[2]) / rise, (ceiling - a[2]) / rise
            first, last = max(0.0, min(s1, s2)), min(1.0, max(s1, s2))
            for i in range(3):
                way = b[i] - a[i]
                b[i] = a[i] + last * way
                a[i] = a[i] + first * way
    return reach


@compiled
def interval_of_capsule(
    capsule: Float, R: Float, o: Float, lowest: float, highest: float
) -> tuple[float, float, float, float, float]:
    """What a capsule covers as seen by the sensor with rotation R (3, 3) at o (3,).

    Returns:
        Azimuth of its middle, half its width in azimuth, lowest and highest elevation [rad] and the
        nearest range at which it can be met [m]. The width is negative when it cannot be seen.
    """
    a, b = np.empty(3), np.empty(3)
    for i in range(3):
        a[i] = b[i] = 0.0
        for j in range(3):
            a[i] += R[j, i] * (capsule[j] - o[j])
            b[i] += R[j, i] * (capsule[3 + j] - o[j])
    r = capsule[6]
    reach = clip_to_view(a, b, r, lowest, highest)
    if reach < 0.0:
        return 0.0, -1.0, 0.0, 0.0, 0.0
    dx, dy = b[0] - a[0], b[1] - a[1]
    span = dx * dx + dy * dy
    s = 0.0 if span < 1e-12 else min(max(-(a[0] * dx + a[1] * dy) / span, 0.0), 1.0)
    distance = np.sqrt((a[0] + s * dx) ** 2 + (a[1] + s * dy) ** 2)
    nearest = max(distance - r, 1e-3)
    top, bottom = max(a[2], b[2]) + r, min(a[2], b[2]) - r
    elevation_top = np.arctan2(top, nearest if top > 0.0 else reach)
    elevation_bottom = np.arctan2(bottom, nearest if bottom < 0.0 else reach)
    if distance <= r * 1.001:
        return 0.0, np.pi, elevation_bottom, elevation_top, nearest
    rho_a, rho_b = np.sqrt(a[0] * a[0] + a[1] * a[1]), np.sqrt(b[0] * b[0] + b[1] * b[1])
    turn = np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    wide_a, wide_b = np.arcsin(min(r / rho_a, 1.0)), np.arcsin(min(r / rho_b, 1.0))
    low, high = min(-wide_a, turn - wide_b), max(wide_a, turn + wide_b)
    middle = np.arctan2(a[1], a[0]) + 0.5 * (low + high)
    return middle, 0.5 * (high - low), elevation_bottom, elevation_top, nearest


@compiled
def window_of_capsule(
    capsule: Float, R: Float, o: Float, lowest: float, ring_step: float, rings: int
) -> tuple[int, int, int, int, float]:
    """The rays of a sweep that can meet a capsule, as seen from the poses R (C, 3, 3) and o (C, 3).

    Returns:
        First and last column (to be taken modulo C), first and last ring, and the nearest range at
        which it can be met [m]. No column at all when it cannot be seen.
    """
    columns = R.shape[0]
    step = 2.0 * np.pi / columns
    highest = lowest + ring_step * (rings - 1)
    c = columns // 2
    turned, width, low, high, nearest = 0.0, -1.0, 0.0, 0.0, 0.0
    for _ in range(2):  # where it stands in the sweep decides from which pose it is seen
        middle, width, low, high, nearest = interval_of_capsule(
            capsule, R[c], o[c], lowest - 0.03, highest + 0.03
        )
        turned = (np.pi - middle) / step
        c = int(turned) % columns
    if width < 0.0:
        return 0, -1, 0, -1, nearest
    # The robot drives 0.1 m, turns and tilts during a sweep; of that, the part it takes to pass.
    tilt = 0.004 + 0.01 * width
    width += 0.05 * width + 1.5 * step
    if turned - width / step < 60.0 or turned + width / step > columns - 60.0:
        tilt = 0.03
        width += 0.1 + 0.15 / max(nearest, 0.15)
    if width >= np.pi:
        first, last = 0, columns - 1
    else:
        first, last = int(np.floor(turned - width / step)), int(np.ceil(turned + width / step))
    ring_first = max(0, int(np.ceil((low - tilt - lowest) / ring_step)))
    ring_last = min(rings - 1, int(np.floor((high + tilt - lowest) / ring_step)))
    return first, min(last, first + columns - 1), ring_first, ring_last, nearest
