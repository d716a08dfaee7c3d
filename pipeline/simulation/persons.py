"""Persons: those who stand sway a little, those who walk go to and fro between two places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.simulation.primitives import Solids
from pipeline.simulation.scene_objects import person
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Float

_STEP_HZ = 0.9
_STRIDE = 0.42


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """Somebody.

    Attributes:
        owner: Number of the thing in the scene.
        start, end: Where they go to and fro between, shape (2,) [m]; equal for one who stands.
        heading: Where one who stands looks [rad].
        speed: [m/s], 0 for one who stands.
        phase: Shift in time [s], so that no two move alike.
    """

    owner: int
    start: Float
    end: Float
    heading: float
    speed: float
    phase: float

    def place(self, t: float) -> tuple[Float, float]:
        """Position (2,) [m] and heading [rad] at time t [s]."""
        if self.speed == 0.0:
            sway = np.array([np.sin(0.9 * (t + self.phase)), np.cos(0.7 * (t - self.phase))])
            return self.start + 0.012 * sway, self.heading + 0.03 * float(sway[0])
        way = self.end - self.start
        length = float(np.hypot(*way))
        gone = (self.speed * (t + self.phase)) % (2.0 * length)
        back = gone > length
        position = self.start + way * ((2.0 * length - gone if back else gone) / length)
        return position, float(np.arctan2(way[1], way[0])) + (np.pi if back else 0.0)

    def solids(self, t: float, terrain: Terrain) -> Solids:
        """Their body in the world at time t [s]."""
        at, heading = self.place(t)
        ground = float(terrain.height(at[:1], at[1:])[0])
        stride = _STRIDE * np.sin(2.0 * np.pi * _STEP_HZ * (t + self.phase)) if self.speed > 0.0 else 0.0
        return person(self.owner, float(stride)).placed(np.array([at[0], at[1], ground]), heading)
