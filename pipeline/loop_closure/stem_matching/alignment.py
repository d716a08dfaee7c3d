"""The rigid transform between two sets of matched stems, in closed form, with its covariance."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.jit import compiled


@compiled
def aligned(local: Float, reference: Float, weight: Float, n: int, out: Float) -> None:
    """Write the pose T that minimises the weighted sum of |reference - T local|^2 into `out` (Horn 1987, in
    the plane).

    tan yaw = sum w (l x r) / sum w (l . r) of the points about their weighted means. One pair, or coincident
    points, give the yaw 0; without pairs the result is NaN.

    Args:
        local, reference: The first `n` rows are pairs, shape (M, 2) [m].
        weight: Weights of the pairs, shape (M,) [1/m^2].
        n: Number of pairs.
        out: Filled with x, y [m], yaw [rad], shape (3,).
    """
    total = lx = ly = rx = ry = 0.0
    for k in range(n):
        total += weight[k]
        lx += weight[k] * local[k, 0]
        ly += weight[k] * local[k, 1]
        rx += weight[k] * reference[k, 0]
        ry += weight[k] * reference[k, 1]
    lx, ly, rx, ry = lx / total, ly / total, rx / total, ry / total
    dot = cross = 0.0
    for k in range(n):
        ax, ay = local[k, 0] - lx, local[k, 1] - ly
        bx, by = reference[k, 0] - rx, reference[k, 1] - ry
        dot += weight[k] * (ax * bx + ay * by)
        cross += weight[k] * (ax * by - ay * bx)
    yaw = np.arctan2(cross, dot)
    c, s = np.cos(yaw), np.sin(yaw)
    out[0], out[1], out[2] = rx - c * lx + s * ly, ry - s * lx - c * ly, yaw


def alignment_covariance(pose: Pose2, local: Float, reference: Float, variance: Float) -> Float:
    """Return the covariance of an aligned pose x, y [m], yaw [rad], shape (3, 3): (sum J^T J / variance)^-1
    at the solution.

    Where the residuals are larger than their variances, it grows by their ratio; it never shrinks.

    Args:
        pose: T_reference_local.
        local, reference: Pairs, shape (M, 2) [m], M >= 2, not all at one position.
        variance: Variance per axis of each difference, shape (M,) [m^2].

    Raises:
        LinAlgError: The pairs do not determine the pose.
    """
    arm = local @ pose.rotation().T
    J = np.zeros((len(arm), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
    information = np.einsum("nki,nkj,n->ij", J, J, 1.0 / variance)
    residual = reference - pose.apply(local)
    chi2 = float(np.sum(residual**2 / variance[:, None]))
    freedom = max(2 * len(arm) - 3, 1)
    covariance: Float = np.linalg.inv(information) * max(chi2 / freedom, 1.0)
    return 0.5 * (covariance + covariance.T)
