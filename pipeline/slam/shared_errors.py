"""What all measured poses of one source err by alike, above all how its frame lies in the map.

Taken for an error of each pose alone it would average out over many of them, and the filter would soon know
better where it is than anybody told it. So it is a state of the filter: given the path of a particle it is
Gaussian, and each particle estimates it as it does a landmark (Rao-Blackwell; Murphy, Russell 2001):

z = x + H e + v,  e ~ N(0, I) at first,  v ~ N(0, R) independent from pose to pose.

Particles that were drawn from one ancestor share its e, and no spread shows any more what it may err by. So
how well poses of this source can tell the pose at all is told by a Gaussian of pose and errors beside them,
with the covariances of a Kalman filter that knows odometry and measured poses alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import compounded, correct_by_pose, inverted
from pipeline.types.records import Int
from pipeline.types.sensor_data import SHARED, SOURCES, PoseMeasurement

POSE = 3


class Measured(NamedTuple):
    """A measured pose, and what each of P particles takes its source's shared errors for.

    Attributes:
        z: x, y [m], yaw [rad], shape (3,), or of no length where there is none.
        own: Covariance of what this pose errs by alone, shape (3, 3).
        H: See PoseMeasurement.shared, shape (3, SHARED).
        mean: shape (P, SHARED); covariance: shape (P, SHARED, SHARED).
    """

    z: Float
    own: Float
    H: Float
    mean: Float
    covariance: Float


def nothing_measured() -> Measured:
    """No pose was measured."""
    return Measured(
        np.zeros(0),
        np.zeros((3, 3)),
        np.zeros((3, SHARED)),
        np.zeros((0, SHARED)),
        np.zeros((0, SHARED, SHARED)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class SharedErrors:
    """Columns of P particles; nothing until a pose counts whose source errs by something that is shared.

    Attributes:
        mean: shape (SOURCES, P, SHARED); covariance: shape (SOURCES, P, SHARED, SHARED).
        joint: Covariance of the pose in the frame of the map and of all sources' errors, by odometry and
            measured poses alone, shape (3 + SOURCES * SHARED,) * 2.
        at: x, y [m], yaw [rad] where that was, shape (3,).
        by_trees: Covariance of the pose as landmarks told it last, grown by the odometry since then, shape
            (3, 3); (0, 0) as long as none told it.
    """

    mean: Float = field(default_factory=lambda: np.zeros((0, 0, SHARED)))
    covariance: Float = field(default_factory=lambda: np.zeros((0, 0, SHARED, SHARED)))
    joint: Float = field(default_factory=lambda: np.zeros((0, 0)))
    at: Float = field(default_factory=lambda: np.zeros(3))
    by_trees: Float = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def begun(self) -> bool:
        """Whether anything is known."""
        return len(self.joint) > 0

    @classmethod
    def begun_at(cls, particles: int, pose: Float, covariance: Float) -> SharedErrors:
        """Nothing known of the errors yet, and a pose, shape (3,), with its covariance, shape (3, 3)."""
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
        """Of particles drawn anew, one of each row; an independent copy."""
        if not self.begun:
            return self
        # An index in brackets would lay the rows otherwise in memory, and kernels be compiled for that too.
        mean, covariance = np.take(self.mean, rows, axis=1), np.take(self.covariance, rows, axis=1)
        return replace(self, mean=mean, covariance=covariance)

    def moved(self, motion: Float, motion_covariance: Float) -> SharedErrors:
        """After a motion by the odometry, shape (3,), with its covariance, shape (3, 3), in its own frame."""
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
        """After a pose, shape (3,), was estimated: covariances move on from there. By odometry alone `at`
        would turn away from the path, and what is unknown in one direction be taken for known in another.

        Args:
            by_trees: The covariance of the pose, shape (3, 3), where landmarks told it, else None.
        """
        if not self.begun:
            return self
        return replace(self, at=pose, by_trees=self.by_trees if by_trees is None else by_trees)

    def measured(self, pose: PoseMeasurement) -> SharedErrors:
        """What the joint Gaussian knows after a measured pose: P - K S K^T."""
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

    def as_seen(self, pose: PoseMeasurement, weights: Float) -> PoseMeasurement:
        """The measured pose without what its source is known by now to err by.

        Args:
            weights: Of the particles, shape (P,).
        """
        if not self.begun or pose.shared is None:
            return pose
        H, mean = pose.shared, self.mean[pose.source]
        middle = weights @ mean
        away = mean - middle
        E = np.einsum("p,pij->ij", weights, self.covariance[pose.source]) + (weights[:, None] * away).T @ away
        at = pose.T_map_base.as_array() - H @ middle
        return replace(pose, T_map_base=type(pose.T_map_base)(*at), covariance=pose.own + H @ E @ H.T)

    def for_particles(self, pose: PoseMeasurement | None) -> Measured:
        """As the kernels take it; they change mean and covariance of the source in place."""
        nothing = nothing_measured()
        if pose is None:
            return nothing
        z = pose.T_map_base.as_array()
        if pose.shared is None:
            return nothing._replace(z=z, own=np.ascontiguousarray(pose.covariance))
        own, H = np.ascontiguousarray(pose.own), np.ascontiguousarray(pose.shared)
        return Measured(z, own, H, self.mean[pose.source], self.covariance[pose.source])


@compiled
def corrected_by(mu: Float, P: Float, measured: Measured, p: int) -> float:
    """Kalman update of the pose of particle p by a measured one, in place; its log likelihood.

    Args:
        mu: x, y [m], yaw [rad], shape (3,); P: its covariance, shape (3, 3).
    """
    z, R = measured.z.copy(), measured.own.copy()
    if measured.mean.shape[0] > 0:
        _add_shared(measured, p, z, R)
    return correct_by_pose(mu, P, z, R)


@compiled
def learn_shared(x: Float, measured: Measured, p: int) -> None:
    """What particle p, which stands at x now, shape (P, 3), takes the shared errors for after the pose that
    was measured: a Kalman update, in place."""
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
def _add_shared(measured: Measured, p: int, z: Float, R: Float) -> None:
    """z - H e and R + H E H^T of particle p, in place."""
    E, H = measured.covariance[p], measured.H
    for i in range(3):
        for a in range(SHARED):
            z[i] -= H[i, a] * measured.mean[p, a]
            for b in range(SHARED):
                for j in range(3):
                    R[i, j] += H[i, a] * E[a, b] * H[j, b]
