"""Operations on arrays of planar poses and covariances, one per row."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, wrap_angle
from pipeline.types.records import Int


def composed(a: Float, b: Float) -> Float:
    """Return T_a_c = T_a_b T_b_c for each row, shape (N, 3), with wrapped yaw.

    Args:
        a: T_a_b as x, y [m], yaw [rad], shape (N, 3).
        b: T_b_c, shape (N, 3).
    """
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [
            a[:, 0] + c * b[:, 0] - s * b[:, 1],
            a[:, 1] + s * b[:, 0] + c * b[:, 1],
            wrap_angle(a[:, 2] + b[:, 2]),
        ]
    )


def inverse(a: Float) -> Float:
    """Return T_b_a for each row of T_a_b, x, y [m], yaw [rad], shape (N, 3)."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack([-c * a[:, 0] - s * a[:, 1], s * a[:, 0] - c * a[:, 1], wrap_angle(-a[:, 2])])


def interpolated(keyframes: Float, motions: Float, scans: Int, keyframe: Int, since: Float) -> Float:
    """Return the pose of each scan between corrected keyframes, x, y [m], yaw [rad], shape (N, 3).

    Each pose is its keyframe composed with the odometry since then. The remaining difference to the next
    keyframe is distributed linearly over the scans between the two.

    Args:
        keyframes: Corrected poses, shape (K, 3).
        motions: Motion by odometry from keyframe k - 1 to k, shape (K, 3); NaN without odometry, then nothing
            is distributed.
        scans: Scan of each keyframe, int64, shape (K,), ascending.
        keyframe: Row of the last keyframe before or at each scan, int64, shape (N,); 0 before the first one.
        since: Motion by odometry from that keyframe to the scan, shape (N, 3).
    """
    lacking = np.zeros_like(keyframes)
    if len(keyframes) > 1:
        between = composed(inverse(keyframes[:-1]), keyframes[1:])
        lacking[:-1] = composed(inverse(motions[1:]), between)
    lacking[np.isnan(lacking).any(axis=1)] = 0.0
    after = np.maximum(np.arange(len(keyframe)) - scans[keyframe], 0)
    part = after / np.diff(scans, append=len(keyframe))[keyframe]
    return composed(composed(keyframes[keyframe], since), part[:, None] * lacking[keyframe])


def rotated_rows(covariance: Float, turn: Float) -> Float:
    """Return covariances xx, xy, yy, shape (N, 3), rotated by angles [rad], shape (N,)."""
    c, s = np.cos(turn), np.sin(turn)
    xx, xy, yy = covariance.T
    return np.column_stack(
        [
            c * c * xx - 2.0 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2.0 * c * s * xy + c * c * yy,
        ]
    )
