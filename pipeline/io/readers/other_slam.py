"""Poses of another SLAM (PoseWithCovarianceStamped, or a named Odometry topic) as pose measurements.

The pose of the other map in ours is fitted to the odometry of the first stretch of the drive, as for GNSS,
and so is the difference of the headings. Poses count from the end of that stretch on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.io.readers.rigid_alignment import RigidFit, fit_rigid, interpolated
from pipeline.types.records import PoseMeasurement

#: Shortest and longest stretch of the drive for the fit [m]; short, because odometry drifts and poses of a
#: SLAM
#: are much better than GNSS fixes.
SHORTEST, LONGEST = 5.0, 20.0
#: Standard deviations that are added to those of the other SLAM [m, rad].
BEST = (0.02, 0.005)
#: Drift of the odometry during the stretch [m/sqrt m], [rad/sqrt m].
DRIFT, TURN_DRIFT = 0.05, math.radians(0.5)
#: A larger RMS difference to the headings by odometry means that they are not those of this robot [rad].
SCATTER = 0.35
#: Variance of a heading that is not measured [rad^2].
NO_HEADING = 1e4
#: Number of the shared errors of these poses, see PoseMeasurement.
SOURCE = 1
#: Squared Mahalanobis distance beyond which a pose is refused (chi-square, three degrees of freedom: 0.002
#: %).
GATE = 25.0
_ROWS = (0, 1, 5)  # x, y, yaw of the six rows of ROS


class NoPoseError(ValueError):
    """A pose of another SLAM cannot be used; the message gives the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class OtherPose:
    """Pose of the base by another SLAM, in its map frame.

    Attributes:
        stamp_ns: Time.
        T_other_base: The pose.
        covariance: Covariance of x, y [m], yaw [rad] in the other frame, shape (3, 3).
    """

    stamp_ns: int
    T_other_base: Pose2
    covariance: Float

    @classmethod
    def of(
        cls,
        stamp_ns: int,
        T_other_child: Pose3,
        covariance: Sequence[float],
        T_child_base: Pose3 | None = None,
    ) -> OtherPose:
        """Make a pose of the fields of its message; `covariance` has 36 numbers.

        Raises:
            NoPoseError: The covariance in the plane is not finite or not positive definite.
        """
        planar = np.array(covariance, dtype=np.float64).reshape(6, 6)[np.ix_(_ROWS, _ROWS)]
        if not (np.abs(planar) < 1e12).all():
            raise NoPoseError("a covariance is not finite")
        C = 0.5 * (planar + planar.T)
        if not np.allclose(planar, C, rtol=1e-3) or np.linalg.eigvalsh(C)[0] <= 0.0:
            raise NoPoseError("a covariance is zero or not positive definite")
        pose = T_other_child if T_child_base is None else T_other_child @ T_child_base
        return cls(stamp_ns, pose.planar(), C + np.diag([BEST[0] ** 2, BEST[0] ** 2, BEST[1] ** 2]))


@dataclass(frozen=True, slots=True, eq=False)
class OtherFrame:
    """Pose of the map of another SLAM in the map frame.

    Attributes:
        fit: Pose of the other frame by positions.
        sigma: Standard deviation of its shift [m], with the drift of the odometry.
        yaw_sigma: Standard deviation of its rotation [rad], with the drift of the odometry.
        turn: Heading in the map minus heading in the other map [rad], None when headings cannot be used.
        turn_sigma: Standard deviation of `turn` [rad].
        from_ns: End of the stretch; later poses count.
    """

    fit: RigidFit
    sigma: float
    yaw_sigma: float
    turn: float | None
    turn_sigma: float
    from_ns: int

    @property
    def summary(self) -> str:
        """Summary for the user."""
        heading = (
            "" if self.turn is not None else "; their headings are not those of this robot and are not used"
        )
        return (
            f"poses are used; over {self.fit.length:.0f} m of the drive their distance from the path by "
            f"odometry is {self.fit.residual:.2f} m (RMS); they count from there on{heading}"
        )

    def measurement(self, pose: OtherPose) -> PoseMeasurement | None:
        """Return the pose in the map with the errors of the pose and of the frame; None until poses count."""
        if pose.stamp_ns <= self.from_ns:
            return None
        T, rate = self.fit.T_map_other, max(self.fit.rate_hz, 1.0)
        at = T @ pose.T_other_base
        c, s = math.cos(T.yaw), math.sin(T.yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        C = rate * (R @ pose.covariance @ R.T)
        shared = self.fit.shared(at.x, at.y, self.sigma, self.yaw_sigma, self.turn_sigma)
        yaw = 0.0
        if self.turn is None:
            C[2], C[:, 2], shared[2] = 0.0, 0.0, 0.0
            C[2, 2] = NO_HEADING
        else:
            yaw = float(wrap_angle(pose.T_other_base.yaw + self.turn))
        C = 0.5 * (C + C.T) + shared @ shared.T
        return PoseMeasurement(pose.stamp_ns, Pose2(at.x, at.y, yaw), C, GATE, shared, SOURCE)


def align_poses(
    poses: Sequence[OtherPose], stamp_ns: Sequence[int], path: Float, lever: float = 0.0
) -> tuple[OtherFrame | None, str]:
    """Fit the pose of the other frame in the map.

    Args:
        poses: In the order of time.
        stamp_ns: Times of the odometry, ascending, shape (N,).
        path: Poses of the base by odometry in the map frame: x, y [m], yaw [rad], shape (N, 3).
        lever: Not used: the poses are those of the base.

    Returns:
        The frame, or None and the reason why there is none.
    """
    del lever
    at_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    other = np.array([pose.T_other_base.as_array() for pose in poses]).reshape(-1, 3)
    sigma = np.array([math.sqrt(0.5 * (p.covariance[0, 0] + p.covariance[1, 1])) for p in poses])
    fit, why = fit_rigid(
        at_ns, other[:, :2], sigma, stamp_ns, path[:, :2],
        shortest=SHORTEST, what="poses", unknown="the pose of their frame",
    )  # fmt: skip
    if fit is None:
        return None, why
    ours = interpolated(at_ns, stamp_ns, np.column_stack([np.cos(path[:, 2]), np.sin(path[:, 2])]))
    off = wrap_angle(np.arctan2(ours[:, 1], ours[:, 0]) - other[:, 2])
    turn = math.atan2(float(np.sin(off).mean()), float(np.cos(off).mean()))
    scatter = float(np.sqrt(np.square(wrap_angle(off - turn)).mean()))
    # In the middle of the stretch a third of the variance of the drift has accumulated.
    drift, turn_drift = DRIFT**2 * fit.length / 3.0, TURN_DRIFT**2 * fit.length / 3.0
    own = math.sqrt(float(np.median([pose.covariance[2, 2] for pose in poses])))
    heading = max(own, scatter) / math.sqrt(max(len(poses) / 10.0, 1.0))
    return OtherFrame(
        fit,
        math.sqrt(fit.sigma**2 + drift),
        math.sqrt(fit.yaw_sigma**2 + turn_drift),
        turn if scatter <= SCATTER else None,
        math.sqrt(heading**2 + turn_drift),
        int(at_ns[-1]),
    ), ""
