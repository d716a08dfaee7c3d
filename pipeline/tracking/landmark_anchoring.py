"""The map held to SLAM's: trees stand where the best particle has them.

A particle that closes a loop brings a map of its own. Trees that disagree with it are moved, and a
tree that it does not know is missed, so that what an abandoned hypothesis left behind goes.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.association import associate
from pipeline.tracking.assignment import by_pose
from pipeline.tracking.miss_suppression import beyond_doubt
from pipeline.tracking.track_table import Rows
from pipeline.tracking.tracking_inputs import Limits, Sight
from pipeline.types.records import Bool, Int

AGREE = 3.0  # sigma; nearer than this, tree and landmark tell the same


@compiled
def anchor(rows: Rows, count: int, sight: Sight, landmarks: Float, covariance: Float, limits: Limits) -> None:
    """Move the trees in reach that disagree with their landmark, and miss those without one, but for those
    that the robot may look for at a wrong place.

    Args:
        rows: The first `count` are trees, which change in place; nothing is removed.
        sight: Trees farther away than its view range are left alone.
        landmarks: shape (L, 2) [m]; covariance: xx, xy, yy, shape (L, 3) [m^2].
        limits: A landmark farther from a tree than `distance_max` is another tree's.
    """
    near, place, spread = np.empty(count, np.int64), np.empty((count, 2)), np.empty((count, 3))
    n = _gather(rows, count, sight, near, place, spread)
    landmark_of, distance2 = associate(
        place[:n], spread[:n], landmarks, covariance, np.inf, limits.distance_max
    )
    spared = beyond_doubt(
        rows.x[:count], rows.P[:count], sight.pose, sight.covariance, limits.distance_max, sight.view_range
    )
    _move(rows, sight, near, landmark_of, distance2, spared, landmarks, covariance, limits.miss)


@compiled_borrowing
def _gather(rows: Rows, count: int, sight: Sight, near: Int, place: Float, spread: Float) -> int:
    """Rows of the trees in reach, their places, and how far each may lie from its landmark; their number."""
    x, P, shared, here = rows.x, rows.P, rows.shared, sight.pose
    n = 0
    for t in range(count):
        dx, dy = x[t, 0] - here[0], x[t, 1] - here[1]
        if dx * dx + dy * dy < sight.view_range * sight.view_range:
            near[n] = t
            place[n, 0], place[n, 1] = x[t, 0], x[t, 1]
            # What tree and landmark share with the frame of the map is no reason to disagree.
            of_pose = by_pose(dx, dy, sight.relative)
            spread[n, 0] = P[t, 0, 0] - shared[t, 0, 0] + of_pose[0]
            spread[n, 1] = P[t, 0, 1] - shared[t, 0, 1] + of_pose[1]
            spread[n, 2] = P[t, 1, 1] - shared[t, 1, 1] + of_pose[2]
            n += 1
    return n


@compiled_borrowing
def _move(
    rows: Rows,
    sight: Sight,
    near: Int,
    landmark_of: Int,
    distance2: Float,
    spared: Bool,
    landmarks: Float,
    covariance: Float,
    miss: float,
) -> None:
    x, P, shared, here = rows.x, rows.P, rows.shared, sight.pose
    for k in range(landmark_of.shape[0]):
        t, landmark = near[k], landmark_of[k]
        if landmark < 0:
            if not spared[t]:
                rows.score[t] -= miss
        elif distance2[k] > AGREE * AGREE:
            C = covariance[landmark]
            x[t, 0], x[t, 1] = landmarks[landmark, 0], landmarks[landmark, 1]
            # The landmark is known from here, so what is shared now is the error of the pose of now.
            B = by_pose(x[t, 0] - here[0], x[t, 1] - here[1], sight.covariance)
            shared[t, 0, 0], shared[t, 0, 1], shared[t, 1, 0], shared[t, 1, 1] = B[0], B[1], B[1], B[2]
            P[t, 0, 0], P[t, 1, 1] = C[0] + B[0], C[2] + B[2]
            P[t, 0, 1] = P[t, 1, 0] = C[1] + B[1]
            # What the old place told of the velocity, the landmark's place does not.
            for a in range(2):
                for b in range(2, 4):
                    P[t, a, b] = P[t, b, a] = 0.0
