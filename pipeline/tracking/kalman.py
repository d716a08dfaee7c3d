"""Kalman filter of a tree (Eq. 10) with the state x = [x, y, vx, vy] and the measured position z = H x.

Two engines give the same numbers: a compiled one and filterpy.
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
        P: Their covariances, shape (T, 4, 4).
        rows: Row of the tree of each measurement, without duplicates, shape (D,).
        dt: Time since the last update of each of these trees, shape (D,) [s].
        acceleration_sigma: Standard deviation of the acceleration [m/s^2].
        z: Measured positions, shape (D, 2) [m].
        R: Their covariances, shape (D, 2, 2) [m^2].
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
        x, P: State, shape (4,), and its covariance, shape (4, 4).
        z, R: Measured position and its covariance; only the first two rows and columns are used.
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
