"""Trees that a robot in doubt of its own place says nothing of: where it looks for them they need not be."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool

SIGMAS = 2.0  # of the pose, beyond those of the tree, that reach as far as a tree is recognised


@compiled
def beyond_doubt(
    x: Float, P: Float, pose: Float, pose_covariance: Float, distance_max: float, reach: float
) -> Bool:
    """Which trees are known so much better than the pose that none of them need be where the scan looks for
    it, shape (T,).

    A tree that the robot has put on the map on its way here shares the error of its pose, and may be missed.
    One that is known from before does not: with sigma_pose - sigma_tree as the least that the place of one is
    uncertain as seen from the other, it is spared where two of those reach farther than the distance at which
    a detection still joins it.

    Args:
        x, P: Of the trees, see `TrackTable`.
        pose: x, y [m], yaw [rad] in the frame of the map; pose_covariance: of it, shape (3, 3).
        distance_max: How far from a tree its detection may lie [m].
        reach: Trees farther away are never missed [m].
    """
    beyond = np.zeros(x.shape[0], np.bool_)
    Sigma, limit = pose_covariance, distance_max / SIGMAS
    most = Sigma[0, 0] + Sigma[1, 1] + reach * reach * Sigma[2, 2]
    most += 2.0 * reach * (abs(Sigma[0, 2]) + abs(Sigma[1, 2]))
    if most <= 2.0 * limit * limit:  # nearly always
        return beyond
    for t in range(x.shape[0]):
        dx, dy = x[t, 0] - pose[0], x[t, 1] - pose[1]
        at_tree = Sigma[0, 0] + Sigma[1, 1] + 2.0 * (dx * Sigma[1, 2] - dy * Sigma[0, 2])
        at_tree += (dx * dx + dy * dy) * Sigma[2, 2]
        own = P[t, 0, 0] + P[t, 1, 1]
        beyond[t] = np.sqrt(0.5 * max(at_tree, 0.0)) - np.sqrt(0.5 * own) > limit
    return beyond
