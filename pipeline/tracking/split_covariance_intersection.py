"""Split covariance intersection (Julier, Uhlmann 2001; Li, Nashashibi, Yang 2013) for the positions of trees.

The poses from which a tree is seen have correlated errors, since they are estimated from the same trees, and
these errors do not average out. The covariance of a tree is therefore kept in two parts: its own part (noise
of the detections, which averages out) and a shared part (of the poses, with an unknown correlation). The
fusion of both is consistent for any correlation:

P1 = P_own + P_shared / w,  P2 = R + B / (1 - w),  K = P1 (P1 + P2)^-1,  0 < w < 1

The Kalman filter (Eq. 10) is unchanged; P1 and P2 replace its covariances P and R.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Int

LEAST, MOST = 1e-3, 1.0 - 1e-6  # bounds of the weight w
NOTHING = 1e-12  # m^2; smaller shared variances are treated as 0


@compiled
def split(
    P: Float, shared: Float, rows: Int, R: Float, B: Float, dt: Float, acceleration_sigma: float
) -> Float:
    """Prepare the next Kalman update of some trees, so that it becomes one of split covariance intersection.

    Args:
        P: Covariances of the states, shape (T, 4, 4); those of `rows` are replaced by P1.
        shared: Shared parts of P, shape (T, 2, 2) [m^2]; those of `rows` are replaced by the shared part
            after the update.
        rows: Row of the tree of each measurement, without duplicates, shape (D,).
        R: Own covariance of each measurement, shape (D, 2, 2) [m^2].
        B: Shared covariance of each measurement, by the pose, shape (D, 2, 2) [m^2].
        dt: Time since the last update of each of these trees, shape (D,) [s]; the Kalman filter predicts
            afterwards.
        acceleration_sigma: Standard deviation of the acceleration [m/s^2].

    Returns:
        P2, the covariance of each measurement for the Kalman filter, shape (D, 2, 2) [m^2].
    """
    P2 = R.copy()
    room = np.empty((3, 2, 2))
    _split(P, shared, rows, R, B, dt, acceleration_sigma, P2, room)
    return P2


@compiled_borrowing
def _split(
    P: Float,
    shared: Float,
    rows: Int,
    R: Float,
    B: Float,
    dt: Float,
    acceleration_sigma: float,
    P2: Float,
    room: Float,
) -> None:
    """Replace P and `shared` of the trees `rows`, and R in P2, by the results of `split`, in place; other
    arguments as in it. P2 contains R before; `room` is a work array, shape (3, 2, 2)."""
    own, P1, S = room[0], room[1], room[2]
    for d in range(rows.shape[0]):
        t = rows[d]
        noise = 0.25 * dt[d] ** 4 * acceleration_sigma * acceleration_sigma
        for a in range(2):
            for b in range(2):
                of_velocity = dt[d] * (P[t, a, b + 2] + P[t, a + 2, b] + dt[d] * P[t, a + 2, b + 2])
                own[a, b] = P[t, a, b] - shared[t, a, b] + of_velocity + (noise if a == b else 0.0)
        w = weight(_mean(own), _mean(shared[t]), _mean(R[d]), _mean(B[d]))
        for a in range(2):
            for b in range(2):
                P[t, a, b] += shared[t, a, b] * (1.0 / w - 1.0)
                P1[a, b] = own[a, b] + shared[t, a, b] / w
                P2[d, a, b] += B[d, a, b] / (1.0 - w)
                S[a, b] = P1[a, b] + P2[d, a, b]
        _share(shared[t], P1, S, w, B[d])


@compiled_borrowing
def _share(shared: Float, P1: Float, S: Float, w: float, B: Float) -> None:
    """Replace `shared`, the shared part of a tree, by that after the update, in place: (I - K) P_shared / w
    (I - K)^T + K B / (1 - w) K^T, with K = P1 S^-1.

    Args:
        shared: Shared part of the covariance of the tree.
        P1: Covariance of the tree, with its shared part divided by w.
        S: Covariance of the innovation.
        w: Weight of the shared part, above 0 and below 1.
        B: Shared part of the measurement. All matrices have the shape (2, 2) [m^2].
    """
    det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    k00, k01 = (
        (P1[0, 0] * S[1, 1] - P1[0, 1] * S[1, 0]) / det,
        (P1[0, 1] * S[0, 0] - P1[0, 0] * S[0, 1]) / det,
    )
    k10, k11 = (
        (P1[1, 0] * S[1, 1] - P1[1, 1] * S[1, 0]) / det,
        (P1[1, 1] * S[0, 0] - P1[1, 0] * S[0, 1]) / det,
    )
    sx, sxy, sy = _turned(1.0 - k00, -k01, -k10, 1.0 - k11, shared[0, 0], shared[0, 1], shared[1, 1])
    bx, bxy, by = _turned(k00, k01, k10, k11, B[0, 0], B[0, 1], B[1, 1])
    v = 1.0 - w
    shared[0, 0], shared[1, 1] = sx / w + bx / v, sy / w + by / v
    shared[0, 1] = shared[1, 0] = sxy / w + bxy / v


@compiled_borrowing
def _turned(
    a: float, b: float, c: float, d: float, xx: float, xy: float, yy: float
) -> tuple[float, float, float]:
    """Return xx, xy, yy of M C M^T for M = [[a, b], [c, d]] and a covariance C with the elements xx, xy,
    yy."""
    return (
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
    )


@compiled_borrowing
def _mean(C: Float) -> float:
    """Return the mean variance of a covariance, shape (2, 2)."""
    return float(0.5 * (C[0, 0] + C[1, 1]))


@compiled_borrowing
def weight(own: float, shared: float, R: float, B: float) -> float:
    """Return the w that minimises the variance of the fused estimate, in closed form for scalar variances.

    Any other w within LEAST and MOST is consistent as well, only less accurate. Without shared variances the
    result is 0.5.

    Args:
        own, shared: Own and shared variance of the tree [m^2].
        R, B: Own and shared variance of the measurement [m^2].
    """
    if shared < NOTHING and B < NOTHING:
        return 0.5
    p, b = np.sqrt(max(shared, 0.0)), np.sqrt(max(B, 0.0))
    below = b * max(own, 0.0) + p * R
    if below <= 0.0:
        return LEAST if p > b else MOST
    return float(min(max((p * R + p * b * (b - p)) / below, LEAST), MOST))
