"""Which detection is which landmark, by the joint Gaussian of the pose and all landmarks in reach.

After a long way all landmarks of the far side share one error with respect to the robot: the first that is
recognised takes it from all others, which the correlations know and a covariance a landmark does not.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.candidate_pairs import LIKELY
from pipeline.slam.scan_statistics import AMBIGUOUS, FOUND, INNOVATION, MOST_HITS, RECOGNISED
from pipeline.types.records import Int, Int32


def moved_joint(m: Float, Sigma: Float, motion: Float, Q: Float) -> None:
    """Move the pose of a joint Gaussian, in place (Smith, Self, Cheeseman 1990).

    Args:
        m: x, y [m], yaw [rad], then x, y of each landmark, shape (3 + 2L,); Sigma: its covariance.
        motion: In the frame of the pose, shape (3,); Q: its covariance, shape (3, 3).
    """
    c, s = np.cos(m[2]), np.sin(m[2])
    dx, dy = c * motion[0] - s * motion[1], s * motion[0] + c * motion[1]
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    m[:3] += [dx, dy, motion[2]]
    Sigma[:3, :] = F @ Sigma[:3, :]
    Sigma[:, :3] = Sigma[:, :3] @ F.T
    Sigma[:3, :3] += G @ Q @ G.T


def correct_by_pose(m: Float, Sigma: Float, z: Float, R: Float) -> None:
    """Kalman update of a joint Gaussian by a measured pose, in place; shapes as in `moved_joint`."""
    y = z - m[:3]
    y[2] = (y[2] + np.pi) % (2.0 * np.pi) - np.pi
    K = Sigma[:, :3] @ np.linalg.inv(Sigma[:3, :3] + R)
    m += K @ y
    Sigma -= K @ Sigma[:3, :]


@compiled
def recognise_jointly(
    m: Float,
    Sigma: Float,
    centre: Float,
    R: Float,
    hits: Int32,
    gate: float,
    distance_max: float,
    hits_to_weigh: int,
    told: Float,
) -> Int:
    """The landmark of each detection, -1 for none, one to one; the joint Gaussian is corrected in place.

    Pairs are taken by falling likelihood, first those of detections with one likely landmark; each one is
    judged with what the pairs before it left, as in `proposal.recognise`.

    Args:
        m, Sigma: See `moved_joint`.
        centre: Detections in the base frame, shape (D, 2) [m]; R: their covariances, shape (D, 2, 2).
        hits: int32, shape (L,).
        gate: Largest Mahalanobis distance [sigma]; distance_max: largest distance [m].
        hits_to_weigh: Landmarks seen fewer times do not correct.
        told: shape (TOLD,), filled as far as the detections say (see health).
    """
    D, L = centre.shape[0], hits.shape[0]
    landmark_of = np.full(D, -1, np.int64)
    cost = np.full(D * L, np.inf)
    best, second = np.full(D, np.inf), np.full(D, np.inf)
    y, S = np.empty(2), np.empty((2, 2))
    for d in range(D):
        for j in range(L):
            _innovation(m, Sigma, centre, R, d, j, y, S)
            if y[0] * y[0] + y[1] * y[1] > distance_max * distance_max:
                continue
            d2, det = _mahalanobis(y, S)
            if d2 > gate * gate:
                continue
            value = d2 + np.log(det)
            cost[d * L + j] = value
            if value < best[d]:
                best[d], second[d] = value, best[d]
            elif value < second[d]:
                second[d] = value
    for d in range(D):
        told[AMBIGUOUS] += second[d] - best[d] < LIKELY
    order = np.argsort(cost, kind="mergesort")
    taken = np.zeros(L, np.bool_)
    for doubtful in range(2):
        for k in order:
            if cost[k] == np.inf:
                break
            d, j = k // L, k % L
            doubt = second[d] - best[d] < LIKELY
            if landmark_of[d] >= 0 or taken[j] or doubt != (doubtful == 1):
                continue
            ax, ay = _innovation(m, Sigma, centre, R, d, j, y, S)
            d2, _ = _mahalanobis(y, S)
            if d2 > gate * gate:
                continue
            landmark_of[d] = j
            taken[j] = True
            if hits[j] >= hits_to_weigh:
                told[INNOVATION] += d2
                told[RECOGNISED] += 1.0
                told[FOUND] += min(float(hits[j]), MOST_HITS)
                _correct(m, Sigma, ax, ay, j, y, S)
    return landmark_of


@compiled
def _innovation(
    m: Float, Sigma: Float, centre: Float, R: Float, d: int, j: int, y: Float, S: Float
) -> tuple[float, float]:
    """y = p + C z - l and its covariance S, filled; returns C z. H = [I, (-ay, ax)^T, -I at l]."""
    c, s = np.cos(m[2]), np.sin(m[2])
    ax, ay = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
    l = 3 + 2 * j  # noqa: E741
    y[0], y[1] = m[0] + ax - m[l], m[1] + ay - m[l + 1]
    xx, xy, yy = R[d, 0, 0], R[d, 0, 1], R[d, 1, 1]
    S[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    S[0, 1] = S[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    S[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    turn = (-ay, ax)
    for a in range(2):
        for b in range(2):
            S[a, b] += (
                Sigma[a, b]
                + turn[b] * Sigma[a, 2]
                + turn[a] * Sigma[2, b]
                + turn[a] * turn[b] * Sigma[2, 2]
                - Sigma[a, l + b]
                - Sigma[l + a, b]
                - turn[a] * Sigma[2, l + b]
                - turn[b] * Sigma[l + a, 2]
                + Sigma[l + a, l + b]
            )
    return ax, ay


@compiled
def _mahalanobis(y: Float, S: Float) -> tuple[float, float]:
    """y^T S^-1 y, and det S."""
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    return (S[1, 1] * y[0] * y[0] - 2.0 * S[0, 1] * y[0] * y[1] + S[0, 0] * y[1] * y[1]) / det, det


@compiled
def _correct(m: Float, Sigma: Float, ax: float, ay: float, j: int, y: Float, S: Float) -> None:
    """Kalman update by y = 0, in place."""
    n = m.shape[0]
    l = 3 + 2 * j  # noqa: E741
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    A = np.empty((n, 2))  # Sigma H^T
    K = np.empty((n, 2))
    for i in range(n):
        A[i, 0] = Sigma[i, 0] - ay * Sigma[i, 2] - Sigma[i, l]
        A[i, 1] = Sigma[i, 1] + ax * Sigma[i, 2] - Sigma[i, l + 1]
        K[i, 0] = (A[i, 0] * S[1, 1] - A[i, 1] * S[1, 0]) / det
        K[i, 1] = (A[i, 1] * S[0, 0] - A[i, 0] * S[0, 1]) / det
    for i in range(n):
        m[i] -= K[i, 0] * y[0] + K[i, 1] * y[1]
        for k in range(n):
            Sigma[i, k] -= K[i, 0] * A[k, 0] + K[i, 1] * A[k, 1]
