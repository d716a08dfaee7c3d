"""What the receiver makes of the rays: mixed echoes at edges, faint ones lost, noise. Compiled."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.intersect import ground_incidence, solid_incidence
from pipeline.simulation.ray_casting import GROUND, NOTHING, meet_solid, random_unit
from pipeline.types.records import Float, Float32, Int32


@compiled
def count_echoes(
    kind: int, shape: Float, o: Float, d: Float, d_next: Float, divergence: float
) -> tuple[int, float]:
    """Cut a beam into eight thin rays side by side: how many meet a shape, and the sum of their ranges.

    Args:
        kind, shape, o, d: As in `meet_solid`.
        d_next: Direction of the ray in the next column.
        divergence: Full width of the beam [rad] times the number of columns.
    """
    ray = np.empty(3)
    count, total = 0, 0.0
    for m in range(8):
        share = divergence * ((m + 0.5) / 8.0 - 0.5) / (2.0 * np.pi)
        for i in range(3):
            ray[i] = d[i] + share * (d_next[i] - d[i])
        met = meet_solid(kind, shape, o, ray, 0.5)
        if met < np.inf:
            count += 1
            total += met
    return count, total


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
    neighbour = after if after != c else before
    count, total = count_echoes(
        kind[edge], shape[edge], o[c], directions[c, k], directions[neighbour, k], divergence * columns
    )
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
