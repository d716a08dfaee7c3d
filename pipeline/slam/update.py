"""What every particle learns from the detections of one scan: pose, landmarks, weight (Eq. 7)."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Float32, Int, Int32
from pipeline.slam.health import MISSED, MOST_HITS, SHIFT
from pipeline.slam.landmarks import kalman_update, merge_duplicates, remove_gone
from pipeline.slam.proposal import draw, recognise, rotated
from pipeline.visibility import is_in_free_view

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time


@compiled
def observe(
    pose: Float,
    log_weight: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    count: Int32,
    motion: Float,
    motion_covariance: Float,
    noise: Float,
    centre: Float,
    R: Float,
    clear_range: Float,
    first_birth: int,
    use_proposal: bool,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    view_range: float,
    miss: float,
    looks: float,
    merge_gate: float,
    miss_weight: float,
    told: Float,
) -> None:
    """Update every particle in place; shapes as in SlamState.

    Args:
        motion, motion_covariance: Since the last observation, in the frame of each particle.
        noise: Standard normal numbers, shape (P, 3).
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariance, (D, 2, 2).
        clear_range: See FastSlam.process.
        first_birth: Serial number of the first of the detections.
        use_proposal: FastSLAM 2.0; else the pose is drawn before the scan is looked at.
        gate: Largest Mahalanobis distance of an association [sigma].
        distance_max: Largest distance of an association [m].
        hits_to_weigh: Landmarks seen fewer times do not weigh.
        view_range: Landmarks nearer than this can be missed [m].
        miss: What one miss takes from the score.
        looks: A landmark is never known better than by so many independent looks.
        merge_gate: Two landmarks nearer than this are one [sigma].
        miss_weight: What one miss takes from the log weight.
        told: shape (P, TOLD), filled: what each particle tells of the scan (see health).
    """
    detections = centre.shape[0]
    reach = view_range
    for d in range(detections):
        reach = max(reach, np.hypot(centre[d, 0], centre[d, 1]) + distance_max)
    landmark_of = np.empty(detections, np.int64)
    near_room = np.empty(mean.shape[1], np.int64)
    mu = np.empty(3)
    P = np.empty((3, 3))
    before = np.empty(3)
    told[:] = 0.0
    for p in range(pose.shape[0]):
        _predict(pose[p], motion, motion_covariance, mu, P)
        before[:] = mu
        if not use_proposal:
            draw(mu, P, noise[p], pose[p])
            mu[:] = pose[p]
            P[:] = 0.0
        known = count[p]
        near = _in_reach(mean[p, :known], mu, reach, near_room)
        log_weight[p] += recognise(
            mu, P, centre, R, near, mean[p, :known], covariance[p, :known], hits[p, :known],
            gate, distance_max, hits_to_weigh, landmark_of, told[p],
        )  # fmt: skip
        _shift(before, mu, motion[2], told[p])
        if use_proposal:
            draw(mu, P, noise[p], pose[p])
        seen = np.zeros(known, np.bool_)
        count[p] = _learn(
            pose[p], mean[p], covariance[p], hits[p], score[p], birth[p], known, landmark_of,
            centre, R, first_birth, looks, seen,
        )  # fmt: skip
        log_weight[p] -= miss_weight * _miss(
            pose[p], mean[p], hits[p], score[p], near, seen, clear_range, view_range, miss, hits_to_weigh,
            told[p],
        )  # fmt: skip
        merge_duplicates(mean[p], covariance[p], hits[p], score[p], birth[p], near, seen, merge_gate)
        remove_gone(mean[p], covariance[p], hits[p], score[p], birth[p], count, p, near)


@compiled
def _learn(
    pose: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    known: int,
    landmark_of: Int,
    centre: Float,
    R: Float,
    first_birth: int,
    looks: float,
    seen: Bool,
) -> int:
    """Sharpen the landmarks of one particle that were seen, marking them, and begin new ones; returns
    how many there are then."""
    z, R_map = np.empty(2), np.empty(3)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    n = known
    for d in range(centre.shape[0]):
        z[0] = pose[0] + c * centre[d, 0] - s * centre[d, 1]
        z[1] = pose[1] + s * centre[d, 0] + c * centre[d, 1]
        rotated(R[d], c, s, R_map)
        j = landmark_of[d]
        if j >= 0:
            seen[j] = True
            kalman_update(mean[j], covariance[j], z, R_map, looks)
            hits[j] += 1
            score[j] = min(score[j] + 1.0, SCORE_MAX)
        else:
            mean[n], covariance[n] = z, R_map
            hits[n], score[n] = 1, 1.0
            birth[n] = first_birth + d
            n += 1
    return n


@compiled
def _predict(pose: Float, motion: Float, covariance: Float, mu: Float, P: Float) -> None:
    """The pose after the motion, and its covariance in the frame of the map."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    mu[0] = pose[0] + c * motion[0] - s * motion[1]
    mu[1] = pose[1] + s * motion[0] + c * motion[1]
    mu[2] = pose[2] + motion[2]
    # P = C covariance C^T with the rotation C about z; written out, for the library's product of
    # such small matrices costs more than all else here.
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    P[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    P[0, 1] = P[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    P[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    P[0, 2] = P[2, 0] = c * covariance[0, 2] - s * covariance[1, 2]
    P[1, 2] = P[2, 1] = s * covariance[0, 2] + c * covariance[1, 2]
    P[2, 2] = covariance[2, 2]


@compiled
def _miss(
    pose: Float,
    mean: Float,
    hits: Int32,
    score: Float32,
    near: Int,
    seen: Bool,
    clear_range: Float,
    view_range: float,
    miss: float,
    hits_to_weigh: int,
    told: Float,
) -> float:
    """Take from the score of landmarks in free view that were not seen; returns how many well known ones
    there are."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    missed = 0.0
    for j in near:
        if not seen[j] and is_in_free_view(mean[j], pose, c, s, clear_range, view_range):
            score[j] -= miss
            if hits[j] >= hits_to_weigh:
                told[MISSED] += min(float(hits[j]), MOST_HITS)
                missed += 1.0
    return missed


@compiled
def _shift(before: Float, after: Float, turn: float, told: Float) -> None:
    """How far the scan moved a pose, in the frame of the odometry's covariance."""
    c, s = np.cos(before[2] - turn), np.sin(before[2] - turn)
    dx, dy = after[0] - before[0], after[1] - before[1]
    shift = told[SHIFT]
    shift[0] = c * dx + s * dy
    shift[1] = c * dy - s * dx
    shift[2] = (after[2] - before[2] + np.pi) % (2.0 * np.pi) - np.pi


@compiled
def _in_reach(mean: Float, mu: Float, reach: float, room: Int) -> Int:
    """Rows of the landmarks nearer than `reach`, ascending."""
    n = 0
    for j in range(mean.shape[0]):
        dx, dy = mean[j, 0] - mu[0], mean[j, 1] - mu[1]
        if dx * dx + dy * dy <= reach * reach:
            room[n] = j
            n += 1
    return room[:n]
