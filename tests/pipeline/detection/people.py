"""Persons in a simulated stand who walk, wait or stand still, each by a timetable."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.simulation.run import SimulatedRun, open_run
from pipeline.simulation.scenarios import EXACT, RunRequest, Scenario
from pipeline.simulation.scene import Person
from pipeline.simulation.scene_objects import person
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float

STRIDE, STEP_HZ = 0.42, 0.9
SECONDS = 70.0
LANE = Scenario(
    line="A way of 30 m between 40 trees",
    waypoints=tuple((float(x), 0.4 * float(np.sin(0.2 * x))) for x in range(0, 33, 2)),
    closed=False,
    speed=0.42,
    duration_s=SECONDS,
    half_side=17.0,
    trees=40,
    waves=(0.2, 9.0),
)

Place = tuple[float, float]
Leg = float | tuple[Place, float]  # seconds of standing still, or where to and how fast [m/s]


class Lane(RunRequest):
    """A drive along LANE."""

    @property
    def scenario(self) -> Scenario:
        """The lane, whatever the name."""
        return LANE


@dataclass(frozen=True, slots=True, eq=False)
class Somebody(Person):
    """Goes and stands by a timetable.

    Attributes:
        times: When they are where, shape (L,) [s]; places: shape (L, 2) [m].
    """

    times: Float
    places: Float

    def place(self, t: float) -> tuple[Float, float]:
        """Position (2,) [m] and heading [rad] at time t [s]."""
        leg = self._leg(t)
        way = self.places[leg + 1] - self.places[leg]
        part = (t - self.times[leg]) / (self.times[leg + 1] - self.times[leg])
        if way.any():
            return self.places[leg] + part * way, float(np.arctan2(way[1], way[0]))
        sway = np.array([np.sin(0.9 * (t + self.phase)), np.cos(0.7 * (t - self.phase))])
        return self.places[leg] + 0.012 * sway, self.heading

    def solids(self, t: float, terrain: SimulatedTerrain):
        """Their body in the world at time t [s]."""
        at, heading = self.place(t)
        leg = self._leg(t)
        walks = (self.places[leg + 1] != self.places[leg]).any()
        stride = STRIDE * np.sin(2.0 * np.pi * STEP_HZ * (t + self.phase)) if walks else 0.0
        ground = float(terrain.height(at[:1], at[1:])[0])
        return person(self.owner, float(stride)).placed(np.array([at[0], at[1], ground]), heading)

    def _leg(self, t: float) -> int:
        return int(np.clip(np.searchsorted(self.times, t, "right") - 1, 0, len(self.times) - 2))


def somebody(owner: int, start: Place, legs: list[Leg], rng: np.random.Generator) -> Somebody:
    """Begins at a place, goes on by these legs, and stays where they end."""
    times, places = [0.0], [start]
    for leg in [*legs, 1000.0]:
        place, seconds = (places[-1], leg) if isinstance(leg, float) else (leg[0], 0.0)
        if not isinstance(leg, float):
            seconds = float(np.hypot(*np.subtract(place, places[-1]))) / leg[1]
        times.append(times[-1] + seconds)
        places.append(place)
    heading, phase = rng.uniform(0.0, 6.0, 2)
    table = np.array(places)
    return Somebody(owner, table[0], table[0], float(heading), 0.0, float(phase), np.array(times), table)


def run_with(seed: int, kinds: tuple[str, ...]) -> SimulatedRun:
    """The lane of a seed with people of these kinds in it; poses are exact.

    Kinds: "still" stands beside the way, "by a trunk" 0.7 m from one; "along" walks beside the robot and
    "ahead" before it, both as fast as it drives; "across" goes to and fro over the way, and "pausing" stops
    for 5 to 15 s between places.
    """
    run = open_run(Lane("stand", seed, 0.02, EXACT, SECONDS, LANE.trees))
    rng = np.random.default_rng([seed, len(kinds)])
    trunks = np.stack([run.scene.truth.x, run.scene.truth.y], axis=1)

    def beside() -> Place:
        while True:
            x, y = float(rng.uniform(4.0, 26.0)), float(rng.choice([-1.0, 1.0]) * rng.uniform(1.2, 5.0))
            if np.hypot(*(trunks - [x, y]).T).min() > 0.8:
                return x, y

    def by_a_trunk() -> Place:
        thick = 0.5 * run.scene.truth.dbh
        while True:
            near, turn = int(rng.integers(len(trunks))), float(rng.uniform(0.0, 2.0 * np.pi))
            x, y = trunks[near] + (0.7 + thick[near]) * np.array([np.cos(turn), np.sin(turn)])
            if 4.0 < x < 26.0 and 1.2 < abs(y) < 5.0 and np.hypot(*(trunks - [x, y]).T).min() > 0.6:
                return float(x), float(y)

    def one(kind: str) -> tuple[Place, list[Leg]]:
        side, x = float(rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 2.5)), float(rng.uniform(5.0, 25.0))
        if kind == "along":
            return (1.0, side), [((30.0, side), LANE.speed)]
        if kind == "ahead":
            return (3.0, 0.1), [((33.0, 0.1), LANE.speed)]
        if kind == "across":
            return (x, -6.0), [((x, 6.0 if k % 2 == 0 else -6.0), 1.0) for k in range(6)]
        if kind == "by a trunk":
            return by_a_trunk(), []
        start, legs = beside(), list[Leg]()
        for _ in range(5 if kind == "pausing" else 0):
            legs += [float(rng.uniform(5.0, 15.0)), (beside(), 1.0)]
        return start, legs

    first = len(run.scene.kinds)
    people = tuple(somebody(first + n, *one(kind), rng) for n, kind in enumerate(kinds))
    scene = replace(run.scene, persons=people, kinds=run.scene.kinds + ("person",) * len(people))
    return replace(run, scene=scene)
