"""Motion model of the robot (Eq. 6): odometry steps, their accumulation between scans, and their
covariance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.config.stages import Slam
from pipeline.geometry.poses import Float, Pose2
from pipeline.jit import compiled
from pipeline.types.records import PoseMeasurement


def wrapped(angle: float) -> float:
    """Return an angle [rad] wrapped to [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


class Noise(NamedTuple):
    """Standard deviations of the odometry noise, each per square root of its cause (a random walk).

    Attributes:
        distance: Position noise [m/sqrt(m)].
        turn_distance: Heading noise by distance [rad/sqrt(m)].
        turn: Heading noise by rotation [rad/sqrt(rad)].
    """

    distance: float
    turn_distance: float
    turn: float


def noise_of(p: Slam) -> Noise:
    """Return the odometry noise of the parameters; their angles in degrees become radians."""
    return Noise(p.noise_distance, math.radians(p.noise_turn_distance), math.radians(p.noise_turn))


def step_variances(x: float, y: float, yaw: float, noise: Noise) -> tuple[float, float]:
    """Return the variances of one odometry step, in the frame in which the step begins.

    With the distance s = hypot(x, y), the position variance is (noise.distance)^2 s for x and for y [m^2],
    and the heading variance is (noise.turn_distance)^2 s + (noise.turn)^2 |yaw| [rad^2]. They are linear in
    distance and rotation.

    Args:
        x, y, yaw: Step [m, m, rad].
        noise: Noise of the odometry.

    Returns:
        Variance of x and of y [m^2], and variance of yaw [rad^2].
    """
    distance = math.hypot(x, y)
    heading = noise.turn_distance**2 * distance + noise.turn**2 * abs(yaw)
    return noise.distance**2 * distance, heading


class OdometryTrust(NamedTuple):
    """How far the odometry may deviate from the motion relative to the trees.

    Attributes:
        noise: Noise of an odometry without faults.
        distrust: 0 to 1; 1 directly after the trees contradicted the odometry, then decaying.
        unobserved: Distance driven since the last scan in which two landmarks with at least `hits_to_weigh`
            hits were detected [m].
        known_share: Running mean of the share of detections of landmarks with at least `hits_to_weigh` hits,
            0 to 1.
    """

    noise: Noise
    distrust: float
    unobserved: float
    known_share: float


def drift_variances(motion: Float, driven: float, trust: OdometryTrust) -> tuple[float, float]:
    """Return the variances of the predicted pose relative to the surrounding trees, for an odometry without
    faults.

    The distance beyond the net motion (a detour, or distance without known trees) counts both as distance and
    as rotation. A heading error that accumulates uniformly over a distance s displaces the end by the
    variance (heading variance) s^2 / 3, which is added to the position variance.

    Args:
        motion: x, y [m], yaw [rad] since the last used scan, shape (3,).
        driven: Path length since that scan, plus TURN_AS_DISTANCE per radian [m]. It is ignored while the
            odometry is distrusted, because each step then has a larger covariance (see `accumulated`).
        trust: State of the odometry.

    Returns:
        Variance of x and of y [m^2], and variance of yaw [rad^2].
    """
    x, y, yaw = motion.tolist()
    distance, turned = math.hypot(x, y), abs(yaw)
    trusted = trust.distrust == 0.0
    detour = max(driven - distance - TURN_AS_DISTANCE * turned, 0.0) if trusted else 0.0
    detour += trust.unobserved  # the share of turns in this distance is unknown
    distance, turned = distance + detour, turned + detour / TURN_AS_DISTANCE
    position, heading = step_variances(distance, 0.0, turned, trust.noise)
    return position + heading * distance * distance / 3.0, heading


def compound(motion: Float, covariance: Float, step: Pose2, step_noise: Float) -> tuple[Float, Float]:
    """Return the composition of a motion and a step, and its covariance (Smith, Self, Cheeseman 1990).

    Args:
        motion: x, y [m], yaw [rad], shape (3,).
        covariance: Covariance of the motion in the frame in which it begins, shape (3, 3).
        step: Step in the frame in which the motion ends.
        step_noise: Covariance of the step in the same frame, shape (3, 3).

    Returns:
        Motion, shape (3,), and covariance, shape (3, 3), in the frame in which the motion begins.
    """
    return compounded(motion, covariance, step.x, step.y, step.yaw, step_noise)


def compounded(
    motion: Float, covariance: Float, x: float, y: float, yaw: float, noise: Float
) -> tuple[Float, Float]:
    """Return the composition of a motion and a step x, y [m], yaw [rad], and its covariance F P F^T + G Q
    G^T. The yaw of the result is in [-pi, pi); arguments are unchanged.

    F is the Jacobian by the motion and G the rotation of the step into the frame of the motion; P is
    `covariance` and Q is `noise`, both of shape (3, 3). See `compound`.
    """
    c, s = math.cos(motion[2]), math.sin(motion[2])
    dx, dy = c * x - s * y, s * x + c * y
    moved = np.array([motion[0] + dx, motion[1] + dy, wrapped(motion[2] + yaw)])
    F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    G = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return moved, F @ covariance @ F.T + G @ noise @ G.T


class Motion(NamedTuple):
    """Motion from one scan to the next.

    Attributes:
        step: T_base(t-1)_base(t) by the odometry.
        slack: Standard deviations that are added where the odometry is doubtful: position [m], heading [rad].
            Those of successive steps are of one velocity, so they add up linearly; see `accumulated`.
        doubt: Message with the reason of the doubt; empty if there is none.
        measured: Pose that another source measured at this scan, if any.
        covariance: Covariance of the step, shape (3, 3), if its source knows it, as LiDAR odometry does;
            None for the noise of the parameters.
        turn_sigma: Standard deviation of the yaw of the step [rad] if a gyroscope measured it, else None.
        due: Whether the scan updates the filter even if the robot has moved less than `update_distance`.
        is_view: See Step.
        period: Time since the scan before [s].
    """

    step: Pose2
    slack: tuple[float, float] = (0.0, 0.0)
    doubt: str = ""
    measured: PoseMeasurement | None = None
    covariance: Float | None = None
    turn_sigma: float | None = None
    due: bool = False
    is_view: bool = True
    period: float = 0.1


# m/s, rad/s; slack of each second at full distrust, because wheels that slipped slip again.
DISTRUST = (1.0, 0.3)
# m, rad; largest sum of the slack: stems that are farther from where they are expected are searched for by
# their constellation.
SLACK_MAX = (3.0, 0.5)
# m/rad; distance to which a turn is equivalent, because a turn on the spot also changes the view of the
# trees.
TURN_AS_DISTANCE = 1.0


def accumulated(
    before: Float, covariance: Float, slack: Float, motion: Motion, distrust: float, p: Slam
) -> tuple[Float, Float, Float, float] | None:
    """Return the motion since the last used scan after one more step, or None if there is nothing to add.

    Args:
        before: x, y [m], yaw [rad] since the last used scan, shape (3,).
        covariance: Covariance of `before`, shape (3, 3).
        slack: Sum of the slack of position [m] and heading [rad] since trees or a measured pose last
            determined the pose, shape (2,).
        motion: The step with its uncertainty.
        distrust: 0 to 1, see OdometryTrust; scales DISTRUST, which is added to the slack of the step.
        p: Noise of the odometry and `update_distance`.

    Returns:
        Motion, shape (3,); covariance of the motion, shape (3, 3); the sum of the slack, shape (2,); and the
        distance that the step counts towards `update_distance` [m], with TURN_AS_DISTANCE per radian; at
        least `update_distance` for a step with slack, distrust or a measured pose. None if the step is zero
        and has none of these.
    """
    step, doubted_s = motion.step, distrust * motion.period
    own, own_yaw = motion.slack[0] + doubted_s * DISTRUST[0], motion.slack[1]
    if motion.turn_sigma is None:
        own_yaw += doubted_s * DISTRUST[1]  # slipping wheels do not affect a gyroscope
    news = motion.measured is not None or own != 0.0 or own_yaw != 0.0
    if step.x == 0.0 and step.y == 0.0 and step.yaw == 0.0 and not news:
        return None
    noise = step_covariance(motion, noise_of(p))
    # A slack is the error of an unknown velocity, which is the same in successive steps: standard deviations
    # add up, and the variance grows with the square of the time, however many scans there are.
    before_xy, before_yaw = slack.tolist()
    total, total_yaw = min(before_xy + own, SLACK_MAX[0]), min(before_yaw + own_yaw, SLACK_MAX[1])
    noise[0, 0] += total**2 - before_xy**2
    noise[1, 1] += total**2 - before_xy**2
    noise[2, 2] += total_yaw**2 - before_yaw**2
    moved, spread = compounded(before, covariance, step.x, step.y, step.yaw, noise)
    driven = math.hypot(step.x, step.y) + TURN_AS_DISTANCE * abs(wrapped(step.yaw))
    return moved, spread, np.array([total, total_yaw]), max(driven, p.update_distance) if news else driven


def step_covariance(motion: Motion, noise: Noise) -> Float:
    """Return the covariance of the step of a motion without its slack, shape (3, 3): its own if it is known,
    else by the noise of the odometry (`step_variances`); a gyroscope replaces the part of the heading."""
    if motion.covariance is None:
        position, heading = step_variances(motion.step.x, motion.step.y, motion.step.yaw, noise)
        covariance = np.array([[position, 0.0, 0.0], [0.0, position, 0.0], [0.0, 0.0, heading]])
    else:
        covariance = motion.covariance.copy()
    if motion.turn_sigma is not None:
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = motion.turn_sigma**2
    return covariance


@compiled
def correct_by_pose(mu: Float, P: Float, z: Float, R: Float) -> float:
    """Correct a pose by a measured pose (Kalman update with H = I), in place.

    Args:
        mu: x, y [m], yaw [rad], shape (3,); is replaced by the corrected pose, whose yaw is not wrapped.
        P: Covariance of `mu`, shape (3, 3); is replaced likewise.
        z: Measured pose, shape (3,).
        R: Covariance of `z`, shape (3, 3), positive definite.

    Returns:
        Log likelihood of the measurement without its constant: -(y^T S^-1 y + ln det S) / 2 with the
        innovation y = z - mu (yaw wrapped) and S = P + R.
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
    """Return the inverse of a symmetric positive definite matrix of shape (3, 3), and its determinant. For a
    singular matrix the determinant is 0 and the inverse contains inf or NaN."""
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
    """Return poses after one common motion, T_map_after = T_map_pose T_motion for each row, shape (P, 3),
    with yaw in [-pi, pi).

    Args:
        pose: x, y [m], yaw [rad] of each pose, shape (P, 3).
        motion: x, y [m], yaw [rad] in the frame of each pose, shape (3,).
    """
    moved = np.empty_like(pose)
    for p in range(pose.shape[0]):
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        moved[p, 0] = pose[p, 0] + c * motion[0] - s * motion[1]
        moved[p, 1] = pose[p, 1] + s * motion[0] + c * motion[1]
        moved[p, 2] = (pose[p, 2] + motion[2] + np.pi) % (2.0 * np.pi) - np.pi
    return moved


def moved_pose(pose: Float, motion: Float) -> Float:
    """Return one pose x, y [m], yaw [rad], shape (3,), after a motion in its own frame, shape (3,), with yaw
    in [-pi, pi). The arguments are unchanged."""
    x, y, yaw = pose.tolist()
    dx, dy, turn = motion.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([x + c * dx - s * dy, y + s * dx + c * dy, wrapped(yaw + turn)])


@compiled
def weighted_pose(
    pose: Float, weights: Float, motion: Float, motion_covariance: Float
) -> tuple[Float, Float]:
    """Return the mean of weighted poses, shape (3,), and their covariance, shape (3, 3), in the frame of the
    poses.

    The mean yaw is the direction of the weighted sum of unit vectors. The covariance is the weighted scatter
    about the mean plus the covariance of the motion since the poses were sampled, rotated into the frame of
    the poses.

    Args:
        pose: x, y [m], yaw [rad] after the motion, shape (P, 3).
        weights: Weights with sum 1, shape (P,).
        motion: Motion since the poses were sampled, the same for all, shape (3,).
        motion_covariance: Covariance of `motion` in the frame in which it begins, shape (3, 3).
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
