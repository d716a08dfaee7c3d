"""The scenario `sim:wild`: a stand with stems, ground, undergrowth, objects and sensors as they are outside.

Every figure is drawn from a distribution of `DISTRIBUTIONS` or `OBJECTS`. They describe forests and parks,
and do not depend on what the mapping can find.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar, cast_beams
from pipeline.simulation.primitives import STEM, Section
from pipeline.simulation.robot_motion import Course
from pipeline.simulation.scenarios import Scenario
from pipeline.simulation.scene import Plot, SimulatedScene
from pipeline.simulation.scene_objects import BREAST_HEIGHT, KINDS, SceneBuilder, add_hedge, unit_vector
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import HIDDEN, Float, TruthTrees


@dataclass(frozen=True, slots=True)
class Uniform:
    """A uniform distribution.

    Attributes:
        low, high: Bounds.
        unit: Unit, "" for a share or a count.
        reason: Reason of the bounds.
    """

    low: float
    high: float
    unit: str
    reason: str

    def draw(self, rng: np.random.Generator) -> float:
        """Return a value of the distribution; the generator advances."""
        return float(rng.uniform(self.low, self.high))


DISTRIBUTIONS = {
    "dbh": Uniform(0.10, 0.55, "m", "from pole wood to mature stems; inventories begin at 7 to 10 cm"),
    "taper": Uniform(0.005, 0.02, "m/m", "0.5 to 2 cm per metre on the plots of docs/trunks.md"),
    "root flare": Uniform(1.2, 1.6, "", "diameter at the ground by that at 0.6 m: buttresses of the roots"),
    "oval": Uniform(0.0, 0.07, "", "smallest by largest diameter 1 to 0.87: wind and slopes make stems oval"),
    "fluted": Uniform(0.0, 0.03, "", "lobes of roots and branches that reach breast height"),
    "bark": Uniform(0.03, 0.05, "1/m", "depth of furrows by DBH; limited by BARK"),
    "furrow spacing": Uniform(0.03, 0.06, "m", "distance of two ridges of oak, pine or robinia bark"),
    "lean": Uniform(0.0, 8.0, "degrees", "stems at slopes and edges; more is windthrow"),
    "height by dbh": Uniform(40.0, 80.0, "", "slenderness of trees, height by DBH"),
    "fork height": Uniform(1.8, 5.0, "m", "a fork below breast height would count as two trees"),
    "fork angle": Uniform(5.0, 14.0, "degrees", "half the angle between the two stems of a fork"),
    "crown base": Uniform(2.5, 7.0, "m", "suppressed branches die in a closed stand"),
    "crown free path": Uniform(0.6, 2.0, "m", "leaf area density 1 to 3 m2/m3, half of it across a beam"),
    "dead branch height": Uniform(0.5, 4.0, "m", "dead branches stay below the crown"),
    "dead branch length": Uniform(0.3, 1.5, "m", ""),
    "dead branch radius": Uniform(0.004, 0.015, "m", ""),
    "undergrowth height": Uniform(0.3, 0.6, "", "share of LOWER_STEM that undergrowth reaches"),
    "undergrowth free path": Uniform(0.25, 0.6, "m", "leaf area density 3 to 8 m2/m3 of fern and bramble"),
    "undergrowth half width": Uniform(0.2, 0.5, "m", "one plant"),
    "slope": Uniform(-0.12, 0.12, "", "up to 7 degrees, which a robot with wheels drives"),
    "waves": Uniform(0.1, 0.35, "m", "amplitude of the longest wave of the ground"),
    "shortest wave": Uniform(5.0, 9.0, "m", "pits and mounds of old windthrow"),
    "ditch depth": Uniform(0.15, 0.35, "m", "drainage ditches that a robot can cross"),
    "ditch width": Uniform(1.0, 1.6, "m", ""),
    "ditch spacing": Uniform(10.0, 16.0, "m", "parallel ditches of plantations"),
    "wind": Uniform(0.0, 0.15, "m", "swing of leaves 10 m above the ground, calm to a fresh breeze"),
}
BARK = (0.005, 0.02)  # m; smallest and largest depth of furrows
LOWER_STEM = 3.0  # m
FORKED, DUAL = 0.15, 0.3  # share of forked stems, of spinning sensors that report two echoes
# Numbers of dead branches and of plants at a stem, upper bound excluded.
DEAD_BRANCHES, PLANTS = (0, 9), (2, 6)
FREE_LANE = 0.3  # m; the robot drives where nothing grows
GAP, CLEAR = 0.6, 0.8  # m; least distance between two stems, and of a stem from the path


@dataclass(frozen=True, slots=True)
class Objects:
    """Objects of a kind of `scene_objects.KINDS`: their number (bounds), their kind in the ground truth, and
    whether they are at the edge of the plot."""

    count: tuple[int, int]
    kind: str
    at_edge: bool = False


OBJECTS = {
    "stump": Objects((2, 6), "other"),
    "log": Objects((1, 4), "other"),
    "shrub": Objects((3, 8), "bush"),
    "motorcycle": Objects((1, 3), "other", at_edge=True),
    "bench": Objects((1, 3), "other", at_edge=True),
    "post": Objects((1, 4), "pole", at_edge=True),
    "sign": Objects((1, 3), "pole", at_edge=True),
    "hedge": Objects((1, 3), "bush", at_edge=True),
}
EDGE, EDGE_REACH = 2.0, 9.5  # m; width of the edge, and greatest distance of an object from the path

# By data sheet; the rings of the VLP-32 are evenly spaced here.
SENSORS = (
    SpinningLidar(),
    SpinningLidar(rings=32, lowest=np.radians(-25.0), ring_step=np.radians(40.0 / 31), name="VLP-32"),
    SpinningLidar(1024, 64, lowest=np.radians(-22.5), ring_step=np.radians(45.0 / 63), name="OS1-64"),
    SolidStateLidar(),
)


def build_wild_scene(
    scenario: Scenario, course: Course, range_sigma: float, rng: np.random.Generator
) -> tuple[SpinningLidar, SimulatedScene]:
    """Return a random sensor of SENSORS, and the scene. A spinning sensor reports two echoes with the
    probability DUAL. In `owners`, an object other than a tree has the number of its last part.

    Args:
        scenario: Number of trees and size of the plot.
        course: Course of the robot.
        range_sigma: Standard deviation of a range [m].
        rng: Random generator.

    Raises:
        SourceError: There is no position left for an object.
    """
    lidar = replace(SENSORS[int(rng.integers(len(SENSORS)))], range_sigma=range_sigma)
    if isinstance(lidar, SolidStateLidar):
        lidar = replace(lidar, pattern=int(rng.integers(2**31)))
    elif rng.random() < DUAL:
        lidar = replace(lidar, dual=True)
    scene = SceneBuilder(_terrain(rng), rng)
    plot = Plot(course, scenario.half_side)
    dbh = sorted((_draw("dbh", rng) for _ in range(scenario.trees)), reverse=True)
    for each in dbh:
        add_wild_tree(scene, plot, *plot.find(0.5 * each, GAP, CLEAR, np.inf, rng, "tree"), each)
    for name, objects in OBJECTS.items():
        for _ in range(int(rng.integers(objects.count[0], objects.count[1] + 1))):
            edge = EDGE if objects.at_edge else np.inf
            x, y = plot.find(0.6, 0.3, CLEAR, EDGE_REACH, rng, name, edge)
            _add_object(scene, plot, name, x, y)
            scene.truth.append((x, y, np.nan, objects.kind))
            scene.owners.append(len(scene.kinds) - 1)
    return lidar, SimulatedScene(
        terrain=scene.terrain,
        still=scene.solids.build(),
        truth=scene.true_objects(),
        kinds=tuple(scene.kinds),
        owners=tuple(scene.owners),
        wind=_draw("wind", rng),
    )


def _draw(name: str, rng: np.random.Generator) -> float:
    """Return a value of the distribution `name` of DISTRIBUTIONS."""
    return DISTRIBUTIONS[name].draw(rng)


def _terrain(rng: np.random.Generator) -> SimulatedTerrain:
    """Return a random terrain with waves and ditches."""
    slope, waves, shortest = (_draw(name, rng) for name in ("slope", "waves", "shortest wave"))
    depth, width, spacing = (_draw(f"ditch {name}", rng) for name in ("depth", "width", "spacing"))
    terrain = SimulatedTerrain.grow(slope, waves, shortest, rng)
    return terrain.with_ditches(depth, width, spacing, float(rng.uniform(0.0, np.pi)), float(rng.random()))


def _add_object(scene: SceneBuilder, plot: Plot, name: str, x: float, y: float) -> None:
    """Add an object of a kind of KINDS, or a hedge of 2 to 8 m parallel to the nearest edge of the plot, at
    x, y [m] to the scene, not to the ground truth."""
    if name != "hedge":
        KINDS[name](scene, x, y)
        return
    # A hedge follows the edge of the plot.
    away = np.array([x, y]) - plot.centre
    along = np.array([0.0, 1.0]) if abs(away[0]) > abs(away[1]) else np.array([1.0, 0.0])
    half = 0.5 * scene.uniform(2.0, 8.0) * along
    add_hedge(scene, np.array([x, y]) - half, np.array([x, y]) + half)


def draw_section(dbh: float, rng: np.random.Generator) -> Section:
    """Return a random section of a stem with the diameter `dbh` at breast height [m]. The depth of the
    furrows is that at breast height, clipped to BARK."""
    return Section(
        oval=_draw("oval", rng),
        oval_phase=float(rng.uniform(0.0, np.pi)),
        fluted=_draw("fluted", rng),
        fluted_phase=float(rng.uniform(0.0, np.pi)),
        bark=float(np.clip(_draw("bark", rng) * dbh, *BARK)),
        furrows=max(round(np.pi * dbh / _draw("furrow spacing", rng)), 3),
        furrow_phase=float(rng.uniform(0.0, 2.0 * np.pi)),
    )


def add_wild_tree(scene: SceneBuilder, plot: Plot, x: float, y: float, dbh: float) -> None:
    """Add a tree with crown, dead branches and undergrowth to the scene, and the tree to the ground truth. At
    breast height, the axis of the stem is at x, y and a tape around the stem has the length pi dbh.

    Args:
        scene: The scene to which the tree is added; its random generator determines the shape.
        plot: The plot with the course of the robot, on which no undergrowth is added. The position is not
            marked as occupied in it.
        x, y: Position in the frame of the scene [m].
        dbh: Diameter at breast height [m].
    """
    rng = scene.rng
    owner = scene.true_object("tree", x, y, dbh)
    section = draw_section(dbh, rng)
    lean = np.tan(np.radians(_draw("lean", rng))) * _towards(rng)
    taper, ground = _draw("taper", rng), float(scene.foot(x, y)[2])
    shade = scene.uniform(0.25, 0.45)
    # A tape is perpendicular to the axis: its length does not depend on the lean.
    at_breast = 0.5 * dbh / section.perimeter_factor()
    slant = float(np.sqrt(1.0 + lean @ lean))

    def axis(height: float) -> Float:
        return np.array([*(np.array([x, y]) + lean * (height - BREAST_HEIGHT)), ground + height])

    def radius(height: float) -> float:
        return max(at_breast - 0.5 * taper * slant * (height - BREAST_HEIGHT), 0.02)

    def stem(start: float, end: float, radii: tuple[float, float]) -> None:
        part = replace(section, bark=section.bark * radii[0] / at_breast)
        scene.solids.stem(owner, axis(start), axis(end), radii, part, reflectivity=shade)

    top = min(dbh * _draw("height by dbh", rng), BREAST_HEIGHT + (at_breast - 0.02) / (0.5 * taper * slant))
    top = max(top, 4.0)
    forks = rng.random() < FORKED
    end = min(_draw("fork height", rng), 0.7 * top) if forks else top
    flare = _draw("root flare", rng)
    stem(-0.4, 0.6, (flare * radius(0.0), radius(0.6)))
    stem(0.6, end, (radius(0.6), radius(end)))
    if forks:
        part, apart = _towards(rng), np.tan(np.radians(_draw("fork angle", rng)))
        for side in (-1.0, 1.0):
            tip = axis(end) + (top - end) * np.array([*(lean + side * apart * part), 1.0])
            # Two stems carry the sap of one: their areas add up to that of the stem.
            radii = (radius(end) / np.sqrt(2.0), 0.02)
            scene.solids.stem(
                owner, axis(end), tip, radii, replace(section, bark=BARK[0]), reflectivity=shade
            )
    base = min(_draw("crown base", rng), 0.8 * top)
    for _ in range(int(rng.integers(*DEAD_BRANCHES))):
        height = min(_draw("dead branch height", rng), base, end)
        way = np.array([*_towards(rng), np.tan(rng.uniform(-0.3, 0.7))])
        length = radius(height) + _draw("dead branch length", rng)
        thick = _draw("dead branch radius", rng)
        scene.solids.cone(
            owner, axis(height), axis(height) + length * way, (thick, 0.003), reflectivity=shade
        )
    _add_crown(scene, axis(top), base, top, dbh)
    _add_undergrowth(scene, plot, x, y, radius(0.5))


def _towards(rng: np.random.Generator) -> Float:
    """Return a random horizontal unit vector, shape (2,)."""
    return unit_vector(rng.uniform(0.0, 2.0 * np.pi))[:2]


def _add_crown(scene: SceneBuilder, tip: Float, base: float, top: float, dbh: float) -> None:
    """Add three porous ellipsoids below the tip of a stem, kind "foliage".

    Args:
        scene: The scene to which the ellipsoids are added.
        tip: Upper end of the stem, shape (3,) [m].
        base, top: Height of the lower end of the crown and of the stem above the ground [m].
        dbh: Diameter of the stem, which scales the width [m].
    """
    rng, owner = scene.rng, scene.owner("foliage")
    free_path, width = _draw("crown free path", rng), float(np.clip(0.9 + 3.0 * dbh, 1.0, 2.4))
    depth = top + 0.8 - base
    for n in range(3):
        half = np.array([width, width, depth / 5.0]) * rng.uniform(0.75, 1.1, 3)
        up = base - top + max(depth * (n + 0.5) / 3.0, half[2])
        centre = tip + np.array([*(0.2 * width * rng.standard_normal(2)), up])
        scene.solids.ellipsoid(owner, centre, half, free_path=free_path, reflectivity=0.5)


def _add_undergrowth(scene: SceneBuilder, plot: Plot, x: float, y: float, radius: float) -> None:
    """Add two to five plants around the foot of a stem, except where the robot drives. They are not in the
    ground truth.

    Args:
        scene: The scene to which the plants are added.
        plot: The plot with the course of the robot.
        x, y: Middle of the stem [m].
        radius: Radius of the stem [m].
    """
    rng, owner = scene.rng, scene.owner("undergrowth")
    high, free_path = LOWER_STEM * _draw("undergrowth height", rng), _draw("undergrowth free path", rng)
    for _ in range(int(rng.integers(*PLANTS))):
        half = np.array([*(_draw("undergrowth half width", rng) for _ in range(2)), 0.5 * high])
        place = np.array([x, y]) + (radius + 0.7 * half[:2].max()) * _towards(rng)
        if plot.from_course(place[None])[0] > half[:2].max() + FREE_LANE:
            centre = scene.foot(float(place[0]), float(place[1])) + np.array([0.0, 0.0, half[2]])
            yaw = scene.uniform(0.0, np.pi)
            scene.solids.ellipsoid(owner, centre, half, yaw=yaw, free_path=free_path, reflectivity=0.4)


#: As many returns make a trunk of labelled scans count (`python -m tests.benchmarks holdout`).
LEAST_BEAMS = 30


def truth_in_view(
    lidar: SpinningLidar, scene: SimulatedScene, poses: Iterable[tuple[Float, Float, Float]]
) -> TruthTrees:
    """Return the ground truth of a scene. A tree is HIDDEN if fewer than LEAST_BEAMS beams of all given scans
    meet its stem up to LOWER_STEM above the ground; leaves and stems before it stop beams. Persons and wind
    are ignored. If there are no scans, all trees are HIDDEN.

    Args:
        lidar, scene: The sensor and the scene.
        poses: Times, rotations and positions of the sensor in some scans, see `SimulatedRun.sensor_poses`;
            read once. The pattern of a solid-state sensor is that of the number of the scan in this row.
    """
    solids, met = scene.still, np.zeros(len(scene.kinds), np.int64)
    for k, (_, R, o) in enumerate(poses):
        now = lidar.at_scan(k)
        directions, ranges, hit = cast_beams(now, solids, scene.terrain, R, o, k)
        column, ring = np.nonzero((hit >= 0) & (ranges < lidar.range_max) & now.fired())
        solid = hit[column, ring]
        on_stem = solids.kind[solid] == STEM
        column, ring, solid = column[on_stem], ring[on_stem], solid[on_stem]
        point = o[column] + ranges[column, ring, None] * directions[column, ring]
        low = point[:, 2] - scene.terrain.height(point[:, 0], point[:, 1]) < LOWER_STEM
        met += np.bincount(solids.owner[solid[low]], minlength=len(met))
    truth = scene.truth
    beams = met[np.array(scene.owners)]
    kind = [HIDDEN if k == "tree" and n < LEAST_BEAMS else k for k, n in zip(truth.kind, beams, strict=True)]
    return replace(truth, kind=tuple(kind))
