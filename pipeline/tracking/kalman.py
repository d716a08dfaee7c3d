"""Kalman filter of a tree (Eq. 10) with the state x = [x, y, vx, vy] and the measured position z = H x.

Two engines give the same numbers: a compiled one and filterpy.

Split covariance intersection (Julier, Uhlmann 2001; Li, Nashashibi, Yang 2013) provides the covariances of
the positions of trees. The poses from which a tree is seen have correlated errors, since they are estimated
from the same trees, and these errors do not average out. The covariance of a tree is therefore kept in two
parts: its own part (noise of the detections, which averages out) and a shared part (of the poses, with an
unknown correlation). The fusion of both is consistent for any correlation:

P1 = P_own + P_shared / w,  P2 = R + B / (1 - w),  K = P1 (P1 + P2)^-1,  0 < w < 1

The Kalman filter is unchanged; P1 and P2 replace its covariances P and R.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Int

# Measurement matrix: the position of the state.
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])


@compiled
def transition(dt: float) -> Float:
    """Return the transition matrix F of [x, y, vx, vy] of constant velocity over dt [s], shape (4, 4)."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt
    return F


@compiled
def process_noise(dt: float, acceleration_sigma: float) -> Float:
    """Return the process noise Q of [x, y, vx, vy] by a white acceleration over dt, shape (4, 4) (Bar-Shalom,
    Li, Kirubarajan 2001, eq. 6.3.2-4).

    Args:
        dt: Time step [s].
        acceleration_sigma: Standard deviation of the acceleration, constant within the step [m/s^2].
    """
    Q = np.zeros((4, 4))
    q = acceleration_sigma * acceleration_sigma
    for a in range(2):
        Q[a, a] = 0.25 * dt**4 * q
        Q[a, a + 2] = Q[a + 2, a] = 0.5 * dt**3 * q
        Q[a + 2, a + 2] = dt * dt * q
    return Q


@compiled
def update_rows(
    x: Float, P: Float, rows: Int, dt: Float, acceleration_sigma: float, z: Float, R: Float
) -> None:
    """Predict some trees to the time of their measurements and correct them, in place.

    Args:
        x: States of all trees, shape (T, 4) [m, m/s].
        P: Covariances of the states, shape (T, 4, 4).
        rows: Row of the tree of each measurement, without duplicates, shape (D,).
        dt: Time since the last update of each of these trees, shape (D,) [s].
        acceleration_sigma: Standard deviation of the acceleration [m/s^2].
        z: Measured positions in the map, shape (D, 2) [m].
        R: Covariances of the measured positions, shape (D, 2, 2) [m^2].
    """
    _update_rows(x, P, rows, dt, acceleration_sigma, z, R, np.empty((4, 2)), np.empty((4, 4)))


@compiled_borrowing
def _update_rows(
    x: Float,
    P: Float,
    rows: Int,
    dt: Float,
    acceleration_sigma: float,
    z: Float,
    R: Float,
    K: Float,
    M: Float,
) -> None:
    """Predict and correct the trees `rows` in place, with the arguments of `update_rows`; K and M are work
    arrays of the shapes (4, 2) and (4, 4)."""
    for k in range(rows.shape[0]):
        row = rows[k]
        _predict(x[row], P[row], dt[k], acceleration_sigma)
        correct(x[row], P[row], z[k], R[k], K, M)


@compiled_borrowing
def _predict(x: Float, P: Float, dt: float, acceleration_sigma: float) -> None:
    """Replace the state x, shape (4,), by F x and P, shape (4, 4), by F P F^T + Q, in place, for `dt` [s] and
    the standard deviation `acceleration_sigma` [m/s^2]; see `transition` and `process_noise`."""
    for a in range(2):
        x[a] += dt * x[a + 2]
        for b in range(4):
            P[a, b] += dt * P[a + 2, b]
    for b in range(4):
        for a in range(2):
            P[b, a] += dt * P[b, a + 2]
    q = acceleration_sigma * acceleration_sigma
    for a in range(2):
        P[a, a] += 0.25 * dt**4 * q
        P[a, a + 2] += 0.5 * dt**3 * q
        P[a + 2, a] += 0.5 * dt**3 * q
        P[a + 2, a + 2] += dt * dt * q


@compiled_borrowing
def correct(x: Float, P: Float, z: Float, R: Float, K: Float, M: Float) -> None:
    """Replace x by x + K y and P by (I - K H) P (I - K H)^T + K R K^T (Joseph form), in place.

    The Joseph form keeps P symmetric and positive.

    Args:
        x, P: State, shape (4,), and covariance of the state, shape (4, 4).
        z, R: Measured position x, y and its covariance; only the first two rows and columns are used.
        K, M: Work arrays, shapes (4, 2) and (4, 4).
    """
    y0, y1 = z[0] - x[0], z[1] - x[1]
    S00, S01, S11 = P[0, 0] + R[0, 0], P[0, 1] + R[0, 1], P[1, 1] + R[1, 1]
    det = S00 * S11 - S01 * S01
    for a in range(4):
        K[a, 0] = (P[a, 0] * S11 - P[a, 1] * S01) / det
        K[a, 1] = (P[a, 1] * S00 - P[a, 0] * S01) / det
        x[a] += K[a, 0] * y0 + K[a, 1] * y1
    for a in range(4):
        for b in range(4):
            M[a, b] = P[a, b] - K[a, 0] * P[0, b] - K[a, 1] * P[1, b]
    for a in range(4):
        for b in range(a, 4):
            KR0, KR1 = K[a, 0] * R[0, 0] + K[a, 1] * R[1, 0], K[a, 0] * R[0, 1] + K[a, 1] * R[1, 1]
            P[a, b] = M[a, b] - M[a, 0] * K[b, 0] - M[a, 1] * K[b, 1] + KR0 * K[b, 0] + KR1 * K[b, 1]
            P[b, a] = P[a, b]


def _update_rows_filterpy(
    x: Float, P: Float, rows: Int, dt: Float, acceleration_sigma: float, z: Float, R: Float
) -> None:
    """Predict the trees `rows` to the times of their measurements and correct them with filterpy, in place;
    arguments and, up to rounding, results are those of `update_rows`."""
    from filterpy.kalman import predict, update

    for k, row in enumerate(rows):
        x_row, P_row = predict(
            x[row], P[row], F=transition(dt[k]), Q=process_noise(dt[k], acceleration_sigma)
        )
        x[row], P[row] = update(x_row, P_row, z[k], R=R[k], H=H)


# Signature of an engine; see `update_rows`.
UpdateRows = Callable[[Float, Float, Int, Float, float, Float, Float], None]
COMPILED = "compiled"
ENGINES: dict[str, UpdateRows] = {COMPILED: update_rows, "filterpy": _update_rows_filterpy}


LEAST, MOST = 1e-3, 1.0 - 1e-6  # bounds of the weight w
NOTHING = 1e-12  # m^2; smaller shared variances are treated as 0


@compiled
def split(
    P: Float, shared: Float, rows: Int, R: Float, B: Float, dt: Float, acceleration_sigma: float
) -> Float:
    """Prepare the next Kalman update of some trees, so that it becomes one of split covariance intersection.

    Args:
        P: Covariances of the states, shape (T, 4, 4); the position blocks of `rows` are replaced by P1,
            before the prediction.
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

    Any other w within LEAST and MOST is consistent as well, only less accurate. If both shared variances are
    below NOTHING, the result is 0.5.

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
