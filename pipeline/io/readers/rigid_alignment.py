"""Rigid alignment of positions in another frame with the path by odometry: least squares in the plane (Arun,
Huang, Blostein 1987)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Int

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
        """Return the factor of the error shared by all positions, at a place in the map; see PoseMeasurement.

        Args:
            x, y: The place [m].
            sigma: Standard deviation of the shift of the frame [m].
            yaw_sigma: Standard deviation of its rotation about `centre` [rad].
            heading_sigma: Standard deviation of the difference of the headings [rad].

        Returns:
            L with covariance L L^T of (x, y, yaw), shape (3, 4).
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
    """Interpolate each column of a path at other times; its end values apply outside of its time span."""
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
