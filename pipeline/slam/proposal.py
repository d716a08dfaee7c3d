"""Data association and proposal distribution of one particle, in one pass.

FastSLAM 2.0 (Montemerlo et al. 2003) draws the pose from the Gaussian of odometry and scan together: each
recognised landmark corrects this Gaussian before the next one is associated, so that unambiguous detections
help to decide ambiguous ones. FastSLAM 1.0 is the same with a pose that was drawn from the odometry and has
no covariance.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, expected_spread, keep_pose, pose_of, turned
from pipeline.geometry.hash_grid import Cells
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_within
from pipeline.slam.candidate_pairs import LIKELY, Room, fill_levels, find_ambiguous, likely_pairs
from pipeline.slam.joint_association import choose_jointly
from pipeline.slam.scan_statistics import AMBIGUOUS, FOUND, INNOVATION, MOST_HITS, RECOGNISED
from pipeline.types.records import Int, Int32


@compiled_within
def recognise(
    mu: Float,
    P: Float,
    centre: Float,
    R: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    cells: Cells,
    scale: float,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    room: Room,
    statistics: Float,
    p: int,
) -> float:
    """Associate detections with landmarks one to one, correct the pose, and return the log likelihood up to a
    constant, in which each detection without well-known landmark counts like a pair at the gate.

    Pairs are accepted in the order of their likelihood, first those of detections with one likely landmark;
    each pair is tested with the pose that the pairs before it corrected. Ambiguous detections are decided
    together, see `choose_jointly`.

    Args:
        mu, P: Pose before the scan, shape (3,), and its covariance, shape (3, 3); corrected in place.
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Their covariances xx, xy, yy, shape (D, 3) [m^2].
        mean, covariance, hits: Landmarks of this particle, see Maps; rows that are not in `cells` are
            ignored.
        cells: Hash grid of the landmarks.
        scale: Cells per metre.
        gate: Maximum Mahalanobis distance [sigma].
        distance_max: Maximum distance [m].
        hits_to_weigh: Minimum hits of a landmark that affects pose and likelihood.
        room: Work arrays; `landmark_of` is filled with the row of the landmark of each detection, -1 for
            none.
        statistics: Statistics of the scan by particle; row p is filled, except MISSED and SHIFT.
        p: Row of the particle.
    """
    gate2 = gate * gate
    pose = pose_of(mu, P)
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    pairs = likely_pairs(pose, c, s, centre, R, mean, covariance, cells, scale, gate2, distance_max, room)
    ambiguous = find_ambiguous(pairs, centre.shape[0], room)
    log_likelihood, product = 0.0, 1.0
    for turn in range(3 if ambiguous > 0 else 1):  # unambiguous detections, joint decisions, the others
        n = pairs
        if turn == 1:
            n = fill_levels(pairs, room)
            choose_jointly(
                pose, centre, R, mean, covariance, hits, gate2, hits_to_weigh, room.taken, n, room.search
            )
        for i in range(n):
            if turn == 1:
                d, j = room.search.detection[i], room.search.best[i]
                room.ambiguous[d] = False
                if j < 0:
                    continue
            else:
                k = room.order[i]
                d, j = room.detection[k], room.landmark[k]
                if room.landmark_of[d] >= 0 or room.taken[j] or room.ambiguous[d] != (turn == 2):
                    continue
            ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
            S0, S1, S2 = S0 + covariance[j, 0], S1 + covariance[j, 1], S2 + covariance[j, 2]
            y0, y1 = mean[j, 0] - pose.x - ax, mean[j, 1] - pose.y - ay
            det = S0 * S2 - S1 * S1
            d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
            if d2 > gate2:
                continue
            room.landmark_of[d] = j
            room.taken[j] = True
            if hits[j] >= hits_to_weigh:
                log_likelihood -= 0.5 * d2
                product *= det
                if product < 1e-100 or product > 1e100:
                    log_likelihood -= 0.5 * np.log(product)
                    product = 1.0
                statistics[p, INNOVATION] += d2
                statistics[p, RECOGNISED] += 1.0
                statistics[p, FOUND] += min(float(hits[j]), MOST_HITS)
                before = pose.yaw
                pose = corrected(pose, ax, ay, S0, S1, S2, y0, y1)
                c, s = turned(c, s, pose.yaw - before, pose.yaw)
    log_likelihood -= 0.5 * np.log(product)
    for d in range(centre.shape[0]):
        if room.second[d] - room.best[d] < LIKELY:
            statistics[p, AMBIGUOUS] += 1.0
    keep_pose(pose, mu, P)
    cost = _cost_of_new(pose, centre, R, hits, room.landmark_of, hits_to_weigh, gate2)
    return float(log_likelihood) - cost


@compiled_within
def _cost_of_new(
    pose: Pose,
    centre: Float,
    R: Float,
    hits: Int32,
    landmark_of: Int,
    hits_to_weigh: int,
    gate2: float,
) -> float:
    """Return the decrease of the log likelihood by detections without a well-known landmark. Each counts like
    a pair at the gate; otherwise particles that recognise nothing would get the largest weights.

    Args:
        pose: Pose of the particle with its covariance.
        centre, R: Detections in the base frame, shape (D, 2) [m], and covariances xx, xy, yy, shape (D, 3).
        hits: Hits of its landmarks.
        landmark_of: Row of the landmark of each detection, -1 for none.
        hits_to_weigh: Least hits of a well-known landmark.
        gate2: Square of the gate.
    """
    c, s, cost = 0.0, 0.0, 0.0
    for d in range(centre.shape[0]):
        if landmark_of[d] < 0 or hits[landmark_of[d]] < hits_to_weigh:
            if (
                c == 0.0 and s == 0.0
            ):  # computed at the first such detection, because most particles have none
                c, s = np.cos(pose.yaw), np.sin(pose.yaw)
            ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
            cost += 0.5 * (gate2 + np.log(S0 * S2 - S1 * S1))
    return cost
