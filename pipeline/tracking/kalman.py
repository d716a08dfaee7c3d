"""The Kalman filter of a tree (Eq. 10): state x = [x, y, vx, vy], measured position z = H x.

Two engines give the same numbers: our compiled one and filterpy.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int

H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])


@compiled
def transition(dt: float) -> Float:
    """F of constant velocity over dt [s]."""
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt
    return F


@compiled
def process_noise(dt: float, acceleration_sigma: float) -> Float:
    """Q of a white acceleration over dt [s] (Bar-Shalom, Li, Kirubarajan 2001, eq. 6.3.2-4)."""
    Q = np.zeros((4, 4))
    q = acceleration_sigma * acceleration_sigma
    for a in range(2):
        Q[a, a] = 0.25 * dt**4 * q
        Q[a, a + 2] = Q[a + 2, a] = 0.5 * dt**3 * q
        Q[a + 2, a + 2] = dt * dt * q
    return Q


@compiled
def _update_compiled(
    x: Float, P: Float, dt: float, acceleration_sigma: float, z: Float, R: Float
) -> tuple[Float, Float]:
    F = transition(dt)
    x = F @ x
    P = F @ P @ F.T + process_noise(dt, acceleration_sigma)
    y = z - x[:2]
    S = P[:2, :2] + R
    K = np.ascontiguousarray(P[:, :2]) @ np.linalg.inv(S)
    x = x + K @ y
    I_KH = np.eye(4)
    I_KH[:, :2] -= K
    P = I_KH @ P @ I_KH.T + K @ R @ K.T  # Joseph's form stays symmetric and positive
    return x, P


@compiled
def _update_rows_compiled(
    x: Float, P: Float, rows: Int, dt: Float, acceleration_sigma: float, z: Float, R: Float
) -> None:
    for k in range(rows.shape[0]):
        row = rows[k]
        x[row], P[row] = _update_compiled(x[row], P[row], dt[k], acceleration_sigma, z[k], R[k])


def _update_rows_filterpy(
    x: Float, P: Float, rows: Int, dt: Float, acceleration_sigma: float, z: Float, R: Float
) -> None:
    from filterpy.kalman import predict, update

    for k, row in enumerate(rows):
        x_row, P_row = predict(
            x[row], P[row], F=transition(dt[k]), Q=process_noise(dt[k], acceleration_sigma)
        )
        x[row], P[row] = update(x_row, P_row, z[k], R=R[k], H=H)


# x (T, 4), P (T, 4, 4), rows (D,), dt (D,) [s], acceleration sigma [m/s^2], z (D, 2) [m], R (D, 2, 2)
UpdateRows = Callable[[Float, Float, Int, Float, float, Float, Float], None]
ENGINES: dict[str, UpdateRows] = {"compiled": _update_rows_compiled, "filterpy": _update_rows_filterpy}
