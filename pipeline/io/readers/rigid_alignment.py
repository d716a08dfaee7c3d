"""Positions in a frame of another source, laid over the way that the odometry tells: a rigid motion in the
plane, by least squares (Arun, Huang, Blostein 1987)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Int

FEWEST = 8
#: What lies farther from the way than so many of its sigmas is of another way.
WORST = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """How a frame lies in the frame of the map.

    Attributes:
        T_map_theirs: The rigid motion.
        centre: Middle of the way it was found from, in the map [m], shape (2,).
        sigma: Of its shift [m]; yaw_sigma: of its turn [rad].
        residual: RMS of the positions from the way [m].
        length: Of the stretch of the way [m].
        rate_hz: Of the positions: their errors change slowly, so all of a second count as one.
    """

    T_map_theirs: Pose2
    centre: Float
    sigma: float
    yaw_sigma: float
    residual: float
    length: float
    rate_hz: float

    def shared(self, x: float, y: float, sigma: float, yaw_sigma: float, turn_sigma: float = 0.0) -> Float:
        """What all positions err by alike, seen at a place in the map; see PoseMeasurement.

        Args:
            x, y: The place [m].
            sigma: Of the frame's shift [m]; yaw_sigma: of its turn about where it was found, and turn_sigma:
                of the headings [rad].
        """
        dx, dy = x - self.centre[0], y - self.centre[1]
        return np.array(
            [
                [sigma, 0.0, -dy * yaw_sigma, 0.0],
                [0.0, sigma, dx * yaw_sigma, 0.0],
                [0.0, 0.0, 0.0, turn_sigma],
            ]
        )


def interpolated(at_ns: Int, stamp_ns: Sequence[int], way: Float) -> Float:
    """The way at other times, column by column; its ends where they lie outside."""
    times = (np.asarray(stamp_ns, dtype=np.int64) - int(stamp_ns[0])).astype(np.float64)
    at = (at_ns - int(stamp_ns[0])).astype(np.float64)
    columns: Float = np.stack([np.interp(at, times, column) for column in way.T], axis=1)
    return columns


def lay_over(
    at_ns: Int,
    seen: Float,
    sigma: Float,
    stamp_ns: Sequence[int],
    way: Float,
    *,
    shortest: float,
    names: tuple[str, str],
) -> tuple[Laid | None, str]:
    """Find how their frame lies in the map.

    Args:
        at_ns: Times of the positions, ascending, shape (K,).
        seen: The positions in their frame [m], shape (K, 2); sigma: of each [m], shape (K,).
        stamp_ns: Of the odometry, ascending, shape (N,).
        way: Where it says the base was, in the frame of the map [m], shape (N, 2).
        shortest: A shorter stretch of the way tells nothing [m].
        names: For people: what the positions are, and what is not told by too short a way.

    Returns:
        How it lies, or None and why that is not known.
    """
    what, unknown = names
    if len(seen) < FEWEST or len(stamp_ns) < 2:
        return None, f"{len(seen)} {what} are too few"
    there = interpolated(at_ns, stamp_ns, way)
    inside = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1]) & np.isfinite(seen).all(axis=1)
    seen, there, sigma = seen[inside], there[inside], sigma[inside]
    if len(seen) < FEWEST:
        return None, f"{what} and odometry are not of the same time"
    length = float(np.hypot(*np.ptp(there, axis=0)))
    if length < max(shortest, 3.0 * float(np.median(sigma))):
        return None, f"the robot drove {length:.0f} m, too little to tell {unknown}"
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
    # Errors that change slowly do not average: the frame is known no better than by one in ten.
    known = max(typical, residual) / math.sqrt(max(len(seen) / 10.0, 1.0))
    spread = float(np.sqrt(w @ np.square(b).sum(axis=1)))
    shift = middle - np.array([[c, -s], [s, c]]) @ middle_seen
    span_s = int(at_ns[-1] - at_ns[0]) * 1e-9
    rate = (len(at_ns) - 1) / span_s if span_s > 0.0 else 1.0
    T_map_theirs = Pose2(float(shift[0]), float(shift[1]), yaw)
    return Laid(T_map_theirs, middle, known, known / spread, residual, length, rate), ""
