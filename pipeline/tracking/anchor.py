"""The map held to SLAM's: trees stand where the best particle has them.

A particle that closes a loop brings a map of its own. Trees that disagree with it are moved, and a
tree that it does not know is missed, so that what an abandoned hypothesis left behind goes.
"""

from __future__ import annotations

import numpy as np

from pipeline.association import associate
from pipeline.geometry import Float, Pose2
from pipeline.tracking.table import TrackTable

AGREE = 3.0  # sigma; nearer than this, tree and landmark tell the same


def anchor(
    tracks: TrackTable,
    landmarks: Float,
    covariance: Float,
    T_map_base: Pose2,
    reach: float,
    distance_max: float,
    miss: float,
) -> None:
    """Move the trees in reach that disagree with their landmark, and miss those without one.

    Args:
        tracks: Changed in place; nothing is removed.
        landmarks: shape (L, 2) [m]; covariance: xx, xy, yy, shape (L, 3) [m^2].
        T_map_base: Where the robot is; reach: trees farther from it are left alone [m].
        distance_max: A landmark farther from a tree than this is another tree's [m].
        miss: What a tree without a landmark loses of its score.
    """
    rows = np.flatnonzero(np.hypot(tracks.x[:, 0] - T_map_base.x, tracks.x[:, 1] - T_map_base.y) < reach)
    P = tracks.P[:, [0, 0, 1], [0, 1, 1]][rows]
    landmark_of, distance2 = associate(tracks.x[rows, :2], P, landmarks, covariance, np.inf, distance_max)
    tracks.score[rows[landmark_of < 0]] -= miss
    moved = (landmark_of >= 0) & (distance2 > AGREE * AGREE)
    to, of = rows[moved], landmark_of[moved]
    tracks.x[to, :2] = landmarks[of]
    tracks.P[to, :2, :2] = covariance[of][:, [[0, 1], [1, 2]]]
