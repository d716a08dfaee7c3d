"""Poses of another SLAM (PoseWithCovarianceStamped, or an Odometry that was named) as measured poses.

Its map has a frame of its own. How that lies in ours is found as for GNSS, from the first stretch of the
way, where odometry and poses must agree; how its robot's heading lies to ours is found there too. From the
end of that stretch on its poses count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.io.readers.rigid_alignment import Laid, interpolated, lay_over
from pipeline.types.records import PoseMeasurement

#: The frame is found from this much of the way on, and from no more than that [m]: odometry drifts, and poses
#: of a SLAM are much better than fixes.
SHORTEST, LONGEST = 5.0, 20.0
#: Added to what a SLAM says of itself [m, rad]: none on a robot is better.
BEST = (0.02, 0.005)
#: How the odometry may drift meanwhile [m/sqrt m], [rad/sqrt m].
DRIFT, TURN_DRIFT = 0.05, math.radians(0.5)
#: Headings that scatter more against the odometry's are not of this robot [rad].
SCATTER = 0.35
#: Says nothing of the heading [rad^2].
NO_HEADING = 1e4
#: The number of its shared errors, see PoseMeasurement.
SOURCE = 1
#: Square of the distance in sigmas (chi-square of three degrees): 0.002 % of honest poses lie beyond.
GATE = 25.0
_ROWS = (0, 1, 5)  # x, y, yaw of ROS's six


class NoPoseError(ValueError):
    """A pose of another SLAM that cannot be used; says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where another SLAM says the base is, in its own frame.

    Attributes:
        stamp_ns: When.
        T_theirs_base: The pose.
        covariance: shape (3, 3) of x, y [m], yaw [rad], about the axes of their frame.
    """

    stamp_ns: int
    T_theirs_base: Pose2
    covariance: Float

    @classmethod
    def of(
        cls,
        stamp_ns: int,
        T_theirs_child: Pose3,
        covariance: Sequence[float],
        T_child_base: Pose3 | None = None,
    ) -> Placed:
        """A pose by the parts of its message; covariance: 36 numbers.

        Raises:
            NoPoseError: The covariance in the plane is not finite or not positive definite.
        """
        told = np.array(covariance, dtype=np.float64).reshape(6, 6)[np.ix_(_ROWS, _ROWS)]
        if not (np.abs(told) < 1e12).all():
            raise NoPoseError("a covariance is not finite")
        C = 0.5 * (told + told.T)
        if not np.allclose(told, C, rtol=1e-3) or np.linalg.eigvalsh(C)[0] <= 0.0:
            raise NoPoseError("a covariance is zero or not positive definite")
        pose = T_theirs_child if T_child_base is None else T_theirs_child @ T_child_base
        return cls(stamp_ns, pose.planar(), C + np.diag([BEST[0] ** 2, BEST[0] ** 2, BEST[1] ** 2]))


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """How another SLAM's frame lies in the map.

    Attributes:
        laid: How it lies, by positions.
        sigma: Of the shift [m]; yaw_sigma: of the turn [rad]; both with what the odometry may have drifted.
        turn: Our heading minus theirs [rad], None where theirs is not of this robot; turn_sigma: of it.
        from_ns: Poses count from this time on, where the stretch ends.
    """

    laid: Laid
    sigma: float
    yaw_sigma: float
    turn: float | None
    turn_sigma: float
    from_ns: int

    @property
    def words(self) -> str:
        """For people."""
        heading = "" if self.turn is not None else "; their heading is not of this robot and is not used"
        return (
            f"poses are used; laid over {self.laid.length:.0f} m of the way they lie "
            f"{self.laid.residual:.2f} m from it (RMS), and count from there on{heading}"
        )

    def measured(self, placed: Placed) -> PoseMeasurement | None:
        """The pose in the map with what it and the frame are uncertain of; None before it counts."""
        if placed.stamp_ns <= self.from_ns:
            return None
        T, rate = self.laid.T_map_theirs, max(self.laid.rate_hz, 1.0)
        at = T @ placed.T_theirs_base
        c, s = math.cos(T.yaw), math.sin(T.yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        C = rate * (R @ placed.covariance @ R.T)
        shared = self.laid.shared(at.x, at.y, self.sigma, self.yaw_sigma, self.turn_sigma)
        yaw = 0.0
        if self.turn is None:
            C[2], C[:, 2], shared[2] = 0.0, 0.0, 0.0
            C[2, 2] = NO_HEADING
        else:
            yaw = float(wrap_angle(placed.T_theirs_base.yaw + self.turn))
        C = 0.5 * (C + C.T) + shared @ shared.T
        return PoseMeasurement(placed.stamp_ns, Pose2(at.x, at.y, yaw), C, GATE, shared, SOURCE)


def relate(
    poses: Sequence[Placed], stamp_ns: Sequence[int], way: Float, lever: float = 0.0
) -> tuple[Relation | None, str]:
    """Find how their frame lies in the map.

    Args:
        poses: In the order of time.
        stamp_ns: Of the odometry, ascending, shape (N,).
        way: Where it says the base was, in the frame of the map: x, y [m], yaw [rad], shape (N, 3).
        lever: Of no use here: the poses are of the base.

    Returns:
        The relation, or None and why it is not known.
    """
    del lever
    at_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    theirs = np.array([pose.T_theirs_base.as_array() for pose in poses]).reshape(-1, 3)
    sigma = np.array([math.sqrt(0.5 * (p.covariance[0, 0] + p.covariance[1, 1])) for p in poses])
    names = ("poses", "how their frame lies")
    laid, why = lay_over(at_ns, theirs[:, :2], sigma, stamp_ns, way[:, :2], shortest=SHORTEST, names=names)
    if laid is None:
        return None, why
    ours = np.column_stack([np.cos(way[:, 2]), np.sin(way[:, 2])])
    ours = interpolated(at_ns, stamp_ns, ours)
    off = wrap_angle(np.arctan2(ours[:, 1], ours[:, 0]) - theirs[:, 2])
    turn = math.atan2(float(np.sin(off).mean()), float(np.cos(off).mean()))
    scatter = float(np.sqrt(np.square(wrap_angle(off - turn)).mean()))
    # In the middle of the stretch a third of the drift's variance has come together.
    drift, turn_drift = DRIFT**2 * laid.length / 3.0, TURN_DRIFT**2 * laid.length / 3.0
    own = math.sqrt(float(np.median([pose.covariance[2, 2] for pose in poses])))
    heading = max(own, scatter) / math.sqrt(max(len(poses) / 10.0, 1.0))
    return Relation(
        laid,
        math.sqrt(laid.sigma**2 + drift),
        math.sqrt(laid.yaw_sigma**2 + turn_drift),
        turn if scatter <= SCATTER else None,
        math.sqrt(heading**2 + turn_drift),
        int(at_ns[-1]),
    ), ""
