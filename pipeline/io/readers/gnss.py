"""GNSS fixes (sensor_msgs/NavSatFix) as pose measurements in the map frame.

Fixes are projected to a plane that touches the Earth at the first fix (azimuthal equidistant, metres). The
pose
of that plane in the map is fitted once to the odometry of the first stretch of the drive, and then fixed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.io.readers.rigid_alignment import RigidFit, fit_rigid
from pipeline.types.records import PoseMeasurement

#: Shortest and longest stretch of the drive from which the plane is fitted [m].
SHORTEST, LONGEST = 10.0, 100.0
#: Standard deviation of fixes without a covariance, and the smallest one that is believed [m].
UNKNOWN_SIGMA, BEST_SIGMA = 3.0, 0.05
#: Variance of a heading that is not measured [rad^2].
NO_HEADING = 1e4
#: Number of the shared errors of fixes, see PoseMeasurement.
SOURCE = 0


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
        """Make a fix of the fields of its message.

        The covariance is unknown when `kind` is 0, or when its variances are zero, as many drivers send it.

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
        """Summary for the user."""
        return (
            f"fixes are used; over {self.fit.length:.0f} m of the drive their distance from the path by "
            f"odometry is {self.fit.residual:.2f} m (RMS), and north is known to "
            f"{math.degrees(self.yaw_sigma):.1f} degrees"
        )

    def measurement(self, fix: Fix) -> PoseMeasurement:
        """Return the position of the base in the map, with the errors of the fix and of the plane."""
        T = self.fit.T_map_other
        c, s = math.cos(T.yaw), math.sin(T.yaw)
        east, north = self.plane.place(fix)
        x = T.x + c * east - s * north
        y = T.y + s * east + c * north
        # The error by the lever is shared while the robot drives straight on, and changes in turns.
        shared = self.fit.shared(x, y, math.hypot(self.fit.sigma, self.lever), self.yaw_sigma)
        own = fix.sigma**2 * max(self.fit.rate_hz, 1.0) + self.lever**2
        C = np.diag([own, own, NO_HEADING]) + shared @ shared.T
        return PoseMeasurement(fix.stamp_ns, Pose2(x, y, 0.0), C, shared=shared, source=SOURCE)


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
        shortest=SHORTEST, what="fixes", unknown="the direction of north",
    )  # fmt: skip
    return (None if fit is None else GnssFrame(plane, fit, lever)), why
