"""GNSS fixes (sensor_msgs/NavSatFix) as measured poses in the frame of the map.

Fixes are laid into a plane that touches the Earth at the first one (azimuthal equidistant, metres). How
that plane lies in the frame of the map nobody tells: it is found once, from the first stretch of the way,
where odometry and fixes must agree (a rigid motion in the plane, least squares), and held from then on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.io.readers.rigid_alignment import Laid, lay_over
from pipeline.types.records import PoseMeasurement

#: The plane is found from this much of the way on, and from no more than that [m].
SHORTEST, LONGEST = 10.0, 100.0
#: Of fixes that do not say how good they are [m]; and no receiver on a robot is better than the second.
UNKNOWN_SIGMA, BEST_SIGMA = 3.0, 0.05
#: Says nothing of the heading [rad^2].
NO_HEADING = 1e4
#: The number of its shared errors, see PoseMeasurement.
SOURCE = 0


@dataclass(frozen=True, slots=True)
class Fix:
    """Where a receiver says it is.

    Attributes:
        stamp_ns: When.
        latitude, longitude: WGS84 [deg].
        sigma: Of each of the two in the plane [m].
    """

    stamp_ns: int
    latitude: float
    longitude: float
    sigma: float

    @classmethod
    def of(
        cls, stamp_ns: int, latitude: float, longitude: float, covariance: Sequence[float], kind: int
    ) -> Fix:
        """A fix by the numbers of its message; `kind` 0, or variances of zero (many drivers fill in
        none), say that the covariance is not known.

        Raises:
            ValueError: They are no place on Earth, or their covariance is none.
        """
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            raise ValueError("no place on Earth")
        sigma = UNKNOWN_SIGMA
        if kind != 0:
            variance = 0.5 * (float(covariance[0]) + float(covariance[4]))
            if not 0.0 <= variance < 1e8:
                raise ValueError("no covariance")
            if variance > 0.0:
                sigma = max(math.sqrt(variance), BEST_SIGMA)
        return cls(stamp_ns, latitude, longitude, sigma)


class Plane:
    """East and north of a first fix [m].

    Args:
        latitude, longitude: Of the origin [deg].
    """

    def __init__(self, latitude: float, longitude: float) -> None:
        from pyproj import Transformer

        local = f"+proj=aeqd +lat_0={latitude!r} +lon_0={longitude!r} +datum=WGS84 +units=m"
        self._transform = Transformer.from_crs("EPSG:4326", local, always_xy=True).transform

    def place(self, fix: Fix) -> tuple[float, float]:
        """East and north of the origin [m]; far away where it is no neighbour of it."""
        east, north = self._transform(fix.longitude, fix.latitude)
        return float(east), float(north)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How the plane lies in the frame of the map.

    Attributes:
        plane: East, north.
        laid: How it lies.
        lever: How far the antenna stands from the base [m]; counts as error.
    """

    plane: Plane
    laid: Laid
    lever: float

    @property
    def yaw_sigma(self) -> float:
        """Of the direction of north [rad]."""
        return self.laid.yaw_sigma

    @property
    def words(self) -> str:
        """For people."""
        return (
            f"fixes are used; laid over {self.laid.length:.0f} m of the way they lie "
            f"{self.laid.residual:.2f} m from it (RMS), north is known to "
            f"{math.degrees(self.yaw_sigma):.1f} degrees"
        )

    def measured(self, fix: Fix) -> PoseMeasurement:
        """The pose that a fix tells, with what it and the plane are uncertain of."""
        T = self.laid.T_map_theirs
        c, s = math.cos(T.yaw), math.sin(T.yaw)
        east, north = self.plane.place(fix)
        x = T.x + c * east - s * north
        y = T.y + s * east + c * north
        # The lever errs alike as long as the robot drives straight on, and otherwise after a turn.
        shared = self.laid.shared(x, y, math.hypot(self.laid.sigma, self.lever), self.yaw_sigma)
        own = fix.sigma**2 * max(self.laid.rate_hz, 1.0) + self.lever**2
        C = np.diag([own, own, NO_HEADING]) + shared @ shared.T
        return PoseMeasurement(fix.stamp_ns, Pose2(x, y, 0.0), C, shared=shared, source=SOURCE)


def align(
    fixes: Sequence[Fix], stamp_ns: Sequence[int], way: Float, lever: float = 0.0
) -> tuple[Alignment | None, str]:
    """Find how the fixes' plane lies in the map.

    Args:
        fixes: In the order of time.
        stamp_ns: Of the odometry, ascending, shape (N,).
        way: Where it says the base was, in the frame of the map [m], shape (N, 2) or with more columns.
        lever: See Alignment.

    Returns:
        The alignment, or None and why there is none.
    """
    if not fixes:
        return None, "0 fixes are too few"
    plane = Plane(fixes[0].latitude, fixes[0].longitude)
    seen = np.array([plane.place(fix) for fix in fixes])
    at_ns = np.array([fix.stamp_ns for fix in fixes], dtype=np.int64)
    sigma = np.array([fix.sigma for fix in fixes])
    names = ("fixes", "the direction of north")
    laid, why = lay_over(at_ns, seen, sigma, stamp_ns, way[:, :2], shortest=SHORTEST, names=names)
    return (None if laid is None else Alignment(plane, laid, lever)), why
