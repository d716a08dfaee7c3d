"""Data association and proposal distribution of one particle, in one pass.

The pairs of detections and landmarks within the gate are collected, most likely first. FastSLAM 2.0
(Montemerlo et al. 2003) draws the pose from the Gaussian of odometry and scan together: each recognised
landmark corrects this Gaussian before the next one is associated, so that unambiguous detections help to
decide ambiguous ones. FastSLAM 1.0 is the same with a pose that was drawn from the odometry and has no
covariance. The kernels run for each particle of each scan and allocate no memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, corrected, expected_spread, keep_pose, pose_of, turned
from pipeline.geometry.hash_grid import Cells, cell_of, first_of_four
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_borrowing
from pipeline.slam.joint_association import CHOICES, MOST, JointSearch, choose_jointly, search_for
from pipeline.slam.pose_quality import AMBIGUOUS, FOUND, INNOVATION, MOST_HITS, RECOGNISED
from pipeline.types.records import Bool, Int, Int32

FEW = 64  # rows that are sorted by insertion
LIKELY = 6.0  # difference in -2 log likelihood below which a second pair makes a detection ambiguous


class Room(NamedTuple):
    """Work arrays for the pairs of one particle, allocated once per scan.

    Attributes:
        detection, landmark: Rows of detection and landmark of each pair, int64, shape (pairs,).
        cost: -2 log likelihood of each pair up to a constant, shape (pairs,).
        order: Pairs in ascending cost, int64, shape (pairs,).
        best, second: The two lowest costs of each detection, shape (D,); infinite without such a pair.
        landmark_of: Landmark of each detection, -1 for none, int64, shape (D,).
        sequence: Detections in the order in which their pairs are collected, int64, shape (D,).
        taken: Whether a landmark has a detection, shape (L,).
        ambiguous: Whether a detection is decided jointly with others, shape (D,).
        claimed: Pair of each landmark with the lowest cost, int64, shape (L,).
        search: Work arrays of the joint decision.
    """

    detection: Int
    landmark: Int
    cost: Float
    order: Int
    best: Float
    second: Float
    landmark_of: Int
    sequence: Int
    taken: Bool
    ambiguous: Bool
    claimed: Int
    search: JointSearch


def room_for(detections: int, landmarks: int) -> Room:
    """Return work arrays with space for all pairs of these numbers of detections and landmarks. `sequence`
    holds the detections in ascending order; the other arrays are uninitialised."""
    pairs = detections * landmarks
    return Room(
        np.empty(pairs, np.int64),
        np.empty(pairs, np.int64),
        np.empty(pairs),
        np.empty(pairs, np.int64),
        np.empty(detections),
        np.empty(detections),
        np.empty(detections, np.int64),
        np.arange(detections),
        np.empty(landmarks, np.bool_),
        np.empty(detections, np.bool_),
        np.empty(landmarks, np.int64),
        search_for(),
    )


@compiled_borrowing
def likely_pairs(
    pose: Pose,
    c: float,
    s: float,
    centre: Float,
    R: Float,
    mean: Float,
    covariance: Float,
    cells: Cells,
    scale: float,
    gate2: float,
    distance_max: float,
    room: Room,
) -> int:
    """Collect the pairs within the gate in `room`, with their `order` by cost, and return their number. Also
    fill `best` and `second`, and set `landmark_of` of all detections to -1.

    Args:
        pose: Pose before the scan.
        c, s: Cosine and sine of the yaw of the pose.
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        mean, covariance: Landmarks, see Maps.
        cells: Hash grid of the landmarks.
        scale: Cells per metre.
        gate2: Square of the maximum Mahalanobis distance.
        distance_max: Maximum distance [m].
        room: Work arrays; `sequence` holds each detection once and is sorted for the next particle.
    """
    pairs = 0
    for i in range(centre.shape[0]):
        d = room.sequence[i]
        room.landmark_of[d] = -1
        best = second = np.inf
        ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        wx, wy = pose.x + ax, pose.y + ay
        s0, s1, s2 = expected_spread(pose, c, s, ax, ay, R, d)
        u, v = first_of_four(wx, wy, scale)
        for quarter in range(4):
            j = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while j >= 0:
                y0, y1 = mean[j, 0] - wx, mean[j, 1] - wy
                at, j = j, cells.following[j]
                if not y0 * y0 + y1 * y1 <= distance_max * distance_max:
                    continue
                S0, S2 = s0 + covariance[at, 0], s2 + covariance[at, 2]
                S1 = s1 + covariance[at, 1]
                det = S0 * S2 - S1 * S1
                d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
                if d2 <= gate2:
                    cost = d2 + np.log(det)
                    room.cost[pairs] = cost
                    room.detection[pairs], room.landmark[pairs], room.order[pairs] = d, at, pairs
                    if cost < best:
                        best, second = cost, best
                    elif cost < second:
                        second = cost
                    pairs += 1
        room.best[d], room.second[d] = best, second
    _sort(room.cost, room.order, pairs)
    _sort_sequence(room, pairs, centre.shape[0])
    return pairs


@compiled_borrowing
def find_ambiguous(pairs: int, found: int, room: Room) -> int:
    """Mark the ambiguous detections and reset `taken` of all landmarks of the pairs; return the number of
    ambiguous detections.

    A detection is ambiguous if the costs of its two best pairs differ by less than LIKELY, or if the cost of
    a pair of it differs by less than LIKELY from that of the best pair of another detection with the same
    landmark; the other detection is then ambiguous as well.

    Args:
        pairs: Number of pairs, which are sorted in `room.order`.
        found: Number of detections.
        room: The pairs; `ambiguous` and `claimed` are written.
    """
    count = 0
    for d in range(found):
        room.ambiguous[d] = room.second[d] - room.best[d] < LIKELY
        count += room.ambiguous[d]
    for i in range(pairs):
        room.taken[room.landmark[i]] = False
    for i in range(pairs):
        k = room.order[i]
        d, j = room.detection[k], room.landmark[k]
        if not room.taken[j]:
            room.taken[j] = True
            room.claimed[j] = k
            continue
        first = room.claimed[j]
        if room.cost[k] - room.cost[first] < LIKELY:
            count += 2 - room.ambiguous[d] - room.ambiguous[room.detection[first]]
            room.ambiguous[d] = room.ambiguous[room.detection[first]] = True
    for i in range(pairs):
        room.taken[room.landmark[i]] = False
    return count


@compiled_borrowing
def fill_levels(pairs: int, room: Room) -> int:
    """Fill the levels of the search with at most MOST ambiguous detections, lowest cost first, and the free
    landmarks of their pairs, at most CHOICES each; return the number of levels. `pairs` is the number of
    pairs, which are sorted in `room.order`; `room.search` is written."""
    search, n = room.search, 0
    for i in range(pairs):
        k = room.order[i]
        d, j = room.detection[k], room.landmark[k]
        if not room.ambiguous[d] or room.taken[j]:
            continue
        level = 0
        while level < n and search.detection[level] != d:
            level += 1
        if level == MOST:
            continue
        if level == n:
            search.detection[n], search.choices[n] = d, 0
            n += 1
        if search.choices[level] < CHOICES:
            search.landmark[level, search.choices[level]] = j
            search.choices[level] += 1
    return n


@compiled_borrowing
def _sort(cost: Float, order: Int, n: int) -> None:
    """Sort the first n rows of `order` by cost, then by row (Shell sort, in place). Up to FEW rows, which are
    nearly sorted after the first particle, are sorted by its last pass."""
    gap = n // 2 if n > FEW else min(n, 1)
    while gap > 0:
        for i in range(gap, n):
            row = order[i]
            at = i
            while at >= gap and (
                cost[order[at - gap]] > cost[row]
                or (cost[order[at - gap]] == cost[row] and order[at - gap] > row)
            ):
                order[at] = order[at - gap]
                at -= gap
            order[at] = row
        gap //= 2


@compiled_borrowing
def _sort_sequence(room: Room, pairs: int, found: int) -> None:
    """Write the detections in the order of their best pairs, then those without a pair, into `room.sequence`.
    `landmark_of` must be -1 for all detections, and is so afterwards."""
    n = 0
    for i in range(pairs):
        d = room.detection[room.order[i]]
        if room.landmark_of[d] == -1:
            room.landmark_of[d] = -2
            room.sequence[n] = d
            n += 1
    for d in range(found):
        if room.landmark_of[d] == -1:
            room.sequence[n] = d
            n += 1
        room.landmark_of[d] = -1


@compiled_borrowing
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
    """Associate detections with landmarks one to one, correct the pose, and return the log likelihood of the
    detections up to a constant. Only landmarks with at least `hits_to_weigh` hits affect pose and likelihood;
    each detection without such a landmark counts like a pair at the gate.

    Pairs are accepted in the order of their likelihood, first those of unambiguous detections (see
    `find_ambiguous`). Each pair is tested with the pose that the earlier pairs corrected. Then ambiguous
    detections are decided jointly, see `choose_jointly`; those beyond MOST are decided last, one by one.

    Args:
        mu, P: Predicted pose x, y [m], yaw [rad] of the base in the map, shape (3,), and its covariance,
            shape (3, 3); corrected in place. The corrected yaw is not wrapped.
        centre: Detections in the base frame, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        mean, covariance, hits: Landmarks of this particle, see Maps; rows that are not in `cells` are
            ignored.
        cells: Hash grid of the landmarks.
        scale: Cells per metre.
        gate: Maximum Mahalanobis distance [sigma].
        distance_max: Maximum distance [m].
        hits_to_weigh: Minimum number of hits of a landmark that affects pose and likelihood.
        room: Work arrays; `landmark_of` is filled with the row of the landmark of each detection, -1 for
            none.
        statistics: Statistics of the scan by particle; the values of the scan are added to row p, except
            MISSED and SHIFT. INNOVATION is the sum of the squared Mahalanobis distances of pairs with at
            least `hits_to_weigh` hits.
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


@compiled_borrowing
def _cost_of_new(
    pose: Pose,
    centre: Float,
    R: Float,
    hits: Int32,
    landmark_of: Int,
    hits_to_weigh: int,
    gate2: float,
) -> float:
    """Return the decrease of the log likelihood by the detections without a landmark of at least
    `hits_to_weigh` hits, each of which counts like a pair at the gate.

    Args:
        pose: Pose of the particle with its covariance.
        centre, R: Detections in the base frame, shape (D, 2) [m], and covariances xx, xy, yy, shape (D, 3).
        hits: Hits of the landmarks of the particle, shape (L,).
        landmark_of: Row of the landmark of each detection, -1 for none.
        hits_to_weigh: Minimum number of hits.
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
