"""One sweep of a spinning LiDAR through a scene, compiled.

Each shape covers an interval of columns and rings as seen from where the sensor is when it looks that
way; only those rays are tested (see `visible`). The intervals are wide enough to miss nothing.
"""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.culling import window_of_capsule
from pipeline.simulation.intersect import meet_box, meet_cone, meet_ellipsoid, meet_ground, stand_on
from pipeline.types.records import Float, Int, Int32

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
    for n in order:
        first, last, ring_first, ring_last, nearest = window_of_capsule(
            capsule[n], R, o, lowest, ring_step, rings
        )
        if nearest > farthest:
            continue
        for column in range(first, last + 1):
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
