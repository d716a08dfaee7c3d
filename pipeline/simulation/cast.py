"""One sweep of a spinning LiDAR through a scene, compiled.

Each shape covers an interval of columns and rings as seen from where the sensor is when it looks that
way; only those rays are tested. Nothing is approximated by it: the intervals are wide enough.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.records import Float, Float32, Int, Int32
from pipeline.simulation.intersect import (
    ground_incidence,
    meet_box,
    meet_cone,
    meet_ellipsoid,
    meet_ground,
    solid_incidence,
    stand_on,
)

NOTHING, GROUND = -1, -2


@compiled
def random_unit(key: int, a: int, b: int) -> float:
    """A number in (0, 1) that depends on the key and two counters only."""
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
    """Directions in the world, shape (C, K, 3), of beams (C, K, 3) under rotations (C, 3, 3)."""
    out = np.empty_like(beams)
    for c in range(beams.shape[0]):
        for k in range(beams.shape[1]):
            for i in range(3):
                out[c, k, i] = (
                    R[c, i, 0] * beams[c, k, 0] + R[c, i, 1] * beams[c, k, 1] + R[c, i, 2] * beams[c, k, 2]
                )
    return out


@compiled
def meet_solid(kind: int, shape: Float, o: Float, d: Float, chance: float) -> float:
    """Range of the first return from a shape; in foliage it lies at a random depth."""
    if kind == 0:
        return meet_cone(shape, o, d)
    if kind == 2:
        return meet_box(shape, o, d)
    enter, leave = meet_ellipsoid(shape, o, d)
    if shape[8] == 0.0:
        return enter if enter > 0.0 else np.inf
    if not leave > 0.0 or leave == np.inf:
        return np.inf
    t = max(enter, 0.0) - shape[8] * np.log(chance)
    return t if t < leave else np.inf


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
    r, reach = capsule[6], 0.0
    # Of a tall trunk only what lies between the lowest and highest beam matters.
    for _ in range(2):
        reach = max(np.sqrt(a[0] * a[0] + a[1] * a[1]), np.sqrt(b[0] * b[0] + b[1] * b[1])) + r
        floor, ceiling = np.tan(lowest) * reach - r, np.tan(highest) * reach + r
        rise = b[2] - a[2]
        if max(a[2], b[2]) < floor or min(a[2], b[2]) > ceiling:
            return 0.0, -1.0, 0.0, 0.0, 0.0
        if abs(rise) > 1e-9:
            s1, s2 = (floor - a[2]) / rise, (ceiling - a[2]) / rise
            first, last = max(0.0, min(s1, s2)), min(1.0, max(s1, s2))
            dx, dy, dz, x, y, z = b[0] - a[0], b[1] - a[1], rise, a[0], a[1], a[2]
            a[0], a[1], a[2] = x + first * dx, y + first * dy, z + first * dz
            b[0], b[1], b[2] = x + last * dx, y + last * dy, z + last * dz
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
def first_returns(
    kind: Int32,
    shape: Float,
    capsule: Float,
    terrain: Float,
    R: Float,
    o: Float,
    directions: Float,
    lowest: float,
    ring_step: float,
    farthest: float,
    key: int,
    order: Int,
) -> tuple[Float, Int32]:
    """Range [m] and shape (or NOTHING, GROUND) of each ray of a sweep, shape (C, K) each.

    `order` names the shapes, best the near ones first: what they hide is not tested.

    Column c looks along the azimuth pi - c 2 pi / C from the pose R[c], o[c].
    """
    columns, rings = directions.shape[0], directions.shape[1]
    ranges = np.full((columns, rings), np.inf)
    owner = np.full((columns, rings), NOTHING, dtype=np.int32)
    step = 2.0 * np.pi / columns
    highest = lowest + ring_step * (rings - 1)
    for n in order:
        c = columns // 2
        turned, width, low, high, nearest = 0.0, -1.0, 0.0, 0.0, 0.0
        for _ in range(2):  # where it stands in the sweep decides from which pose it is seen
            middle, width, low, high, nearest = interval_of_capsule(
                capsule[n], R[c], o[c], lowest - 0.03, highest + 0.03
            )
            turned = (np.pi - middle) / step
            c = int(turned) % columns
        if width < 0.0 or nearest > farthest:
            continue
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
        for column in range(first, min(last, first + columns - 1) + 1):
            c = column % columns
            for k in range(ring_first, ring_last + 1):
                if ranges[c, k] <= nearest - 0.2:
                    continue
                chance = 0.5
                if kind[n] == 1 and shape[n, 8] > 0.0:
                    chance = random_unit(key, c * rings + k, n)
                t = meet_solid(kind[n], shape[n], o[c], directions[c, k], chance)
                if t < ranges[c, k]:
                    ranges[c, k] = t
                    owner[c, k] = n
    waves, space = np.empty((terrain.shape[0], 3)), np.empty(terrain.shape[0])
    for c in range(columns):
        stand_on(terrain, o[c], waves)
        for k in range(rings):
            t = meet_ground(terrain, waves, directions[c, k], min(ranges[c, k], farthest), space)
            if t < ranges[c, k]:
                ranges[c, k] = t
                owner[c, k] = GROUND
    return ranges, owner


@compiled
def echo(
    c: int,
    k: int,
    ranges: Float,
    hit: Int32,
    kind: Int32,
    shape: Float,
    surface: Float,
    o: Float,
    directions: Float,
    divergence: float,
    pulse: float,
) -> tuple[float, int]:
    """Range and shape that the receiver reports for a beam as wide as `divergence` [rad].

    At the edge of a shape part of the beam goes by and meets what is behind. Echoes nearer to one
    another than `pulse` [m] melt into one range in between; else the stronger one is reported.
    """
    columns = ranges.shape[0]
    before, after = max(c - 1, 0), min(c + 1, columns - 1)
    t, n = ranges[c, k], hit[c, k]
    # Written so that two misses, whose difference is not a number, are no edge.
    if not (abs(ranges[before, k] - t) >= 0.05 or abs(ranges[after, k] - t) >= 0.05):
        return t, n
    front = c
    if ranges[before, k] < ranges[front, k]:
        front = before
    if ranges[after, k] < ranges[front, k]:
        front = after
    edge = hit[front, k]
    if edge < 0 or (kind[edge] == 1 and shape[edge, 8] > 0.0):
        return t, n
    behind, behind_hit = t, n
    if n == edge:
        back = before if hit[before, k] != edge else after
        behind, behind_hit = ranges[back, k], hit[back, k]
    if behind_hit == edge or behind - ranges[front, k] < 0.05:
        return t, n
    step = 2.0 * np.pi / columns
    d = np.empty(3)
    count, total = 0, 0.0
    neighbour = after if after != c else before
    for m in range(8):
        share = divergence * ((m + 0.5) / 8.0 - 0.5) / step
        for i in range(3):
            d[i] = directions[c, k, i] + share * (directions[neighbour, k, i] - directions[c, k, i])
        met = meet_solid(kind[edge], shape[edge], o[c], d, 0.5)
        if met < np.inf:
            count += 1
            total += met
    if count == 0 or count == 8:
        return t, n
    near, part = total / count, count / 8.0
    strong = part * surface[edge, 0] / (near * near)
    weak = 0.0
    if behind < np.inf:
        weak = (1.0 - part) * (surface[behind_hit, 0] if behind_hit >= 0 else 0.25) / (behind * behind)
    if behind - near < pulse:
        return (strong * near + weak * behind) / (strong + weak), edge
    if strong >= weak:
        return near, edge
    return behind, behind_hit


@compiled
def measure(
    ranges: Float,
    hit: Int32,
    kind: Int32,
    shape: Float,
    surface: Float,
    terrain: Float,
    o: Float,
    directions: Float,
    divergence: float,
    pulse: float,
    ground_reflectivity: float,
    strength: float,
    range_min: float,
    range_max: float,
    noise: Float,
    key: int,
) -> tuple[Float, Float, Int32]:
    """What the receiver reports: range [m] (0: no return), reflectance 0..255 and shape, (C, K) each.

    Args:
        noise: Error of each range [m], shape (C, K).
        strength: A surface seen head-on with reflectivity 1 at this range [m] returns with 63 %.
    """
    columns, rings = ranges.shape
    reported = np.zeros((columns, rings))
    reflectance = np.zeros((columns, rings))
    source = np.full((columns, rings), NOTHING, dtype=np.int32)
    for c in range(columns):
        for k in range(rings):
            t, n = echo(c, k, ranges, hit, kind, shape, surface, o, directions, divergence, pulse)
            if n == NOTHING or t > range_max:
                continue
            if n == GROUND:
                reflectivity = ground_reflectivity
                incidence = ground_incidence(terrain, o[c], directions[c, k], t)
            else:
                reflectivity = surface[n, 0]
                incidence = 0.7
                if shape[n, 8] == 0.0 or kind[n] == 0:
                    incidence = solid_incidence(kind[n], shape[n], o[c], directions[c, k], t)
                    incidence = max(incidence, 0.05)
                if surface[n, 1] > 0.0:
                    t += surface[n, 1] * (2.0 * random_unit(n, c // 2, k) - 1.0)
            power = reflectivity * incidence * (strength / t) ** 2
            if power < 10.0 and random_unit(key, c * rings + k, -2) > 1.0 - np.exp(-power):
                continue
            t += noise[c, k]
            if t < range_min or t > range_max:
                continue
            reported[c, k] = t
            shade = 100.0 * reflectivity * (0.4 + 0.6 * incidence)
            shade += 6.0 * (random_unit(key, c * rings + k, -3) - 0.5)
            reflectance[c, k] = min(max(np.floor(shade + 0.5), 0.0), 255.0)
            source[c, k] = n
    return reported, reflectance, source


@compiled
def pack_returns(
    reported: Float, reflectance: Float, source: Int32, beams: Float, offsets_ns: Int32
) -> tuple[Float32, Float32, Int32, Int32, Int32]:
    """The returns of a sweep as columns in the order of time, then ring: points (N, 3) [m],
    reflectance, ring, time after the sweep's start [ns] and shape."""
    columns, rings = reported.shape
    count = 0
    for c in range(columns):
        for k in range(rings):
            count += reported[c, k] > 0.0
    points, shade = np.empty((count, 3), dtype=np.float32), np.empty(count, dtype=np.float32)
    ring, offset = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    solid = np.empty(count, dtype=np.int32)
    n = 0
    for c in range(columns):
        for k in range(rings):
            if reported[c, k] > 0.0:
                for i in range(3):
                    points[n, i] = beams[c, k, i] * reported[c, k]
                shade[n], ring[n], offset[n] = reflectance[c, k], k, offsets_ns[c]
                solid[n] = source[c, k]
                n += 1
    return points, shade, ring, offset, solid
