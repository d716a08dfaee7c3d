"""A scene: the terrain and all that stands on it, built from a scenario and a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.simulation.persons import Person
from pipeline.simulation.planting import Plot
from pipeline.simulation.primitives import Solids, SolidsBuilder
from pipeline.simulation.scenarios import Placed, Scenario
from pipeline.simulation.scene_objects import (
    TreeShape,
    add_box,
    add_bush,
    add_pole,
    add_tree,
    add_undergrowth,
)
from pipeline.simulation.terrain import Terrain
from pipeline.simulation.trajectory import Course
from pipeline.types.records import Float, TruthTrees


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What the robot drives through.

    Attributes:
        terrain: The ground.
        still: All solids that never move.
        persons: Those that do, even a little.
        trees: The trees' shapes, in the order of `truth`.
        truth: Trees (x, y of the axis at 1.3 m above the tree's ground), poles, bushes, boxes
            ("other") and standing persons. Who walks is nowhere and so is not in it; neither is
            undergrowth, which is ground.
        kinds: Kind of each thing by its number (`Solids.owner`), among them "walker" and "undergrowth".
    """

    terrain: Terrain
    still: Solids
    persons: tuple[Person, ...]
    trees: tuple[TreeShape, ...]
    truth: TruthTrees
    kinds: tuple[str, ...]

    def person_solids(self, n: int, t: float) -> Solids:
        """The body of person n at time t [s]."""
        return self.persons[n].solids(t, self.terrain)

    def solids_at(self, times: Float, R: Float, o: Float) -> Solids:
        """What stands there, each person as they stand when the beam of a sweep passes them.

        Args:
            times: Of the sweep's columns, shape (C,) [s].
            R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        """
        solids = self.still
        middle = times.size // 2
        for n, person in enumerate(self.persons):
            at, _ = person.place(float(times[middle]))
            away = R[middle].T @ (np.array([at[0], at[1], o[middle, 2]]) - o[middle])
            turned = (np.pi - float(np.arctan2(away[1], away[0]))) / (2.0 * np.pi)
            column = min(int(turned * times.size), times.size - 1)
            solids = solids.join(self.person_solids(n, float(times[column])))
        return solids


def build_scene(scenario: Scenario, course: Course, rng: np.random.Generator) -> Scene:
    """Build the scene.

    Raises:
        SourceError: Not everything found a place.
    """
    slope = float(np.tan(np.radians(scenario.slope)))
    terrain = Terrain.grow(slope, scenario.waves[0], scenario.waves[1], rng)
    work = _Work(scenario, terrain, Plot(course, scenario.half_side), rng)
    for placed in _placed(scenario):
        work.put(placed)
    work.plant(scenario.trees - sum(placed.kind == "tree" for placed in _placed(scenario)))
    work.scatter()
    return work.scene()


def _placed(scenario: Scenario) -> list[Placed]:
    """The placed things, and no more trees than were asked for."""
    trees = [placed for placed in scenario.placed if placed.kind == "tree"][: scenario.trees]
    return trees + [placed for placed in scenario.placed if placed.kind != "tree"]


class _Work:
    """The scene while it is being built."""

    def __init__(self, scenario: Scenario, terrain: Terrain, plot: Plot, rng: np.random.Generator) -> None:
        self.scenario, self.terrain, self.plot, self.rng = scenario, terrain, plot, rng
        self.builder = SolidsBuilder()
        self.kinds: list[str] = []
        self.persons: list[Person] = []
        self.trees: list[TreeShape] = []
        self.truth: list[tuple[float, float, float, str]] = []

    def put(self, placed: Placed) -> None:
        """Set one thing where it is told to stand."""
        x, y, radius = placed.x, placed.y, 0.5 * placed.diameter
        self.plot.take(x, y, radius)
        if placed.kind == "tree":
            self._add_tree(x, y, placed.diameter)
        elif placed.kind == "pole":
            add_pole(self.builder, self._number("pole", x, y), x, y, radius, self._ground(x, y), self.rng)
        elif placed.kind == "bush":
            add_bush(self.builder, self._number("bush", x, y), x, y, radius, self._ground(x, y), self.rng)
        else:
            self._add_standing(x, y)

    def plant(self, count: int) -> None:
        """Trees at free places, the thick ones first."""
        low, high = self.scenario.dbh
        sizes = low + (high - low) * self.rng.beta(1.3, self.scenario.thin, max(count, 0))
        for dbh in np.sort(sizes)[::-1]:
            x, y = self.plot.find(0.5 * dbh, self.scenario.gap, 0.8, np.inf, self.rng, "tree")
            self._add_tree(x, y, float(dbh))

    def scatter(self) -> None:
        """All that is not a tree, near enough to the course to be seen."""
        plan, rng, find = self.scenario, self.rng, self.plot.find
        for _ in range(plan.boxes):
            x, y = find(0.9, 0.5, 1.2, 9.0, rng, "box")
            add_box(self.builder, self._number("other", x, y), x, y, self._ground(x, y), rng)
        for _ in range(plan.poles):
            radius = float(rng.uniform(0.03, 0.08))
            x, y = find(radius, 0.7, 1.0, 7.0, rng, "pole")
            add_pole(self.builder, self._number("pole", x, y), x, y, radius, self._ground(x, y), rng)
        for _ in range(plan.standing):
            self._add_standing(*find(0.35, 0.5, 1.2, 5.0, rng, "person"))
        for _ in range(plan.bushes):
            radius = float(rng.uniform(0.4, 0.8))
            x, y = find(radius, 0.2, 0.8, 9.0, rng, "bush")
            add_bush(self.builder, self._number("bush", x, y), x, y, radius, self._ground(x, y), rng)
        for _ in range(plan.walking):
            self._add_walker()
        for x, y, to_x, to_y, speed in plan.crossings:
            self.kinds.append("walker")
            ends = (np.array([x, y]), np.array([to_x, to_y]))
            self.persons.append(Person(len(self.kinds) - 1, *ends, 0.0, speed, 0.0))
        for _ in range(plan.undergrowth):
            place = self.plot.centre + self.plot.half_side * rng.uniform(-1.0, 1.0, 2)
            if self.plot.from_course(place[None])[0] > 1.0:
                x, y = float(place[0]), float(place[1])
                self.kinds.append("undergrowth")
                add_undergrowth(self.builder, len(self.kinds) - 1, x, y, self._ground(x, y), rng)

    def scene(self) -> Scene:
        """What was built."""
        x, y, dbh, kind = zip(*self.truth, strict=True) if self.truth else ((), (), (), ())
        return Scene(
            terrain=self.terrain,
            still=self.builder.build(),
            persons=tuple(self.persons),
            trees=tuple(self.trees),
            truth=TruthTrees(np.array(x), np.array(y), np.array(dbh), tuple(kind)),
            kinds=tuple(self.kinds),
        )

    def _number(self, kind: str, x: float, y: float, dbh: float = np.nan) -> int:
        self.kinds.append(kind)
        self.truth.append((x, y, dbh, kind))
        return len(self.kinds) - 1

    def _ground(self, x: float, y: float) -> float:
        return float(self.terrain.height(np.array([x]), np.array([y]))[0])

    def _add_tree(self, x: float, y: float, dbh: float) -> None:
        rng, plan = self.rng, self.scenario
        lean = np.clip(np.radians(plan.lean) * rng.standard_normal(2), -0.09, 0.09)
        low, high = plan.crown_base
        crown = float(rng.uniform(low, high) if dbh > 0.12 else rng.uniform(low, low + 1.0))
        top = max(float(4.0 + 28.0 * dbh * rng.uniform(0.85, 1.15)), crown + 1.5)
        branches = int(rng.integers(3, 9)) if rng.random() < plan.branchy else 0
        tree = TreeShape(x, y, dbh, (float(lean[0]), float(lean[1])), top, crown, branches)
        self.trees.append(tree)
        add_tree(self.builder, self._number("tree", x, y, dbh), tree, self._ground(x, y), rng)

    def _add_standing(self, x: float, y: float) -> None:
        at: Float = np.array([x, y])
        heading, phase = self.rng.uniform(0.0, 6.0, 2)
        self.persons.append(Person(self._number("person", x, y), at, at, float(heading), 0.0, float(phase)))

    def _add_walker(self) -> None:
        rng = self.rng
        middle = self.plot.centre
        for _ in range(2000):
            start = middle + self.plot.half_side * rng.uniform(-0.8, 0.8, 2)
            angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(5.0, 10.0)
            end = start + length * np.array([np.cos(angle), np.sin(angle)])
            line = start + np.linspace(0.0, 1.0, 25)[:, None] * (end - start)
            off = self.plot.from_course(line)
            if off.min() >= 1.0 and off.max() < 9.0 and self.plot.from_things(line).min() >= 0.4:
                self.kinds.append("walker")
                speed, phase = rng.uniform(0.8, 1.2), rng.uniform(0.0, 20.0)
                number = len(self.kinds) - 1
                self.persons.append(Person(number, start, end, 0.0, float(speed), float(phase)))
                return
        raise self.plot.full("person who walks")
