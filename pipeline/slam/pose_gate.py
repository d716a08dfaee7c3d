"""Whether a measured pose can be: another SLAM that closes a loop jumps, and must not tear our map."""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam.motion import Motion, Noise, compound, step_variances

REFUSED = "left out: a measured pose that lies too far from what is known (another SLAM may have jumped)"


def within_gate(T_map_base: Pose2, covariance: Float, motion: Motion, noise: Noise) -> bool:
    """Whether the pose that was measured after a motion fits what is known: y^T S^-1 y <= its gate.

    Args:
        T_map_base: Pose before the motion; covariance: of its x, y [m], yaw [rad], shape (3, 3).
        motion: With the measured pose.
        noise: Of the odometry.
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
