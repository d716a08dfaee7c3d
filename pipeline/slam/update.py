"""What one particle learns from the detections of one scan: association, landmarks, weight (Eq. 7)."""

from __future__ import annotations

import numpy as np

from pipeline.association import associate
from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Float32, Int32
from pipeline.visibility import in_free_view

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time
VARIANCE_MIN = 1e-4  # m^2; views of one trunk share an error of about a centimetre


@compiled
def observe(
    pose: Float,
    log_weight: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    count: Int32,
    centre: Float,
    R: Float,
    clear_range: Float,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    view_range: float,
    miss: float,
) -> None:
    """Update every particle in place; shapes as in SlamState.

    Args:
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance, (D, 2, 2).
        clear_range: See FastSlam.process.
        gate: Largest Mahalanobis distance of an association [sigma].
        distance_max: Largest distance of an association [m].
        hits_to_weigh: Landmarks seen fewer times do not weigh.
        view_range: Landmarks nearer than this can be missed [m].
        miss: What one miss takes from the score.
    """
    detections = centre.shape[0]
    world = np.empty((detections, 2))
    world_R = np.empty((detections, 3))
    for p in range(pose.shape[0]):
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        for d in range(detections):
            x, y = centre[d, 0], centre[d, 1]
            world[d, 0], world[d, 1] = pose[p, 0] + c * x - s * y, pose[p, 1] + s * x + c * y
            xx, xy, yy = R[d, 0, 0], R[d, 0, 1], R[d, 1, 1]
            world_R[d, 0] = c * c * xx - 2 * c * s * xy + s * s * yy
            world_R[d, 1] = c * s * (xx - yy) + (c * c - s * s) * xy
            world_R[d, 2] = s * s * xx + 2 * c * s * xy + c * c * yy
        known = count[p]
        landmark_of, distance2 = associate(
            world, world_R, mean[p, :known], covariance[p, :known], gate, distance_max
        )
        seen = np.zeros(known, np.bool_)
        for d in range(detections):
            j = landmark_of[d]
            if j >= 0 and hits[p, j] >= hits_to_weigh:
                S = covariance[p, j] + world_R[d]
                log_weight[p] -= 0.5 * (distance2[d] + np.log(S[0] * S[2] - S[1] * S[1]))
            else:
                # A new tree is as likely as one at the gate, else particles that recognise nothing win.
                det = world_R[d, 0] * world_R[d, 2] - world_R[d, 1] ** 2
                log_weight[p] -= 0.5 * (gate * gate + np.log(det))
            if j >= 0:
                seen[j] = True
                kalman_update(mean[p, j], covariance[p, j], world[d], world_R[d])
                hits[p, j] += 1
                score[p, j] = min(score[p, j] + 1.0, SCORE_MAX)
            else:
                n = count[p]
                mean[p, n] = world[d]
                covariance[p, n] = world_R[d]
                hits[p, n] = 1
                score[p, n] = 1.0
                count[p] = n + 1
        free = in_free_view(mean[p, :known], pose[p], clear_range, view_range)
        for j in range(known):
            if free[j] and not seen[j]:
                score[p, j] -= miss
        _remove_gone(mean[p], covariance[p], hits[p], score[p], count, p, known)


@compiled
def kalman_update(m: Float, Sigma: Float, z: Float, R: Float) -> None:
    """m, Sigma of a resting landmark after measuring its position z with covariance R (xx, xy, yy)."""
    a, b, d = Sigma[0] + R[0], Sigma[1] + R[1], Sigma[2] + R[2]  # S = Sigma + R, H = I
    det = a * d - b * b
    k00 = (Sigma[0] * d - Sigma[1] * b) / det  # K = Sigma S^-1
    k01 = (Sigma[1] * a - Sigma[0] * b) / det
    k10 = (Sigma[1] * d - Sigma[2] * b) / det
    k11 = (Sigma[2] * a - Sigma[1] * b) / det
    y0, y1 = z[0] - m[0], z[1] - m[1]
    m[0] += k00 * y0 + k01 * y1
    m[1] += k10 * y0 + k11 * y1
    # K R is (I - K) Sigma for K = Sigma S^-1, and stays positive in floating point.
    xx = k00 * R[0] + k01 * R[1]
    xy = 0.5 * (k00 * R[1] + k01 * R[2] + k10 * R[0] + k11 * R[1])
    yy = k10 * R[1] + k11 * R[2]
    Sigma[0], Sigma[1], Sigma[2] = max(xx, VARIANCE_MIN), xy, max(yy, VARIANCE_MIN)


@compiled
def _remove_gone(
    mean: Float, covariance: Float, hits: Int32, score: Float32, count: Int32, p: int, known: int
) -> None:
    for j in range(known - 1, -1, -1):
        if score[j] <= 0.0:
            last = count[p] - 1
            mean[j], covariance[j] = mean[last], covariance[last]
            hits[j], score[j] = hits[last], score[last]
            count[p] = last
