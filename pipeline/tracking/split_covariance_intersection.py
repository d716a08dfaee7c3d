"""What the views of a tree share: the error of the poses that they were seen from.

From scan to scan the pose errs alike, for it is found by the same trees, so it does not average out. A tree's
covariance is kept in two parts, its own (noise of the detections, which does average out) and a shared one
(of the poses, correlated in a way that nobody knows), and both are joined by split covariance intersection
(Julier, Uhlmann 2001; Li, Nashashibi, Yang 2013), which is right whatever the correlation is:

P1 = P_own + P_shared / w,  P2 = R + B / (1 - w),  K = P1 (P1 + P2)^-1,  0 < w < 1

The Kalman filter itself (Eq. 10) stays as it is; it is only told P1 and P2.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Int

LEAST, MOST = 1e-3, 1.0 - 1e-6  # of the weight w
NOTHING = 1e-12  # m^2


@compiled
def split(
    P: Float, shared: Float, rows: Int, R: Float, B: Float, dt: Float, acceleration_sigma: float
) -> Float:
    """Make the Kalman filter's next update one of split covariance intersection, in place.

    Args:
        P: shape (T, 4, 4), becomes P1 of the rows; shared: part of it, shape (T, 2, 2), becomes that after
            the update.
        rows: The tree of each measurement, none twice, shape (D,).
        R: Own covariance of each measurement, shape (D, 2, 2); B: what it shares with the tree.
        dt, acceleration_sigma: See `kalman.ENGINES`.

    Returns:
        P2 of each measurement, shape (D, 2, 2).
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
    """(I - K) P_shared / w (I - K)^T + K B / (1 - w) K^T in place, with K = P1 S^-1."""
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
    """xx, xy, yy of M C M^T with M = [[a, b], [c, d]]."""
    return (
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
    )


@compiled_borrowing
def _mean(C: Float) -> float:
    return float(0.5 * (C[0, 0] + C[1, 1]))


@compiled_borrowing
def weight(own: float, shared: float, R: float, B: float) -> float:
    """The w that makes the joined variance least, in closed form for variances; any other is right too."""
    if shared < NOTHING and B < NOTHING:
        return 0.5
    p, b = np.sqrt(max(shared, 0.0)), np.sqrt(max(B, 0.0))
    below = b * max(own, 0.0) + p * R
    if below <= 0.0:
        return LEAST if p > b else MOST
    return float(min(max((p * R + p * b * (b - p)) / below, LEAST), MOST))
