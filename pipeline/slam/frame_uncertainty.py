"""Lower bound for the covariance of the pose in the frame of the map.

The spread of the particles shows only the errors in which they differ. Once all particles descend from one
ancestor they share its map and the error of that map; back at an old place they agree, although the place
itself is uncertain in the frame of the map. This module therefore stores the pose covariance at reference
poses along the path, where landmarks were begun. A pose that is found by those landmarks gets at least the
stored covariance: an unknown common error does not shrink when estimates that share it are combined (Julier,
Uhlmann 2001). After a solution of the graph all particles have the same landmarks; their error is stored in
place of the covariance, and is added to the spread. Landmarks that are begun later are as before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float
from pipeline.slam.motion import wrapped
from pipeline.types.records import Bool, Int, Int32

APART = 0.5  # m or rad; minimum change of x, y or yaw between two reference poses
# Two sigma of the ratio of two variances that are each estimated from N particles, times sqrt(N): the
# relative variance of one is 2 / N, that of the ratio 4 / N.
NOISE = 4.0
SMALL = 1e-12  # m^2, rad^2; regularises a covariance without spread


@dataclass(frozen=True, slots=True, eq=False)
class FrameUncertainty:
    """Covariances of the pose in the frame of the map at M reference poses, and the part that particles do
    not show.

    Instances are immutable.

    Attributes:
        serial: First birth number of each reference pose, int64, shape (M,), ascending. Landmarks with birth
            numbers from it up to the next serial belong to the reference pose.
        scan: Number of the scan of each reference pose, int64, shape (M,).
        pose: x, y [m], yaw [rad] of the reference poses, shape (M, 3).
        covariance: Covariances of x, y [m], yaw [rad] of the reference poses, shape (M, 3, 3). For a smoothed
            reference pose it is the part that comes from the positions of its landmarks in the solution of a
            graph, which all particles share.
        smoothed: Which reference poses are smoothed, shape (M,).
        hidden: Covariance of the error that all particles share, at the pose `at`, shape (3, 3).
        at: Pose x, y [m], yaw [rad] of `hidden` in the map, shape (3,).
    """

    serial: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    scan: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    pose: Float = field(default_factory=lambda: np.zeros((0, 3)))
    covariance: Float = field(default_factory=lambda: np.zeros((0, 3, 3)))
    smoothed: Bool = field(default_factory=lambda: np.zeros(0, np.bool_))
    hidden: Float = field(default_factory=lambda: np.zeros((3, 3)))
    at: Float = field(default_factory=lambda: np.zeros(3))

    def with_pose(
        self,
        pose: Float,
        spread: Float,
        n_eff: float,
        mean: Float,
        birth: Int,
        hits: Int32,
        hits_min: int,
        reach: float,
    ) -> tuple[Float, FrameUncertainty]:
        """Return the covariance of a pose in the frame of the map, shape (3, 3), and the state after it.

        With landmarks of reference poses in reach, the result is `at_least(spread, C)`, where C is the mean
        of the covariances of their reference poses, transported to the pose and weighted by the numbers of
        landmarks. A smoothed reference pose has `spread` in this mean, and its covariance is added to the
        result: it is an error of the map that all particles share. Without such landmarks the result is
        `spread` plus the transported `hidden`. Landmarks that precede all reference poses do not count. In
        the state after it, `hidden` is the result minus `spread`, and `at` is the pose.

        Args:
            pose: Pose x, y [m], yaw [rad] in the map, shape (3,).
            spread: Covariance of the particles, shape (3, 3).
            n_eff: Effective number of particles.
            mean, birth, hits: Positions [m], birth numbers and hits of the landmarks, shapes (L, 2), (L,) and
                (L,).
            hits_min: Landmarks with fewer hits are ignored.
            reach: Landmarks farther from the pose are ignored [m].

        Raises:
            LinAlgError: `spread` is not positive semidefinite.
        """
        used, counts = self._references(pose, mean, birth, hits, hits_min, reach)
        if not len(used):
            hidden = transported_covariance(self.hidden, pose[0] - self.at[0], pose[1] - self.at[1])
            return spread + hidden, replace(self, hidden=hidden, at=pose)
        weight, smoothed = (counts / counts.sum())[:, None, None], self.smoothed[used][:, None, None]
        part = weight * self._transported(used, pose)
        least = np.where(smoothed, weight * spread, part).sum(axis=0)
        of_map = np.where(smoothed, part, 0.0).sum(axis=0)
        covariance = at_least(spread, least, NOISE / math.sqrt(n_eff)) + of_map
        return covariance, replace(self, hidden=covariance - spread, at=pose)

    def _transported(self, rows: Int, pose: Float) -> Float:
        """Return the covariances of reference poses, transported to a pose, shape (U, 3, 3)."""
        A = np.tile(np.eye(3), (len(rows), 1, 1))
        A[:, 0, 2], A[:, 1, 2] = self.pose[rows, 1] - pose[1], pose[0] - self.pose[rows, 0]
        moved: Float = A @ self.covariance[rows] @ A.transpose(0, 2, 1)
        return moved

    def _references(
        self, pose: Float, mean: Float, birth: Int, hits: Int32, hits_min: int, reach: float
    ) -> tuple[Int, Int]:
        """Return the rows of the reference poses to which landmarks in reach belong, ascending, and the
        numbers of these landmarks, int64, shape (U,) each. The arguments are those of `with_pose`."""
        if not reach > 0.0 or not len(self.serial):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        dx, dy = mean[:, 0] - pose[0], mean[:, 1] - pose[1]
        near = (hits >= hits_min) & (dx * dx + dy * dy <= reach * reach)
        counts = np.bincount(np.searchsorted(self.serial, birth[near], side="right"))[1:]
        used = np.flatnonzero(counts)
        return used, counts[used]

    def observes_known(
        self, pose: Float, mean: Float, birth: Int, hits: Int32, hits_min: int, reach: float
    ) -> bool:
        """Return whether a landmark with `hits_min` hits or more, within `reach` [m] of the pose, belongs to
        a reference pose. The arguments are those of `with_pose`. False if there are no reference poses."""
        if not len(self.serial):
            return False
        near = np.hypot(*(mean - pose[:2]).T) <= reach
        return bool(np.any(near & (hits >= hits_min) & (birth >= self.serial[0])))

    def with_measured_pose(
        self, spread: Float, n_eff: float, least: Float, by_landmarks: Float | None
    ) -> tuple[Float, FrameUncertainty]:
        """Return the covariance of a pose that another source measures, shape (3, 3), and the state after it.

        The result is `at_least(spread, least)`, or `by_landmarks` if its position variance is smaller: with
        two independent ways to find the pose, it is known at least as well as by the better one. In the state
        after it, `hidden` is the result minus `spread`; `at` is unchanged.

        Args:
            spread: Covariance of the particles, shape (3, 3).
            n_eff: Effective number of particles.
            least: Lower bound of the covariance by measured poses and odometry, shape (3, 3).
            by_landmarks: Covariance by the landmarks in reach, shape (3, 3); None if there is none.

        Raises:
            LinAlgError: `spread` is not positive semidefinite.
        """
        covariance = at_least(spread, least, NOISE / np.sqrt(n_eff))
        if by_landmarks is not None and np.trace(by_landmarks[:2, :2]) < np.trace(covariance[:2, :2]):
            covariance = by_landmarks
        return covariance, replace(self, hidden=covariance - spread)

    def with_reference(self, serial: int, scan: int, pose: Float, covariance: Float) -> FrameUncertainty:
        """Return the state with a new reference pose, or unchanged if x, y and yaw all differ from those of
        the last one by less than APART.

        Args:
            serial: Birth number of the first landmark that this scan may begin.
            scan: Number of the scan.
            pose: x, y [m], yaw [rad], shape (3,).
            covariance: Covariance of the pose in the frame of the map, shape (3, 3).
        """
        if len(self.serial):
            away = pose - self.pose[-1]
            away[2] = wrapped(away[2])
            if np.abs(away).max() < APART:
                return self
        return replace(
            self,
            serial=np.append(self.serial, serial),
            scan=np.append(self.scan, scan),
            pose=np.concatenate([self.pose, pose[None]]),
            covariance=np.concatenate([self.covariance, covariance[None]]),
            smoothed=np.append(self.smoothed, False),
        )

    def without_unused(self, birth: Int) -> FrameUncertainty:
        """Return the state without the reference poses to which no landmark belongs, except the last one. The
        results of the other methods do not change for these landmarks.

        Args:
            birth: Birth numbers of all landmarks of all particles, int64, shape (L,).
        """
        used = np.zeros(len(self.serial) + 1, np.bool_)
        used[np.searchsorted(self.serial, birth, side="right")] = True
        keep = used[1:]
        keep[-1:] = True
        return replace(
            self,
            serial=self.serial[keep],
            scan=self.scan[keep],
            pose=self.pose[keep],
            covariance=self.covariance[keep],
            smoothed=self.smoothed[keep],
        )

    def scan_of(self, birth: Int) -> Int:
        """Return the scan of the reference pose of each landmark, int64, shape (L,), by birth numbers of
        shape (L,); 0 for landmarks that precede all reference poses."""
        if not len(self.serial):
            return np.zeros(len(birth), np.int64)
        k = np.searchsorted(self.serial, birth, side="right") - 1
        return np.where(k >= 0, self.scan[np.maximum(k, 0)], 0)

    def at_landmarks(self, birth: Int, position: Float) -> Float:
        """Return the covariance of the reference pose of each landmark, transported to its position, shape
        (L, 2, 2) [m^2]; zeros if there are no reference poses. Landmarks that precede all reference poses
        belong to the first one.

        Args:
            birth: Birth numbers of the landmarks, int64, shape (L,).
            position: Positions x, y of the landmarks in the map, shape (L, 2) [m].
        """
        if not len(self.serial):
            return np.zeros((len(birth), 2, 2))
        m = np.maximum(np.searchsorted(self.serial, birth, side="right") - 1, 0)
        x, y = (position - self.pose[m, :2]).T
        J = np.zeros((len(birth), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2], J[:, 1, 2] = -y, x
        return J @ self.covariance[m] @ J.transpose(0, 2, 1)

    def smoothed_by(self, correction: PathCorrection, covariance: Float) -> FrameUncertainty:
        """Return the state after a solution of the graph, from which all particles continue: reference poses
        move, and all of them are smoothed. `hidden` and `at` are unchanged; see `with_total`.

        Args:
            correction: Path before and after.
            covariance: Covariance that the positions of the landmarks cause at the scan of each reference
                pose, shape (M, 3, 3).

        Raises:
            IndexError: The scan of a reference pose is not in the path.
        """
        pose = correction.poses(self.pose, self.scan)
        return replace(self, pose=pose, covariance=covariance, smoothed=np.ones(len(pose), np.bool_))

    def without_hidden(self) -> FrameUncertainty:
        """Return the state with `hidden` = 0; all reference poses remain. It is for particles that are
        sampled from the complete covariance of the pose."""
        return replace(self, hidden=np.zeros((3, 3)))

    def with_total(self, spread: Float, total: Float, at: Float) -> FrameUncertainty:
        """Return the state in which `hidden` is `at_least(spread, total)` minus `spread`, and `at` is the
        pose. All reference poses remain.

        Args:
            spread: Covariance from which the particles are sampled, shape (3, 3).
            total: Covariance of the pose in the frame of the map, shape (3, 3).
            at: x, y [m], yaw [rad] of the pose, shape (3,).

        Raises:
            LinAlgError: `spread` is not positive semidefinite.
        """
        return replace(self, hidden=at_least(spread, total) - spread, at=at)


def transported_covariance(covariance: Float, dx: float, dy: float) -> Float:
    """Return the covariance of a frame error at another pose: A Sigma A^T, A = [[1, 0, -dy], [0, 1, dx], [0,
    0, 1]].

    Args:
        covariance: Sigma of x, y [m], yaw [rad] at the first pose, shape (3, 3).
        dx, dy: Vector from the first to the second position along the axes of the map [m].

    Returns:
        Covariance of x, y [m], yaw [rad] at the second pose, shape (3, 3).
    """
    A = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    moved: Float = A @ covariance @ A.T
    return moved


def at_least(spread: Float, least: Float, noise: float = 0.0) -> Float:
    """Return `spread`, shape (3, 3), enlarged to the variance of `least` in each common principal axis in
    which that of `least` is larger.

    In the coordinates in which `spread` is the identity, let 1 + m be a variance of `least`. The result has
    the variance 1 + max(m - noise^2 / m, 0) (non-negative garrote; Gao 1998): an excess m below `noise` is
    ignored, and a large excess counts almost entirely. Without this threshold, the larger of two equal
    covariances that are each estimated from particles would be too large, and grow with each repetition.

    Args:
        spread, least: Covariances of x, y [m], yaw [rad], shape (3, 3).
        noise: Standard error of the ratio of their variances; 0 for exact covariances.

    Raises:
        LinAlgError: `spread` is not positive semidefinite.
    """
    # The regularisation grows with the spread: two distant particles spread along a line, and the rounding
    # error of the other directions is relative to that distance.
    L = np.linalg.cholesky(spread + SMALL * max(1.0, np.trace(spread)) * np.eye(3))
    L_inv = np.linalg.inv(L)
    values, axes = np.linalg.eigh(L_inv @ least @ L_inv.T)
    B = L @ axes
    more = np.maximum(values - 1.0, 1e-300)
    larger = np.maximum(more - noise * noise / more, 0.0)
    grown: Float = spread + (B * larger) @ B.T
    return grown
