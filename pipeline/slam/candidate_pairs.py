"""Which landmark each detection may be of, for one particle: pairs within the gate, the likeliest first.

The kernels run for each particle of each scan, so they take no memory of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, expected_spread
from pipeline.geometry.hash_grid import Cells, cell_of, first_of_four
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.slam.joint_association import CHOICES, MOST, Doubts, doubts_for
from pipeline.types.records import Bool, Int

FEW = 64  # rows
LIKELY = 6.0  # of -2 log likelihood: a second choice that is less than this behind makes a doubt


class Room(NamedTuple):
    """Memory for the pairs of one particle, taken once a scan.

    Attributes:
        detection, landmark: int64, shape (pairs,); cost: shape (pairs,); order: int64, shape (pairs,).
        best, second: shape (D,): costs of the likeliest landmarks of each detection.
        landmark_of: int64, shape (D,), -1 for none.
        turn: int64, shape (D,): the detections in the order in which the last particle took them.
        taken: shape (L,).
        doubt: shape (D,): which detections have a close choice; claimed: int64, shape (L,): the row of
            `order` with the likeliest pair of a landmark; doubts: for those that are decided together.
    """

    detection: Int
    landmark: Int
    cost: Float
    order: Int
    best: Float
    second: Float
    landmark_of: Int
    turn: Int
    taken: Bool
    doubt: Bool
    claimed: Int
    doubts: Doubts


@compiled
def room_for(detections: int, landmarks: int) -> Room:
    """Room for every pair; the detections take their turns by number."""
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
        doubts_for(),
    )


@compiled_within
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
    """Fill the pairs within the gate, their costs and order, and the best costs of each detection; how many.

    Args:
        pose: Before the scan; c, s: cosine and sine of its yaw.
        centre: shape (D, 2) [m], base frame; R: xx, xy, yy, shape (D, 3).
        mean, covariance: Of the landmarks; cells: which hold them, `scale` a metre.
        gate2: Square of the largest Mahalanobis distance; distance_max: largest distance [m].
        room: Its `turn` has every detection once; the order of the pairs and of the turns is left in it.
    """
    pairs = 0
    for i in range(centre.shape[0]):
        d = room.turn[i]
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
    _remember_turns(room, pairs, centre.shape[0])
    return pairs


@compiled_within
def find_doubts(pairs: int, found: int, room: Room) -> int:
    """Mark the detections with a close choice and free all landmarks of the pairs; returns how many.

    The choice is close where a second landmark is nearly as likely, and where two detections would have one
    landmark nearly alike.
    """
    doubtful = 0
    for d in range(found):
        room.doubt[d] = room.second[d] - room.best[d] < LIKELY
        doubtful += room.doubt[d]
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
            doubtful += 2 - room.doubt[d] - room.doubt[room.detection[first]]
            room.doubt[d] = room.doubt[room.detection[first]] = True
    for i in range(pairs):
        room.taken[room.landmark[i]] = False
    return doubtful


@compiled_borrowing
def gather_doubts(pairs: int, room: Room) -> int:
    """Fill the levels of the search with the surest of the doubtful detections and the free landmarks that
    each may be of; returns how many levels."""
    doubts, n = room.doubts, 0
    for i in range(pairs):
        k = room.order[i]
        d, j = room.detection[k], room.landmark[k]
        if not room.doubt[d] or room.taken[j]:
            continue
        level = 0
        while level < n and doubts.detection[level] != d:
            level += 1
        if level == MOST:
            continue
        if level == n:
            doubts.detection[n], doubts.choices[n] = d, 0
            n += 1
        if doubts.choices[level] < CHOICES:
            doubts.landmark[level, doubts.choices[level]] = j
            doubts.choices[level] += 1
    return n


@compiled_within
def _sort(cost: Float, order: Int, n: int) -> None:
    """Order the first n rows by cost, equal ones by row: Shell's sort, which needs no memory. Few rows that
    stand nearly in order, as they do after the first particle, want its last pass alone."""
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


@compiled_within
def _remember_turns(room: Room, pairs: int, found: int) -> None:
    """Let the next particle, which sees much the same, take the detections as this one sorted them."""
    n = 0
    for i in range(pairs):
        d = room.detection[room.order[i]]
        if room.landmark_of[d] == -1:
            room.landmark_of[d] = -2
            room.turn[n] = d
            n += 1
    for d in range(found):
        if room.landmark_of[d] == -1:
            room.turn[n] = d
            n += 1
        room.landmark_of[d] = -1
