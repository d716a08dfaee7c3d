"""Poses by other sources as pose measurements in the map frame: GNSS fixes (NavSatFix) and poses of another
SLAM (PoseWithCovarianceStamped, or a named Odometry topic).

Fixes are projected to a plane that touches the Earth at the first fix (azimuthal equidistant, metres). The
pose of that plane, or of the map of the other SLAM, in our map is fitted once to the odometry of the first
stretch of the drive, by least squares in the plane (Arun, Huang, Blostein 1987). Poses of another SLAM count
from the end of that stretch on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.types.records import Int, PoseMeasurement

FEWEST = 8  # positions
#: A larger RMS residual, in sigmas of a position, means that the positions belong to another path.
WORST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """Pose of another frame in the map frame.

    Attributes:
        T_map_other: The rigid motion.
        centre: Centre of the path it was fitted to, in the map [m], shape (2,).
        sigma: Standard deviation of the shift [m].
        yaw_sigma: Standard deviation of the rotation [rad].
        residual: RMS distance of the positions from the path [m].
        length: Extent of the path it was fitted to [m].
        rate_hz: Rate of the positions; their errors change slowly, so those of a second count as one.
    """

    T_map_other: Pose2
    centre: Float
    sigma: float
    yaw_sigma: float
    residual: float
    length: float
    rate_hz: float

    def shared(self, x: float, y: float, sigma: float, yaw_sigma: float, heading_sigma: float = 0.0) -> Float:
        """Return the factor L of the covariance L L^T of (x, y, yaw) that all positions share, shape (3, 4);
        see PoseMeasurement.

        Args:
            x, y: Position in the map [m].
            sigma: Standard deviation of the shift of the frame [m].
            yaw_sigma: Standard deviation of its rotation about `centre` [rad].
            heading_sigma: Standard deviation of the difference of the headings [rad].
        """
        dx, dy = x - self.centre[0], y - self.centre[1]
        return np.array(
            [
                [sigma, 0.0, -dy * yaw_sigma, 0.0],
                [0.0, sigma, dx * yaw_sigma, 0.0],
                [0.0, 0.0, 0.0, heading_sigma],
            ]
        )


def interpolated(at_ns: Int, stamp_ns: Sequence[int], path: Float) -> Float:
    """Return the columns of a path, linearly interpolated at other times, shape (K, C). Outside of the path
    its end values apply.

    Args:
        at_ns: Times [ns], shape (K,).
        stamp_ns: Times of the path, ascending [ns], length N.
        path: shape (N, C).
    """
    times = (np.asarray(stamp_ns, dtype=np.int64) - int(stamp_ns[0])).astype(np.float64)
    at = (at_ns - int(stamp_ns[0])).astype(np.float64)
    columns: Float = np.stack([np.interp(at, times, column) for column in path.T], axis=1)
    return columns


def fit_rigid(
    at_ns: Int,
    positions: Float,
    sigma: Float,
    stamp_ns: Sequence[int],
    path: Float,
    *,
    shortest: float,
    what: str,
    unknown: str,
) -> tuple[RigidFit | None, str]:
    """Fit the pose of another frame in the map.

    Args:
        at_ns: Times of the positions, ascending, shape (K,).
        positions: Positions in the other frame [m], shape (K, 2).
        sigma: Standard deviation of each position [m], shape (K,).
        stamp_ns: Times of the odometry, ascending, shape (N,).
        path: Positions of the base by odometry in the map frame [m], shape (N, 2).
        shortest: Shortest extent of the path for a fit [m].
        what, unknown: For messages: name of the positions, and what a short path does not determine.

    Returns:
        The fit, or None and the reason why there is none.
    """
    if len(positions) < FEWEST or len(stamp_ns) < 2:
        return None, f"{len(positions)} {what} are too few"
    by_odometry = interpolated(at_ns, stamp_ns, path)
    inside = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1]) & np.isfinite(positions).all(axis=1)
    positions, by_odometry, sigma = positions[inside], by_odometry[inside], sigma[inside]
    if len(positions) < FEWEST:
        return None, f"{what} and odometry are not from the same time"
    length = float(np.hypot(*np.ptp(by_odometry, axis=0)))
    if length < max(shortest, 3.0 * float(np.median(sigma))):
        return None, f"the robot drove {length:.0f} m, too little to determine {unknown}"
    w = 1.0 / np.square(sigma)
    w /= w.sum()
    centre_other, centre = w @ positions, w @ by_odometry
    a, b = positions - centre_other, by_odometry - centre
    yaw = math.atan2(float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(w @ (a * b).sum(axis=1)))
    c, s = math.cos(yaw), math.sin(yaw)
    rotated = a @ np.array([[c, s], [-s, c]])
    residual = float(np.sqrt(w @ np.square(rotated - b).sum(axis=1)))
    typical = float(np.median(sigma))
    if residual > WORST * max(typical, 0.02 * length):
        return None, f"their distance from the path by odometry is {residual:.1f} m (RMS)"
    # Errors that change slowly do not average out: only one position in ten counts.
    known = max(typical, residual) / math.sqrt(max(len(positions) / 10.0, 1.0))
    spread = float(np.sqrt(w @ np.square(b).sum(axis=1)))
    shift = centre - np.array([[c, -s], [s, c]]) @ centre_other
    span_s = int(at_ns[-1] - at_ns[0]) * 1e-9
    rate = (len(at_ns) - 1) / span_s if span_s > 0.0 else 1.0
    T_map_other = Pose2(float(shift[0]), float(shift[1]), yaw)
    return RigidFit(T_map_other, centre, known, known / spread, residual, length, rate), ""


#: Shortest and longest stretch of the drive from which the plane is fitted [m].
FIX_STRETCH = 10.0, 100.0
#: Standard deviation of fixes without a covariance, and the smallest one that is believed [m].
UNKNOWN_SIGMA, BEST_SIGMA = 3.0, 0.05
#: Variance of a heading that is not measured [rad^2].
NO_HEADING = 1e4
#: Number of the shared errors of fixes, see PoseMeasurement.
GNSS_SOURCE = 0


@dataclass(frozen=True, slots=True)
class Fix:
    """A position by GNSS.

    Attributes:
        stamp_ns: Time.
        latitude, longitude: WGS84 [deg].
        sigma: Standard deviation of each horizontal coordinate [m].
    """

    stamp_ns: int
    latitude: float
    longitude: float
    sigma: float

    @classmethod
    def of(
        cls, stamp_ns: int, latitude: float, longitude: float, covariance: Sequence[float], kind: int
    ) -> Fix:
        """Return a fix from the fields of its message.

        Args:
            stamp_ns: Time [ns].
            latitude, longitude: WGS84 [deg].
            covariance: Covariance of east, north, up [m^2], nine numbers.
            kind: Field `position_covariance_type`. The covariance is unknown if it is 0, or if the variances
                are zero, as many drivers send it.

        Raises:
            ValueError: The position is not on Earth, or the covariance is invalid.
        """
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise ValueError("a position is not on Earth")
        sigma = UNKNOWN_SIGMA
        if kind != 0:
            variance = 0.5 * (float(covariance[0]) + float(covariance[4]))
            if not 0.0 <= variance < 1e8:
                raise ValueError("a covariance is negative or not finite")
            if variance > 0.0:
                sigma = max(math.sqrt(variance), BEST_SIGMA)
        return cls(stamp_ns, latitude, longitude, sigma)


class Plane:
    """Projection to east and north of an origin [m].

    Args:
        latitude, longitude: The origin [deg].
    """

    def __init__(self, latitude: float, longitude: float) -> None:
        from pyproj import Transformer

        local = f"+proj=aeqd +lat_0={latitude!r} +lon_0={longitude!r} +datum=WGS84 +units=m"
        self._transform = Transformer.from_crs("EPSG:4326", local, always_xy=True).transform

    def place(self, fix: Fix) -> tuple[float, float]:
        """Return east and north of the origin [m]."""
        east, north = self._transform(fix.longitude, fix.latitude)
        return float(east), float(north)


@dataclass(frozen=True, slots=True, eq=False)
class GnssFrame:
    """Pose of the GNSS plane in the map frame.

    Attributes:
        plane: Projection of fixes.
        fit: Pose of the plane in the map.
        lever: Distance of the antenna from the base [m]; it counts as an error.
    """

    plane: Plane
    fit: RigidFit
    lever: float

    @property
    def yaw_sigma(self) -> float:
        """Standard deviation of the direction of north [rad]."""
        return self.fit.yaw_sigma

    @property
    def summary(self) -> str:
        """How the fixes are used, as text for the user."""
        return (
            f"fixes are used; over {self.fit.length:.0f} m of the drive their distance from the path by "
            f"odometry is {self.fit.residual:.2f} m (RMS), and north is known to "
            f"{math.degrees(self.yaw_sigma):.1f} degrees"
        )

    def measurement(self, fix: Fix) -> PoseMeasurement:
        """Return a fix as measurement of the position of the base in the map, with the errors of the fix and
        of the plane."""
        T = self.fit.T_map_other
        c, s = math.cos(T.yaw), math.sin(T.yaw)
        east, north = self.plane.place(fix)
        x = T.x + c * east - s * north
        y = T.y + s * east + c * north
        # The error by the lever is shared while the robot drives straight on, and changes in turns.
        shared = self.fit.shared(x, y, math.hypot(self.fit.sigma, self.lever), self.yaw_sigma)
        own = fix.sigma**2 * max(self.fit.rate_hz, 1.0) + self.lever**2
        C = np.diag([own, own, NO_HEADING]) + shared @ shared.T
        return PoseMeasurement(fix.stamp_ns, Pose2(x, y, 0.0), C, shared=shared, source=GNSS_SOURCE)


def align_fixes(
    fixes: Sequence[Fix], stamp_ns: Sequence[int], path: Float, lever: float = 0.0
) -> tuple[GnssFrame | None, str]:
    """Fit the pose of the GNSS plane in the map.

    Args:
        fixes: In the order of time.
        stamp_ns: Times of the odometry, ascending, shape (N,).
        path: Positions of the base by odometry in the map frame [m], shape (N, 2) or with more columns.
        lever: Distance of the antenna from the base [m].

    Returns:
        The frame, or None and the reason why there is none.
    """
    if not fixes:
        return None, "0 fixes are too few"
    plane = Plane(fixes[0].latitude, fixes[0].longitude)
    positions = np.array([plane.place(fix) for fix in fixes])
    at_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    sigma = np.array([fix.sigma for fix in fixes])
    fit, why = fit_rigid(
        at_ns, positions, sigma, stamp_ns, path[:, :2],
        shortest=FIX_STRETCH[0], what="fixes", unknown="the direction of north",
    )  # fmt: skip
    return (None if fit is None else GnssFrame(plane, fit, lever)), why


#: Shortest and longest stretch for poses of another SLAM [m]; short, because odometry drifts and these poses
#: are much better than GNSS fixes.
POSE_STRETCH = 5.0, 20.0
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
        """Return a pose from the fields of its message.

        Args:
            stamp_ns: Time [ns].
            T_other_child: Pose in the message.
            covariance: Covariance of x, y, z [m], roll, pitch, yaw [rad], 36 numbers.
            T_child_base: Pose of the base in the frame of the message; None for the base itself.

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
        """How the poses are used, as text for the user."""
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
        return PoseMeasurement(pose.stamp_ns, Pose2(at.x, at.y, yaw), C, GATE, shared, POSE_SOURCE)


def align_poses(
    poses: Sequence[OtherPose], stamp_ns: Sequence[int], path: Float
) -> tuple[OtherFrame | None, str]:
    """Fit the pose of the other frame in the map.

    Args:
        poses: In the order of time.
        stamp_ns: Times of the odometry, ascending, shape (N,).
        path: Poses of the base by odometry in the map frame: x, y [m], yaw [rad], shape (N, 3).

    Returns:
        The frame, or None and the reason why there is none.
    """
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
