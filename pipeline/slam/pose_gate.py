"""Gate for measured poses: a pose of another source that jumps, for example by a loop closure, is
rejected."""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam.motion import Motion, Noise, compound, step_variances

REJECTED = "a measured pose is rejected: it is too far from the estimated pose (another SLAM may have jumped)"


def within_gate(T_map_base: Pose2, covariance: Float, motion: Motion, noise: Noise) -> bool:
    """Return whether a measured pose agrees with the prediction: y^T (P + R)^-1 y <= gate of the measurement.
    The gate is a squared Mahalanobis distance.

    y is the difference to the predicted pose, P the covariance of the prediction and R that of the
    measurement. Without a measured pose, or with an infinite gate, the result is True.

    Args:
        T_map_base: Pose before the motion.
        covariance: Its covariance of x, y [m], yaw [rad], shape (3, 3).
        motion: Motion with the measured pose.
        noise: Noise of the odometry.
    """
    z = motion.measured
    if z is None or math.isinf(z.gate):
        return True
    position, heading = step_variances(motion.step.x, motion.step.y, motion.step.yaw, noise)
    if motion.turn_sigma is not None:
        heading = motion.turn_sigma**2
    slack, slack_yaw = motion.slack
    Q = np.diag([position + slack**2, position + slack**2, heading + slack_yaw**2])
    expected, P = compound(T_map_base.as_array(), covariance, motion.step, Q)
    y = z.T_map_base.as_array() - expected
    y[2] = wrap_angle(y[2])
    return bool(y @ np.linalg.solve(P + z.covariance, y) <= z.gate)
