"""Where one particle stands after a scan: association and proposal in one pass.

FastSLAM 2.0 (Montemerlo et al. 2003) draws the pose from what odometry and scan say together:
each recognised landmark corrects the Gaussian of the pose before the next one is looked for, so
that the sure ones help to decide the doubtful ones. FastSLAM 1.0 is the same with a pose that was
drawn from the odometry alone and has no spread left.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, expected_spread, keep_pose, pose_of, turned
from pipeline.geometry.hash_grid import Cells
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_within
from pipeline.slam.candidate_pairs import LIKELY, Room, find_doubts, gather_doubts, likely_pairs
from pipeline.slam.joint_association import choose_jointly
from pipeline.slam.scan_statistics import AMBIGUOUS as DOUBTFUL
from pipeline.slam.scan_statistics import FOUND, INNOVATION, MOST_HITS, RECOGNISED
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
    told: Float,
    p: int,
) -> float:
    """Find the landmark of each detection, one to one, correct the pose, and weigh.

    Pairs are taken by falling likelihood, first those of detections with one likely landmark; each
    one is judged with the pose that the pairs before it left. Close choices are decided together
    (see joint_choice).

    Args:
        mu, P: The pose before the scan and its covariance; corrected in place.
        centre: shape (D, 2) [m], base frame; R: xx, xy, yy, shape (D, 3).
        mean, covariance, hits: Their first rows are the landmarks in reach of this particle.
        cells: Hold them, `scale` a metre.
        gate: Largest Mahalanobis distance [sigma]; distance_max: largest distance [m].
        hits_to_weigh: Landmarks seen fewer times neither correct nor weigh.
        room: Its `landmark_of` is filled.
        told: Row p is filled as far as the detections say (see health).

    Returns:
        Log likelihood of the detections.
    """
    gate2 = gate * gate
    pose = pose_of(mu, P)
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    pairs = likely_pairs(pose, c, s, centre, R, mean, covariance, cells, scale, gate2, distance_max, room)
    doubtful = find_doubts(pairs, centre.shape[0], room)
    log_likelihood, product = 0.0, 1.0
    for turn in range(3 if doubtful > 0 else 1):  # the sure ones, those decided together, the rest
        n = pairs
        if turn == 1:
            n = gather_doubts(pairs, room)
            choose_jointly(
                pose, centre, R, mean, covariance, hits, gate2, hits_to_weigh, room.taken, n, room.doubts
            )
        for i in range(n):
            if turn == 1:
                d, j = room.doubts.detection[i], room.doubts.best[i]
                room.doubt[d] = False
                if j < 0:
                    continue
            else:
                k = room.order[i]
                d, j = room.detection[k], room.landmark[k]
                if room.landmark_of[d] >= 0 or room.taken[j] or room.doubt[d] != (turn == 2):
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
                told[p, INNOVATION] += d2
                told[p, RECOGNISED] += 1.0
                told[p, FOUND] += min(float(hits[j]), MOST_HITS)
                before = pose.yaw
                pose = corrected(pose, ax, ay, S0, S1, S2, y0, y1)
                c, s = turned(c, s, pose.yaw - before, pose.yaw)
    log_likelihood -= 0.5 * np.log(product)
    for d in range(centre.shape[0]):
        if room.second[d] - room.best[d] < LIKELY:
            told[p, DOUBTFUL] += 1.0
    keep_pose(pose, mu, P)
    price = _price_of_new(pose, centre, R, hits, room.landmark_of, hits_to_weigh, gate2)
    return float(log_likelihood) - price


@compiled_within
def _price_of_new(
    pose: Pose,
    centre: Float,
    R: Float,
    hits: Int32,
    landmark_of: Int,
    hits_to_weigh: int,
    gate2: float,
) -> float:
    """What detections of no well known landmark take from the log likelihood: a new tree is as likely as
    one at the gate, else particles that recognise nothing win."""
    c, s, price = 0.0, 0.0, 0.0
    for d in range(centre.shape[0]):
        if landmark_of[d] < 0 or hits[landmark_of[d]] < hits_to_weigh:
            if c == 0.0 and s == 0.0:  # most particles know all that they see, and need neither
                c, s = np.cos(pose.yaw), np.sin(pose.yaw)
            ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
            price += 0.5 * (gate2 + np.log(S0 * S2 - S1 * S1))
    return price
