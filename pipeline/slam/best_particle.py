"""The particle whose map and past are shown, and whose pose is told where the particles lie far apart."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int


@compiled
def are_apart(pose: Float, weights: Float, distance: float) -> bool:
    """Whether particles, shape (P, 3), of weights that sum to 1, lie farther from one another than a distance
    [m] (one sigma)."""
    x, y, square = 0.0, 0.0, 0.0
    for p in range(pose.shape[0]):
        x += weights[p] * pose[p, 0]
        y += weights[p] * pose[p, 1]
    for p in range(pose.shape[0]):
        square += weights[p] * ((pose[p, 0] - x) ** 2 + (pose[p, 1] - y) ** 2)
    return square > 2.0 * distance * distance


@compiled
def leader(weights: Float, before: int, pose: Float, distance: float) -> int:
    """The particle that explains the scans best; the one before it, where the particles lie farther apart
    than trees are told apart: there they are hypotheses of which each has a map of its own, the weights of a
    few scans choose another one every time, and what is mapped by one after the other fits none."""
    return before if are_apart(pose, weights, distance) else int(np.argmax(weights))


@compiled
def heir(best: int, ancestors: Int, weights: Float) -> int:
    """The best particle after resampling: itself, for survivors keep their slot; the one that explained the
    scans best (which survives) where it has not."""
    return best if ancestors[best] == best else int(np.argmax(weights))
