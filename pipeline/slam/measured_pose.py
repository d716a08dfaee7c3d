"""Poses that another source measures: their gate, and the errors that all poses of one source share, above
all the alignment of its frame with the map.

A pose that jumps, for example by a loop closure of another SLAM, is rejected. Treated as an independent
error of each pose, a shared error would average out, and the filter would report a smaller sigma than the
source has. It is therefore part of the state: given the path of a particle it is Gaussian, and each
particle estimates it like a landmark (Rao-Blackwellisation; Murphy, Russell 2001):

z = x + H e + v,  e ~ N(0, I) a priori,  v ~ N(0, R) independent for each pose.

Particles that descend from one ancestor share its e, so that their spread does not show its uncertainty.
The uncertainty of the pose by measured poses is therefore also computed by a Kalman filter over pose and
errors that uses only odometry and measured poses (`SharedErrors.joint`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.jit import compiled
from pipeline.slam.motion import (
    Motion,
    Noise,
    compound,
    compounded,
    correct_by_pose,
    inverted,
    step_covariance,
)
from pipeline.types.records import SHARED, SOURCES, Int, PoseMeasurement

POSE = 3  # dimensions of a pose


class MeasuredPose(NamedTuple):
    """A measured pose, with the estimates that P particles have of the shared errors of its source.

    Attributes:
        z: Measured pose x, y [m], yaw [rad] in the map, shape (3,); shape (0,) if no pose was measured.
        own: Covariance of the error of this pose that is independent of other poses, shape (3, 3).
        H: Effect of the shared errors on the pose, see `PoseMeasurement.shared`, shape (3, SHARED).
        mean: Estimated shared errors, shape (P, SHARED); P is 0 for a source without shared errors.
        covariance: Covariances of the shared errors, shape (P, SHARED, SHARED).
    """

    z: Float
    own: Float
    H: Float
    mean: Float
    covariance: Float


def no_measured_pose() -> MeasuredPose:
    """Return the record for a scan without a measured pose: `z` of length 0, zeros, and no particles."""
    return MeasuredPose(
        np.zeros(0),
        np.zeros((3, 3)),
        np.zeros((3, SHARED)),
        np.zeros((0, SHARED)),
        np.zeros((0, SHARED, SHARED)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """Estimates of the shared errors by P particles and by a joint Gaussian.

    All arrays are empty until the first pose of a source with shared errors is used.

    Attributes:
        mean: Estimated errors of each source and particle, shape (SOURCES, P, SHARED).
        covariance: Covariances of the estimated errors, shape (SOURCES, P, SHARED, SHARED).
        joint: Covariance of the pose in the frame of the map and of the errors of all sources, by odometry
            and measured poses only, shape (3 + SOURCES * SHARED, 3 + SOURCES * SHARED).
        at: Pose x, y [m], yaw [rad] to which `joint` and `by_trees` refer, shape (3,).
        by_trees: Covariance of the pose when landmarks last determined it, plus the odometry since then,
            shape (3, 3); shape (0, 0) before.
    """

    mean: Float = field(default_factory=lambda: np.zeros((0, 0, SHARED)))
    covariance: Float = field(default_factory=lambda: np.zeros((0, 0, SHARED, SHARED)))
    joint: Float = field(default_factory=lambda: np.zeros((0, 0)))
    at: Float = field(default_factory=lambda: np.zeros(3))
    by_trees: Float = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def begun(self) -> bool:
        """Whether a pose with shared errors was used."""
        return len(self.joint) > 0

    @classmethod
    def begun_at(cls, particles: int, pose: Float, covariance: Float) -> SharedErrors:
        """Return the estimates before the first measured pose: errors N(0, I), independent of the pose, and
        no `by_trees`.

        Args:
            particles: Number of particles.
            pose: Estimated pose, shape (3,).
            covariance: Covariance of the pose in the frame of the map, shape (3, 3).
        """
        one = np.eye(SHARED)
        joint = np.eye(POSE + SOURCES * SHARED)
        joint[:POSE, :POSE] = covariance
        return cls(
            np.zeros((SOURCES, particles, SHARED)),
            np.tile(one, (SOURCES, particles, 1, 1)),
            joint,
            pose.copy(),
        )

    def drawn(self, rows: Int) -> SharedErrors:
        """Return the estimates of resampled particles: those of the given rows, int64, shape (P,). `mean` and
        `covariance` are copies, the other arrays are shared. Before the first shared pose the estimates
        themselves are returned."""
        if not self.begun:
            return self
        # Indexing with brackets gives another memory layout, for which the kernels would be compiled again.
        mean, covariance = np.take(self.mean, rows, axis=1), np.take(self.covariance, rows, axis=1)
        return replace(self, mean=mean, covariance=covariance)

    def moved(self, motion: Float, motion_covariance: Float) -> SharedErrors:
        """Return the estimates after a motion by the odometry: `at` moves, and the pose block of `joint` and
        `by_trees` grow; unchanged before the first shared pose.

        Args:
            motion: x, y [m], yaw [rad] in the frame of the pose before, shape (3,).
            motion_covariance: Covariance of the motion, shape (3, 3).
        """
        if not self.begun:
            return self
        joint, before = self.joint.copy(), self.joint[:POSE, :POSE].copy()
        x, y, yaw = (float(part) for part in motion)
        at, joint[:POSE, :POSE] = compounded(self.at, before, x, y, yaw, motion_covariance)
        dx, dy = at[:2] - self.at[:2]
        F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        joint[:POSE, POSE:] = F @ joint[:POSE, POSE:]
        joint[POSE:, :POSE] = joint[:POSE, POSE:].T
        by_trees = self.by_trees
        if len(by_trees):
            _, by_trees = compounded(self.at, by_trees, x, y, yaw, motion_covariance)
        return replace(self, joint=joint, at=at, by_trees=by_trees)

    def corrected(self, pose: Float, by_trees: Float | None) -> SharedErrors:
        """Return the estimates with `at` at the estimated pose; unchanged before the first shared pose.

        Without this correction `at` would follow the odometry, turn away from the path, and rotate the
        covariances wrongly.

        Args:
            pose: Estimated pose, shape (3,).
            by_trees: Covariance of the pose if landmarks determined it, shape (3, 3); None keeps the one
                before.
        """
        if not self.begun:
            return self
        return replace(self, at=pose, by_trees=self.by_trees if by_trees is None else by_trees)

    def measured(self, pose: PoseMeasurement) -> SharedErrors:
        """Return the estimates after a measured pose: `joint` becomes P - K S K^T, with the gain K = P H^T
        S^-1. The errors of the particles are updated in the kernels, see `update_shared_errors`. Unchanged
        before the first shared pose. A pose without shared errors corrects only the pose block directly."""
        if not self.begun:
            return self
        H = np.zeros((POSE, len(self.joint)))
        H[:, :POSE] = np.eye(POSE)
        if pose.shared is not None:
            first = POSE + SHARED * pose.source
            H[:, first : first + SHARED] = pose.shared
        cross = self.joint @ H.T
        joint = self.joint - cross @ np.linalg.solve(H @ cross + pose.own, cross.T)
        return replace(self, joint=0.5 * (joint + joint.T))

    def without_shared_error(self, pose: PoseMeasurement, weights: Float) -> PoseMeasurement:
        """Return a measured pose minus the estimated shared error, H e, with the covariance R + H E H^T.

        e and E are the mean and the covariance of the error over the particles. The result has no shared
        errors (`shared` is None); all other attributes of the pose remain. A pose without shared errors, and
        each pose before the first shared one, is returned unchanged.

        Args:
            pose: The measured pose.
            weights: Weights of the particles with sum 1, shape (P,).
        """
        if not self.begun or pose.shared is None:
            return pose
        H, mean = pose.shared, self.mean[pose.source]
        middle = weights @ mean
        away = mean - middle
        E = np.einsum("p,pij->ij", weights, self.covariance[pose.source]) + (weights[:, None] * away).T @ away
        at = pose.T_map_base.as_array() - H @ middle
        return replace(
            pose, T_map_base=type(pose.T_map_base)(*at), covariance=pose.own + H @ E @ H.T, shared=None
        )

    def for_particles(self, pose: PoseMeasurement | None) -> MeasuredPose:
        """Return a measured pose as the record for the kernels, `no_measured_pose()` for None. With shared
        errors, its mean and covariance are views, which `update_shared_errors` changes in place; a pose
        without shared errors has its whole covariance as `own` and no particles.

        Raises:
            IndexError: The pose has shared errors, and no estimates were begun (`begun_at`).
        """
        nothing = no_measured_pose()
        if pose is None:
            return nothing
        z = pose.T_map_base.as_array()
        if pose.shared is None:
            return nothing._replace(z=z, own=np.ascontiguousarray(pose.covariance))
        own, H = np.ascontiguousarray(pose.own), np.ascontiguousarray(pose.shared)
        return MeasuredPose(z, own, H, self.mean[pose.source], self.covariance[pose.source])


@compiled
def correct_by_measured(mu: Float, P: Float, measured: MeasuredPose, p: int) -> float:
    """Correct the pose of a particle by a measured pose (Kalman update), in place, and return its log
    likelihood up to a constant.

    The shared error of the particle is subtracted from the measurement, and its covariance is added.

    Args:
        mu: x, y [m], yaw [rad], shape (3,); is corrected, and its yaw is not wrapped.
        P: Covariance of `mu`, shape (3, 3); is corrected.
        measured: The measured pose, with `z` of shape (3,); unchanged.
        p: Row of the particle.
    """
    z, R = measured.z.copy(), measured.own.copy()
    if measured.mean.shape[0] > 0:
        _add_shared(measured, p, z, R)
    return correct_by_pose(mu, P, z, R)


@compiled
def update_shared_errors(x: Float, measured: MeasuredPose, p: int) -> None:
    """Update the shared errors of a particle by a measured pose (Kalman update with the pose known), in
    place.

    Args:
        x: Poses of the particles after sampling, shape (P, 3).
        measured: The measured pose, with shared errors (P > 0); row p of its `mean` and `covariance` is
            changed.
        p: Row of the particle.
    """
    y, S = measured.z.copy(), measured.own.copy()
    _add_shared(measured, p, y, S)
    for i in range(3):
        y[i] -= x[p, i]
    y[2] = (y[2] + np.pi) % (2.0 * np.pi) - np.pi
    S_inv, _ = inverted(S)
    E, H = measured.covariance[p], measured.H
    G, K = np.zeros((SHARED, 3)), np.zeros((SHARED, 3))
    for a in range(SHARED):
        for i in range(3):
            for b in range(SHARED):
                G[a, i] += E[a, b] * H[i, b]
    for a in range(SHARED):
        for i in range(3):
            for j in range(3):
                K[a, i] += G[a, j] * S_inv[j, i]
            measured.mean[p, a] += K[a, i] * y[i]
    for a in range(SHARED):
        for b in range(a, SHARED):
            for i in range(3):
                E[a, b] -= 0.5 * (K[a, i] * G[b, i] + K[b, i] * G[a, i])
            E[b, a] = E[a, b]


@compiled
def _add_shared(measured: MeasuredPose, p: int, z: Float, R: Float) -> None:
    """Replace z by z - H e and R by R + H E H^T, with the mean e and covariance E of the shared errors of
    particle p and the Jacobian H of `measured`, in place; shapes (3,) and (3, 3)."""
    E, H = measured.covariance[p], measured.H
    for i in range(3):
        for a in range(SHARED):
            z[i] -= H[i, a] * measured.mean[p, a]
            for b in range(SHARED):
                for j in range(3):
                    R[i, j] += H[i, a] * E[a, b] * H[j, b]


REJECTED = "a measured pose is rejected: it is too far from the estimated pose (another SLAM may have jumped)"


def within_gate(T_map_base: Pose2, covariance: Float, motion: Motion, noise: Noise) -> bool:
    """Return whether a measured pose agrees with the prediction: y^T (P + R)^-1 y <= gate of the measurement.
    The gate is a squared Mahalanobis distance.

    y is the difference to the predicted pose, P the covariance of the prediction with noise and slack of the
    motion (see `step_covariance`), and R that of the measurement, shared errors included. Without a measured
    pose, or with an infinite gate, the result is True.

    Args:
        T_map_base: Pose before the motion.
        covariance: Covariance of x, y [m], yaw [rad] of this pose, shape (3, 3).
        motion: Motion with the measured pose.
        noise: Noise of the odometry.
    """
    z = motion.measured
    if z is None or math.isinf(z.gate):
        return True
    slack, slack_yaw = motion.slack
    Q = step_covariance(motion, noise) + np.diag([slack**2, slack**2, slack_yaw**2])
    expected, P = compound(T_map_base.as_array(), covariance, motion.step, Q)
    y = z.T_map_base.as_array() - expected
    y[2] = wrap_angle(y[2])
    return bool(y @ np.linalg.solve(P + z.covariance, y) <= z.gate)
