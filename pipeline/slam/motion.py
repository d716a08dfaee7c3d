"""The motion model (Eq. 6): what the odometry told since a scan was used, and how far it may lie."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.config.stages import Slam
from pipeline.geometry.poses import Float, Pose2
from pipeline.jit import compiled
from pipeline.types.records import PoseMeasurement


@compiled
def wrapped(angle: float) -> float:
    """The same direction between -pi and pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


class Noise(NamedTuple):
    """How the odometry errs: position [m/sqrt m], heading [rad/sqrt m], and heading [rad/sqrt rad]."""

    distance: float
    turn_distance: float
    turn: float


def noise_of(p: Slam) -> Noise:
    """As the parameters have it."""
    return Noise(p.noise_distance, math.radians(p.noise_turn_distance), math.radians(p.noise_turn))


@compiled
def step_variances(x: float, y: float, yaw: float, noise: Noise) -> tuple[float, float]:
    """Variances of one step of the odometry in its own frame: of x and of y [m^2], and of yaw [rad^2].

    They grow with the distance and the turn, so many short steps scatter as one long one does.
    """
    distance = np.hypot(x, y)
    heading = noise.turn_distance**2 * distance + noise.turn**2 * abs(yaw)
    return noise.distance**2 * distance, heading


class Wheels(NamedTuple):
    """How far an odometry may lie from what the trees say.

    Attributes:
        noise: Of one that is as good as it should be.
        distrust: 0 to 1, how much it was wrong lately.
        alone: Distance that it led alone, without two known trees in view [m].
        familiar: Fading share of the detections that were well known trees.
    """

    noise: Noise
    distrust: float
    alone: float
    familiar: float


@compiled
def away_from_trees(motion: Float, driven: float, wheels: Wheels) -> tuple[float, float]:
    """Variances with respect to the trees around of a place that an honest odometry led to: of x and of y
    [m^2], and of yaw [rad^2].

    Args:
        motion: Since the last scan that was used, shape (3,); driven: all the way there, turns as well, more
            than the motion where the robot came back [m], infinite where that was not counted. Of wheels that
            were wrong lately it is not asked: each step of theirs counts for more, see advanced.
    """
    way, turned = np.hypot(motion[0], motion[1]), abs(motion[2])
    counted = np.isfinite(driven) and wheels.distrust == 0.0
    besides = max(driven - way - TURN_AS_DISTANCE * turned, 0.0) if counted else 0.0
    besides += wheels.alone  # it is not known how much of these was a turn
    way, turned = way + besides, turned + besides / TURN_AS_DISTANCE
    position, heading = step_variances(way, 0.0, turned, wheels.noise)
    return position + heading * way * way / 3.0, heading  # the heading went astray on the way


def compound(motion: Float, covariance: Float, step: Pose2, step_noise: Float) -> tuple[Float, Float]:
    """A motion and then a step, with the covariance of both (Smith, Self, Cheeseman 1990).

    Args:
        motion: x, y [m], yaw [rad], shape (3,); covariance: shape (3, 3).
        step: In the frame where the motion ends; step_noise: its covariance, shape (3, 3).
    """
    return compounded(motion, covariance, step.x, step.y, step.yaw, step_noise)


@compiled
def compounded(
    motion: Float, covariance: Float, x: float, y: float, yaw: float, noise: Float
) -> tuple[Float, Float]:
    """See `compound`: F P F^T + G Q G^T, where F moves the error of the motion along, and G turns that of
    the step into its frame."""
    c, s = np.cos(motion[2]), np.sin(motion[2])
    dx, dy = c * x - s * y, s * x + c * y
    moved = np.array([motion[0] + dx, motion[1] + dy, wrapped(motion[2] + yaw)])
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    spread = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for a in range(3):
                for b in range(3):
                    spread[i, j] += F[i, a] * covariance[a, b] * F[j, b] + G[i, a] * noise[a, b] * G[j, b]
    return moved, spread


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
UNKNOWN = -1.0  # a sigma that nobody told
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
    news = motion.measured is not None
    turn_sigma = UNKNOWN if motion.turn_sigma is None else motion.turn_sigma
    moved, motion_after, spread, driven = advanced(
        before, covariance, step.x, step.y, step.yaw, *motion.slack, turn_sigma, news, distrust, noise_of(p),
        p.update_distance,
    )  # fmt: skip
    return (motion_after, spread, driven) if moved else None


@compiled
def advanced(
    before: Float,
    covariance: Float,
    x: float,
    y: float,
    yaw: float,
    slack: float,
    slack_yaw: float,
    turn_sigma: float,
    news: bool,
    distrust: float,
    noise: Noise,
    update_distance: float,
) -> tuple[bool, Float, Float, float]:
    """The same by numbers, and first whether anything moved or is new.

    Args:
        x, y, yaw: The step [m, rad]; slack, slack_yaw, turn_sigma: of it, see Motion; UNKNOWN means None.
        news: Whether another source told the pose.
        update_distance: After so much a scan is used [m].
    """
    slack += distrust * DISTRUST[0]
    if turn_sigma < 0.0:
        slack_yaw += distrust * DISTRUST[1]  # but wheels that slip turn no gyroscope
    news = news or slack != 0.0 or slack_yaw != 0.0
    if x == 0.0 and y == 0.0 and yaw == 0.0 and not news:
        return False, before.copy(), covariance.copy(), 0.0
    position, heading = step_variances(x, y, yaw, noise)
    if turn_sigma >= 0.0:
        heading = turn_sigma * turn_sigma
    moved, spread = stepped(
        before, covariance, x, y, yaw, position + slack * slack, heading + slack_yaw * slack_yaw
    )
    driven = np.hypot(x, y) + TURN_AS_DISTANCE * abs(wrapped(yaw))
    return True, moved, spread, max(driven, update_distance) if news else driven  # news must not wait


@compiled
def stepped(
    motion: Float, covariance: Float, x: float, y: float, yaw: float, position: float, heading: float
) -> tuple[Float, Float]:
    """A motion and then a step whose errors are independent; see `compounded` and `step_variances`."""
    noise = np.zeros((3, 3))
    noise[0, 0] = noise[1, 1] = position
    noise[2, 2] = heading
    return compounded(motion, covariance, x, y, yaw, noise)


@compiled
def correct_by_pose(mu: Float, P: Float, z: Float, R: Float) -> float:
    """Kalman update of a pose by a measured one, in place; returns the log likelihood of the measurement.

    Args:
        mu: shape (3,): x, y [m], yaw [rad]; P: its covariance, shape (3, 3).
        z, R: Likewise of the measurement; R is positive definite.
    """
    S, y, before = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(3):
        y[i] = z[i] - mu[i]
        for j in range(3):
            S[i, j], before[i, j] = P[i, j] + R[i, j], P[i, j]
    y[2] = (y[2] + np.pi) % (2.0 * np.pi) - np.pi
    S_inv, det = inverted(S)
    K, square = np.zeros((3, 3)), 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                K[i, j] += before[i, k] * S_inv[k, j]
            mu[i] += K[i, j] * y[j]
            square += y[i] * S_inv[i, j] * y[j]
    for i in range(3):
        for j in range(i, 3):
            for k in range(3):
                P[i, j] -= 0.5 * (K[i, k] * before[k, j] + K[j, k] * before[k, i])
            P[j, i] = P[i, j]
    return float(-0.5 * (square + np.log(det)))


@compiled
def inverted(S: Float) -> tuple[Float, float]:
    """Inverse of a symmetric positive definite matrix, shape (3, 3), by its cofactors, and its determinant:
    the library's takes seven seconds to compile."""
    inverse = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            inverse[j, i] = S[a, c] * S[b, d] - S[a, d] * S[b, c]
    det = S[0, 0] * inverse[0, 0] + S[0, 1] * inverse[1, 0] + S[0, 2] * inverse[2, 0]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= det
    return inverse, det


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
def moved_pose(pose: Float, motion: Float) -> Float:
    """One pose, shape (3,), after a motion in its own frame."""
    one = np.empty((1, 3))
    for i in range(3):
        one[0, i] = pose[i]
    moved: Float = moved_poses(one, motion)[0]
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
