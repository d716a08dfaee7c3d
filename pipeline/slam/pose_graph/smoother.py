"""The factor graph and its incremental solution: iSAM2 (Kaess et al. 2012) of GTSAM.

GTSAM is an extra, so it is imported where it is used. Its factors are made one by one: a loop over the
detections of a keyframe is all that its interface allows.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Int

HUBER = 1.345  # sigma; 95 % efficient where errors are normal
RELINEARISE = 0.02  # m and rad; a variable that moved farther is linearised anew
RELINEARISE_EVERY = 5  # updates
RANGE_FLOOR = 0.05  # m; bearing and range mean nothing at the origin
SIGMA_FLOOR = 1e-4  # m and rad; an odometry that stands still has no sigma
VARIABLE_BYTES = 1300  # measured over copies of a graph of 1,100
ONE_TREE = 0.05  # m, sigma of the distance between two landmarks that are one tree


class Additions:
    """New variables and factors of one keyframe."""

    def __init__(self) -> None:
        import gtsam

        self._gtsam = gtsam
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def pose(self, k: int, pose: Float) -> None:
        """Keyframe k, first guess x, y [m], yaw [rad]."""
        self.values.insert(_x(k), self._gtsam.Pose2(*pose))

    def point(self, j: int, place: Float) -> None:
        """Landmark j, first guess, shape (2,) [m]."""
        self.values.insert(_l(j), place)

    def pose_prior(self, k: int, pose: Float, covariance: Float, *, robust: bool = False) -> None:
        """What is known of a keyframe: covariance of x, y, yaw in the frame of the map, shape (3, 3)."""
        noise = self._noise(_in_own_axes(covariance, pose[2]), robust=robust)
        self.graph.add(self._gtsam.PriorFactorPose2(_x(k), self._gtsam.Pose2(*pose), noise))

    def point_prior(self, j: int, place: Float, covariance: Float) -> None:
        """What is known of a landmark: shapes (2,), (2, 2)."""
        self.graph.add(self._gtsam.PriorFactorPoint2(_l(j), place, self._noise(covariance)))

    def odometry(self, k: int, motion: Float, covariance: Float) -> None:
        """Motion from keyframe k - 1 to k with its covariance, both in the frame of k - 1."""
        self.tie(k - 1, k, motion, covariance)

    def tie(self, i: int, k: int, motion: Float, covariance: Float) -> None:
        """Motion from keyframe i to k, which need not follow it, with its covariance in the frame of i."""
        noise = self._noise(_in_own_axes(covariance, motion[2]))
        self.graph.add(self._gtsam.BetweenFactorPose2(_x(i), _x(k), self._gtsam.Pose2(*motion), noise))

    def sights(self, keyframes: Int, nodes: Int, centre: Float, R: Float) -> None:
        """Landmarks seen from keyframes: places in the base frame, shape (D, 2) [m], and covariances,
        shape (D, 2, 2), as bearing and range."""
        reach = np.maximum(np.hypot(centre[:, 0], centre[:, 1]), RANGE_FLOOR)
        u, v = centre[:, 0] / reach, centre[:, 1] / reach
        J = np.stack([np.stack([-v / reach, u / reach], axis=1), np.stack([u, v], axis=1)], axis=1)
        noise = J @ R @ J.transpose(0, 2, 1)
        bearing = np.arctan2(centre[:, 1], centre[:, 0])
        for k, j, b, r, C in zip(keyframes, nodes, bearing, reach, noise, strict=True):
            self.graph.add(
                self._gtsam.BearingRangeFactor2D(
                    _x(int(k)), _l(int(j)), self._gtsam.Rot2(b), r, self._noise(C, robust=True)
                )
            )

    def one_tree(self, j: int, k: int) -> None:
        """Two landmarks that stand for one tree."""
        noise = self._noise(np.eye(2) * ONE_TREE**2, robust=True)
        self.graph.add(self._gtsam.BetweenFactorPoint2(_l(j), _l(k), np.zeros(2), noise))

    def _noise(self, covariance: Float, *, robust: bool = False) -> Any:  # noqa: ANN401
        model = self._gtsam.noiseModel
        floored = covariance + np.eye(len(covariance)) * SIGMA_FLOOR**2
        noise = model.Gaussian.Covariance(floored)
        return model.Robust.Create(model.mEstimator.Huber.Create(HUBER), noise) if robust else noise


class Smoother:
    """The most likely keyframes and landmarks by all factors so far."""

    def __init__(self) -> None:
        import gtsam

        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(RELINEARISE)
        parameters.relinearizeSkip = RELINEARISE_EVERY
        self._gtsam = gtsam
        self._isam = gtsam.ISAM2(parameters)
        self.landmarks = 0  # how many there are
        self._keyframes = 0

    def copy(self) -> Smoother:
        """Independent; the cost grows with the run, about 10 ms at 1,500 keyframes. The factors, which
        nobody changes, are shared."""
        copied = Smoother()
        copied._isam = self._gtsam.ISAM2(self._isam)
        copied.landmarks, copied._keyframes = self.landmarks, self._keyframes
        return copied

    @property
    def nbytes(self) -> int:
        """About how much memory it takes, for those who keep many."""
        return VARIABLE_BYTES * (self._keyframes + self.landmarks)

    def update(self, additions: Additions) -> tuple[Float, Float]:
        """Take new factors; returns all keyframes, shape (K, 3), and all landmarks, shape (L, 2)."""
        self._isam.update(additions.graph, additions.values)
        poses, points = self.estimate()
        self._keyframes, self.landmarks = len(poses), len(points)
        return poses, points

    def estimate(self) -> tuple[Float, Float]:
        """All keyframes: x, y [m], yaw [rad], shape (K, 3); and all landmarks, shape (L, 2) [m]."""
        values = self._isam.calculateEstimate()
        poses: Float = np.asarray(self._gtsam.utilities.extractPose2(values)).reshape(-1, 3)
        points: Float = np.asarray(self._gtsam.utilities.extractPoint2(values)).reshape(-1, 2)
        return poses, points

    def joint_covariance(self, k: int, yaw: float, nodes: Iterable[int]) -> Float:
        """Of keyframe k (x, y, yaw) and landmarks, in the frame of the map, shape (3 + 2n, 3 + 2n).

        Args:
            yaw: Of the keyframe [rad].
        """
        keys = [_x(k), *(_l(int(j)) for j in nodes)]
        ordering = self._gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        information: Float = np.asarray(self._isam.joint(keys).hessian(ordering)[0], np.float64)
        Sigma: Float = np.linalg.inv(information).astype(np.float64, copy=False)
        C: Float = np.eye(len(Sigma))  # GTSAM perturbs a pose along its own axes
        c, s = np.cos(yaw), np.sin(yaw)
        C[:2, :2] = [[c, -s], [s, c]]
        turned: Float = C @ Sigma @ C.T
        return turned


def _in_own_axes(covariance: Float, yaw: float) -> Float:
    c, s = np.cos(yaw), np.sin(yaw)
    C = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned: Float = C @ covariance @ C.T
    return turned


def _x(k: int) -> int:
    return (ord("x") << 56) + k


def _l(j: int) -> int:
    return (ord("l") << 56) + j
