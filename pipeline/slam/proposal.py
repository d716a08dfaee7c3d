"""Where one particle stands after a scan: association and proposal in one pass.

FastSLAM 2.0 (Montemerlo et al. 2003) draws the pose from what odometry and scan say together:
each recognised landmark corrects the Gaussian of the pose before the next one is looked for, so
that the sure ones help to decide the doubtful ones. FastSLAM 1.0 is the same with a pose that was
drawn from the odometry alone and has no spread left.

The kernels run for each particle of each scan, so they take no memory of their own: rows are scalars,
and room for pairs comes from the caller.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int, Int32
from pipeline.slam.health import AMBIGUOUS as DOUBTFUL
from pipeline.slam.health import FOUND, INNOVATION, MOST_HITS, RECOGNISED

LIKELY = 6.0  # of -2 log likelihood: a second choice that is less than this behind makes a doubt
SMALL_TURN = 0.02  # rad; below it the series of sine and cosine is exact to 1e-10


class Room(NamedTuple):
    """Memory for the pairs of one particle, taken once a scan.

    Attributes:
        detection, landmark: int64, shape (pairs,); cost: shape (pairs,); order: int64, shape (pairs,).
        best, second: shape (D,): costs of the likeliest landmarks of each detection.
        landmark_of: int64, shape (D,), -1 for none.
        taken: shape (L,).
    """

    detection: Int
    landmark: Int
    cost: Float
    order: Int
    best: Float
    second: Float
    landmark_of: Int
    taken: Bool


def room_for(detections: int, landmarks: int) -> Room:
    """Room for every pair."""
    pairs = detections * max(landmarks, 1)
    return Room(
        detection=np.empty(pairs, np.int64),
        landmark=np.empty(pairs, np.int64),
        cost=np.empty(pairs),
        order=np.empty(pairs, np.int64),
        best=np.empty(detections),
        second=np.empty(detections),
        landmark_of=np.empty(detections, np.int64),
        taken=np.empty(landmarks, np.bool_),
    )


@compiled
def rotated(R: Float, d: int, c: float, s: float) -> tuple[float, float, float]:
    """The covariance R[d] (xx, xy, yy) turned by the angle of cosine c and sine s."""
    xx, xy, yy = R[d, 0], R[d, 1], R[d, 2]
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@compiled
def expected_spread(
    P: Float, c: float, s: float, ax: float, ay: float, R: Float, d: int
) -> tuple[float, float, float]:
    """C R C^T + J P J^T of detection d, xx, xy, yy: how far it may lie by the pose and by its own error.

    Args:
        P: Covariance of the pose, shape (3, 3); c, s: cosine and sine of its yaw.
        ax, ay: From the robot to the detection, frame of the map: J = [I, (-ay, ax)^T].
    """
    xx, xy, yy = rotated(R, d, c, s)
    return (
        xx + P[0, 0] - 2.0 * ay * P[0, 2] + ay * ay * P[2, 2],
        xy + P[0, 1] + ax * P[0, 2] - ay * P[1, 2] - ax * ay * P[2, 2],
        yy + P[1, 1] + 2.0 * ax * P[1, 2] + ax * ax * P[2, 2],
    )


@compiled
def correct_pose(
    mu: Float, P: Float, ax: float, ay: float, S0: float, S1: float, S2: float, y0: float, y1: float
) -> None:
    """Kalman update of the pose by one landmark, in place; S: xx, xy, yy, y: the innovation."""
    scale = 1.0 / (S0 * S2 - S1 * S1)
    a0, a1, a2 = P[0, 0] - ay * P[0, 2], P[0, 1] - ay * P[1, 2], P[0, 2] - ay * P[2, 2]
    b0, b1, b2 = P[0, 1] + ax * P[0, 2], P[1, 1] + ax * P[1, 2], P[1, 2] + ax * P[2, 2]
    k00, k01 = (a0 * S2 - b0 * S1) * scale, (b0 * S0 - a0 * S1) * scale
    k10, k11 = (a1 * S2 - b1 * S1) * scale, (b1 * S0 - a1 * S1) * scale
    k20, k21 = (a2 * S2 - b2 * S1) * scale, (b2 * S0 - a2 * S1) * scale
    mu[0] += k00 * y0 + k01 * y1
    mu[1] += k10 * y0 + k11 * y1
    mu[2] += k20 * y0 + k21 * y1
    P[0, 0] -= k00 * a0 + k01 * b0
    P[0, 1] -= k00 * a1 + k01 * b1
    P[0, 2] -= k00 * a2 + k01 * b2
    P[1, 1] -= k10 * a1 + k11 * b1
    P[1, 2] -= k10 * a2 + k11 * b2
    P[2, 2] -= k20 * a2 + k21 * b2
    P[1, 0], P[2, 0], P[2, 1] = P[0, 1], P[0, 2], P[1, 2]


@compiled
def recognise(
    mu: Float,
    P: Float,
    centre: Float,
    R: Float,
    known: int,
    mean: Float,
    covariance: Float,
    hits: Int32,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    room: Room,
    told: Float,
    p: int,
) -> float:
    """Find the landmark of each detection, one to one, correct the pose, and weigh.

    Pairs are taken by falling likelihood, first those of detections with one likely landmark; each
    one is judged with the pose that the pairs before it left.

    Args:
        mu, P: The pose before the scan and its covariance; corrected in place.
        centre: shape (D, 2) [m], base frame; R: xx, xy, yy, shape (D, 3).
        known: So many rows of the next three are landmarks in reach of this particle.
        gate: Largest Mahalanobis distance [sigma]; distance_max: largest distance [m].
        hits_to_weigh: Landmarks seen fewer times neither correct nor weigh.
        room: Its `landmark_of` is filled.
        told: Row p is filled as far as the detections say (see health).

    Returns:
        Log likelihood of the detections.
    """
    gate2 = gate * gate
    pairs = _likely_pairs(mu, P, centre, R, known, mean, covariance, gate2, distance_max, room)
    _sort(room.cost, room.order, pairs)
    for j in range(known):
        room.taken[j] = False
    log_likelihood, product = 0.0, 1.0
    c, s = np.cos(mu[2]), np.sin(mu[2])
    for doubtful in range(2):
        for i in range(pairs):
            k = room.order[i]
            d, j = room.detection[k], room.landmark[k]
            doubt = room.second[d] - room.best[d] < LIKELY
            if room.landmark_of[d] >= 0 or room.taken[j] or doubt != (doubtful == 1):
                continue
            ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            S0, S1, S2 = expected_spread(P, c, s, ax, ay, R, d)
            S0, S1, S2 = S0 + covariance[j, 0], S1 + covariance[j, 1], S2 + covariance[j, 2]
            y0, y1 = mean[j, 0] - mu[0] - ax, mean[j, 1] - mu[1] - ay
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
                before = mu[2]
                correct_pose(mu, P, ax, ay, S0, S1, S2, y0, y1)
                c, s = _turned(c, s, mu[2] - before, mu[2])
    log_likelihood -= 0.5 * np.log(product)
    for d in range(centre.shape[0]):
        if room.second[d] - room.best[d] < LIKELY:
            told[p, DOUBTFUL] += 1.0
    price = _price_of_new(mu, P, centre, R, hits, room.landmark_of, hits_to_weigh, gate2)
    return float(log_likelihood) - price


@compiled
def _likely_pairs(
    mu: Float,
    P: Float,
    centre: Float,
    R: Float,
    known: int,
    mean: Float,
    covariance: Float,
    gate2: float,
    distance_max: float,
    room: Room,
) -> int:
    """Fill the pairs within the gate, their costs, and the best costs of each detection; how many."""
    pairs = 0
    c, s = np.cos(mu[2]), np.sin(mu[2])
    for d in range(centre.shape[0]):
        room.landmark_of[d] = -1
        room.best[d] = room.second[d] = np.inf
        ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        wx, wy = mu[0] + ax, mu[1] + ay
        s0, s1, s2 = expected_spread(P, c, s, ax, ay, R, d)
        for j in range(known):
            y0, y1 = mean[j, 0] - wx, mean[j, 1] - wy
            square = y0 * y0 + y1 * y1
            if square > distance_max * distance_max:
                continue
            S0, S2 = s0 + covariance[j, 0], s2 + covariance[j, 2]
            if square > gate2 * (S0 + S2):  # the trace bounds the larger eigenvalue
                continue
            S1 = s1 + covariance[j, 1]
            det = S0 * S2 - S1 * S1
            d2 = (S2 * y0 * y0 - 2.0 * S1 * y0 * y1 + S0 * y1 * y1) / det
            if d2 > gate2:
                continue
            cost = d2 + np.log(det)
            room.cost[pairs] = cost
            room.detection[pairs], room.landmark[pairs], room.order[pairs] = d, j, pairs
            if cost < room.best[d]:
                room.best[d], room.second[d] = cost, room.best[d]
            elif cost < room.second[d]:
                room.second[d] = cost
            pairs += 1
    return pairs


@compiled
def _sort(cost: Float, order: Int, n: int) -> None:
    """Order the first n rows by cost, equal ones by row: Shell's sort, which needs no memory."""
    gap = n // 2
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
def _turned(c: float, s: float, by: float, yaw: float) -> tuple[float, float]:
    """Cosine and sine of a yaw from those before it turned by a little."""
    if abs(by) > SMALL_TURN:
        return np.cos(yaw), np.sin(yaw)
    b2 = by * by
    cos, sin = 1.0 - b2 * (0.5 - b2 / 24.0), by * (1.0 - b2 / 6.0)
    return c * cos - s * sin, s * cos + c * sin


@compiled
def _price_of_new(
    mu: Float,
    P: Float,
    centre: Float,
    R: Float,
    hits: Int32,
    landmark_of: Int,
    hits_to_weigh: int,
    gate2: float,
) -> float:
    """What detections of no well known landmark take from the log likelihood: a new tree is as likely as
    one at the gate, else particles that recognise nothing win."""
    c, s = np.cos(mu[2]), np.sin(mu[2])
    price = 0.0
    for d in range(centre.shape[0]):
        if landmark_of[d] < 0 or hits[landmark_of[d]] < hits_to_weigh:
            ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
            S0, S1, S2 = expected_spread(P, c, s, ax, ay, R, d)
            price += 0.5 * (gate2 + np.log(S0 * S2 - S1 * S1))
    return price


@compiled
def draw(mu: Float, P: Float, noise: Float, p: int, out: Float) -> None:
    """out[p] = mu + L noise[p] with L L^T = P (Cholesky); a direction without variance gets no noise."""
    l00 = np.sqrt(max(P[0, 0], 0.0))
    l10 = P[1, 0] / l00 if l00 > 1e-12 else 0.0
    l20 = P[2, 0] / l00 if l00 > 1e-12 else 0.0
    l11 = np.sqrt(max(P[1, 1] - l10 * l10, 0.0))
    l21 = (P[2, 1] - l20 * l10) / l11 if l11 > 1e-12 else 0.0
    l22 = np.sqrt(max(P[2, 2] - l20 * l20 - l21 * l21, 0.0))
    n0, n1, n2 = noise[p, 0], noise[p, 1], noise[p, 2]
    out[p, 0] = mu[0] + l00 * n0
    out[p, 1] = mu[1] + l10 * n0 + l11 * n1
    out[p, 2] = (mu[2] + l20 * n0 + l21 * n1 + l22 * n2 + np.pi) % (2.0 * np.pi) - np.pi
