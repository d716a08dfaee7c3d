"""Single rays through a scene, wherever they look: what stands before a return that a real sensor saw."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.ray_casting import meet_solid, random_unit
from pipeline.types.records import Float, Int32


@compiled
def first_along(kind: Int32, shape: Float, capsule: Float, directions: Float, key: int) -> Float:
    """Range [m] at which each ray from the origin meets a shape first, infinity where none, shape (N,).

    Args:
        kind, shape, capsule: See `Solids`; nothing stands at the origin.
        directions: Unit vectors, shape (N, 3).
        key: Of the depths at which foliage stops light.
    """
    ranges = np.full(directions.shape[0], np.inf)
    middle = np.zeros(3)
    origin = np.zeros(3)
    for n in range(kind.shape[0]):
        # A ball around the shape: only rays within its cone are looked at.
        reach, away = capsule[n, 6], 0.0
        half = 0.0
        for i in range(3):
            middle[i] = 0.5 * (capsule[n, i] + capsule[n, i + 3])
            away += middle[i] ** 2
            half += (0.5 * (capsule[n, i] - capsule[n, i + 3])) ** 2
        reach, away = reach + np.sqrt(half), np.sqrt(away)
        beside = reach / away if away > reach else 1.0
        ahead = np.sqrt(1.0 - beside * beside) * away
        for k in range(directions.shape[0]):
            d = directions[k]
            if away > reach and d[0] * middle[0] + d[1] * middle[1] + d[2] * middle[2] < ahead:
                continue
            chance = 0.5
            if kind[n] == 1 and shape[n, 8] > 0.0:
                chance = random_unit(key, k, n)
            ranges[k] = min(ranges[k], meet_solid(kind[n], shape[n], origin, d, chance))
    return ranges
