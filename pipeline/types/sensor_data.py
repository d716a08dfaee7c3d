"""Records of sources: scans, motion, and ground truth. Times are integer nanoseconds, lengths metres, angles
radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Pose2, Pose3

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Int32 = NDArray[np.int32]
UInt16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Stems:
    """Stems that another program detected in a scan, one row per point of the scan.

    Attributes:
        axis: Unit vectors along the stems, upwards, sensor frame, shape (N, 3); NaN if unknown.
        dbh: Diameter at breast height [m], shape (N,); NaN without a fit.
    """

    axis: Float
    dbh: Float


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One scan of the LiDAR (Eq. 1), in the frame of the sensor (`lidar`).

    Attributes:
        stamp_ns: Time of the scan.
        points: float32, shape (N, 3) [m], all finite, no returns at the origin.
        reflectance: float32, shape (N,), in the scale of the sensor, or None.
        ring: int32, shape (N,), the laser that measured the point (0 = lowest), or None.
        offset_ns: int32, shape (N,), time of each point relative to `stamp_ns`, or None.
        dropped: Number of returns that the reader rejected because they were not finite or empty.
        stems: Stems, if the source provides stems instead of returns; `points` are their positions then.
    """

    stamp_ns: int
    points: Float32
    reflectance: Float32 | None = None
    ring: Int32 | None = None
    offset_ns: Int32 | None = None
    dropped: int = 0
    stems: Stems | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Pose of the base by wheels or another odometry.

    Attributes:
        stamp_ns: Time of the pose.
        T_odom_base: Pose of the base in the frame of the odometry.
    """

    stamp_ns: int
    T_odom_base: Pose3


SHARED = 4  # most errors that all poses of a source share: two of a shift, two of rotations
SOURCES = 2  # sources of measured poses, each with its own shared errors: GNSS, another SLAM


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """Pose of the base in the frame of the map, measured by another source (GNSS, another SLAM).

    z = x + shared e + v, where the error e ~ N(0, I) is the same for all poses of the source, for example the
    offset of its frame, and v is independent between poses.

    Attributes:
        stamp_ns: Time of the pose.
        T_map_base: The pose.
        covariance: shape (3, 3) of x, y [m], yaw [rad], with the shared errors; the variance of
            an unknown heading is large.
        gate: Largest squared Mahalanobis distance from the estimate at which it is used.
        shared: Effect on x, y [m], yaw [rad] of one sigma of each shared error, shape (3, SHARED); None
            without shared errors.
        source: Number of the source, less than SOURCES.
    """

    stamp_ns: int
    T_map_base: Pose2
    covariance: Float
    gate: float = math.inf
    shared: Float | None = None
    source: int = 0

    @property
    def own(self) -> Float:
        """Covariance of the independent error v, shape (3, 3): `covariance` less the part of the shared
        errors."""
        return self.covariance if self.shared is None else self.covariance - self.shared @ self.shared.T

    def is_sound(self) -> bool:
        """Return whether all numbers are finite, `covariance` has the shape (3, 3), and the covariance of the
        independent error is symmetric and positive definite. With shared errors, also whether their shape is
        (3, SHARED) and the number of the source is valid. The gate is not checked."""
        C, pose = self.covariance, self.T_map_base.as_array()
        if C.shape != (3, 3) or not (np.all(np.isfinite(C)) and np.all(np.isfinite(pose))):
            return False
        if self.shared is not None:
            if self.shared.shape != (3, SHARED) or not 0 <= self.source < SOURCES:
                return False
            C = self.own
        return bool(np.allclose(C, C.T) and np.all(np.linalg.eigvalsh(C) > 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Imu:
    """One reading of the inertial measurement unit, in the base frame.

    Attributes:
        stamp_ns: Time of the reading.
        angular_velocity: shape (3,) [rad/s].
        linear_acceleration: shape (3,) [m/s^2], +9.81 along z at rest and level.
        orientation: Quaternion w, x, y, z of the base in a level frame, shape (4,), or None.
    """

    stamp_ns: int
    angular_velocity: Float
    linear_acceleration: Float
    orientation: Float | None = None


@dataclass(frozen=True, slots=True)
class Turn:
    """Rotation of the base about the vertical since the previous scan by the gyroscope: angle and its
    standard deviation [rad]."""

    angle: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Notice:
    """A message of a source for the user, which becomes a warning of the next step.

    Attributes:
        stamp_ns: Time.
        text: The message.
    """

    stamp_ns: int
    text: str


Record = Scan | Odometry | Imu | PoseMeasurement | Notice


@dataclass(frozen=True, slots=True)
class Sensor:
    """Properties of the LiDAR; they determine the distance between neighbouring returns.

    Attributes:
        name: Displayed name, e.g. "VLP-16".
        rings: Number of lasers; 1 for a planar laser; 0 if unknown or not a spinning sensor.
        ring_step: Angle between neighbouring lasers [rad]; 0 if unknown.
        azimuth_step: Angle between neighbouring shots [rad].
        range_sigma: Standard deviation of a range [m].
        range_max: Largest range that it reports [m].
    """

    name: str = "LiDAR"
    rings: int = 0
    ring_step: float = 0.0
    azimuth_step: float = 0.0035
    range_sigma: float = 0.02
    range_max: float = 100.0


HIDDEN = "hidden"  # a tree that the sensor could not see


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrees:
    """Ground truth of trees and other objects, in the frame of the map.

    Attributes:
        x, y: shape (N,) [m].
        dbh: Diameter at breast height [m], shape (N,); NaN if unknown.
        kind: Class of each: "tree", "pole", "person", "bush", "other" or HIDDEN.
    """

    x: Float
    y: Float
    dbh: Float
    kind: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TruthPath:
    """Ground truth of the path.

    Attributes:
        stamp_ns: int64, shape (N,), ascending.
        x, y: shape (N,) [m].
        yaw: shape (N,) [rad]; NaN if only the position is known (GNSS).
        same_frame: Whether x and y are in the frame of the map; if not, the path is aligned before it is
            compared.
    """

    stamp_ns: Int
    x: Float
    y: Float
    yaw: Float
    same_frame: bool


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of a run; either part may be missing."""

    trees: TruthTrees | None = None
    path: TruthPath | None = None
