"""Trees that a robot in doubt of its own place says nothing of: where it looks for them they need not be."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float, Pose2
from pipeline.records import Bool
from pipeline.tracking.table import TrackTable

SIGMAS = 2.0  # of the pose, beyond those of the tree, that reach as far as a tree is recognised


def beyond_doubt(
    tracks: TrackTable, T_map_base: Pose2, pose_covariance: Float, distance_max: float, reach: float
) -> Bool | None:
    """Which trees are known so much better than the pose that none of them need be where the scan looks for
    it, shape (T,); None where there are none.

    A tree that the robot has put on the map on its way here shares the error of its pose, and may be missed.
    One that is known from before does not: with sigma_pose - sigma_tree as the least that the place of one is
    uncertain as seen from the other, it is spared where two of those reach farther than the distance at which
    a detection still joins it.

    Args:
        tracks: In the frame of the map.
        T_map_base: The pose; pose_covariance: of x, y [m], yaw [rad] in the frame of the map, shape (3, 3).
        distance_max: How far from a tree its detection may lie [m].
        reach: Trees farther away are never missed [m].
    """
    Sigma, limit = pose_covariance, distance_max / SIGMAS
    most = float(Sigma[0, 0] + Sigma[1, 1] + reach * reach * Sigma[2, 2])
    most += 2.0 * reach * (abs(float(Sigma[0, 2])) + abs(float(Sigma[1, 2])))
    if most <= 2.0 * limit * limit:  # nearly always
        return None
    dx, dy = tracks.x[:, 0] - T_map_base.x, tracks.x[:, 1] - T_map_base.y
    at_tree = Sigma[0, 0] + Sigma[1, 1] + 2.0 * (dx * Sigma[1, 2] - dy * Sigma[0, 2])
    at_tree += (dx * dx + dy * dy) * Sigma[2, 2]
    own = tracks.P[:, 0, 0] + tracks.P[:, 1, 1]
    beyond: Bool = np.sqrt(0.5 * np.maximum(at_tree, 0.0)) - np.sqrt(0.5 * own) > limit
    return beyond if beyond.any() else None
