"""Ray casting: ranges at which rays meet shapes and the ground, in closed form, compiled.

In a sweep each shape covers an interval of columns and rings, as seen from the pose of the sensor at that
time. Only these rays are tested (see `window_of_capsule`); the intervals are wide enough to contain all hits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.primitives import BOX, CONE, STEM, Solids
from pipeline.simulation.terrain import gradient_at, sine_of_turns
from pipeline.types.records import Float, Int, Int32

MISS = np.inf


class Optics(NamedTuple):
    """Beams and receiver of a LiDAR.

    Attributes:
        lowest, ring_step: Elevation of ring 0, and angle between two rings [rad].
        range_min, range_max: Measured ranges [m].
        divergence: Full width of a beam [rad].
        pulse: Echoes nearer to one another than this are reported as one [m].
        strength: Range at which a perpendicular surface of reflectivity 1 gives a return in 63 % of the shots
            [m].
        field: Half the width of the field of view in azimuth [rad].
    """

    lowest: float
    ring_step: float
    range_min: float
    range_max: float
    divergence: float
    pulse: float
    strength: float
    field: float


@compiled
def meet_cone(shape: Float, o: Float, d: Float, widest: float = 1.0) -> float:
    """Return the range [m] at which a ray enters the mantle of a tapered cylinder from outside; MISS if it
    does not, or if the origin is inside. The cylinder has no caps: a ray through an open end misses.

    Args:
        shape: Row of the shape, see `Solids.shape`.
        o: Origin of the ray, shape (3,) [m].
        d: Unit direction of the ray, shape (3,).
        widest: Factor of the radii.
    """
    wx, wy, wz = o[0] - shape[0], o[1] - shape[1], o[2] - shape[2]
    along = wx * shape[3] + wy * shape[4] + wz * shape[5]
    rate = d[0] * shape[3] + d[1] * shape[4] + d[2] * shape[5]
    k = widest * shape[8]
    first = widest * shape[7]
    radius = first + k * along
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] - rate * rate * (1.0 + k * k)
    b = wx * d[0] + wy * d[1] + wz * d[2] - along * rate - k * rate * radius
    c = wx * wx + wy * wy + wz * wz - along * along - radius * radius
    discriminant = b * b - a * c
    if discriminant <= 0.0 or a <= 1e-12:
        return MISS
    t: float = (-b - np.sqrt(discriminant)) / a
    h = along + t * rate
    if t <= 0.0 or h < 0.0 or h > shape[6] or first + k * h <= 0.0:
        return MISS
    return t


FURROW_WAVE = 0.5  # m of height in which a furrow swings to and fro
_MARCH, _TOUCH = 0.4, 5e-4  # share of the gap to the bark that is safe to advance; precision [m]


@compiled
def bark_radius(surface: Float, radius: float, depth: float, angle: float, height: float) -> float:
    """Return the radius of a stem in a direction [m], with lobes and furrows, see `primitives.Section`; the
    angle of the furrows oscillates over FURROW_WAVE of height.

    Args:
        surface: Row of `Solids.surface` with the parameters of the section.
        radius: r at this height [m].
        depth: Depth of the furrows at this height [m].
        angle: Angle around the axis [rad].
        height: Distance along the axis [m].
    """
    lobes = surface[2] * np.cos(2.0 * (angle - surface[3])) + surface[4] * np.cos(3.0 * (angle - surface[5]))
    swing = sine_of_turns(height / FURROW_WAVE)
    furrow = 0.5 - 0.5 * np.cos(surface[7] * angle + surface[8] + swing)
    bark: float = radius * (1.0 + lobes) - depth * furrow * furrow
    return bark


@compiled
def meet_stem(shape: Float, surface: Float, o: Float, d: Float) -> float:
    """Return the range [m] at which a ray enters the bark of a stem from outside; MISS if it does not, or if
    the origin is inside the mantle that encloses the stem. From this mantle the ray advances by
    a share of the gap, which is small enough for furrows with a slope of 2.

    Args:
        shape, surface: Rows of the stem, see `Solids`.
        o, d: Origin [m] and unit direction of the ray, shape (3,).
    """
    widest = 1.0 + surface[2] + surface[4]
    t = meet_cone(shape, o, d, widest)
    if t == MISS:
        return MISS
    ux, uy, uz = shape[3], shape[4], shape[5]
    # Two directions perpendicular to the axis: the x axis without its part along the axis, and their product.
    ax, ay, az = 1.0 - ux * ux, -ux * uy, -ux * uz
    norm = np.sqrt(ax * ax + ay * ay + az * az)
    if norm < 1e-6:
        ax, ay, az, norm = 0.0, 1.0, 0.0, 1.0
    ax, ay, az = ax / norm, ay / norm, az / norm
    bx, by, bz = uy * az - uz * ay, uz * ax - ux * az, ux * ay - uy * ax
    before = MISS
    for _ in range(400):
        x, y, z = o[0] + t * d[0] - shape[0], o[1] + t * d[1] - shape[1], o[2] + t * d[2] - shape[2]
        h = x * ux + y * uy + z * uz
        if h < 0.0 or h > shape[6]:
            return MISS
        a, b = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        rho = np.sqrt(a * a + b * b)
        radius = shape[7] + shape[8] * h
        depth = surface[6] * radius / shape[7]
        gap = rho - bark_radius(surface, radius, depth, np.arctan2(b, a), h)
        if gap < _TOUCH:
            return t
        if rho > widest * radius + _TOUCH and rho > before:
            return MISS
        before = rho
        t += max(_MARCH * gap, _TOUCH)
    return MISS


@compiled
def meet_ellipsoid(shape: Float, o: Float, d: Float) -> tuple[float, float]:
    """Return the ranges [m] at which a ray enters and leaves an ellipsoid, negative behind the origin (both,
    if the ellipsoid is behind); both are MISS if the line of the ray passes it.

    Args:
        shape: Row of the shape, see `Solids.shape`.
        o, d: Origin [m] and unit direction of the ray, shape (3,).
    """
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
    """Return the range [m] at which a ray enters an upright box from outside; MISS if it does not, or if the
    origin is inside.

    Args:
        shape: Row of the shape, see `Solids.shape`.
        o, d: Origin [m] and unit direction of the ray, shape (3,).
    """
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
def waves_at(terrain: Float, o: Float, waves: Float) -> None:
    """Fill `waves`, shape (W, 3), with what all rays from one origin share: for each row of the terrain its
    phase in turns, sine and cosine at the origin; in row 0 the height above the plane. `terrain` is
    `SimulatedTerrain.packed`, shape (W, 4), and `o` the origin, shape (3,) [m]."""
    waves[0, 0] = o[2] - terrain[0, 0] * o[0] - terrain[0, 1] * o[1] - terrain[0, 2]
    for i in range(1, terrain.shape[0]):
        turns = terrain[i, 1] * o[0] + terrain[i, 2] * o[1] + terrain[i, 3]
        waves[i, 0] = turns
        waves[i, 1] = sine_of_turns(turns)
        waves[i, 2] = sine_of_turns(turns + 0.25)


@compiled
def meet_ground(terrain: Float, waves: Float, d: Float, farthest: float, rate: Float) -> float:
    """Return the range [m] at which a ray first goes below the terrain; MISS (infinite) if not before
    `farthest`, or if the origin is not above the terrain.

    Along the ray the waves rise no faster than `steepest` and curve no more than `bend`. Both bound how far
    it is safe to advance; near the ground the second converges as fast as Newton's method.

    Args:
        terrain: `SimulatedTerrain.packed`, shape (W, 4).
        waves: Waves at the origin of the ray, see `waves_at`, shape (W, 3).
        d: Unit direction, shape (3,).
        farthest: Maximum range [m].
        rate: Working space of shape (W,), overwritten.
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
    if fall < 0.0:  # a rising ray meets nothing above the highest crest
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
    """Return the absolute cosine of the angle between a ray (origin o, unit direction d) and the normal of
    the ground at range t [m]; `terrain` is `SimulatedTerrain.packed`."""
    gx, gy = gradient_at(terrain, o[0] + t * d[0], o[1] + t * d[1])
    cosine: float = abs(gx * d[0] + gy * d[1] - d[2]) / np.sqrt(1.0 + gx * gx + gy * gy)
    return cosine


@compiled
def solid_incidence(kind: int, shape: Float, o: Float, d: Float, t: float) -> float:
    """Return the absolute cosine of the angle between a ray (origin o, unit direction d) and the normal of
    the shape that it meets at range t [m]; `kind` and `shape` are a row of `Solids`. Furrows are ignored."""
    x, y, z = o[0] + t * d[0] - shape[0], o[1] + t * d[1] - shape[1], o[2] + t * d[2] - shape[2]
    if kind in (CONE, STEM):
        h = x * shape[3] + y * shape[4] + z * shape[5]
        nx, ny, nz = x - h * shape[3], y - h * shape[4], z - h * shape[5]
    else:
        cos, sin = shape[6], shape[7]
        u, v = (cos * x + sin * y) / shape[3], (cos * y - sin * x) / shape[4]
        w = z / shape[5]
        if kind == BOX:
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


@compiled
def interval_of_capsule(
    capsule: Float, R: Float, o: Float, lowest: float, highest: float
) -> tuple[float, float, float, float, float]:
    """Return the angles that a capsule covers as seen by the sensor.

    Args:
        capsule: Ends of the axis in the world, and radius, shape (7,) [m].
        R, o: Rotation (3, 3) and position (3,) [m] of the sensor in the world.
        lowest, highest: Elevations of the outer rings [rad].

    Returns:
        Azimuth of the middle of the capsule, half of its width in azimuth (pi if the capsule is around or
        above the sensor), lowest and highest elevation, in the sensor frame [rad], and the minimum range at
        which it can be met [m]. The width is -1 when the capsule is above or below all elevations.
    """
    a, b = np.empty(3), np.empty(3)
    for i in range(3):
        a[i] = b[i] = 0.0
        for j in range(3):
            a[i] += R[j, i] * (capsule[j] - o[j])
            b[i] += R[j, i] * (capsule[3 + j] - o[j])
    r = capsule[6]
    rho_a, rho_b = np.sqrt(a[0] * a[0] + a[1] * a[1]), np.sqrt(b[0] * b[0] + b[1] * b[1])
    reach = max(rho_a, rho_b) + r
    if max(a[2], b[2]) < np.tan(lowest) * reach - r or min(a[2], b[2]) > np.tan(highest) * reach + r:
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
    turn = np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    wide_a, wide_b = np.arcsin(min(r / rho_a, 1.0)), np.arcsin(min(r / rho_b, 1.0))
    low, high = min(-wide_a, turn - wide_b), max(wide_a, turn + wide_b)
    middle = np.arctan2(a[1], a[0]) + 0.5 * (low + high)
    return middle, 0.5 * (high - low), elevation_bottom, elevation_top, nearest


@compiled
def window_of_capsule(
    capsule: Float, R: Float, o: Float, lowest: float, ring_step: float, rings: int
) -> tuple[int, int, int, int, float]:
    """Return the rays of a sweep that can meet a capsule.

    Args:
        capsule: Ends of the axis in the world, and radius, shape (7,) [m].
        R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        lowest, ring_step: Elevation of the lowest ring, and angle between two rings [rad].
        rings: Number of rings.

    Returns:
        First and last column (may be negative or above C - 1, to be taken modulo C), first and last ring, and
        the nearest range at which it can be met [m]. The columns are empty (last before first) when it is out
        of view; the rings are empty when it is between two of them.
    """
    columns = R.shape[0]
    step = 2.0 * np.pi / columns
    highest = lowest + ring_step * (rings - 1)
    c = columns // 2
    turned, width, low, high, nearest = 0.0, -1.0, 0.0, 0.0, 0.0
    for _ in range(2):  # the position in the sweep decides from which pose it is seen
        middle, width, low, high, nearest = interval_of_capsule(
            capsule, R[c], o[c], lowest - 0.03, highest + 0.03
        )
        turned = (np.pi - middle) / step
        c = int(turned) % columns
    if width < 0.0:
        return 0, -1, 0, -1, nearest
    # The robot moves 0.1 m, turns and tilts during a sweep; the margin covers its share while the beam
    # passes.
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


NOTHING, GROUND = -1, -2


@compiled
def random_unit(key: int, a: int, b: int) -> float:
    """Return a random number in (0, 1) that only depends on the key and the two counters a and b."""
    h = (
        np.uint64(key)
        ^ (np.uint64(a + 1) * np.uint64(0x9E3779B97F4A7C15))
        ^ (np.uint64(b + 1) * np.uint64(0xC2B2AE3D27D4EB4F))
    )
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ (h >> np.uint64(31))
    return (float(h >> np.uint64(11)) + 0.5) / 9007199254740992.0


@compiled
def ray_directions(R: Float, beams: Float) -> Float:
    """Return the directions in the world, shape (C, K, 3), of beams (C, K, 3) under rotations (C, 3, 3)."""
    out = np.empty_like(beams)
    for c in range(beams.shape[0]):
        for k in range(beams.shape[1]):
            for i in range(3):
                out[c, k, i] = (
                    R[c, i, 0] * beams[c, k, 0] + R[c, i, 1] * beams[c, k, 1] + R[c, i, 2] * beams[c, k, 2]
                )
    return out


@compiled
def meet_solid(kind: int, shape: Float, surface: Float, o: Float, d: Float, chance: float) -> float:
    """Return the range [m] of the first return from a shape, infinite if there is none. Solid shapes are met
    from outside only. In a porous ellipsoid the depth of the return is -ln(chance) times the mean free path;
    the ray passes the ellipsoid if this exceeds the length of its path in it, and may begin inside.

    Args:
        kind, shape, surface: Row of `Solids`.
        o, d: Origin [m] and unit direction of the ray, shape (3,).
        chance: Number in (0, 1) that decides the depth of the return in foliage.
    """
    if kind == STEM:
        return meet_stem(shape, surface, o, d)
    if kind == CONE:
        return meet_cone(shape, o, d, 1.0)
    if kind == BOX:
        return meet_box(shape, o, d)
    enter, leave = meet_ellipsoid(shape, o, d)
    if shape[8] == 0.0:
        return enter if enter > 0.0 else np.inf
    if not leave > 0.0 or leave == np.inf:
        return np.inf
    t = max(enter, 0.0) - shape[8] * np.log(chance)
    return t if t < leave else np.inf


@compiled
def first_returns(
    solids: Solids,
    terrain: Float,
    R: Float,
    o: Float,
    directions: Float,
    optics: Optics,
    key: int,
    order: Int,
) -> tuple[Float, Int32]:
    """Return range [m] and shape (row of `solids`, GROUND or NOTHING) of each ray of a sweep, shape (C, K)
    each.

    Column c looks along the azimuth pi - c 2 pi / C from the pose R[c], o[c]. Ranges are infinite for
    NOTHING. Columns outside of `optics.field` have no returns; the ground ends at `optics.range_max`, and
    shapes that are entirely beyond it are skipped.

    Args:
        solids: The shapes.
        terrain: `SimulatedTerrain.packed`.
        R, o: Pose of the sensor at each column, shapes (C, 3, 3) and (C, 3) [m].
        directions: Unit directions of the rays in the scene, shape (C, K, 3).
        optics: Range, field and rings.
        key: Random seed of foliage.
        order: Rows of the shapes that are tested, shape (M,); with near shapes first, rays that they stop are
            not tested again.
    """
    kind, shape, surface = solids.kind, solids.shape, solids.surface
    capsule, farthest = solids.capsule, optics.range_max
    columns, rings = directions.shape[0], directions.shape[1]
    ranges = np.full((columns, rings), np.inf)
    owner = np.full((columns, rings), NOTHING, dtype=np.int32)
    for n in order:
        first, last, ring_first, ring_last, nearest = window_of_capsule(
            capsule[n], R, o, optics.lowest, optics.ring_step, rings
        )
        if nearest > farthest:
            continue
        for column in range(first, last + 1):
            c = column % columns
            if abs(np.pi - c * (2.0 * np.pi / columns)) > optics.field:
                continue
            for k in range(ring_first, ring_last + 1):
                if ranges[c, k] <= nearest - 0.2:
                    continue
                chance = random_unit(key, c * rings + k, n)
                t = meet_solid(kind[n], shape[n], surface[n], o[c], directions[c, k], chance)
                if t < ranges[c, k]:
                    ranges[c, k] = t
                    owner[c, k] = n
    waves, space = np.empty((terrain.shape[0], 3)), np.empty(terrain.shape[0])
    for c in range(columns):
        if abs(np.pi - c * (2.0 * np.pi / columns)) > optics.field:
            continue
        waves_at(terrain, o[c], waves)
        for k in range(rings):
            t = meet_ground(terrain, waves, directions[c, k], min(ranges[c, k], farthest), space)
            if t < ranges[c, k]:
                ranges[c, k] = t
                owner[c, k] = GROUND
    return ranges, owner
