"""The motion model (Eq. 6): what the odometry told since a scan was used, and how far it may lie."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float, Pose2
from pipeline.parameters.stages import Slam
from pipeline.records import PoseMeasurement


def wrapped(angle: float) -> float:
    """The same direction between -pi and pi."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def step_covariance(step: Pose2, p: Slam) -> Float:
    """Covariance of one step of the odometry in its own frame: x, y [m], yaw [rad], shape (3, 3).

    Variances grow with the distance and the turn, so many short steps scatter as one long one does.
    """
    distance = math.hypot(step.x, step.y)
    position = p.noise_distance**2 * distance
    yaw = math.radians(p.noise_turn_distance) ** 2 * distance
    yaw += math.radians(p.noise_turn) ** 2 * abs(step.yaw)
    return np.array([[position, 0.0, 0.0], [0.0, position, 0.0], [0.0, 0.0, yaw]])


def compound(motion: Float, covariance: Float, step: Pose2, step_noise: Float) -> tuple[Float, Float]:
    """A motion and then a step, with the covariance of both (Smith, Self, Cheeseman 1990).

    Args:
        motion: x, y [m], yaw [rad], shape (3,); covariance: shape (3, 3).
        step: In the frame where the motion ends; step_noise: its covariance, shape (3, 3).
    """
    yaw = float(motion[2])
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = c * step.x - s * step.y, s * step.x + c * step.y
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = np.array([motion[0] + dx, motion[1] + dy, wrapped(yaw + step.yaw)])
    return moved, F @ covariance @ F.T + G @ step_noise @ G.T


class Motion(NamedTuple):
    """What is known of the motion from one scan to the next.

    Attributes:
        step: T_base(t-1)_base(t) by the odometry.
        slack: Added to its standard deviations where the odometry is doubtful: position [m], heading [rad].
        doubt: Why, for people; empty when nothing is.
        measured: The pose by another source.
        turn_sigma: Of the step's turn [rad] where it is known better than the odometry alone knows it.
    """

    step: Pose2
    slack: tuple[float, float] = (0.0, 0.0)
    doubt: str = ""
    measured: PoseMeasurement | None = None
    turn_sigma: float | None = None


DISTRUST = (0.1, 0.03)  # m, rad; added to a step of wheels that just slipped, for they slip again
TURN_AS_DISTANCE = 1.0  # m/rad; a robot that turns on the spot sees the trees anew as well


def accumulated(
    before: Float, covariance: Float, motion: Motion, distrust: float, p: Slam
) -> tuple[Float, Float, float] | None:
    """A motion so far and one step more, with its covariance, and what the step counts as driven [m]; None
    where nothing moved and nothing is new.

    Args:
        before: x, y [m], yaw [rad] since the last scan that was used; covariance: shape (3, 3).
        distrust: 0 to 1, how much the odometry was wrong lately.
    """
    step = motion.step
    turned = motion.turn_sigma
    doubted = distrust * DISTRUST[1] if turned is None else 0.0  # wheels that slip turn no gyroscope
    slack = motion.slack[0] + distrust * DISTRUST[0], motion.slack[1] + doubted
    is_news = motion.measured is not None or slack != (0.0, 0.0)
    if step.x == step.y == step.yaw == 0.0 and not is_news:
        return None
    noise = step_covariance(step, p)
    if turned is not None:
        noise[2, 2] = turned**2
    noise += np.diag([slack[0] ** 2, slack[0] ** 2, slack[1] ** 2])
    moved, spread = compound(before, covariance, step, noise)
    driven = math.hypot(step.x, step.y) + TURN_AS_DISTANCE * abs(wrapped(step.yaw))
    return moved, spread, max(driven, p.update_distance) if is_news else driven  # news must not wait


@compiled
def correct_by_pose(mu: Float, P: Float, z: Float, R: Float) -> float:
    """Kalman update of a pose by a measured one, in place; returns the log likelihood of the measurement.

    Args:
        mu: shape (3,): x, y [m], yaw [rad]; P: its covariance, shape (3, 3).
        z, R: Likewise of the measurement; R is positive definite.
    """
    S_inv = np.linalg.inv(P + R)
    y = z - mu
    y[2] = (y[2] + np.pi) % (2.0 * np.pi) - np.pi
    K = P @ S_inv
    mu += K @ y
    P[:] = P - K @ P
    P[:] = 0.5 * (P + P.T)
    return float(-0.5 * (y @ (S_inv @ y)) + 0.5 * np.log(np.linalg.det(S_inv)))


@compiled
def moved_poses(pose: Float, motion: Float) -> Float:
    """Poses of shape (P, 3) after one and the same motion, each in its own frame."""
    moved = np.empty_like(pose)
    for p in range(pose.shape[0]):
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        moved[p, 0] = pose[p, 0] + c * motion[0] - s * motion[1]
        moved[p, 1] = pose[p, 1] + s * motion[0] + c * motion[1]
        moved[p, 2] = (pose[p, 2] + motion[2] + np.pi) % (2.0 * np.pi) - np.pi
    return moved


@compiled
def weighted_pose(
    pose: Float, weights: Float, motion: Float, motion_covariance: Float
) -> tuple[Float, Float]:
    """Mean x, y, yaw and covariance, shape (3, 3), of weighted poses of shape (P, 3), a yaw being a
    direction.

    Args:
        motion, motion_covariance: What the poses were moved by since they were drawn, in their frame.
    """
    mean = np.zeros(3)
    cos, sin = 0.0, 0.0
    for p in range(pose.shape[0]):
        mean[0] += weights[p] * pose[p, 0]
        mean[1] += weights[p] * pose[p, 1]
        cos += weights[p] * np.cos(pose[p, 2])
        sin += weights[p] * np.sin(pose[p, 2])
    mean[2] = np.arctan2(sin, cos)
    covariance = np.zeros((3, 3))
    for p in range(pose.shape[0]):
        dx, dy = pose[p, 0] - mean[0], pose[p, 1] - mean[1]
        turn = (pose[p, 2] - mean[2] + np.pi) % (2.0 * np.pi) - np.pi
        covariance[0, 0] += weights[p] * dx * dx
        covariance[0, 1] += weights[p] * dx * dy
        covariance[0, 2] += weights[p] * dx * turn
        covariance[1, 1] += weights[p] * dy * dy
        covariance[1, 2] += weights[p] * dy * turn
        covariance[2, 2] += weights[p] * turn * turn
    c, s = np.cos(mean[2] - motion[2]), np.sin(mean[2] - motion[2])
    C = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for i in range(3):
        for j in range(i, 3):
            for a in range(3):
                for b in range(3):
                    covariance[i, j] += C[i, a] * motion_covariance[a, b] * C[j, b]
            covariance[j, i] = covariance[i, j]
    return mean, covariance
