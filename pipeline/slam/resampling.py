"""Low-variance resampling (Thrun, Burgard, Fox: Probabilistic Robotics, table 4.4), in place."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int


@compiled
def normalised(log_weight: Float) -> Float:
    """Return weights that sum to 1 from logarithms up to a constant, shape (P,), P > 0. NaN if all logarithms
    are -inf; the argument is unchanged."""
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
    """Return the row of the ancestor of each particle of the new generation, int64, shape (P,).

    A particle of weight w is drawn floor(P w) or ceil(P w) times. Survivors keep their own slot, so that only
    their copies have to be written: ancestors[k] == k for each particle k that is drawn.

    Args:
        weights: Weights with sum 1, shape (P,).
        offset: Uniform random number in [0, 1).
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
