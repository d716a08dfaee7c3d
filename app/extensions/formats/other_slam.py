"""Poses of another SLAM (PoseWithCovarianceStamped, or a named Odometry topic) as pose measurements, from the
end of the stretch on which the pose of their map is fitted to the odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.extensions.formats import POSE_STRETCH
from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.io.readers.container import Message
from pipeline.io.readers.measured_poses import NO_HEADING, RigidFit, fit_rigid, interpolated
from pipeline.io.readers.message_formats import UnusableReadingError
from pipeline.io.readers.transforms import frame_name, pose_of
from pipeline.types.records import PoseMeasurement

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

    from pipeline.io.readers.ros_records import RecordDecoder

#: Standard deviations that are added to those of the other SLAM [m, rad].
BEST = (0.02, 0.005)
#: Drift of the odometry during the stretch [m/sqrt m], [rad/sqrt m].
DRIFT, TURN_DRIFT = 0.05, math.radians(0.5)
#: A larger RMS difference to the headings by odometry means that they are not those of this robot [rad].
SCATTER = 0.35
#: Number of the shared errors of these poses, see PoseMeasurement.
POSE_SOURCE = 1
#: Squared Mahalanobis distance beyond which a pose is refused (chi-square, three degrees of freedom: 0.002
# %).
GATE = 25.0
_ROWS = (0, 1, 5)  # x, y, yaw of the six rows of ROS


@dataclass(frozen=True, slots=True, eq=False)
class OtherPose:
    """Pose of the base by another SLAM, in its map frame.

    Attributes:
        stamp_ns: Time [ns].
        T_other_base: Pose of the base in the other frame.
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
        """Return a pose from the fields of its message, in the plane; the variances BEST are added to its
        covariance.

        Args:
            stamp_ns: Time [ns].
            T_other_child: Pose in the message, of its child frame in the other frame.
            covariance: Covariance of x, y, z [m], roll, pitch, yaw [rad], 36 numbers row by row.
            T_child_base: Pose of the base in the child frame; None if the child frame is the base.

        Raises:
            UnusableReadingError: The covariance in the plane is not finite, has a magnitude of 1e12 or more,
                or is not symmetric or not positive definite.
        """
        planar = np.array(covariance, dtype=np.float64).reshape(6, 6)[np.ix_(_ROWS, _ROWS)]
        if not (np.abs(planar) < 1e12).all():
            raise UnusableReadingError("a covariance is not finite")
        C = 0.5 * (planar + planar.T)
        if not np.allclose(planar, C, rtol=1e-3) or np.linalg.eigvalsh(C)[0] <= 0.0:
            raise UnusableReadingError("a covariance is zero or not positive definite")
        pose = T_other_child if T_child_base is None else T_other_child @ T_child_base
        return cls(stamp_ns, pose.planar(), C + np.diag([BEST[0] ** 2, BEST[0] ** 2, BEST[1] ** 2]))


@dataclass(frozen=True, slots=True, eq=False)
class OtherFrame:
    """Pose of the map of another SLAM in the map frame.

    Attributes:
        fit: Pose of the other frame by positions.
        sigma: Standard deviation of the shift of the frame [m], with the drift of the odometry.
        yaw_sigma: Standard deviation of the rotation of the frame [rad], with the drift of the odometry.
        turn: Heading in the map minus heading in the other map [rad], None when headings cannot be used.
        turn_sigma: Standard deviation of `turn` [rad].
        from_ns: Time of the end of the fitted stretch [ns]; only later poses are used.
    """

    fit: RigidFit
    sigma: float
    yaw_sigma: float
    turn: float | None
    turn_sigma: float
    from_ns: int

    @property
    def summary(self) -> str:
        """How the poses are used, as text for the user."""
        heading = (
            "" if self.turn is not None else "; their headings are not those of this robot and are not used"
        )
        return (
            f"poses are used; over {self.fit.length:.0f} m of the drive their distance from the path by "
            f"odometry is {self.fit.residual:.2f} m (RMS); they count from there on{heading}"
        )

    def measurement(self, pose: OtherPose) -> PoseMeasurement | None:
        """Return the pose in the map with the errors of the pose and of the frame, and the gate GATE; those
        of the poses of one second count as one. None for a pose that is not later than `from_ns`. If `turn`
        is None, the heading is unknown: yaw 0 with the variance NO_HEADING."""
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
        return PoseMeasurement(pose.stamp_ns, Pose2(at.x, at.y, yaw), C, GATE, shared, POSE_SOURCE)


def align_poses(
    poses: Sequence[OtherPose], stamp_ns: Sequence[int], path: Float, lever: float = 0.0
) -> tuple[OtherFrame | None, str]:
    """Fit the pose of the other frame in the map.

    Args:
        poses: Poses in the order of time.
        stamp_ns: Times of the odometry, ascending, shape (N,) [ns].
        path: Poses of the base by odometry in the map frame: x, y [m], yaw [rad], shape (N, 3).
        lever: Not used: the poses are of the base.

    Returns:
        The frame and "", or None and the reason why there is none, see `fit_rigid`. The yaw of the frame is
        from the positions alone. If the differences between the headings and those of the odometry scatter
        about their mean by more than SCATTER (RMS), the headings are not used: `turn` is None.
    """
    del lever
    at_ns = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    other = np.array([pose.T_other_base.as_array() for pose in poses]).reshape(-1, 3)
    sigma = np.array([math.sqrt(0.5 * (p.covariance[0, 0] + p.covariance[1, 1])) for p in poses])
    fit, why = fit_rigid(
        at_ns, other[:, :2], sigma, stamp_ns, path[:, :2],
        shortest=POSE_STRETCH[0], what="poses", unknown="the pose of their frame",
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


def read_pose(decoder: RecordDecoder, message: Message, stamp_ns: int) -> tuple[OtherPose, str]:
    """Return a pose of another SLAM, in the plane, and the frame in which it is given (`frame_id` of the
    header, without leading slashes).

    If fixed transforms link the child frame of the message to the base, it is the pose of the base.
    Otherwise, and without a child frame, the pose of the message is taken as that of the base. Its covariance
    is at least that of `OtherPose.of`.

    Args:
        decoder: Decoder of the message, nav_msgs/Odometry, or a type with the same header and pose.
        message: The message.
        stamp_ns: Time of the pose [ns].

    Raises:
        UnusableReadingError: The covariance in the plane is not finite, not symmetric or not positive
            definite; zeros, which mean that it is unknown, are not either.
        Exception: Of many kinds, when the message is damaged.
    """
    decoded: ros2.nav_msgs__msg__Odometry = decoder.message(message)  # the other type has the same fields
    frame = frame_name(decoded.header.frame_id)
    child = frame_name(getattr(decoded, "child_frame_id", ""))
    linked = decoder.tree.find(child, decoder.base) if child and child != decoder.base else None
    pose, covariance = decoded.pose.pose, decoded.pose.covariance
    at = pose_of(pose.position, pose.orientation)
    return OtherPose.of(stamp_ns, at, [float(number) for number in covariance], linked), frame
