"""Where one particle stands after a scan: association and proposal in one pass.

FastSLAM 2.0 (Montemerlo et al. 2003) draws the pose from what odometry and scan say together:
each recognised landmark corrects the Gaussian of the pose before the next one is looked for, so
that the sure ones help to decide the doubtful ones. FastSLAM 1.0 is the same with a pose that was
drawn from the odometry alone and has no spread left.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int, Int32
from pipeline.slam.health import AMBIGUOUS as DOUBTFUL
from pipeline.slam.health import FOUND, INNOVATION, MOST_HITS, RECOGNISED

AMBIGUOUS = 6.0  # of -2 log likelihood: the second choice is a twentieth as likely


@compiled
def rotated(R: Float, c: float, s: float, out: Float) -> None:
    """A covariance, shape (2, 2), turned by the angle of cosine c and sine s, as xx, xy, yy."""
    xx, xy, yy = R[0, 0], R[0, 1], R[1, 1]
    out[0] = c * c * xx - 2 * c * s * xy + s * s * yy
    out[1] = c * s * (xx - yy) + (c * c - s * s) * xy
    out[2] = s * s * xx + 2 * c * s * xy + c * c * yy


@compiled
def innovation(
    mu: Float,
    P: Float,
    c: float,
    s: float,
    z: Float,
    R: Float,
    m: Float,
    Sigma: Float,
    S: Float,
    y: Float,
) -> float:
    """y = m - (position + C(yaw) z) and S = Sigma + C R C^T + J P J^T; returns det S.

    Args:
        mu, P: The pose, shape (3,), and its covariance, shape (3, 3); c, s: cosine and sine of its yaw.
        z: Detection in the base frame, shape (2,) [m]; R: shape (2, 2).
        m, Sigma: Landmark, shape (2,), and its covariance xx, xy, yy, shape (3,).
        S, y: Filled: xx, xy, yy and x, y.
    """
    ax, ay = c * z[0] - s * z[1], s * z[0] + c * z[1]
    rotated(R, c, s, S)
    # J = [I, (-ay, ax)^T]
    S[0] += Sigma[0] + P[0, 0] - 2.0 * ay * P[0, 2] + ay * ay * P[2, 2]
    S[1] += Sigma[1] + P[0, 1] + ax * P[0, 2] - ay * P[1, 2] - ax * ay * P[2, 2]
    S[2] += Sigma[2] + P[1, 1] + 2.0 * ax * P[1, 2] + ax * ax * P[2, 2]
    y[0], y[1] = m[0] - mu[0] - ax, m[1] - mu[1] - ay
    return float(S[0] * S[2] - S[1] * S[1])


@compiled
def correct_pose(mu: Float, P: Float, c: float, s: float, z: Float, S: Float, y: Float) -> None:
    """Kalman update of the pose by one landmark, in place; S and y as `innovation` gives them."""
    ax, ay = c * z[0] - s * z[1], s * z[0] + c * z[1]
    det = S[0] * S[2] - S[1] * S[1]
    PJ = np.empty((3, 2))
    K = np.empty((3, 2))
    for i in range(3):
        PJ[i, 0] = P[i, 0] - ay * P[i, 2]
        PJ[i, 1] = P[i, 1] + ax * P[i, 2]
        K[i, 0] = (PJ[i, 0] * S[2] - PJ[i, 1] * S[1]) / det
        K[i, 1] = (PJ[i, 1] * S[0] - PJ[i, 0] * S[1]) / det
    for i in range(3):
        mu[i] += K[i, 0] * y[0] + K[i, 1] * y[1]
        for j in range(i, 3):
            P[i, j] -= K[i, 0] * PJ[j, 0] + K[i, 1] * PJ[j, 1]
            P[j, i] = P[i, j]


@compiled
def recognise(
    mu: Float,
    P: Float,
    centre: Float,
    R: Float,
    near: Int,
    mean: Float,
    covariance: Float,
    hits: Int32,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    landmark_of: Int,
    told: Float,
) -> float:
    """Find the landmark of each detection, one to one, correct the pose, and weigh.

    Pairs are taken by falling likelihood, first those of detections with one likely landmark; each
    one is judged with the pose that the pairs before it left.

    Args:
        mu, P: The pose before the scan and its covariance; corrected in place.
        centre: shape (D, 2) [m], base frame; R: shape (D, 2, 2).
        near: Rows of landmarks in reach.
        mean, covariance, hits: Of this particle's landmarks.
        gate: Largest Mahalanobis distance [sigma]; distance_max: largest distance [m].
        hits_to_weigh: Landmarks seen fewer times neither correct nor weigh.
        landmark_of: shape (D,), filled with rows, -1 for none.
        told: shape (TOLD,), filled as far as the detections say (see health).

    Returns:
        Log likelihood of the detections.
    """
    detections = centre.shape[0]
    S, y = np.empty(3), np.empty(2)
    room = detections * max(len(near), 1)
    pair = np.empty((room, 2), np.int64)
    cost = np.empty(room)
    best = np.full(detections, np.inf)
    second = np.full(detections, np.inf)
    pairs = 0
    c, s = np.cos(mu[2]), np.sin(mu[2])
    for d in range(detections):
        landmark_of[d] = -1
        wx = mu[0] + c * centre[d, 0] - s * centre[d, 1]
        wy = mu[1] + s * centre[d, 0] + c * centre[d, 1]
        for j in near:
            dx, dy = mean[j, 0] - wx, mean[j, 1] - wy
            if dx * dx + dy * dy > distance_max * distance_max:
                continue
            det = innovation(mu, P, c, s, centre[d], R[d], mean[j], covariance[j], S, y)
            d2 = (S[2] * y[0] * y[0] - 2.0 * S[1] * y[0] * y[1] + S[0] * y[1] * y[1]) / det
            if d2 > gate * gate:
                continue
            cost[pairs] = d2 + np.log(det)
            pair[pairs, 0], pair[pairs, 1] = d, j
            if cost[pairs] < best[d]:
                best[d], second[d] = cost[pairs], best[d]
            elif cost[pairs] < second[d]:
                second[d] = cost[pairs]
            pairs += 1
    order = np.argsort(cost[:pairs], kind="mergesort")
    taken = np.zeros(mean.shape[0], np.bool_)
    log_likelihood = 0.0
    for doubtful in (False, True):
        for k in order:
            d, j = pair[k, 0], pair[k, 1]
            if landmark_of[d] >= 0 or taken[j] or (second[d] - best[d] < AMBIGUOUS) != doubtful:
                continue
            det = innovation(mu, P, c, s, centre[d], R[d], mean[j], covariance[j], S, y)
            d2 = (S[2] * y[0] * y[0] - 2.0 * S[1] * y[0] * y[1] + S[0] * y[1] * y[1]) / det
            if d2 > gate * gate:
                continue
            landmark_of[d] = j
            taken[j] = True
            if hits[j] >= hits_to_weigh:
                log_likelihood -= 0.5 * (d2 + np.log(det))
                told[INNOVATION] += d2
                told[RECOGNISED] += 1.0
                told[FOUND] += min(float(hits[j]), MOST_HITS)
                correct_pose(mu, P, c, s, centre[d], S, y)
                c, s = np.cos(mu[2]), np.sin(mu[2])
    for d in range(detections):
        if second[d] - best[d] < AMBIGUOUS:
            told[DOUBTFUL] += 1.0
    return log_likelihood - _price_of_new(mu, P, centre, R, hits, landmark_of, hits_to_weigh, gate)


@compiled
def _price_of_new(
    mu: Float, P: Float, centre: Float, R: Float, hits: Int32, landmark_of: Int, hits_to_weigh: int,
    gate: float,
) -> float:  # fmt: skip
    """What detections of no well known landmark take from the log likelihood: a new tree is as likely as
    one at the gate, else particles that recognise nothing win."""
    S, y, still = np.empty(3), np.empty(2), np.zeros(3)
    c, s = np.cos(mu[2]), np.sin(mu[2])
    price = 0.0
    for d in range(centre.shape[0]):
        if landmark_of[d] < 0 or hits[landmark_of[d]] < hits_to_weigh:
            det = innovation(mu, P, c, s, centre[d], R[d], mu[:2], still, S, y)
            price += 0.5 * (gate * gate + np.log(det))
    return price


@compiled
def draw(mu: Float, P: Float, noise: Float, out: Float) -> None:
    """out = mu + L noise with L L^T = P (Cholesky); a direction without variance gets no noise."""
    L = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            rest = P[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = np.sqrt(max(rest, 0.0))
            elif L[j, j] > 1e-12:
                L[i, j] = rest / L[j, j]
    for i in range(3):
        out[i] = mu[i]
        for k in range(i + 1):
            out[i] += L[i, k] * noise[k]
    out[2] = (out[2] + np.pi) % (2.0 * np.pi) - np.pi
