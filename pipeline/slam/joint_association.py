"""Detections that could each be of more than one landmark are decided together, for one particle.

Taken one by one the likeliest pair may be a wrong one, where trees stand closer than the pose is known: it
then bends the pose, and its neighbour finds nothing. The pairs of one scan share the error of the pose, so
what they say together tells (joint compatibility; Neira, Tardos 2001). Branch and bound over all one-to-one
choices finds the likeliest, the log likelihood being taken pair by pair,

-2 log p(z | choice) = sum_i d_i^2 + log |S_i|,  d_i and S_i given the pairs before i,

and a detection of no landmark counting like one at the gate. Only doubtful detections get here, a few at
a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, expected_spread, rotated
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Bool, Int, Int32

MOST = 8  # detections at a time
CHOICES = 4  # landmarks a detection, the likeliest
MOST_STEPS = 512  # of the search; then the best so far holds, which is never worse than the first descent


class Doubts(NamedTuple):
    """Memory for the search, taken once a scan; rows are levels, a doubtful detection each.

    Attributes:
        detection: int64, shape (MOST,), the surest first; choices: int64, shape (MOST,), how many landmarks
            it has.
        landmark: int64, shape (MOST, CHOICES), the likeliest first, judged alone.
        new: shape (MOST,), what no landmark costs; least: shape (MOST + 1,), what this level and those
            behind it cost at the least.
        cost: shape (MOST + 1,), and pose: shape (MOST + 1, 9), before each level.
        next: int64, shape (MOST,), the choice to be tried; chosen, best: int64, shape (MOST,), landmark
            or -1.
    """

    detection: Int
    choices: Int
    landmark: Int
    new: Float
    least: Float
    cost: Float
    pose: Float
    next: Int
    chosen: Int
    best: Int


@compiled
def doubts_for() -> Doubts:
    """Room for one search."""
    return Doubts(
        np.empty(MOST, np.int64),
        np.empty(MOST, np.int64),
        np.empty((MOST, CHOICES), np.int64),
        np.empty(MOST),
        np.empty(MOST + 1),
        np.empty(MOST + 1),
        np.empty((MOST + 1, 9)),
        np.empty(MOST, np.int64),
        np.empty(MOST, np.int64),
        np.empty(MOST, np.int64),
    )


@compiled_borrowing
def innovation(
    pose: Pose, c: float, s: float, centre: Float, R: Float, d: int, mean: Float, covariance: Float, j: int
) -> tuple[float, float, float, float, float, float, float]:
    """Detection d as landmark j: where it lies from the robot, ax and ay, the innovation y0 and y1, and its
    covariance S as xx, xy, yy, all in the frame of the map."""
    ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
    S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
    return (
        ax,
        ay,
        mean[j, 0] - pose.x - ax,
        mean[j, 1] - pose.y - ay,
        S0 + covariance[j, 0],
        S1 + covariance[j, 1],
        S2 + covariance[j, 2],
    )


@compiled_borrowing
def choose_jointly(
    pose: Pose,
    centre: Float,
    R: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    gate2: float,
    hits_to_weigh: int,
    taken: Bool,
    n: int,
    doubts: Doubts,
) -> float:
    """Fill `best` of the first n levels, whose detections and landmarks stand in `doubts`; -2 log likelihood.

    Args:
        pose: By the odometry and the pairs that were taken before.
        centre, R, mean, covariance, hits, gate2, hits_to_weigh: See `proposal.recognise`.
        taken: shape (L,): landmarks that are none of the choices; as it was when this returns.
    """
    _price(pose, centre, R, covariance, gate2, n, doubts)
    least, steps, level = np.inf, 0, 0
    for i in range(n):
        doubts.best[i] = -1
    _keep(pose, doubts.pose, 0)
    doubts.cost[0], doubts.next[0], doubts.chosen[0] = 0.0, 0, -1
    while level >= 0:
        if level == n:
            least = doubts.cost[n]
            for i in range(n):
                doubts.best[i] = doubts.chosen[i]
            level -= 1
            continue
        if doubts.chosen[level] >= 0:
            taken[doubts.chosen[level]] = False
            doubts.chosen[level] = -1
        choice = doubts.next[level]
        if choice > doubts.choices[level]:
            level -= 1
            continue
        doubts.next[level] += 1
        if steps >= MOST_STEPS and least < np.inf:
            doubts.next[level] = CHOICES + 1
            continue
        if _descended(
            level, choice, centre, R, mean, covariance, hits, gate2, hits_to_weigh, taken, least, doubts
        ):
            steps += 1
            level += 1
            if level < n:
                doubts.next[level], doubts.chosen[level] = 0, -1
    return float(least)


@compiled_borrowing
def _descended(
    level: int,
    choice: int,
    centre: Float,
    R: Float,
    mean: Float,
    covariance: Float,
    hits: Int32,
    gate2: float,
    hits_to_weigh: int,
    taken: Bool,
    least: float,
    doubts: Doubts,
) -> bool:
    """Take a choice of a level and prepare the next one; not where it is forbidden or cannot be the best."""
    pose = _kept(doubts.pose, level)
    if choice == doubts.choices[level]:
        cost = doubts.cost[level] + doubts.new[level]
        if not cost + doubts.least[level + 1] < least:
            return False
    else:
        j = doubts.landmark[level, choice]
        if taken[j]:
            return False
        c, s = np.cos(pose.yaw), np.sin(pose.yaw)
        d = doubts.detection[level]
        ax, ay, y0, y1, S0, S1, S2 = innovation(pose, c, s, centre, R, d, mean, covariance, j)
        det = S0 * S2 - S1 * S1
        d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
        cost = doubts.cost[level] + d2 + np.log(det)
        if not (d2 <= gate2 and cost + doubts.least[level + 1] < least):
            return False
        taken[j] = True
        doubts.chosen[level] = j
        if hits[j] >= hits_to_weigh:
            pose = corrected(pose, ax, ay, S0, S1, S2, y0, y1)
    doubts.cost[level + 1] = cost
    _keep(pose, doubts.pose, level + 1)
    return True


@compiled_borrowing
def _price(
    pose: Pose, centre: Float, R: Float, covariance: Float, gate2: float, n: int, doubts: Doubts
) -> None:
    """What each level costs without a landmark, and at the least: with a pose that is known exactly."""
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    doubts.least[n] = 0.0
    for i in range(n - 1, -1, -1):
        d = doubts.detection[i]
        ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
        doubts.new[i] = gate2 + np.log(S0 * S2 - S1 * S1)
        # The matrices turn by little with the pose; what is left without a turn bounds the determinant.
        R0, R1, R2 = rotated(R, d, c, s)
        lowest = doubts.new[i]
        for k in range(doubts.choices[i]):
            j = doubts.landmark[i, k]
            lowest = min(lowest, _log_det_least(R0, R1, R2, covariance, j))
        doubts.least[i] = doubts.least[i + 1] + lowest


@compiled_borrowing
def _log_det_least(R0: float, R1: float, R2: float, covariance: Float, j: int) -> float:
    """Lower bound of log |C R C^T + Sigma_j| over all turns C: |A + B|^(1/2) >= |A|^(1/2) + |B|^(1/2)
    (Minkowski), whose determinants no turn changes."""
    Sigma = covariance[j, 0] * covariance[j, 2] - covariance[j, 1] * covariance[j, 1]
    both = np.sqrt(max(R0 * R2 - R1 * R1, 0.0)) + np.sqrt(max(Sigma, 0.0))
    return float(2.0 * np.log(both))


@compiled_borrowing
def _keep(pose: Pose, rows: Float, i: int) -> None:
    rows[i, 0], rows[i, 1], rows[i, 2] = pose.x, pose.y, pose.yaw
    rows[i, 3], rows[i, 4], rows[i, 5] = pose.xx, pose.xy, pose.xt
    rows[i, 6], rows[i, 7], rows[i, 8] = pose.yy, pose.yt, pose.tt


@compiled_borrowing
def _kept(rows: Float, i: int) -> Pose:
    return Pose(
        rows[i, 0], rows[i, 1], rows[i, 2],
        rows[i, 3], rows[i, 4], rows[i, 5],
        rows[i, 6], rows[i, 7], rows[i, 8],
    )  # fmt: skip
