"""Low-variance resampling (Thrun, Burgard, Fox: Probabilistic Robotics, table 4.4), in place."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int


@compiled
def normalised(log_weight: Float) -> Float:
    """Weights that sum to 1 from logarithms up to a constant, shape (P,)."""
    weights = np.empty(log_weight.shape[0])
    greatest, total = log_weight.max(), 0.0
    for p in range(log_weight.shape[0]):
        weights[p] = np.exp(log_weight[p] - greatest)
        total += weights[p]
    for p in range(log_weight.shape[0]):
        weights[p] /= total
    return weights


@compiled
def low_variance_ancestors(weights: Float, offset: float) -> Int:
    """Which particle each one of the new generation comes from, shape (P,).

    A particle of weight w is drawn floor(P w) or ceil(P w) times. Survivors keep their own slot, so
    that only their copies have to be written.

    Args:
        weights: shape (P,), sum 1.
        offset: Uniform in [0, 1).
    """
    n = weights.shape[0]
    draws = np.zeros(n, np.int64)
    total, k = weights[0], 0
    for i in range(n):
        at = (i + offset) / n
        while at >= total and k < n - 1:
            k += 1
            total += weights[k]
        draws[k] += 1
    ancestors = np.full(n, -1, np.int64)
    for k in range(n):
        if draws[k] > 0:
            ancestors[k] = k
            draws[k] -= 1
    k = 0
    for i in range(n):
        if ancestors[i] < 0:
            while draws[k] == 0:
                k += 1
            ancestors[i] = k
            draws[k] -= 1
    return ancestors
