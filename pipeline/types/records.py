"""What flows through the pipeline: immutable records. Times are integer nanoseconds, lengths metres,
angles radians. Tables are kept as columns of equal length, never as lists of objects.
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
from pipeline.types.sensor_data import Bool as Bool
from pipeline.types.sensor_data import Float as Float
from pipeline.types.sensor_data import Float32 as Float32
from pipeline.types.sensor_data import Imu as Imu
from pipeline.types.sensor_data import Int as Int
from pipeline.types.sensor_data import Int32 as Int32
from pipeline.types.sensor_data import Learnt as Learnt
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

# --- what the stages hand on ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """All that the mapper needs for one scan: the scan and the motion at its time.

    Attributes:
        index: Number of the scan in the run, from 0.
        scan: The sweep.
        T_odom_base: Pose of the base at the scan's time in the odometry's frame, None when the
            source has none.
        roll, pitch: Tilt of the base against gravity [rad], 0 when not known.
        tilt_known: Whether roll and pitch were measured.
        twist: Velocity of the base at the scan: forward, left [m/s], turn [rad/s]; zero when unknown.
        warnings: What the synchroniser noticed on the way to this scan.
        doubt: Why the motion to this scan may be wrong, for people; empty when nothing says so.
        slack: What that adds to its standard deviations: position [m] and heading [rad].
        measured: The pose by another source at this scan, None where there is none.
        turn: By a gyroscope since the scan before, None where there is none.
        turn_rate: By a gyroscope at the scan [rad/s].
        learnt: What the readings so far have taught of the gyroscope.
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
    measured: PoseMeasurement | None = None
    turn: Turn | None = None
    turn_rate: float | None = None
    learnt: Learnt = field(default_factory=Learnt)


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Which cluster each point belongs to.

    Attributes:
        label: int32, shape (N,): 0..clusters-1 in the order of their first point, -1 for noise. What was
            joined to a trunk and taken off (see `cluster_splitting`) comes after all others.
        clusters: Number of clusters.
        hidden: shape (clusters,): whether something nearer hides an edge of the cluster.
    """

    label: Int32
    clusters: int
    hidden: Bool


class Verdict(IntEnum):
    """What a cluster is, or why it is not a tree."""

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
        """The verdict in words, for people and files."""
        return self.name.lower().replace("_", " ")


#: What columns are voted to be, in the order of their shares (see Columns).
CLASSES = (Verdict.TREE, Verdict.POLE, Verdict.PERSON, Verdict.BUSH, Verdict.WALL, Verdict.OTHER)
#: What the votes count where circles show something round: so seldom is it anything else (docs/trunks.md).
AT_ROUND = tuple(1.0 if k in (Verdict.TREE, Verdict.POLE, Verdict.PERSON) else 0.1 for k in CLASSES)


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """The clusters of one scan as columns of length K; positions in the level sensor frame.

    Attributes:
        size: int64, number of points.
        centroid: shape (K, 3) [m].
        eigenvalues: shape (K, 3) [m^2], descending; the third is 0 when the plane is 2D.
        eccentricity: lambda1 / lambda2 >= 1 (Eq. 4); inf for points on a line.
        centre: shape (K, 2) [m], the estimate of the trunk's axis.
        covariance: shape (K, 2, 2) [m^2], of `centre`.
        radius, radius_sigma: [m], of the fitted circle; NaN where none was fitted.
        radial_std: [m], standard deviation of the distances to the axis (the cylinder check).
        arc: Visible part of the circle [rad].
        extent: shape (K, 3) [m], size of the bounding box along the ray, across it and up.
        hidden: Whether something nearer hides an edge of the cluster.
        cut: Whether it goes on where nobody looked (see `pipeline.detection.truncation`).
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
    """The clusters that SLAM sees as trees, in the base frame; columns of length D.

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
    """A table without rows."""
    return Detections(
        np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), *(np.zeros(0) for _ in range(4))
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trees:
    """The tree map (Table 2) as columns of length T, in the frame of the map.

    Attributes:
        number: int64, from 1; a tree keeps its number for ever.
        position: shape (T, 2) [m].
        covariance: shape (T, 2, 2) [m^2].
        velocity: shape (T, 2) [m/s], of the Kalman filter's state (Eq. 10).
        dbh: Diameter at breast height [m], NaN where no arc carried one.
        dbh_sigma: [m], NaN likewise.
        eccentricity: Mean over the observations.
        observations: int64, number of scans it was seen in; where pieces of it were trees of their own before
            they came to be one, the scans in which each was seen count for each.
        coverage: Part of its circumference that was seen [rad].
        first_seen_ns, last_seen_ns: int64.
        confirmed: Whether it was seen often enough to be shown and exported.
        sides: int64: bit k is set when the k-th of 36 sectors around the trunk was seen, counted from x
            to y of the map; None where only the coverage is known.
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


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """What stands upright in what all scans gathered; columns of length K, frame of the map.

    Attributes:
        tile: int64, shape (K, 2): where in the memory the foot stands.
        axis: shape (K, 5): x, y at 1.3 m [m], shift of x and y per metre of height, strength.
        viewed: How high above the ground any scan looked there [m].
        present, absent: In how many scans something, or nothing, stood there in free view.
        met, passed: int32, shape (K, slices of height): rays that ended at it, or passed its axis.
        figures: shape (K, figures): what it is judged by, see `pipeline.classification.features.NAMES`.
        share: shape (K, 6): votes for tree, pole, person, bush, wall, other; verdict: int32, see Verdict.
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
    """The ground as all scans saw it; columns of length K, one a known cell, in the frame of the map.

    Attributes:
        cell: Side of the square cells [m].
        place: int32, shape (K, 2): the cell spans from place * cell to (place + 1) * cell [m].
        height: float32 [m], above the ground where the run began.
        sigma: float32 [m], how far one view's height lies from it.
        views: int32, how many scans saw it.
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
        score: Hits less misses in free view, of the last hits; below 0 it was missed more often than seen.
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
    """What SLAM believes after a scan.

    Attributes:
        T_map_base: The pose.
        covariance: shape (3, 3) of x, y, yaw [m, m, rad], in the frame of the map.
        particles: shape (P, 3): x, y [m], yaw [rad] in the frame of the map.
        weights: shape (P,), sum 1.
        n_eff: Effective number of particles, 1 / sum of squared weights.
        landmarks: shape (L, 2) [m], the landmarks of the best particle.
        resampled: Whether the particles were resampled at this scan.
        health: How far it can be trusted.
        relative: Covariance with respect to the landmarks around, shape (3, 3); None: `covariance`.
        landmark_of: Birth of the landmark that SLAM associates with each detection, int64, shape (D,); -1 for
            a detection without landmark.
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
    """Where the robot was at each scan (Eq. 11), in the frame of the map; columns of length N.

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
    """All that came of one scan: the picture, and what the map knows now.

    Attributes:
        index, stamp_ns: Of the scan.
        raw: float32, shape (N, 3) [m]: the scan in the level sensor frame.
        filtered: float32, shape (M, 3) [m]: what passed the filters, same frame.
        labels: int32, shape (M,): row in `clusters` of each filtered point, -1 for noise.
        clusters, detections: Of this scan.
        estimate: The pose.
        T_odom_base: The pose by odometry alone.
        sensor_offset: shape (3,) [m]: where the sensor stands in the base frame; add it to points
            of `raw` and `filtered` to have them in the level base frame.
        trees: The map.
        counts: How many points each stage let pass and how many it refused, by name.
        warnings: For people.
        columns: What was gathered over the scans, None where nothing is.
        ground: The height map, made anew every some scans; None where no ground is looked for, or where it
            is the same as in the picture before.
        base_z: Height of the base in the height map [m].
        clearance: Of the way that the robot drives; None where nobody looks for obstacles.
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

    @property
    def health(self) -> Health:
        """How far the pose can be trusted."""
        return self.estimate.health
