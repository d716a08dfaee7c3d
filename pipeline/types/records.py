"""Immutable records that pass between packages. Times are integer nanoseconds, lengths metres, angles
radians. Tables are columns of equal length, not lists of objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from pipeline.geometry.poses import Pose2
from pipeline.types.clearance import Clearance as Clearance
from pipeline.types.clearance import Zone as Zone
from pipeline.types.pose_health import Health
from pipeline.types.sensor_data import HIDDEN as HIDDEN
from pipeline.types.sensor_data import Bool as Bool
from pipeline.types.sensor_data import Float as Float
from pipeline.types.sensor_data import Float32 as Float32
from pipeline.types.sensor_data import Imu as Imu
from pipeline.types.sensor_data import Int as Int
from pipeline.types.sensor_data import Int32 as Int32
from pipeline.types.sensor_data import Notice as Notice
from pipeline.types.sensor_data import Odometry as Odometry
from pipeline.types.sensor_data import PoseMeasurement as PoseMeasurement
from pipeline.types.sensor_data import Record as Record
from pipeline.types.sensor_data import Scan as Scan
from pipeline.types.sensor_data import Sensor as Sensor
from pipeline.types.sensor_data import Stems as Stems
from pipeline.types.sensor_data import Truth as Truth
from pipeline.types.sensor_data import TruthPath as TruthPath
from pipeline.types.sensor_data import TruthTrees as TruthTrees
from pipeline.types.sensor_data import Turn as Turn
from pipeline.types.sensor_data import UInt16 as UInt16


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Input of the mapper: a scan, and the motion and tilt at its time.

    Attributes:
        index: Number of the scan in the run, from 0.
        scan: The scan.
        T_odom_base: Pose of the base in the frame of the odometry at the time of the scan; None without
            odometry.
        roll, pitch: Tilt of the base against gravity [rad]; 0 if unknown.
        tilt_known: Whether roll and pitch were measured.
        twist: Velocity of the base at the scan: forward, left [m/s], turn [rad/s]; zero if unknown.
        warnings: Messages of the synchroniser since the previous scan.
        doubt: Message why the motion to this scan may be wrong; empty if there is no doubt.
        slack: Standard deviations that the doubt adds to the motion: position [m] and heading [rad].
        unreported: Motion by the odometry up to the previous scan that no earlier step contains, because the
            odometry was missing; it came with this step. None without such a motion.
        measured: Pose measurement of another source at this scan, or None.
        turn: Rotation by the gyroscope since the previous scan, or None.
        turn_rate: Rate of turn by the gyroscope at the scan [rad/s], or None.
    """

    index: int
    scan: Scan
    T_odom_base: Pose2 | None
    roll: float = 0.0
    pitch: float = 0.0
    tilt_known: bool = False
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
    warnings: tuple[str, ...] = ()
    doubt: str = ""
    slack: tuple[float, float] = (0.0, 0.0)
    unreported: Pose2 | None = None
    measured: PoseMeasurement | None = None
    turn: Turn | None = None
    turn_rate: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Clusters of the points of one scan.

    Attributes:
        label: int32, shape (N,): cluster of each point, 0..clusters-1, -1 for noise. DBSCAN numbers clusters
            in the order of their first points, range jumps number them counter-clockwise. Parts that were
            split off trunks (see `cluster_splitting`) follow all other clusters.
        clusters: Number of clusters.
        hidden: shape (clusters,): whether a nearer object hides an edge of the cluster.
    """

    label: Int32
    clusters: int
    hidden: Bool


class Verdict(IntEnum):
    """Class of a cluster, or the reason why it is not a tree."""

    TREE = 0
    POLE = 1
    PERSON = 2
    BUSH = 3
    WALL = 4
    OTHER = 5
    TOO_FEW_POINTS = 6
    TOO_ROUND = 7
    TOO_LONG = 8
    NOT_ROUND = 9
    TOO_THIN = 10
    TOO_THICK = 11
    TOO_LOW = 12
    NO_ARC = 13
    AT_BORDER = 14
    MOVING = 15
    HIDDEN = 16

    @property
    def label(self) -> str:
        """The verdict as text for the page and for files, in lower case, e.g. "too few points"."""
        return self.name.lower().replace("_", " ")


#: Classes of columns, in the order of their shares of votes (see Columns).
CLASSES = (Verdict.TREE, Verdict.POLE, Verdict.PERSON, Verdict.BUSH, Verdict.WALL, Verdict.OTHER)
#: Weights of the votes for an object that is round by its circle fits (docs/trunks.md).
AT_ROUND = tuple(1.0 if k in (Verdict.TREE, Verdict.POLE, Verdict.PERSON) else 0.1 for k in CLASSES)
#: Radius around the axis of a column of the surroundings that its features describe [m].
RING_FAR = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """The clusters of one scan as columns of length K; positions in the level sensor frame.

    Attributes:
        size: int64, number of points.
        centroid: shape (K, 3) [m].
        eigenvalues: shape (K, 3) [m^2], descending, of the horizontal covariance; the third is 0.
        eccentricity: lambda1 / lambda2 >= 1 (Eq. 4); inf for points on a line.
        centre: shape (K, 2) [m], the estimate of the trunk's axis.
        covariance: shape (K, 2, 2) [m^2], of `centre`.
        radius, radius_sigma: [m], of the fitted circle; NaN without a fit.
        radial_std: [m], standard deviation of the distances to the axis (the cylinder check).
        arc: Visible part of the circle [rad].
        extent: shape (K, 3) [m], size of the bounding box along the ray, across it and up.
        hidden: Whether something nearer hides an edge of the cluster.
        cut: Whether it may continue beyond the observed space (see `pipeline.detection.truncation`).
        verdict: int32, see Verdict.
    """

    size: Int
    centroid: Float
    eigenvalues: Float
    eccentricity: Float
    centre: Float
    covariance: Float
    radius: Float
    radius_sigma: Float
    radial_std: Float
    arc: Float
    extent: Float
    hidden: Bool
    cut: Bool
    verdict: Int32


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Candidates for trees, the observations of SLAM, in the base frame; columns of length D.

    Attributes:
        cluster: int64, row in Clusters.
        centre: shape (D, 2) [m].
        covariance: shape (D, 2, 2) [m^2].
        radius, radius_sigma: [m], NaN where unknown.
        arc: Visible part of the circle [rad].
        eccentricity: lambda1 / lambda2.
    """

    cluster: Int
    centre: Float
    covariance: Float
    radius: Float
    radius_sigma: Float
    arc: Float
    eccentricity: Float


def no_detections() -> Detections:
    """Return a table without rows."""
    return Detections(
        np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), *(np.zeros(0) for _ in range(4))
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trees:
    """The tree map (Table 2) as columns of length T, in the frame of the map.

    Attributes:
        number: int64, from 1; a tree never changes its number.
        position: shape (T, 2) [m].
        covariance: shape (T, 2, 2) [m^2].
        velocity: shape (T, 2) [m/s], of the Kalman filter's state (Eq. 10).
        dbh: Diameter at breast height [m], NaN if no arc was wide enough.
        dbh_sigma: Its standard deviation [m], or NaN.
        eccentricity: Mean over the observations.
        observations: int64, number of scans with a detection of it. The counts of merged trees are added.
        coverage: Part of its circumference that was observed [rad].
        first_seen_ns, last_seen_ns: int64.
        confirmed: Whether it was observed often enough to be shown and exported.
        sides: int64: bit k is set if the k-th of 36 sectors around the trunk was observed, counted from x to
            y of the map; None if only the coverage is known.
        height, height_sigma: Height of the tree and its standard deviation [m], NaN where its top is not
            seen; None if heights are not measured, as in a drive.
        lean: Angle of the stem from the vertical [rad]; None if it is not measured.
    """

    number: Int
    position: Float
    covariance: Float
    velocity: Float
    dbh: Float
    dbh_sigma: Float
    eccentricity: Float
    observations: Int
    coverage: Float
    first_seen_ns: Int
    last_seen_ns: Int
    confirmed: Bool
    sides: Int | None = None
    height: Float | None = None
    height_sigma: Float | None = None
    lean: Float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Vertical columns of voxels over all scans; columns of length K, frame of the map.

    Attributes:
        tile: int64, shape (K, 2): tile of the voxel map that contains the foot.
        axis: shape (K, 5): x, y at 1.3 m [m], shift of x and y per metre of height, strength.
        viewed: Greatest height above the ground that a scan observed there [m].
        present, absent: Number of scans with free view of the place in which an object was there, or not.
        met, passed: int32, shape (K, slices of height): rays that ended at it, or passed its axis.
        figures: shape (K, figures): features, see `pipeline.classification.features.NAMES`.
        share: shape (K, 6): votes for tree, pole, person, bush, wall, other.
        verdict: int32, see Verdict.
    """

    tile: Int
    axis: Float
    viewed: Float
    present: Float
    absent: Float
    met: Int32
    passed: Int32
    figures: Float
    share: Float
    verdict: Int32


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap:
    """Terrain map; columns of length K, one row per observed cell, frame of the map.

    Attributes:
        cell: Side of the square cells [m].
        place: int32, shape (K, 2): the cell spans from place * cell to (place + 1) * cell [m].
        height: float32 [m], above the ground at the start of the run.
        sigma: float32 [m], standard deviation of the height of one view.
        views: int32, number of scans that observed it.
    """

    cell: float
    place: Int32
    height: Float32
    sigma: Float32
    views: Int32


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """The landmarks of SLAM, in the frame of the map; columns of length L.

    Attributes:
        birth: int64, serial number of the detection that began the landmark: its identity.
        position: shape (L, 2) [m].
        covariance: xx, xy, yy, shape (L, 3) [m^2], given the path.
        score: Weighted hits minus misses in free view; negative if it was missed more often than detected.
        gate, distance_max: Limits of the data association [sigma], [m].
    """

    birth: Int
    position: Float
    covariance: Float
    score: Float
    gate: float
    distance_max: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Estimate of SLAM after a scan.

    Attributes:
        T_map_base: The pose.
        covariance: shape (3, 3) of x, y, yaw [m, m, rad], in the frame of the map.
        particles: shape (P, 3): x, y [m], yaw [rad] in the frame of the map.
        weights: shape (P,), sum 1.
        n_eff: Effective number of particles, 1 / sum of squared weights.
        landmarks: shape (L, 2) [m], the landmarks of the best particle.
        resampled: Whether the particles were resampled at this scan.
        health: Quality of the pose.
        relative: Covariance with respect to the nearby landmarks, shape (3, 3); None if it is `covariance`.
        landmark_of: Birth number of the landmark of each detection, int64, shape (D,); -1 without one.
    """

    T_map_base: Pose2
    covariance: Float
    particles: Float
    weights: Float
    n_eff: float
    landmarks: Float
    resampled: bool
    health: Health = field(default_factory=Health)
    relative: Float | None = None
    landmark_of: Int = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """Path of the robot (Eq. 11), one row per scan, in the frame of the map; columns of length N.

    Attributes:
        stamp_ns: int64.
        x, y: [m].
        yaw: [rad].
        sigma_xy: [m], square root of the mean of the two variances of the position.
    """

    stamp_ns: Int
    x: Float
    y: Float
    yaw: Float
    sigma_xy: Float


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Result of one scan: its points and clusters, and the present map.

    Attributes:
        index, stamp_ns: Of the scan.
        raw: float32, shape (N, 3) [m]: the scan in the level sensor frame.
        filtered: float32, shape (M, 3) [m]: the points that passed the filters, same frame.
        labels: int32, shape (M,): row in `clusters` of each filtered point, -1 for noise.
        clusters, detections: Of this scan.
        estimate: The pose.
        T_odom_base: The pose by odometry only.
        sensor_offset: shape (3,) [m]: position of the sensor in the base frame; `raw` plus this offset is in
            the level base frame.
        trees: The map.
        counts: Number of points that each stage passed and rejected, by name.
        warnings: Messages for the user.
        columns: Voxel columns; None without this classifier.
        ground: Terrain map, updated every few scans; None without ground segmentation, or if it is unchanged.
        base_z: Height of the base in the terrain map [m].
        clearance: Free distance on the path of the robot; None without obstacle detection.
        of_cloud: Whether it is the map of a whole cloud: there is no robot, and the pose is the middle of the
            plot.
    """

    index: int
    stamp_ns: int
    raw: Float32
    filtered: Float32
    labels: Int32
    clusters: Clusters
    detections: Detections
    estimate: PoseEstimate
    T_odom_base: Pose2
    sensor_offset: Float
    trees: Trees
    counts: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    columns: Columns | None = None
    ground: HeightMap | None = None
    base_z: float = 0.0
    clearance: Clearance | None = None
    of_cloud: bool = False

    @property
    def health(self) -> Health:
        """Quality of the pose."""
        return self.estimate.health
