"""Gaussians of poses and positions in the plane, and solution of small positive definite systems.

The matrix products are written out with scalars, which stay in registers; library calls for such small
matrices are slower.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing

SMALL_TURN = 0.02  # rad; below it the series of sine and cosine is exact to 1e-10


class Pose(NamedTuple):
    """A Gaussian pose as scalars.

    Attributes:
        x, y, yaw: Mean [m, m, rad].
        xx, xy, xt, yy, yt, tt: Upper half of the covariance of x, y and yaw (t) [m^2, m rad, rad^2].
    """

    x: float
    y: float
    yaw: float
    xx: float
    xy: float
    xt: float
    yy: float
    yt: float
    tt: float


@compiled_borrowing
def pose_of(mu: Float, P: Float) -> Pose:
    """Return a pose by its mean, shape (3,), and covariance, shape (3, 3), of which only the upper triangle
    is read."""
    return Pose(mu[0], mu[1], mu[2], P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])


@compiled_borrowing
def keep_pose(pose: Pose, mu: Float, P: Float) -> None:
    """Write a pose into its mean, shape (3,), and its symmetric covariance, shape (3, 3), both in place: the
    inverse of `pose_of`."""
    mu[0], mu[1], mu[2] = pose.x, pose.y, pose.yaw
    P[0, 0], P[1, 1], P[2, 2] = pose.xx, pose.yy, pose.tt
    P[0, 1] = P[1, 0] = pose.xy
    P[0, 2] = P[2, 0] = pose.xt
    P[1, 2] = P[2, 1] = pose.yt


def rows_of(covariance: Float) -> Float:
    """Return xx, xy, yy, shape (D, 3), of covariances of shape (D, 2, 2)."""
    return np.ascontiguousarray(covariance.reshape(-1, 4)[:, [0, 1, 3]])


@compiled_borrowing
def rotated(R: Float, d: int, c: float, s: float) -> tuple[float, float, float]:
    """Return xx, xy, yy of C R[d] C^T, where C is the rotation by the angle with cosine c and sine s; R holds
    the elements xx, xy, yy of covariances, shape (D, 3)."""
    xx, xy, yy = R[d, 0], R[d, 1], R[d, 2]
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@compiled_borrowing
def expected_spread(
    pose: Pose, c: float, s: float, ax: float, ay: float, R: Float, d: int
) -> tuple[float, float, float]:
    """Return xx, xy, yy of C R C^T + J P J^T, the covariance of detection d by the pose and by its own error.

    Args:
        pose: Pose with its covariance P.
        c, s: Cosine and sine of the yaw of the pose.
        ax, ay: Vector from the robot to the detection in the frame of the map [m]: J = [I, (-ay, ax)^T].
        R: Covariances xx, xy, yy of the detections in the base frame, shape (D, 3) [m^2].
        d: Row of R.
    """
    xx, xy, yy = rotated(R, d, c, s)
    return (
        xx + pose.xx - 2.0 * ay * pose.xt + ay * ay * pose.tt,
        xy + pose.xy + ax * pose.xt - ay * pose.yt - ax * ay * pose.tt,
        yy + pose.yy + 2.0 * ax * pose.yt + ax * ax * pose.tt,
    )


@compiled
def in_map(
    centre: Float, covariance: Float, pose: Float, pose_covariance: Float
) -> tuple[Float, Float, Float]:
    """Return detections in the frame of the map: positions, shape (D, 2) [m], own covariances C R C^T of the
    detections, and the covariances that the pose adds, J Sigma J^T, both of shape (D, 2, 2) [m^2].

    Args:
        centre: Positions of the detections in the base frame, shape (D, 2) [m].
        covariance: Covariances R of the detections in the base frame, shape (D, 2, 2) [m^2].
        pose: x, y [m], yaw [rad] of the base in the map, shape (3,).
        pose_covariance: Covariance Sigma of the pose, shape (3, 3).
    """
    D = centre.shape[0]
    place, own, added = np.empty((D, 2)), np.empty((D, 2, 2)), np.empty((D, 2, 2))
    c, s, S = np.cos(pose[2]), np.sin(pose[2]), pose_covariance
    for d in range(D):
        x, y = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        place[d, 0], place[d, 1] = pose[0] + x, pose[1] + y
        a, b, e = covariance[d, 0, 0], covariance[d, 0, 1], covariance[d, 1, 1]
        own[d, 0, 0] = c * c * a - 2.0 * c * s * b + s * s * e
        own[d, 0, 1] = own[d, 1, 0] = c * s * (a - e) + (c * c - s * s) * b
        own[d, 1, 1] = s * s * a + 2.0 * c * s * b + c * c * e
        added[d, 0, 0] = S[0, 0] - 2.0 * y * S[0, 2] + y * y * S[2, 2]
        added[d, 0, 1] = added[d, 1, 0] = S[0, 1] + x * S[0, 2] - y * S[1, 2] - x * y * S[2, 2]
        added[d, 1, 1] = S[1, 1] + 2.0 * x * S[1, 2] + x * x * S[2, 2]
    return place, own, added


def spread_by_pose(position: Float, pose: Float, Sigma: Float) -> Float:
    """Return the covariance that a pose adds to positions relative to it, J Sigma J^T, shape (N, 2, 2) [m^2].

    Args:
        position: Positions in the frame of the map, shape (N, 2) [m].
        pose: Pose x, y [m], yaw [rad] in the map, shape (3,); J is evaluated at the position minus the pose.
        Sigma: Covariance of the pose, shape (3, 3).
    """
    J = np.zeros((len(position), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = pose[1] - position[:, 1], position[:, 0] - pose[0]
    added: Float = J @ Sigma @ J.transpose(0, 2, 1)
    return added


@compiled_borrowing
def corrected(
    pose: Pose, ax: float, ay: float, S0: float, S1: float, S2: float, y0: float, y1: float
) -> Pose:
    """Return a pose corrected by the observation of one landmark (Kalman update). The yaw of the result is
    not wrapped.

    Args:
        pose: Pose before the correction.
        ax, ay: Vector from the robot to the detection in the frame of the map [m]; J as in `expected_spread`.
        S0, S1, S2: Covariance xx, xy, yy of the innovation [m^2], which must be invertible.
        y0, y1: Innovation: the landmark minus the detection, both in the frame of the map [m].
    """
    scale = 1.0 / (S0 * S2 - S1 * S1)
    a0, a1, a2 = pose.xx - ay * pose.xt, pose.xy - ay * pose.yt, pose.xt - ay * pose.tt
    b0, b1, b2 = pose.xy + ax * pose.xt, pose.yy + ax * pose.yt, pose.yt + ax * pose.tt
    k00, k01 = (a0 * S2 - b0 * S1) * scale, (b0 * S0 - a0 * S1) * scale
    k10, k11 = (a1 * S2 - b1 * S1) * scale, (b1 * S0 - a1 * S1) * scale
    k20, k21 = (a2 * S2 - b2 * S1) * scale, (b2 * S0 - a2 * S1) * scale
    return Pose(
        pose.x + (k00 * y0 + k01 * y1),
        pose.y + (k10 * y0 + k11 * y1),
        pose.yaw + (k20 * y0 + k21 * y1),
        pose.xx - (k00 * a0 + k01 * b0),
        pose.xy - (k00 * a1 + k01 * b1),
        pose.xt - (k00 * a2 + k01 * b2),
        pose.yy - (k10 * a1 + k11 * b1),
        pose.yt - (k10 * a2 + k11 * b2),
        pose.tt - (k20 * a2 + k21 * b2),
    )


@compiled_borrowing
def turned(c: float, s: float, by: float, yaw: float) -> tuple[float, float]:
    """Return cosine and sine of a yaw after a rotation.

    Args:
        c, s: Cosine and sine of the yaw before the rotation.
        by: Angle of the rotation [rad]; up to SMALL_TURN, cosine and sine are updated by a series.
        yaw: Yaw after the rotation [rad], which is used for larger rotations only.
    """
    if abs(by) > SMALL_TURN:
        return np.cos(yaw), np.sin(yaw)
    b2 = by * by
    cos, sin = 1.0 - b2 * (0.5 - b2 / 24.0), by * (1.0 - b2 / 6.0)
    return c * cos - s * sin, s * cos + c * sin


@compiled_borrowing
def draw(mu: Float, P: Float, noise: Float, p: int, out: Float) -> None:
    """Sample row p of `out` from the Gaussian N(mu, P): mu + L noise[p] with L L^T = P (Cholesky), yaw
    wrapped.

    Args:
        mu: Mean x, y [m], yaw [rad], shape (3,).
        P: Covariance, shape (3, 3), which may be singular: a direction without variance gets no noise.
        noise: Standard normal numbers, shape (N, 3).
        p: Row of `noise` and of `out`.
        out: Poses, shape (N, 3); row p is changed.
    """
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


@compiled
def factorise(H: Float, L: Float) -> None:
    """Write the Cholesky factor of H, H = L L^T, into the lower triangle of L, in place; both have the shape
    (n, n). Only the lower triangle of H is read, and the upper triangle of L is not written. L contains NaN
    or inf if H is not positive definite; no error is raised."""
    for a in range(H.shape[0]):
        for b in range(a):
            total = H[a, b]
            for k in range(b):
                total -= L[a, k] * L[b, k]
            L[a, b] = total / L[b, b]
        total = H[a, a]
        for k in range(a):
            total -= L[a, k] * L[a, k]
        L[a, a] = np.sqrt(total)


@compiled
def solve(L: Float, b: Float, x: Float) -> None:
    """Write the solution x of L L^T x = b into x, in place.

    Args:
        L: Result of `factorise`, shape (n, n), of which only the lower triangle is read.
        b: Right side, shape (n,), not changed unless it is the same array as x.
        x: Filled with the solution, shape (n,).
    """
    n = b.shape[0]
    for a in range(n):
        total = b[a]
        for k in range(a):
            total -= L[a, k] * x[k]
        x[a] = total / L[a, a]
    for a in range(n - 1, -1, -1):
        total = x[a]
        for k in range(a + 1, n):
            total -= L[k, a] * x[k]
        x[a] = total / L[a, a]
