"""Free distance on the path of the robot, for the page, programs and robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum


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
