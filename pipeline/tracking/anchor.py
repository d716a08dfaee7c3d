"""The map held to SLAM's: trees stand where the best particle has them.

A particle that closes a loop brings a map of its own. Trees that disagree with it are moved, and a
tree that it does not know is missed, so that what an abandoned hypothesis left behind goes.
"""

from __future__ import annotations

import numpy as np

from pipeline.association import associate
from pipeline.compiled import compiled
from pipeline.geometry import Float, Pose2
from pipeline.tracking.assignment import by_pose
from pipeline.tracking.table import TrackTable

AGREE = 3.0  # sigma; nearer than this, tree and landmark tell the same


def anchor(
    tracks: TrackTable,
    landmarks: Float,
    covariance: Float,
    T_map_base: Pose2,
    pose_covariance: Float,
    relative: Float,
    reach: float,
    distance_max: float,
    miss: float,
) -> None:
    """Move the trees in reach that disagree with their landmark, and miss those without one.

    Args:
        tracks: Changed in place; nothing is removed.
        landmarks: shape (L, 2) [m]; covariance: xx, xy, yy, shape (L, 3) [m^2].
        T_map_base: Where the robot is; pose_covariance: of it, shape (3, 3); relative:
            with respect to the landmarks around.
        reach: trees farther from it are left alone [m].
        distance_max: A landmark farther from a tree than this is another tree's [m].
        miss: What a tree without a landmark loses of its score.
    """
    here = T_map_base.as_array()
    _anchor(
        tracks.x, tracks.P, tracks.shared, tracks.score, landmarks, covariance, here, pose_covariance,
        relative, reach, distance_max, miss,
    )  # fmt: skip


@compiled
def _anchor(
    x: Float,
    P: Float,
    shared: Float,
    score: Float,
    landmarks: Float,
    covariance: Float,
    here: Float,
    pose_covariance: Float,
    relative: Float,
    reach: float,
    distance_max: float,
    miss: float,
) -> None:
    rows, place, spread = np.empty(len(x), np.int64), np.empty((len(x), 2)), np.empty((len(x), 3))
    n = 0
    for t in range(len(x)):
        dx, dy = x[t, 0] - here[0], x[t, 1] - here[1]
        if dx * dx + dy * dy < reach * reach:
            rows[n] = t
            place[n, 0], place[n, 1] = x[t, 0], x[t, 1]
            # What tree and landmark share with the frame of the map is no reason to disagree.
            of_pose = by_pose(dx, dy, relative)
            spread[n, 0] = P[t, 0, 0] - shared[t, 0, 0] + of_pose[0]
            spread[n, 1] = P[t, 0, 1] - shared[t, 0, 1] + of_pose[1]
            spread[n, 2] = P[t, 1, 1] - shared[t, 1, 1] + of_pose[2]
            n += 1
    landmark_of, distance2 = associate(place[:n], spread[:n], landmarks, covariance, np.inf, distance_max)
    for k in range(n):
        t, landmark = rows[k], landmark_of[k]
        if landmark < 0:
            score[t] -= miss
        elif distance2[k] > AGREE * AGREE:
            C = covariance[landmark]
            x[t, 0], x[t, 1] = landmarks[landmark, 0], landmarks[landmark, 1]
            # The landmark is known from here, so what is shared now is the error of the pose of now.
            B = by_pose(x[t, 0] - here[0], x[t, 1] - here[1], pose_covariance)
            shared[t, 0, 0], shared[t, 0, 1], shared[t, 1, 0], shared[t, 1, 1] = B[0], B[1], B[1], B[2]
            P[t, 0, 0], P[t, 1, 1] = C[0] + B[0], C[2] + B[2]
            P[t, 0, 1] = P[t, 1, 0] = C[1] + B[1]
            # What the old place told of the velocity, the landmark's place does not.
            P[t, :2, 2:] = 0.0
            P[t, 2:, :2] = 0.0
