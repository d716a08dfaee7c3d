"""Joint data association of the ambiguous detections of one particle.

Where trees are closer to each other than the pose is known, the most likely pair of a detection may be wrong;
it then shifts the pose, and the next detection has no landmark. The pairs of one scan share the error of the
pose, so that only one assignment explains all of them (joint compatibility; Neira, Tardos 2001). Branch and
bound over all one-to-one assignments finds the most likely one, with

-2 log p(z | assignment) = sum_i d_i^2 + log |S_i|,  d_i and S_i given the pairs before i,

where a detection without landmark counts like a pair at the gate. The search is limited to MOST detections.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, expected_spread, rotated
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_borrowing
from pipeline.types.records import Bool, Int, Int32

MOST = 8  # maximum number of detections
CHOICES = 4  # maximum number of landmarks per detection
MOST_STEPS = 512  # maximum number of steps; then the best assignment so far is the result


class JointSearch(NamedTuple):
    """Work arrays of the search, allocated once per scan. Each level is one ambiguous detection; costs are
    -2 log likelihoods.

    Attributes:
        detection: Detection of each level, lowest cost first, int64, shape (MOST,).
        choices: Number of landmarks of each level, int64, shape (MOST,).
        landmark: Rows of the landmarks of each level, lowest cost first, int64, shape (MOST, CHOICES).
        new: Cost of a detection without landmark, shape (MOST,).
        least: Lower bound of the cost of this level and all later ones, shape (MOST + 1,).
        cost: Cost of all earlier levels, shape (MOST + 1,).
        pose: Pose before each level, see `_write_pose`, shape (MOST + 1, 9).
        next: Next choice of each level, int64, shape (MOST,).
        chosen: Landmark of each level in the present assignment, -1 for none, int64, shape (MOST,).
        best: Landmark of each level in the best assignment, -1 for none, int64, shape (MOST,).
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


def search_for() -> JointSearch:
    """Return uninitialised work arrays for a search."""
    return JointSearch(
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
    """Return ax, ay, y0, y1, S0, S1, S2 for detection d and landmark j, in the frame of the map: vector from
    the robot to the detection [m], innovation [m], and its covariance xx, xy, yy [m^2].

    Args:
        pose: Pose of the robot with its covariance.
        c, s: Cosine and sine of the yaw of the pose.
        centre, R: Detections in the base frame, shape (D, 2) [m], and covariances, shape (D, 3).
        d: Row of the detection.
        mean, covariance: Landmarks, shape (L, 2) [m], and covariances, shape (L, 3).
        j: Row of the landmark.
    """
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
    search: JointSearch,
) -> float:
    """Find the assignment with the highest likelihood of the detections of n levels, and write it to
    `search.best` (-1 for a detection without landmark, which counts like a pair at the gate); return its -2
    log likelihood. After MOST_STEPS steps the best assignment so far is the result; n = 0 gives 0.

    Args:
        pose: Pose by the odometry and the pairs that were accepted before.
        centre, R, mean, covariance, hits, hits_to_weigh: See `proposal.recognise`.
        gate2: Square of the maximum Mahalanobis distance.
        taken: Landmarks that are no choices, shape (L,); unchanged on return.
        n: Number of levels.
        search: Work arrays with `detection`, `choices` and `landmark` of n levels.
    """
    _fill_bounds(pose, centre, R, covariance, gate2, n, search)
    least, steps, level = np.inf, 0, 0
    for i in range(n):
        search.best[i] = -1
    _write_pose(pose, search.pose, 0)
    search.cost[0], search.next[0], search.chosen[0] = 0.0, 0, -1
    while level >= 0:
        if level == n:
            least = search.cost[n]
            for i in range(n):
                search.best[i] = search.chosen[i]
            level -= 1
            continue
        if search.chosen[level] >= 0:
            taken[search.chosen[level]] = False
            search.chosen[level] = -1
        choice = search.next[level]
        if choice > search.choices[level]:
            level -= 1
            continue
        search.next[level] += 1
        if steps >= MOST_STEPS and least < np.inf:
            search.next[level] = CHOICES + 1
            continue
        if _accept(
            level, choice, centre, R, mean, covariance, hits, gate2, hits_to_weigh, taken, least, search
        ):
            steps += 1
            level += 1
            if level < n:
                search.next[level], search.chosen[level] = 0, -1
    return float(least)


@compiled_borrowing
def _accept(
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
    search: JointSearch,
) -> bool:
    """Accept a choice of a level: mark its landmark as taken and chosen, and write cost and pose of the next
    level; return True. Return False, without a change, if the landmark is taken, the pair is outside the
    gate, or the cost cannot fall below `least`.

    Args:
        level: Level of the search, which decides about one detection.
        choice: Index in `search.landmark[level]`; `search.choices[level]` means no landmark.
        centre, R, mean, covariance: See `innovation`.
        hits: Hits of the landmarks, int32, shape (L,).
        gate2: Square of the gate.
        hits_to_weigh: Minimum number of hits of a landmark that corrects the pose.
        taken: Whether a landmark is taken, shape (L,).
        least: Cost of the best assignment so far.
        search: The search.
    """
    pose = _read_pose(search.pose, level)
    if choice == search.choices[level]:
        cost = search.cost[level] + search.new[level]
        if not cost + search.least[level + 1] < least:
            return False
    else:
        j = search.landmark[level, choice]
        if taken[j]:
            return False
        c, s = np.cos(pose.yaw), np.sin(pose.yaw)
        d = search.detection[level]
        ax, ay, y0, y1, S0, S1, S2 = innovation(pose, c, s, centre, R, d, mean, covariance, j)
        det = S0 * S2 - S1 * S1
        d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
        cost = search.cost[level] + d2 + np.log(det)
        if not (d2 <= gate2 and cost + search.least[level + 1] < least):
            return False
        taken[j] = True
        search.chosen[level] = j
        if hits[j] >= hits_to_weigh:
            pose = corrected(pose, ax, ay, S0, S1, S2, y0, y1)
    search.cost[level + 1] = cost
    _write_pose(pose, search.pose, level + 1)
    return True


@compiled_borrowing
def _fill_bounds(
    pose: Pose, centre: Float, R: Float, covariance: Float, gate2: float, n: int, search: JointSearch
) -> None:
    """Fill `new` and `least` of the first n levels. The lower bounds hold for a pose without covariance.

    Args:
        pose: Pose of the robot with its covariance.
        centre, R: See `innovation`.
        covariance: Covariances of the landmarks, shape (L, 3).
        gate2: Square of the gate.
        n: Number of levels.
        search: The search.
    """
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    search.least[n] = 0.0
    for i in range(n - 1, -1, -1):
        d = search.detection[i]
        ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        S0, S1, S2 = expected_spread(pose, c, s, ax, ay, R, d)
        search.new[i] = gate2 + np.log(S0 * S2 - S1 * S1)
        # The pose may turn during the search; the bound of the determinant holds for all angles.
        R0, R1, R2 = rotated(R, d, c, s)
        lowest = search.new[i]
        for k in range(search.choices[i]):
            j = search.landmark[i, k]
            lowest = min(lowest, _log_det_least(R0, R1, R2, covariance, j))
        search.least[i] = search.least[i + 1] + lowest


@compiled_borrowing
def _log_det_least(R0: float, R1: float, R2: float, covariance: Float, j: int) -> float:
    """Return a lower bound of log |C R C^T + Sigma_j| over all rotations C: |A + B|^(1/2) >= |A|^(1/2) +
    |B|^(1/2) (Minkowski), where rotations do not change |A| and |B|. R0, R1, R2 are xx, xy, yy of R;
    `covariance` contains xx, xy, yy of each landmark, shape (L, 3), and j is a row of it."""
    Sigma = covariance[j, 0] * covariance[j, 2] - covariance[j, 1] * covariance[j, 1]
    both = np.sqrt(max(R0 * R2 - R1 * R1, 0.0)) + np.sqrt(max(Sigma, 0.0))
    return float(2.0 * np.log(both))


@compiled_borrowing
def _write_pose(pose: Pose, rows: Float, i: int) -> None:
    """Write mean and covariance of a pose into row i, shape (9,), in the order of the fields of `Pose`."""
    rows[i, 0], rows[i, 1], rows[i, 2] = pose.x, pose.y, pose.yaw
    rows[i, 3], rows[i, 4], rows[i, 5] = pose.xx, pose.xy, pose.xt
    rows[i, 6], rows[i, 7], rows[i, 8] = pose.yy, pose.yt, pose.tt


@compiled_borrowing
def _read_pose(rows: Float, i: int) -> Pose:
    """Return the pose of row i, see `_write_pose`."""
    return Pose(
        rows[i, 0], rows[i, 1], rows[i, 2],
        rows[i, 3], rows[i, 4], rows[i, 5],
        rows[i, 6], rows[i, 7], rows[i, 8],
    )  # fmt: skip
