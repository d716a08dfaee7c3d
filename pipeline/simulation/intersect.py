"""Where a ray meets one shape or the ground: closed forms, compiled."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.terrain import gradient_at, sine_of_turns
from pipeline.types.records import Float

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
    t: float = (-b - np.sqrt(discriminant)) / a
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
def stand_on(terrain: Float, o: Float, waves: Float) -> None:
    """What all rays from one origin share, written into `waves`, shape (W, 3): for each row of the
    terrain its phase in turns, sine and cosine at the origin; in row 0 the height above the plane."""
    waves[0, 0] = o[2] - terrain[0, 0] * o[0] - terrain[0, 1] * o[1] - terrain[0, 2]
    for i in range(1, terrain.shape[0]):
        turns = terrain[i, 1] * o[0] + terrain[i, 2] * o[1] + terrain[i, 3]
        waves[i, 0] = turns
        waves[i, 1] = sine_of_turns(turns)
        waves[i, 2] = sine_of_turns(turns + 0.25)


@compiled
def meet_ground(terrain: Float, waves: Float, d: Float, farthest: float, rate: Float) -> float:
    """Range at which a ray first goes under the terrain, infinite if not before `farthest`.

    Along the ray the waves rise no faster than `steepest` and bend no more than `bend`; both tell how
    far it is safe to jump, and near the ground the second closes in as fast as Newton's method does.

    Args:
        terrain: Packed, see `Terrain`.
        waves: Of the ray's origin, see `stand_on`.
        d: Unit direction.
        farthest: [m].
        rate: Working space of shape (W,).
    """
    count = terrain.shape[0]
    fall = terrain[0, 0] * d[0] + terrain[0, 1] * d[1] - d[2]
    above_plane = waves[0, 0]
    steepest, bend, crest = 0.0, 0.0, 0.0
    clearance, change = above_plane, -fall
    for i in range(1, count):
        rate[i] = terrain[i, 1] * d[0] + terrain[i, 2] * d[1]
        slope = 6.283185307179586 * rate[i]
        steepest += terrain[i, 0] * abs(slope)
        bend += terrain[i, 0] * slope * slope
        crest += terrain[i, 0]
        clearance -= terrain[i, 0] * waves[i, 1]
        change -= terrain[i, 0] * slope * waves[i, 2]
    closing = steepest + fall
    if closing <= 1e-9 or clearance <= 0.0:
        return MISS
    if fall < 0.0:  # rising: above the highest crest nothing can be met any more
        farthest = min(farthest, (crest - above_plane) / -fall)
    t: float = 0.0
    for _ in range(400):
        root = np.sqrt(change * change + 2.0 * bend * clearance)
        if change <= 0.0:
            jump = 2.0 * clearance / (root - change)
        else:
            jump = (change + root) / bend if bend > 0.0 else MISS
        t += max(jump, clearance / closing)
        if t > farthest:
            return MISS
        if bend * jump * jump < 2e-5:
            return t
        clearance, change = above_plane - t * fall, -fall
        for i in range(1, count):
            turns = waves[i, 0] + t * rate[i]
            clearance -= terrain[i, 0] * sine_of_turns(turns)
            change -= 6.283185307179586 * terrain[i, 0] * rate[i] * sine_of_turns(turns + 0.25)
        if clearance < 1e-5:
            return t
    return t


@compiled
def ground_incidence(terrain: Float, o: Float, d: Float, t: float) -> float:
    """Cosine of the angle between a ray and the normal of the ground that it meets at range t."""
    gx, gy = gradient_at(terrain, o[0] + t * d[0], o[1] + t * d[1])
    cosine: float = abs(gx * d[0] + gy * d[1] - d[2]) / np.sqrt(1.0 + gx * gx + gy * gy)
    return cosine


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
    cosine: float = abs(nx * d[0] + ny * d[1] + nz * d[2]) / max(length, 1e-12)
    return cosine
