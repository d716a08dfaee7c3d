"""Choice of the best particle, whose map and, if the particles are far apart, pose are reported."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int


@compiled
def are_apart(pose: Float, weights: Float, distance: float) -> bool:
    """Return whether the weighted position scatter of particles exceeds a distance per axis.

    The criterion is sum_p w_p |p - mean|^2 > 2 distance^2.

    Args:
        pose: x, y [m], yaw [rad], shape (P, 3).
        weights: Weights with sum 1, shape (P,).
        distance: Standard deviation per axis [m].
    """
    x, y, square = 0.0, 0.0, 0.0
    for p in range(pose.shape[0]):
        x += weights[p] * pose[p, 0]
        y += weights[p] * pose[p, 1]
    for p in range(pose.shape[0]):
        square += weights[p] * ((pose[p, 0] - x) ** 2 + (pose[p, 1] - y) ** 2)
    return square > 2.0 * distance * distance


@compiled
def select_best(weights: Float, before: int, pose: Float, distance: float) -> int:
    """Return the row of the best particle: the heaviest one, or the previous one if the particles are apart.

    Particles that are farther apart than trees can be distinguished are hypotheses with different maps. The
    weights of a few scans would select another hypothesis in each scan, and the mapped trees would agree with
    none of them.

    Args:
        weights: Weights with sum 1, shape (P,).
        before: Row of the previous best particle.
        pose, distance: See `are_apart`.
    """
    return before if are_apart(pose, weights, distance) else int(np.argmax(weights))


@compiled
def best_after_resampling(best: int, ancestors: Int, weights: Float) -> int:
    """Return the row of the best particle after resampling: `best` if it survived, else the heaviest
    particle.

    Args:
        best: Row before resampling.
        ancestors: Ancestor of each row; survivors keep their row, so that ancestors[k] == k. Shape (P,).
        weights: Weights before resampling, shape (P,). The heaviest particle always survives.
    """
    return best if ancestors[best] == best else int(np.argmax(weights))
