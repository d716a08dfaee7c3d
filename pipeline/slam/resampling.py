"""Random numbers of a scan, low-variance resampling (Thrun, Burgard, Fox: Probabilistic Robotics, table 4.4),
and the choice of the best particle, whose map is reported."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int

WORD = 2**32  # seeds below it need one 32-bit word


def draws(seed: int, index: int, particles: int) -> tuple[Float, float]:
    """Return standard normal numbers, shape (P, 3), and one uniform number in [0, 1); the same for equal
    arguments.

    Args:
        seed: Seed of the run, >= 0.
        index: Number of the scan, >= 0.
        particles: Number of particles P.
    """
    # An array of 32-bit words gives the same stream as the list and is converted faster.
    fit = 0 <= seed < WORD and 0 <= index < WORD
    rng = np.random.default_rng(np.array([seed, index], np.uint32) if fit else [seed, index])
    return rng.standard_normal((particles, 3)), float(rng.random())


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
