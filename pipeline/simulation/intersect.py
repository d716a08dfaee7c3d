"""Where a ray meets one shape or the ground: closed forms, compiled."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.records import Float
from pipeline.simulation.terrain import gradient_at, height_at

MISS = np.inf


@compiled
def meet_cone(shape: Float, o: Float, d: Float) -> float:
    """Range at which a ray (origin o, unit direction d) enters the mantle of a tapered cylinder."""
    wx, wy, wz = o[0] - shape[0], o[1] - shape[1], o[2] - shape[2]
    along = wx * shape[3] + wy * shape[4] + wz * shape[5]
    rate = d[0] * shape[3] + d[1] * shape[4] + d[2] * shape[5]
    k = shape[8]
    radius = shape[7] + k * along
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - rate * rate * (1.0 + k * k)
    b = wx * d[0] + wy * d[1] + wz * d[2] - along * rate - k * rate * radius
    c = wx * wx + wy * wy + wz * wz - along * along - radius * radius
    discriminant = b * b - a * c
    if discriminant <= 0.0 or a <= 1e-12:
        return MISS
    t = (-b - np.sqrt(discriminant)) / a
    h = along + t * rate
    if t <= 0.0 or h < 0.0 or h > shape[6] or shape[7] + k * h <= 0.0:
        return MISS
    return t


@compiled
def meet_ellipsoid(shape: Float, o: Float, d: Float) -> tuple[float, float]:
    """Ranges at which a ray enters and leaves an ellipsoid; both infinite when it misses."""
    cos, sin = shape[6], shape[7]
    wx, wy, wz = o[0] - shape[0], o[1] - shape[1], o[2] - shape[2]
    px, py, pz = (cos * wx + sin * wy) / shape[3], (cos * wy - sin * wx) / shape[4], wz / shape[5]
    qx, qy = (cos * d[0] + sin * d[1]) / shape[3], (cos * d[1] - sin * d[0]) / shape[4]
    qz = d[2] / shape[5]
    a = qx * qx + qy * qy + qz * qz
    b = px * qx + py * qy + pz * qz
    discriminant = b * b - a * (px * px + py * py + pz * pz - 1.0)
    if discriminant <= 0.0:
        return MISS, MISS
    root = np.sqrt(discriminant)
    return (-b - root) / a, (-b + root) / a


@compiled
def meet_box(shape: Float, o: Float, d: Float) -> float:
    """Range at which a ray enters an upright box from outside."""
    cos, sin = shape[6], shape[7]
    wx, wy = o[0] - shape[0], o[1] - shape[1]
    enter, leave = -np.inf, np.inf
    for axis in range(3):
        if axis == 0:
            p, q = cos * wx + sin * wy, cos * d[0] + sin * d[1]
        elif axis == 1:
            p, q = cos * wy - sin * wx, cos * d[1] - sin * d[0]
        else:
            p, q = o[2] - shape[2], d[2]
        half = shape[3 + axis]
        if abs(q) < 1e-12:
            if abs(p) > half:
                return MISS
        else:
            t1, t2 = (-half - p) / q, (half - p) / q
            enter, leave = max(enter, min(t1, t2)), min(leave, max(t1, t2))
    return enter if 0.0 < enter <= leave else MISS


@compiled
def meet_ground(terrain: Float, roughness: float, o: Float, d: Float, farthest: float) -> float:
    """Range at which a ray first goes under the terrain, infinite if not before `farthest`.

    The waves rise no faster than `roughness` above the plane, which tells how far it is safe to jump;
    where that is too short for progress, the steps are short against the waves instead.
    """
    level = np.sqrt(d[0] * d[0] + d[1] * d[1])
    # The clearance shrinks by at most `closing` per metre of ray.
    closing = roughness * level - (d[2] - terrain[0, 0] * d[0] - terrain[0, 1] * d[1])
    if closing <= 1e-9:
        return MISS
    t, clearance = 0.0, o[2] - height_at(terrain, o[0], o[1])
    if clearance <= 0.0:
        return MISS
    while t < farthest:
        last_t, last_clearance = t, clearance
        t = min(t + max(clearance / closing, 0.3 + 0.02 * t), farthest)
        clearance = o[2] + t * d[2] - height_at(terrain, o[0] + t * d[0], o[1] + t * d[1])
        if clearance <= 0.0:
            return _bisect_ground(terrain, o, d, last_t, last_clearance, t, clearance)
    return MISS


@compiled
def _bisect_ground(
    terrain: Float, o: Float, d: Float, low: float, above: float, high: float, below: float
) -> float:
    # Regula falsi with the Illinois rule: three or four rounds to a tenth of a millimetre.
    t = high
    for _ in range(20):
        t = low + (high - low) * above / (above - below)
        clearance = o[2] + t * d[2] - height_at(terrain, o[0] + t * d[0], o[1] + t * d[1])
        if abs(clearance) < 1e-5:
            break
        if clearance > 0.0:
            low, above, below = t, clearance, 0.5 * below
        else:
            high, below, above = t, clearance, 0.5 * above
    return t


@compiled
def ground_incidence(terrain: Float, o: Float, d: Float, t: float) -> float:
    """Cosine of the angle between a ray and the normal of the ground that it meets at range t."""
    gx, gy = gradient_at(terrain, o[0] + t * d[0], o[1] + t * d[1])
    return abs(gx * d[0] + gy * d[1] - d[2]) / np.sqrt(1.0 + gx * gx + gy * gy)


@compiled
def solid_incidence(kind: int, shape: Float, o: Float, d: Float, t: float) -> float:
    """Cosine of the angle between a ray and the normal of the shape that it meets at range t."""
    x, y, z = o[0] + t * d[0] - shape[0], o[1] + t * d[1] - shape[1], o[2] + t * d[2] - shape[2]
    if kind == 0:
        h = x * shape[3] + y * shape[4] + z * shape[5]
        nx, ny, nz = x - h * shape[3], y - h * shape[4], z - h * shape[5]
    else:
        cos, sin = shape[6], shape[7]
        u, v = (cos * x + sin * y) / shape[3], (cos * y - sin * x) / shape[4]
        w = z / shape[5]
        if kind == 2:
            # On a face the scaled coordinate is 1: that axis is the normal.
            if abs(w) >= abs(u) and abs(w) >= abs(v):
                u, v = 0.0, 0.0
            elif abs(u) >= abs(v):
                v, w = 0.0, 0.0
            else:
                u, w = 0.0, 0.0
        u, v, w = u / shape[3], v / shape[4], w / shape[5]
        nx, ny, nz = cos * u - sin * v, sin * u + cos * v, w
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length == 0.0:
        return 1.0
    return abs(nx * d[0] + ny * d[1] + nz * d[2]) / length
