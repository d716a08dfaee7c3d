"""Immutable records that pass between packages. Times are integer nanoseconds, lengths metres, angles
radians. Tables are columns of equal length, not lists of objects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float as Float
from pipeline.geometry.poses import Pose2, Pose3

# Metadata of fields of records that are written to files, see `pipeline.io.checkpoints`.
NOT_SAVED = "not saved"  # of a field that is not saved and gets its default

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
        T_base_lidar: Extrinsics of the LiDAR that made the scan, if it is not that of the source.
    """

    stamp_ns: int
    points: Float32
    reflectance: Float32 | None = None
    ring: Int32 | None = None
    offset_ns: Int32 | None = None
    dropped: int = 0
    stems: Stems | None = None
    T_base_lidar: Pose3 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Pose of the base by wheels or another odometry.

    Attributes:
        stamp_ns: Time of the pose.
        T_odom_base: Pose of the base in the frame of the odometry.
        covariance: Covariance of the step since the previous pose, x, y [m], yaw [rad] in the frame of the
            base at that pose, shape (3, 3), as a registration of scans knows it; None of wheels, whose noise
            is a parameter.
    """

    stamp_ns: int
    T_odom_base: Pose3
    covariance: Float | None = None


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
        ring_step: Angle between neighbouring lasers, or between neighbouring returns of a sensor without
            rings [rad]; 0 if unknown.
        azimuth_step: Angle between neighbouring shots, or returns of a sensor without rings [rad].
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


FIRST_NS = 1_000_000_000  # ns; so that a short recording uses all its data


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
        covariance: Covariance of the motion since the previous scan, see Odometry; None if unknown.
        unreported: Motion by the odometry up to the previous scan that no earlier step contains, because the
            odometry was missing; it came with this step. None without such a motion.
        measured: Pose measurement of another source at this scan, or None.
        turn: Rotation by the gyroscope since the previous scan, or None.
        turn_rate: Rate of turn by the gyroscope at the scan [rad/s], or None.
        elapsed_ns: Time since the first scan of the run [ns].
        period_ns: Time since the previous scan [ns]; 0 for the first one.
        is_view: Whether SLAM and the tracker may use the scan. Scans in quick succession show the
            same errors of a trunk, so that more of them are no more evidence.
        again_ns: Time since the previous scan of the same LiDAR in the same directions [ns]; None without
            one.
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
    covariance: Float | None = None
    unreported: Pose2 | None = None
    measured: PoseMeasurement | None = None
    turn: Turn | None = None
    turn_rate: float | None = None
    elapsed_ns: int = 0
    period_ns: int = 0
    is_view: bool = True
    again_ns: int | None = None

    def is_due(self, interval: float, delay: float = 0.0) -> bool:
        """Return whether the scan is used by something that needs one scan per interval of time, whatever the
        rate of the sensor: of each LiDAR and direction the first scan of an interval, and all scans of the
        first second (FIRST_NS).

        Args:
            interval: Length of the intervals [s]; 0 makes each scan due.
            delay: Shift of all intervals [s]: they begin at `delay` plus or minus multiples of `interval`
                after the first scan.
        """
        if self.elapsed_ns < FIRST_NS or interval == 0.0:
            return True
        length, since = round(interval * 1e9), self.elapsed_ns - round(delay * 1e9)
        before_ns = self.period_ns if self.again_ns is None else self.again_ns
        return since // length > (since - before_ns) // length


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
    STUMP = 17

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
        covariance: shape (T, 2, 2) [m^2]; assumed, not measured, without observations.
        dbh: Diameter at breast height [m], NaN if no arc was wide enough.
        dbh_sigma: Its standard deviation [m], or NaN.
        eccentricity: Mean over the observations.
        observations: int64, number of scans with a detection of it. The counts of merged trees are added. 0
            for a tree of the accumulated scans only, and for one whose position a person gave.
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
        absent_lately: Number of the last of these scans without a break in which no object was there.
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
    absent_lately: Float
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


HealthState = Literal["good", "weak", "lost"]
#: Standard deviation up to which a position is usable [m]: the usual distance between neighbouring trunks,
#: beyond which associations become wrong.
SIGMA_XY_MAX = 1.5
#: First words of the reasons of a weak pose that nothing contradicts: no tree is in view, the position is
#: known less well than a third of the distance between trees, or neighbouring trees fit equally well.
ALONE = "fewer than two known trees in view"
UNCERTAIN = "the position is uncertain"
UNDECIDED = "most detections match two trees"


@dataclass(frozen=True, slots=True)
class Health:
    """Quality of the pose after a scan.

    Attributes:
        state: "good"; "weak": the map may be wrong; "lost": the pose is not usable.
        reason: Message with the reason; empty if good, unless the map was repaired since.
        n_eff: Effective number of particles.
        ancestors: Number of particles of 50 to 100 scans ago that have descendants.
        detections: Number of detections in the scan.
        recognised: Number of detections of well known landmarks, mean over the particles.
        ambiguous: Number of detections with two likely landmarks, mean over the particles.
        innovation: Normalised innovation squared per degree of freedom, mean over the scan: 1 if the errors
            agree with their covariances; NaN without a known landmark.
        sigma_xy: Standard deviation of the position [m].
        sigma_yaw: Standard deviation of the heading [rad].
        odometry: Difference between the pose and the prediction by odometry [sigma].
        doubt: Message why the odometry may be wrong; the pose may be good nevertheless.
    """

    state: HealthState = "good"
    reason: str = ""
    n_eff: float = 0.0
    ancestors: int = 0
    detections: int = 0
    recognised: float = 0.0
    ambiguous: float = 0.0
    innovation: float = float("nan")
    sigma_xy: float = 0.0
    sigma_yaw: float = 0.0
    odometry: float = 0.0
    doubt: str = ""

    def warnings(self, reported: str) -> tuple[str, ...]:
        """Return the doubt about the odometry as a tuple of one warning; empty without a doubt, or if the
        doubt equals the text `reported`, which was reported before."""
        return (self.doubt,) if self.doubt not in ("", reported) else ()


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Estimate of SLAM after a scan.

    Attributes:
        T_map_base: The pose.
        covariance: shape (3, 3) of x, y, yaw [m, m, rad], in the frame of the map.
        particles: shape (P, 3): x, y [m], yaw [rad] in the frame of the map.
        weights: shape (P,), sum 1.
        n_eff: Effective number of particles, 1 / sum of squared weights.
        landmarks: shape (L, 2) [m], the landmarks of the best particle with at least `hits_to_weigh` hits.
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
    health: Health = field(default_factory=Health)
    relative: Float | None = None
    landmark_of: Int = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def sigma_xy(self) -> float:
        """Root mean square of the standard deviations of x and y in the map [m]."""
        return float(np.sqrt(0.5 * (self.covariance[0, 0] + self.covariance[1, 1])))

    @property
    def local_covariance(self) -> Float:
        """Covariance with respect to the nearby landmarks, shape (3, 3): `relative`, or `covariance` where
        that is None."""
        return self.covariance if self.relative is None else self.relative


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


class Zone(IntEnum):
    """What a robot should do because of obstacles on its path."""

    CLEAR = 0
    SLOW = 1
    STOP = 2
    UNKNOWN = 3

    @property
    def label(self) -> str:
        """The zone as text in lower case, e.g. "slow"."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Clearance:
    """Obstacles of one scan on the path of the robot, an arc of constant curvature.

    Attributes:
        zone: UNKNOWN if no obstacle is observed but the sensor does not observe the path, or the height of
            returns is unknown.
        ahead: Distance along the path from the end of the robot to the nearest obstacle [m], 0 at its side;
            infinite if the slow zone is free.
        beside: Least distance between the sides of the robot and obstacles next to the path [m], 0 for one on
            the path; infinite without one.
        x, y: Position of the nearest obstacle in the level base frame [m]; NaN without one.
        curvature: Curvature of the path [1/m], positive to the left.
        backward: Whether the robot drives backwards.
        within: Length of the path that is checked [m].
        begins: Distance along the path from the base to the end of the robot, where `ahead` begins [m].
    """

    zone: Zone
    ahead: float = math.inf
    beside: float = math.inf
    x: float = math.nan
    y: float = math.nan
    curvature: float = 0.0
    backward: bool = False
    within: float = 0.0
    begins: float = 0.0


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
        counts: Dict from names such as "out of range", "clustered" and "noise" to numbers of points that a
            stage passed or rejected; the names differ for stems and without a drive.
        warnings: Messages for the user.
        columns: Voxel columns; None without this classifier.
        ground: Terrain map, updated every few scans; None without ground segmentation, or if it is unchanged.
        base_z: Height of the base in the terrain map [m].
        clearance: Free distance on the path of the robot; None without obstacle detection.
        of_drive: Whether it is of the drive of a robot; else it is the map of a source as a whole, there is
            no robot, and the pose is the middle of the map.
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
    of_drive: bool = True

    @property
    def health(self) -> Health:
        """Quality of the pose: that of the estimate, whose `sigma_xy` is relative to nearby landmarks, but
        not "good" if the standard deviation of the position in the map exceeds SIGMA_XY_MAX."""
        health, sigma_xy = self.estimate.health, self.estimate.sigma_xy
        if health.state != "good" or sigma_xy <= SIGMA_XY_MAX:
            return health
        return replace(
            health, state="weak", reason=f"the position in the map is uncertain by {sigma_xy:.1f} m"
        )
