"""Weights: a far return counts for as many neighbours as it stands for, so that DBSCAN holds over range."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Clustering
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int32, Sensor

# Of a solid-state sensor with 24,000 returns in a cone of 70 degrees; a sensor that tells no rings has
# about as much.
UNKNOWN_RING_STEP = float(np.radians(0.8))


def weigh(points: Float32, sensor: Sensor, parameters: Clustering) -> Int32:
    """For how many neighbours each return counts, int32, shape (N,), from 1 to `weight_max`.

    A stem of which the area A is seen returns n(r) = A / (r^2 da de) points at range r, with da and de
    the angles between shots and between rings. Where that is fewer than `min_points`, a return counts
    for min_points / n(r), rounded down.

    Args:
        points: float32, shape (N, 3) [m], level sensor frame.
        sensor: Its angles between shots and rings.
        parameters: stem_area is A [m^2]; see `Clustering`.
    """
    rings = sensor.ring_step if sensor.ring_step > 0.0 else UNKNOWN_RING_STEP
    scale = parameters.min_points * sensor.azimuth_step * rings / parameters.stem_area
    return _weigh(points, scale, parameters.weight_max)


@compiled
def _weigh(points: Float32, scale: float, most: int) -> Int32:
    weight = np.empty(points.shape[0], np.int32)
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        weight[i] = int(min(max(scale * (x * x + y * y), 1.0), float(most)))
    return weight
