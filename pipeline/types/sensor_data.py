"""What sources give: scans, motion, and what is known for certain. Times are integer nanoseconds, lengths
metres, angles radians.
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
    """Stems that another program found in a sweep, one row a point of its scan.

    Attributes:
        axis: Unit vectors along the stems, upwards, sensor frame, shape (N, 3); NaN where not known.
        dbh: Diameter at breast height [m], NaN where none was fitted, shape (N,).
    """

    axis: Float
    dbh: Float


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the LiDAR (Eq. 1), in the sensor's own frame (`lidar`).

    Attributes:
        stamp_ns: Time of the sweep.
        points: float32, shape (N, 3) [m], all finite, no returns at the origin.
        reflectance: float32, shape (N,), in the sensor's own scale, or None.
        ring: int32, shape (N,), the laser that saw the point (0 = lowest), or None.
        offset_ns: int32, shape (N,), time of each point relative to `stamp_ns`, or None.
        dropped: How many returns the reader left out because they were not finite or empty.
        stems: Where the source gives stems instead of returns; then `points` are their places.
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
    """Where the wheels (or another source) say the base is.

    Attributes:
        stamp_ns: Time of the pose.
        T_odom_base: The pose of the base in the odometry's own frame.
    """

    stamp_ns: int
    T_odom_base: Pose3


SHARED = 4  # errors that all poses of a source have alike, at the most: two of a shift, two of turns
SOURCES = 2  # of measured poses, each with errors of its own: GNSS, another SLAM


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """Where another source (GNSS, another SLAM) says the base is, in the frame of the map.

    What its frame lies off errs all its poses alike: z = x + shared e + v with e ~ N(0, I) the same for all
    poses of the source, and v of this one alone.

    Attributes:
        stamp_ns: Time of the pose.
        T_map_base: The pose.
        covariance: shape (3, 3) of x, y [m], yaw [rad]; a large variance says nothing of the heading.
        gate: It is left out where the square of its distance from what is known, in sigmas, is larger: a
            source may jump.
        shared: How x, y [m], yaw [rad] err by one sigma of each of the errors that all poses of the source
            have alike, shape (3, SHARED); they are in the covariance too. None: each errs alone.
        source: Whose errors those are, less than SOURCES.
    """

    stamp_ns: int
    T_map_base: Pose2
    covariance: Float
    gate: float = math.inf
    shared: Float | None = None
    source: int = 0

    @property
    def own(self) -> Float:
        """Covariance of what this pose errs by alone, shape (3, 3)."""
        return self.covariance if self.shared is None else self.covariance - self.shared @ self.shared.T

    def is_sound(self) -> bool:
        """Whether all numbers are finite and the covariance is symmetric and positive definite."""
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
    """One reading of the inertial unit, turned into the base frame.

    Attributes:
        stamp_ns: Time of the reading.
        angular_velocity: shape (3,) [rad/s].
        linear_acceleration: shape (3,) [m/s^2], +9.81 along z when it stands still and level.
        orientation: Quaternion w, x, y, z of the base in a level frame, shape (4,), or None.
    """

    stamp_ns: int
    angular_velocity: Float
    linear_acceleration: Float
    orientation: Float | None = None


@dataclass(frozen=True, slots=True)
class Turn:
    """How far a gyroscope says that the base turned about the vertical since the scan before: angle and its
    standard deviation [rad]."""

    angle: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Learnt:
    """What the readings up to a step have taught of the gyroscope: who reads on from there needs it.

    Attributes:
        stamp_ns: Of the step.
        bias: Of the turn rate; scatter: of the readings around it [rad/s]; blocks: how many it is the mean
            of; block: the readings of the next.
        same: How many readings in a row were the same.
        turned: Sums over the steps, of the wheels' turns [rad], of their squares, and of their products with
            those of the gyroscope [rad^2].
        proven: Whether it was seen to turn as the wheels do.
        stands: Since when the robot stands, and where by odometry; None before the first odometry.
        tilt: When it was last taken [ns], roll and pitch [rad].
    """

    stamp_ns: int = 0
    bias: float = 0.0
    scatter: float = 0.0
    blocks: int = 0
    block: tuple[float, ...] = ()
    same: int = 0
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    proven: bool = False
    stands: tuple[int, Pose2] | None = None
    tilt: tuple[int, float, float] = (0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Notice:
    """What a source noticed on the way, for people: it becomes a warning of the next step.

    Attributes:
        stamp_ns: When.
        text: In words.
    """

    stamp_ns: int
    text: str


Record = Scan | Odometry | Imu | PoseMeasurement | Notice


@dataclass(frozen=True, slots=True)
class Sensor:
    """What is known of the LiDAR. It decides how far apart neighbouring returns lie.

    Attributes:
        name: For people, e.g. "VLP-16".
        rings: Number of lasers; 1 for a planar laser; 0 when unknown or not a spinning sensor.
        ring_step: Angle between neighbouring lasers [rad]; 0 when unknown.
        azimuth_step: Angle between neighbouring shots [rad].
        range_sigma: Standard deviation of a range [m].
        range_max: Longest range that it reports [m].
    """

    name: str = "LiDAR"
    rings: int = 0
    ring_step: float = 0.0
    azimuth_step: float = 0.0035
    range_sigma: float = 0.02
    range_max: float = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrees:
    """What really stands in the plot (trees and others), in the frame of the map.

    Attributes:
        x, y: shape (N,) [m].
        dbh: Diameter at breast height [m], NaN where it is not known, shape (N,).
        kind: One of "tree", "pole", "person", "bush", "other" each.
    """

    x: Float
    y: Float
    dbh: Float
    kind: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TruthPath:
    """Where the robot really was.

    Attributes:
        stamp_ns: int64, shape (N,), ascending.
        x, y: shape (N,) [m].
        yaw: shape (N,) [rad], NaN where only the position is known (GNSS).
        same_frame: Whether x and y are in the frame of the map; if not, it is aligned before it is
            compared.
    """

    stamp_ns: Int
    x: Float
    y: Float
    yaw: Float
    same_frame: bool


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is known for certain about a run; either part may be missing."""

    trees: TruthTrees | None = None
    path: TruthPath | None = None
