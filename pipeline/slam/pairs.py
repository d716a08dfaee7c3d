"""Which landmark each detection may be of, for one particle: pairs within the gate, the likeliest first.

The kernels run for each particle of each scan, so they take no memory of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int
from pipeline.slam.cells import Cells, cell_of, first_of_four
from pipeline.slam.gaussian import Pose, expected_spread

FEW = 64  # rows


class Room(NamedTuple):
    """Memory for the pairs of one particle, taken once a scan.

    Attributes:
        detection, landmark: int64, shape (pairs,); cost: shape (pairs,); order: int64, shape (pairs,).
        best, second: shape (D,): costs of the likeliest landmarks of each detection.
        landmark_of: int64, shape (D,), -1 for none.
        turn: int64, shape (D,): the detections in the order in which the last particle took them.
        taken: shape (L,).
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
    )


@compiled
def likely_pairs(
    pose: Pose,
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
        pose: Before the scan.
        centre: shape (D, 2) [m], base frame; R: xx, xy, yy, shape (D, 3).
        mean, covariance: Of the landmarks; cells: which hold them, `scale` a metre.
        gate2: Square of the largest Mahalanobis distance; distance_max: largest distance [m].
        room: Its `turn` has every detection once; the order of the pairs and of the turns is left in it.
    """
    pairs = 0
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
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
                square = y0 * y0 + y1 * y1
                S0, S2 = s0 + covariance[j, 0], s2 + covariance[j, 2]
                S1 = s1 + covariance[j, 1]
                det = S0 * S2 - S1 * S1
                d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
                if square <= distance_max * distance_max and d2 <= gate2:
                    cost = d2 + np.log(det)
                    room.cost[pairs] = cost
                    room.detection[pairs], room.landmark[pairs], room.order[pairs] = d, j, pairs
                    if cost < best:
                        best, second = cost, best
                    elif cost < second:
                        second = cost
                    pairs += 1
                j = cells.following[j]
        room.best[d], room.second[d] = best, second
    _sort(room.cost, room.order, pairs)
    _remember_turns(room, pairs, centre.shape[0])
    return pairs


@compiled
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


@compiled
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
