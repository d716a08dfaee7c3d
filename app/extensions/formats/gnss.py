"""GNSS fixes (NavSatFix) as pose measurements, projected to a plane that touches the Earth at the first one
(azimuthal equidistant, metres)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.extensions.formats import FIX_STRETCH
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.readers.container import Message
from pipeline.io.readers.measured_poses import NO_HEADING, RigidFit, fit_rigid
from pipeline.io.readers.transforms import frame_name
from pipeline.types.records import PoseMeasurement

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

    from pipeline.io.readers.ros_records import RecordDecoder

#: Standard deviation of fixes without a covariance, and the smallest one that is believed [m].
UNKNOWN_SIGMA, BEST_SIGMA = 3.0, 0.05
#: Number of the shared errors of fixes, see PoseMeasurement.
GNSS_SOURCE = 0


@dataclass(frozen=True, slots=True)
class Fix:
    """A position by GNSS.

    Attributes:
        stamp_ns: Time [ns].
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
        """Return a fix from the fields of its message; the height is ignored. Its sigma is the root of the
        mean of the variances of east and north, at least BEST_SIGMA; UNKNOWN_SIGMA if the covariance is
        unknown.

        Args:
            stamp_ns: Time [ns].
            latitude, longitude: WGS84 [deg].
            covariance: Covariance of east, north, up [m^2], nine numbers by row; only the variances of east
                and north are used.
            kind: Field `position_covariance_type`. The covariance is unknown if it is 0, or if the mean of
                the two variances is 0, as many drivers send it.

        Raises:
            ValueError: The position is not on Earth; or `kind` is not 0 and one of the two variances is
                negative, not finite, or 1e8 m^2 or more.
        """
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise ValueError("a position is not on Earth")
        sigma = UNKNOWN_SIGMA
        if kind != 0:
            east, north = float(covariance[0]), float(covariance[4])
            if not (0.0 <= east < 1e8 and 0.0 <= north < 1e8):
                raise ValueError("a variance is negative, too large or not finite")
            variance = 0.5 * (east + north)
            if variance > 0.0:
                sigma = max(math.sqrt(variance), BEST_SIGMA)
        return cls(stamp_ns, latitude, longitude, sigma)


class Plane:
    """Projection to east and north of an origin [m].

    Args:
        latitude, longitude: The origin [deg].
    """

    def __init__(self, latitude: float, longitude: float) -> None:
        """Prepare the projection; imports pyproj."""
        from pyproj import Transformer

        local = f"+proj=aeqd +lat_0={latitude!r} +lon_0={longitude!r} +datum=WGS84 +units=m"
        self._transform = Transformer.from_crs("EPSG:4326", local, always_xy=True).transform

    def place(self, fix: Fix) -> tuple[float, float]:
        """Return east and north of a fix from the origin [m]."""
        east, north = self._transform(fix.longitude, fix.latitude)
        return float(east), float(north)


@dataclass(frozen=True, slots=True, eq=False)
class GnssFrame:
    """Pose of the GNSS plane in the map frame.

    Attributes:
        plane: Projection of fixes.
        fit: Pose of the plane in the map.
        lever: Horizontal distance of the antenna from the base [m]; it counts as an error.
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
        """Return a fix as measurement of the position of the base in the map, with the errors of the fix, of
        the distance of the antenna and of the plane; those of the fixes of one second count as one. Its
        heading is unknown: yaw 0 with the variance NO_HEADING."""
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
        fixes: Fixes in the order of time; the first one is the origin of the plane.
        stamp_ns: Times of the odometry, ascending, shape (N,) [ns].
        path: Positions x, y of the base by odometry in the map frame, shape (N, 2 or more) [m]; further
            columns are ignored.
        lever: Horizontal distance of the antenna from the base [m].

    Returns:
        The frame and "", or None and the reason why there is none, see `fit_rigid`.
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


def read_fix(decoder: RecordDecoder, message: Message, stamp_ns: int) -> tuple[Fix | None, str]:
    """Return a GNSS fix, None if the receiver had no fix, and the name of the frame of its antenna.

    Raises:
        ValueError: Position or variances are invalid, see `Fix.of`.
        Exception: Of many kinds, when the message is damaged.
    """
    decoded: ros2.sensor_msgs__msg__NavSatFix = decoder.message(message)
    frame = frame_name(decoded.header.frame_id)
    if decoded.status.status < 0:
        return None, frame
    covariance = [float(number) for number in decoded.position_covariance]
    kind = int(decoded.position_covariance_type)
    return Fix.of(stamp_ns, float(decoded.latitude), float(decoded.longitude), covariance, kind), frame
