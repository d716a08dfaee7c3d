"""Poses and angles. `T_a_b` maps the coordinates of a point in frame b to those in frame a.

Frames: `lidar` (the sensor), `base` (the robot, x forward, y left, z up), `odom` (frame of the odometry),
`map` (frame of SLAM).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]


def wrap_angle(angle: ArrayLike) -> Float:
    """Return angles [rad] in [-pi, pi), float64, in the shape of the input (shape () for one number); NaN
    stays NaN."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi
    # The remainder of an angle just below -pi is rounded up to a whole turn.
    return np.where(wrapped >= np.pi, -np.pi, wrapped)


@dataclass(frozen=True, slots=True)
class Pose2:
    """A pose in the plane: x, y [m], yaw [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def __matmul__(self, other: Pose2) -> Pose2:
        """Compose: `T_a_c = T_a_b @ T_b_c`; the yaw of the result is in [-pi, pi)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return Pose2(
            float(self.x + c * other.x - s * other.y),
            float(self.y + s * other.x + c * other.y),
            float(wrap_angle(self.yaw + other.yaw)),
        )

    def inverse(self) -> Pose2:
        """Return `T_b_a` of this `T_a_b`; its yaw is in [-pi, pi)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return Pose2(
            float(-c * self.x - s * self.y), float(s * self.x - c * self.y), float(wrap_angle(-self.yaw))
        )

    def apply(self, points: Float) -> Float:
        """Return points of shape (N, 2) [m] in frame b as points in frame a (this pose is `T_a_b`), same
        shape."""
        moved: Float = points @ self.rotation().T + np.array([self.x, self.y])
        return moved

    def rotation(self) -> Float:
        """Return the rotation matrix R_a_b of this `T_a_b`, shape (2, 2)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s], [s, c]])

    def as_array(self) -> Float:
        """Return x, y [m], yaw [rad], shape (3,)."""
        return np.array([self.x, self.y, self.yaw])


@dataclass(frozen=True, slots=True, eq=False)
class Pose3:
    """A pose in space: rotation matrix R of shape (3, 3) and translation t of shape (3,) [m]."""

    R: Float
    t: Float

    @classmethod
    def identity(cls) -> Pose3:
        """Return the pose without rotation and translation."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, t: ArrayLike, wxyz: ArrayLike) -> Pose3:
        """Return the pose of a translation, shape (3,) [m], and a quaternion w, x, y, z, shape (4,), which is
        normalised.

        Raises:
            ValueError: The length of the quaternion is 0 (up to 1e-9), or a number is not finite.
        """
        q = np.asarray(wxyz, dtype=np.float64)
        norm = float(np.linalg.norm(q))
        t_array = np.asarray(t, dtype=np.float64)
        if not (np.isfinite(norm) and norm > 1e-9 and np.all(np.isfinite(t_array))):
            raise ValueError("a pose needs finite numbers and a quaternion that is not zero")
        w, x, y, z = q / norm
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return cls(R, t_array)

    @classmethod
    def from_euler(cls, t: ArrayLike, roll: float, pitch: float, yaw: float) -> Pose3:
        """Return the pose of a translation (3,) [m] and R = Rz(yaw) Ry(pitch) Rx(roll), angles [rad]; numbers
        are not checked."""
        return cls(euler_rotation(roll, pitch, yaw), np.asarray(t, dtype=np.float64))

    def __matmul__(self, other: Pose3) -> Pose3:
        """Compose: `T_a_c = T_a_b @ T_b_c`."""
        return Pose3(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> Pose3:
        """Return `T_b_a` of this `T_a_b`."""
        return Pose3(self.R.T, -self.R.T @ self.t)

    def apply(self, points: Float) -> Float:
        """Return points of shape (N, 3) [m] in frame b as points in frame a (this pose is `T_a_b`), same
        shape."""
        return points @ self.R.T + self.t

    def euler(self) -> tuple[float, float, float]:
        """Return roll, pitch, yaw [rad] with R = Rz(yaw) Ry(pitch) Rx(roll): roll and yaw in [-pi, pi], pitch
        in [-pi/2, pi/2]."""
        R = self.R
        return (
            float(np.arctan2(R[2, 1], R[2, 2])),
            float(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))),
            float(np.arctan2(R[1, 0], R[0, 0])),
        )

    def quaternion(self) -> Float:
        """Return the unit quaternion w, x, y, z with w >= 0, shape (4,)."""
        R = self.R
        # The largest of the four squares is never small, so the division is safe for every rotation.
        squares = np.array(
            [
                1 + R[0, 0] + R[1, 1] + R[2, 2],
                1 + R[0, 0] - R[1, 1] - R[2, 2],
                1 - R[0, 0] + R[1, 1] - R[2, 2],
                1 - R[0, 0] - R[1, 1] + R[2, 2],
            ]
        )
        k = int(np.argmax(squares))
        rows = np.array(
            [
                [squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
                [R[2, 1] - R[1, 2], squares[1], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]],
                [R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], squares[2], R[2, 1] + R[1, 2]],
                [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], squares[3]],
            ]
        )
        q: Float = rows[k] / np.linalg.norm(rows[k])
        return -q if q[0] < 0 else q

    def planar(self) -> Pose2:
        """Return the planar pose: x, y and yaw; z, roll and pitch are dropped."""
        return Pose2(float(self.t[0]), float(self.t[1]), self.euler()[2])


def euler_rotation(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Float:
    """Return the rotation matrices R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        roll, pitch, yaw: Angles [rad], three numbers or three arrays of the same shape (N,); they are not
            broadcast.

    Returns:
        Rotation matrices, shape (3, 3) for numbers, (N, 3, 3) for arrays.
    """
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def interpolate(a: Pose2, b: Pose2, fraction: float) -> Pose2:
    """Return the pose at a fraction between a (0) and b (1): linear in x and y, and in yaw along the smaller
    rotation, wrapped to [-pi, pi). Fractions below 0 or above 1 extrapolate."""
    turn = float(wrap_angle(b.yaw - a.yaw))
    return Pose2(
        a.x + fraction * (b.x - a.x),
        a.y + fraction * (b.y - a.y),
        float(wrap_angle(a.yaw + fraction * turn)),
    )
