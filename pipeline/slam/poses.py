"""Arrays of poses and covariances, one per row, and the path between corrected keyframes."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, wrap_angle
from pipeline.types.records import Int


def composed(a: Float, b: Float) -> Float:
    """T_a_b @ T_b_c of poses x, y [m], yaw [rad], shape (N, 3)."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [
            a[:, 0] + c * b[:, 0] - s * b[:, 1],
            a[:, 1] + s * b[:, 0] + c * b[:, 1],
            wrap_angle(a[:, 2] + b[:, 2]),
        ]
    )


def inverse(a: Float) -> Float:
    """T_b_a of T_a_b, shape (N, 3)."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack([-c * a[:, 0] - s * a[:, 1], s * a[:, 0] - c * a[:, 1], wrap_angle(-a[:, 2])])


def interpolated(keyframes: Float, motions: Float, keyframe: Int, since: Float) -> Float:
    """x, y [m], yaw [rad] of every scan, shape (N, 3).

    The odometry leads from one keyframe on; what it lacks at the next one is spread evenly over the scans
    between the two.

    Args:
        keyframes: shape (K, 3).
        motions: By the odometry from keyframe k - 1 to k, shape (K, 3); NaN where it tells nothing.
        keyframe: int64, shape (N,), ascending, the last keyframe before each scan or at it.
        since: Motion by the odometry since then, shape (N, 3).
    """
    lacking = np.zeros_like(keyframes)
    if len(keyframes) > 1:
        between = composed(inverse(keyframes[:-1]), keyframes[1:])
        lacking[:-1] = composed(inverse(motions[1:]), between)
    lacking[np.isnan(lacking).any(axis=1)] = 0.0
    first = np.searchsorted(keyframe, np.arange(len(keyframes) + 1))
    part = (np.arange(len(keyframe)) - first[keyframe]) / (first[keyframe + 1] - first[keyframe])
    return composed(composed(keyframes[keyframe], since), part[:, None] * lacking[keyframe])


def rotated_rows(covariance: Float, turn: Float) -> Float:
    """Return covariances xx, xy, yy, shape (N, 3), rotated by angles, shape (N,)."""
    c, s = np.cos(turn), np.sin(turn)
    xx, xy, yy = covariance.T
    return np.column_stack(
        [
            c * c * xx - 2.0 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2.0 * c * s * xy + c * c * yy,
        ]
    )
