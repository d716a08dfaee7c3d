"""Scenes of forest scenarios: the terrain and all objects on it, built from a scenario and a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.errors import SourceError
from pipeline.simulation.primitives import ELLIPSOID, Solids
from pipeline.simulation.robot_motion import Course
from pipeline.simulation.scenarios import Placed, Scenario
from pipeline.simulation.scene_objects import (
    SceneBuilder,
    add_box,
    add_bush,
    add_pole,
    add_tree,
    add_undergrowth,
    person,
)
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float, TruthTrees

_STEP_HZ, _STRIDE = 0.9, 0.42  # of a walking person; [rad]
_SWAY_HZ = 0.4  # of branches in the wind; natural frequencies of trees are 0.1 to 1 Hz
# Positions are drawn in small batches while there is room, and in large ones when the plot becomes full.
_BATCHES = (8, 16, 32, 64, 128, *[256] * 36)


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """A person who stands and sways, or walks back and forth between two positions.

    Attributes:
        owner: Number of the object in the scene.
        start, end: Ends of the path, shape (2,) [m]; equal for a person who stands.
        heading: Heading of a person who stands [rad].
        speed: Speed [m/s], 0 for a person who stands.
        phase: Shift in time [s], so that no two persons move alike.
    """

    owner: int
    start: Float
    end: Float
    heading: float
    speed: float
    phase: float

    def place(self, t: float) -> tuple[Float, float]:
        """Return the position, shape (2,) [m], and the heading [rad, not wrapped] at time t since the start
        of the run [s]. A person who stands sways by about a centimetre; one who walks faces the end to which
        they walk."""
        if self.speed == 0.0:
            sway = np.array([np.sin(0.9 * (t + self.phase)), np.cos(0.7 * (t - self.phase))])
            return self.start + 0.012 * sway, self.heading + 0.03 * float(sway[0])
        way = self.end - self.start
        length = float(np.hypot(*way))
        gone = (self.speed * (t + self.phase)) % (2.0 * length)
        back = gone > length
        position = self.start + way * ((2.0 * length - gone if back else gone) / length)
        return position, float(np.arctan2(way[1], way[0])) + (np.pi if back else 0.0)

    def solids(self, t: float, terrain: SimulatedTerrain) -> Solids:
        """Return the body in the world, on the ground, at time t since the start of the run [s]."""
        at, heading = self.place(t)
        ground = float(terrain.height(at[:1], at[1:])[0])
        stride = _STRIDE * np.sin(2.0 * np.pi * _STEP_HZ * (t + self.phase)) if self.speed > 0.0 else 0.0
        return person(self.owner, float(stride)).placed(np.array([at[0], at[1], ground]), heading)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedScene:
    """A simulated scene.

    Attributes:
        terrain: The ground.
        still: All solids that do not move.
        persons: All persons; even those who stand sway.
        truth: Trees (x, y of the axis at 1.3 m above the ground), poles, bushes, boxes ("other") and
            standing persons. Walking persons have no position, and undergrowth counts as ground.
        kinds: Kind of each object; the index is the number of the object (`Solids.owner`). They include
            "walker" and "undergrowth".
        owners: Number of each object of the ground truth.
        wind: Amplitude of the motion of leaves 10 m above the ground by the wind [m].
    """

    terrain: SimulatedTerrain
    still: Solids
    truth: TruthTrees
    kinds: tuple[str, ...] = ()
    persons: tuple[Person, ...] = ()
    owners: tuple[int, ...] = ()
    wind: float = 0.0

    def solids_at(self, times: Float, R: Float, o: Float) -> Solids:
        """Return all solids, each person at the time when the beam of a sweep passes them, leaves at the
        middle of the sweep. Without persons and wind it is `still` itself.

        Args:
            times: Times of the columns of the sweep, shape (C,) [s].
            R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        """
        middle = times.size // 2
        solids = self.still if self.wind == 0.0 else self._blown(float(times[middle]))
        for each in self.persons:
            at, _ = each.place(float(times[middle]))
            away = R[middle].T @ (np.array([at[0], at[1], o[middle, 2]]) - o[middle])
            turned = (np.pi - float(np.arctan2(away[1], away[0]))) / (2.0 * np.pi)
            column = min(int(turned * times.size), times.size - 1)
            solids = solids.join(each.solids(float(times[column]), self.terrain))
        return solids

    def _blown(self, t: float) -> Solids:
        """Return the solids at time t [s] with the leaves (porous ellipsoids) moved along x by the wind: each
        oscillates with a phase of its own and the amplitude `wind` times its height above the ground / 10 m.
        `still` is not changed."""
        solids = self.still
        leaves = np.flatnonzero((solids.kind == ELLIPSOID) & (solids.shape[:, 8] > 0.0))
        x, y, z = solids.shape[leaves, :3].T
        height = np.maximum(z - self.terrain.height(x, y), 0.0)
        turns = _SWAY_HZ * t + 0.618 * np.arange(len(leaves))
        shift = self.wind * height / 10.0 * np.sin(2.0 * np.pi * turns)
        shape, capsule = solids.shape.copy(), solids.capsule.copy()
        shape[leaves, 0] += shift
        capsule[leaves, 0] += shift
        capsule[leaves, 3] += shift
        return solids._replace(shape=shape, capsule=capsule)


class Plot:
    """A square plot with a course through it; finds free positions for objects.

    Args:
        course: Course of the robot.
        half_side: Half the side of the plot around the middle of the course [m].
    """

    def __init__(self, course: Course, half_side: float) -> None:
        line = np.stack([course.x, course.y], axis=1)[::5]
        self.centre = 0.5 * (line.min(axis=0) + line.max(axis=0))
        self.half_side = half_side
        self._line = cKDTree(line)
        self._taken = np.empty((0, 3))

    def from_course(self, places: Float) -> Float:
        """Return the distances of positions, shape (N, 2) [m], from the line of the course, shape (N,)
        [m]."""
        distance: Float = self._line.query(places)[0]
        return distance

    def from_objects(self, places: Float) -> Float:
        """Return the distances of positions, shape (N, 2) [m], from the nearest surface of an object, shape
        (N,) [m]; negative inside of an object, infinite if there are no objects."""
        if self._taken.shape[0] == 0:
            return np.full(places.shape[0], np.inf)
        away = np.hypot(places[:, :1] - self._taken[:, 0], places[:, 1:] - self._taken[:, 1])
        free: Float = (away - self._taken[:, 2]).min(axis=1)
        return free

    def take(self, x: float, y: float, radius: float) -> None:
        """Mark a disc around x, y with a radius [m] as occupied; it may overlap others."""
        self._taken = np.vstack([self._taken, [x, y, radius]])

    def find(
        self,
        radius: float,
        gap: float,
        near: float,
        far: float,
        rng: np.random.Generator,
        what: str,
        edge: float = np.inf,
    ) -> tuple[float, float]:
        """Find a free position and mark it as occupied. At most about 9,500 random positions are tried.

        Args:
            radius: Radius of the object [m].
            gap: Minimum distance between the surfaces of the object and of its neighbours [m].
            near, far: Minimum and maximum distance of the surface of the object from the course [m].
            rng: Random generator of the positions.
            what: Name of the object, for the error.
            edge: Maximum distance of the position from the edge of the plot [m].

        Returns:
            x, y [m].

        Raises:
            SourceError: No free position was found.
        """
        for count in _BATCHES:
            places = self.centre + self.half_side * rng.uniform(-1.0, 1.0, (count, 2))
            off = self.from_course(places) - radius
            good = (off >= near) & (off <= far)
            good &= np.abs(places - self.centre).max(axis=1) >= self.half_side - edge
            good[good] = self.from_objects(places[good]) - radius >= gap
            if good.any():
                x, y = (float(value) for value in places[int(np.argmax(good))])
                self.take(x, y, radius)
                return x, y
        raise self.full(what)

    @staticmethod
    def full(what: str) -> SourceError:
        """Return (not raise) the error for an object that does not fit; `what` is its name."""
        return SourceError(
            f"no place is left for another {what} in the simulated stand",
            remedy="Ask for fewer trees with trees=N",
        )


def build_scene(scenario: Scenario, course: Course, rng: np.random.Generator) -> SimulatedScene:
    """Build the scene of a scenario: terrain, placed objects, then random trees and other objects beside the
    course.

    Args:
        scenario: Numbers and sizes of the objects. The number of trees includes the placed ones; placed trees
            beyond this number are left out.
        course: Course of the robot, which stays free of random objects.
        rng: Random generator.

    Raises:
        SourceError: There is no position left for an object.
    """
    slope = float(np.tan(np.radians(scenario.slope)))
    terrain = SimulatedTerrain.grow(slope, scenario.waves[0], scenario.waves[1], rng)
    planter = _Planter(scenario, SceneBuilder(terrain, rng), Plot(course, scenario.half_side))
    trees = [placed for placed in scenario.placed if placed.kind == "tree"][: scenario.trees]
    for placed in [*trees, *(placed for placed in scenario.placed if placed.kind != "tree")]:
        planter.add_placed(placed)
    planter.add_trees(scenario.trees - len(trees))
    planter.add_others()
    return planter.built()


class _Planter:
    """Places the objects of a scenario."""

    def __init__(self, scenario: Scenario, scene: SceneBuilder, plot: Plot) -> None:
        self._scenario, self._scene, self._plot, self._rng = scenario, scene, plot, scene.rng
        self._persons: list[Person] = []

    def add_placed(self, placed: Placed) -> None:
        """Add an object at its given position, even if this is occupied, and mark the position as occupied. A
        kind other than "tree", "pole" and "bush" gives a standing person."""
        x, y, radius = placed.x, placed.y, 0.5 * placed.diameter
        self._plot.take(x, y, radius)
        if placed.kind == "tree":
            self._add_tree(x, y, placed.diameter)
        elif placed.kind == "pole":
            add_pole(self._scene, x, y, radius)
        elif placed.kind == "bush":
            add_bush(self._scene, x, y, radius)
        else:
            self._add_standing(x, y)

    def add_trees(self, count: int) -> None:
        """Add trees at free positions, the thick ones first; none for a negative count. SourceError if the
        plot is full."""
        low, high = self._scenario.dbh
        sizes = low + (high - low) * self._rng.beta(1.3, self._scenario.thin, max(count, 0))
        for dbh in np.sort(sizes)[::-1]:
            x, y = self._plot.find(0.5 * dbh, self._scenario.gap, 0.8, np.inf, self._rng, "tree")
            self._add_tree(x, y, float(dbh))

    def add_others(self) -> None:
        """Add the objects that are not trees, near enough to the course to be seen. Persons who walk and
        undergrowth are not in the ground truth. Undergrowth is left out on the course, and may be at occupied
        positions. SourceError if the plot is full."""
        scenario, scene, rng, find = self._scenario, self._scene, self._rng, self._plot.find
        for _ in range(scenario.boxes):
            add_box(scene, *find(0.9, 0.5, 1.2, 9.0, rng, "box"))
        for _ in range(scenario.poles):
            radius = scene.uniform(0.03, 0.08)
            add_pole(scene, *find(radius, 0.7, 1.0, 7.0, rng, "pole"), radius)
        for _ in range(scenario.standing):
            self._add_standing(*find(0.35, 0.5, 1.2, 5.0, rng, "person"))
        for _ in range(scenario.bushes):
            radius = scene.uniform(0.4, 0.8)
            add_bush(scene, *find(radius, 0.2, 0.8, 9.0, rng, "bush"), radius)
        for _ in range(scenario.walking):
            self._add_walker()
        for x, y, to_x, to_y, speed in scenario.crossings:
            ends = (np.array([x, y]), np.array([to_x, to_y]))
            self._persons.append(Person(scene.owner("walker"), *ends, 0.0, speed, 0.0))
        for _ in range(scenario.undergrowth):
            place = self._plot.centre + self._plot.half_side * rng.uniform(-1.0, 1.0, 2)
            if self._plot.from_course(place[None])[0] > 1.0:
                add_undergrowth(scene, float(place[0]), float(place[1]))

    def built(self) -> SimulatedScene:
        """Return the scene with all objects so far."""
        return SimulatedScene(
            terrain=self._scene.terrain,
            still=self._scene.solids.build(),
            persons=tuple(self._persons),
            truth=self._scene.true_objects(),
            kinds=tuple(self._scene.kinds),
            owners=tuple(self._scene.owners),
        )

    def _add_tree(self, x: float, y: float, dbh: float) -> None:
        """Add a tree of a DBH [m] at x, y [m] with random height, lean, crown and branches."""
        rng, scenario = self._rng, self._scenario
        lean = np.clip(np.radians(scenario.lean) * rng.standard_normal(2), -0.09, 0.09)
        low, high = scenario.crown_base
        crown = float(rng.uniform(low, high) if dbh > 0.12 else rng.uniform(low, low + 1.0))
        top = max(float(4.0 + 28.0 * dbh * rng.uniform(0.85, 1.15)), crown + 1.5)
        branches = int(rng.integers(3, 9)) if rng.random() < scenario.branchy else 0
        add_tree(self._scene, x, y, dbh, (float(lean[0]), float(lean[1])), top, crown, branches)

    def _add_standing(self, x: float, y: float) -> None:
        """Add a person who stands at x, y [m], to scene and ground truth."""
        at: Float = np.array([x, y])
        heading, phase = self._rng.uniform(0.0, 6.0, 2)
        owner = self._scene.true_object("person", x, y)
        self._persons.append(Person(owner, at, at, float(heading), 0.0, float(phase)))

    def _add_walker(self) -> None:
        """Add a person who walks back and forth on a free line near the course; not to the ground truth. The
        line is not marked as occupied. SourceError if 2,000 random lines are not free."""
        rng, plot = self._rng, self._plot
        for _ in range(2000):
            start = plot.centre + plot.half_side * rng.uniform(-0.8, 0.8, 2)
            angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(5.0, 10.0)
            end = start + length * np.array([np.cos(angle), np.sin(angle)])
            line = start + np.linspace(0.0, 1.0, 25)[:, None] * (end - start)
            off = plot.from_course(line)
            if off.min() >= 1.0 and off.max() < 9.0 and plot.from_objects(line).min() >= 0.4:
                speed, phase = rng.uniform(0.8, 1.2), rng.uniform(0.0, 20.0)
                owner = self._scene.owner("walker")
                self._persons.append(Person(owner, start, end, 0.0, float(speed), float(phase)))
                return
        raise plot.full("person who walks")
