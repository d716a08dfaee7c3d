"""How far the way is free, as people, programs and robots are told."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum


class Zone(IntEnum):
    """What a robot should do about what is on its way."""

    CLEAR = 0
    SLOW = 1
    STOP = 2
    UNKNOWN = 3

    @property
    def label(self) -> str:
        """The zone in one word."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Clearance:
    """What one scan shows of the way that the robot drives, an arc of constant curvature.

    Attributes:
        zone: UNKNOWN where nothing is seen in the way and the sensor does not look along it, or where it is
            not known how high what it sees stands: that is not free, it is not seen.
        ahead: Distance along the way from the robot's end to the nearest obstacle [m], 0 at the robot's
            side; infinite where the slow zone is free.
        beside: Least distance between the robot's sides and what stands beside the way [m], 0 for what
            stands in it; infinite where nothing is near.
        x, y: Where the nearest obstacle stands in the level base frame [m]; NaN where there is none.
        curvature: Of the way [1/m], positive to the left.
        backward: Whether the robot drives backwards.
        within: How far along the way was looked [m].
        begins: How far along the way from the base the robot ends and `ahead` begins [m].
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
