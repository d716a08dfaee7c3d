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

from pipeline.geometry import Float, Pose2
from pipeline.records import PoseMeasurement

#: The plane is found from this much of the way on, and from no more than that [m].
SHORTEST, LONGEST = 10.0, 100.0
FEWEST = 8
#: Of fixes that do not say how good they are [m]; and no receiver on a robot is better than the second.
UNKNOWN_SIGMA, BEST_SIGMA = 3.0, 0.05
#: Fixes that lie farther from the way than so many of their sigmas are of another way.
WORST = 4.0
#: Says nothing of the heading [rad^2].
NO_HEADING = 1e4


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
        T_map_plane: The rigid motion.
        centre: Middle of the way it was found from, in the map [m].
        sigma: Of its shift [m]; yaw_sigma: of its turn [rad].
        residual: RMS of the fixes from the way [m].
        length: Of the stretch of the way [m].
        rate_hz: Of the fixes: their errors change slowly, so all of a second count as one.
        lever: How far the antenna stands from the base [m]; counts as error.
    """

    plane: Plane
    T_map_plane: Pose2
    centre: Float
    sigma: float
    yaw_sigma: float
    residual: float
    length: float
    rate_hz: float
    lever: float

    @property
    def words(self) -> str:
        """For people."""
        return (
            f"fixes are used; laid over {self.length:.0f} m of the way they lie {self.residual:.2f} m from "
            f"it (RMS), north is known to {math.degrees(self.yaw_sigma):.1f} degrees"
        )

    def measured(self, fix: Fix) -> PoseMeasurement:
        """The pose that a fix tells, with what it and the plane are uncertain of."""
        c, s = math.cos(self.T_map_plane.yaw), math.sin(self.T_map_plane.yaw)
        east, north = self.plane.place(fix)
        x = self.T_map_plane.x + c * east - s * north
        y = self.T_map_plane.y + s * east + c * north
        dx, dy = x - self.centre[0], y - self.centre[1]
        across = np.array([-dy, dx]) * self.yaw_sigma
        C = np.zeros((3, 3))
        own = fix.sigma**2 * max(self.rate_hz, 1.0) + self.sigma**2 + self.lever**2
        C[:2, :2] = own * np.eye(2) + np.outer(across, across)
        C[2, 2] = NO_HEADING
        return PoseMeasurement(fix.stamp_ns, Pose2(x, y, 0.0), C)


def align(
    fixes: Sequence[Fix], stamp_ns: Sequence[int], way: Float, lever: float = 0.0
) -> tuple[Alignment | None, str]:
    """Find how the fixes' plane lies in the map.

    Args:
        fixes: In the order of time.
        stamp_ns: Of the odometry, ascending, shape (N,).
        way: Where it says the base was, in the frame of the map [m], shape (N, 2).
        lever: See Alignment.

    Returns:
        The alignment, or None and why there is none.
    """
    if len(fixes) < FEWEST or len(stamp_ns) < 2:
        return None, f"{len(fixes)} fixes are too few"
    plane = Plane(fixes[0].latitude, fixes[0].longitude)
    seen = np.array([plane.place(fix) for fix in fixes])
    at = np.array([fix.stamp_ns for fix in fixes], dtype=np.float64) - float(stamp_ns[0])
    times = np.asarray(stamp_ns, dtype=np.int64) - int(stamp_ns[0])
    there = np.stack([np.interp(at, times.astype(np.float64), way[:, axis]) for axis in (0, 1)], axis=1)
    inside = (at >= 0.0) & (at <= float(times[-1])) & np.isfinite(seen).all(axis=1)
    seen, there = seen[inside], there[inside]
    sigma = np.array([fix.sigma for fix in fixes])[inside]
    if len(seen) < FEWEST:
        return None, "fixes and odometry are not of the same time"
    length = float(np.hypot(*np.ptp(there, axis=0)))
    if length < max(SHORTEST, 3.0 * float(np.median(sigma))):
        return None, f"the robot drove {length:.0f} m, too little to tell the direction of north"
    w = 1.0 / np.square(sigma)
    w /= w.sum()
    middle_seen, middle = w @ seen, w @ there
    a, b = seen - middle_seen, there - middle
    yaw = math.atan2(float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(w @ (a * b).sum(axis=1)))
    c, s = math.cos(yaw), math.sin(yaw)
    turned = a @ np.array([[c, s], [-s, c]])
    residual = float(np.sqrt(w @ np.square(turned - b).sum(axis=1)))
    typical = float(np.median(sigma))
    if residual > WORST * max(typical, 0.02 * length):
        return None, f"they lie {residual:.1f} m from the way that the odometry tells"
    # Errors that change slowly do not average: the plane is known no better than by one fix in ten.
    known = max(typical, residual) / math.sqrt(max(len(seen) / 10.0, 1.0))
    spread = float(np.sqrt(w @ np.square(b).sum(axis=1)))
    shift = middle - np.array([[c, -s], [s, c]]) @ middle_seen
    span_s = (fixes[-1].stamp_ns - fixes[0].stamp_ns) * 1e-9
    rate = (len(fixes) - 1) / span_s if span_s > 0.0 else 1.0
    T_map_plane = Pose2(float(shift[0]), float(shift[1]), yaw)
    return Alignment(plane, T_map_plane, middle, known, known / spread, residual, length, rate, lever), ""
