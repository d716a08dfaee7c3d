"""The motion model (Eq. 6): what the odometry told since a scan was used, and how far it may lie."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float, Pose2, wrap_angle
from pipeline.parameters.stages import Slam


def step_covariance(step: Pose2, p: Slam) -> Float:
    """Covariance of one step of the odometry in its own frame: x, y [m], yaw [rad], shape (3, 3).

    Variances grow with the distance and the turn, so many short steps scatter as one long one does.
    """
    distance = float(np.hypot(step.x, step.y))
    position = p.noise_distance**2 * distance
    yaw = np.radians(p.noise_turn_distance) ** 2 * distance + np.radians(p.noise_turn) ** 2 * abs(step.yaw)
    return np.diag([position, position, yaw])


def compound(motion: Float, covariance: Float, step: Pose2, step_noise: Float) -> tuple[Float, Float]:
    """A motion and then a step, with the covariance of both (Smith, Self, Cheeseman 1990).

    Args:
        motion: x, y [m], yaw [rad], shape (3,); covariance: shape (3, 3).
        step: In the frame where the motion ends; step_noise: its covariance, shape (3, 3).
    """
    c, s = np.cos(motion[2]), np.sin(motion[2])
    dx, dy = c * step.x - s * step.y, s * step.x + c * step.y
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = np.array([motion[0] + dx, motion[1] + dy, float(wrap_angle(motion[2] + step.yaw))])
    return moved, F @ covariance @ F.T + G @ step_noise @ G.T


def moved_poses(pose: Float, motion: Float) -> Float:
    """Poses of shape (P, 3) after one and the same motion, each in its own frame."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack(
        [
            pose[:, 0] + c * motion[0] - s * motion[1],
            pose[:, 1] + s * motion[0] + c * motion[1],
            wrap_angle(pose[:, 2] + motion[2]),
        ],
        axis=1,
    )
