"""Objects of simulated scenes, each built of solids: trees, poles, bushes, persons, street furniture.

Every function `add_*` adds one object at x, y [m] on the terrain of a `SceneBuilder` and draws its shape from
the random generator of the builder. `KINDS` declares the objects that a layout places by name, with the
distributions of their sizes. These distributions are wide on purpose: a classifier should learn what an
object is, not how large it is in one town.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pipeline.simulation.primitives import Solids, SolidsBuilder
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float, TruthTrees

BREAST_HEIGHT = 1.3  # m
TAPER = 0.01  # decrease of the diameter per metre of height
_FOOT = 0.4  # m; trunks begin below the ground, so that no gap is visible on a slope


class SceneBuilder:
    """Collects the objects of a scene.

    Args:
        terrain: The ground on which objects are placed.
        rng: Draws their shapes.

    Attributes:
        solids: Solids of all objects so far.
        kinds: Kind of each object or part of an object by its number (`Solids.owner`).
        truth: x, y [m], DBH [m] (NaN if not a tree) and kind of the objects of the ground truth.
        owners: Numbers of the objects of the ground truth.
    """

    def __init__(self, terrain: SimulatedTerrain, rng: np.random.Generator) -> None:
        self.terrain, self.rng = terrain, rng
        self.solids = SolidsBuilder()
        self.kinds: list[str] = []
        self.truth: list[tuple[float, float, float, str]] = []
        self.owners: list[int] = []

    def owner(self, kind: str) -> int:
        """Add an object or a part of one to `kinds` and return its number; it is not added to the ground
        truth."""
        self.kinds.append(kind)
        return len(self.kinds) - 1

    def true_object(self, kind: str, x: float, y: float, dbh: float = np.nan) -> int:
        """Add an object to the ground truth and return its number, the owner of its shapes.

        Args:
            kind: Kind of the object.
            x, y: Position [m].
            dbh: Diameter [m], NaN for objects without one.
        """
        self.truth.append((x, y, dbh, kind))
        self.owners.append(self.owner(kind))
        return self.owners[-1]

    def true_objects(self) -> TruthTrees:
        """Return the ground truth so far; without objects, empty columns."""
        x, y, dbh, kind = zip(*self.truth, strict=True) if self.truth else ((), (), (), ())
        return TruthTrees(np.array(x), np.array(y), np.array(dbh), tuple(kind))

    def foot(self, x: float, y: float) -> Float:
        """Return the point on the ground at x, y [m], shape (3,)."""
        return np.array([x, y, self.terrain.height(np.array([x]), np.array([y]))[0]])

    def uniform(self, low: float, high: float) -> float:
        """Draw a number from a uniform distribution between `low` and `high`; the generator advances."""
        return float(self.rng.uniform(low, high))


def _up(height: float) -> Float:
    """Return the vector of a height along z, shape (3,) [m]."""
    return np.array([0.0, 0.0, height])


def _ahead(angle: float, rise: float = 0.0) -> Float:
    """Return the vector of length 1 in the plane at an angle from x [rad] with the vertical component `rise`,
    shape (3,)."""
    return np.array([np.cos(angle), np.sin(angle), rise])


# --- forest ----------------------------------------------------------------------------------------


def add_tree(
    scene: SceneBuilder,
    x: float,
    y: float,
    dbh: float,
    lean: tuple[float, float],
    top: float,
    crown_base: float,
    branches: int,
) -> None:
    """Add a tapered, leaning trunk with rough bark, branches and a crown, to scene and ground truth.

    Args:
        scene: The scene.
        x, y: Position of the axis at breast height [m].
        dbh: Diameter at 1.3 m [m].
        lean: Shift of the axis per metre of height along x and y.
        top: Height of the tree above the ground [m].
        crown_base: Lower end of the foliage [m]; a tree with a crown base at or above `top` has none.
        branches: Number of branches below the crown.
    """
    rng, owner = scene.rng, scene.true_object("tree", x, y, dbh)
    ground = float(scene.foot(x, y)[2])

    def axis(height: float) -> Float:
        up = height - BREAST_HEIGHT
        return np.array([x + lean[0] * up, y + lean[1] * up, ground + height])

    def radius(height: float) -> float:
        return max(0.5 * (dbh - TAPER * (height - BREAST_HEIGHT)), 0.015)

    end_of_trunk = min(top, BREAST_HEIGHT + (dbh - 0.04) / TAPER)
    bark = min(0.012 * dbh, 0.004)
    shade = rng.uniform(0.25, 0.45)
    radii = (radius(-_FOOT), radius(end_of_trunk))
    scene.solids.cone(owner, axis(-_FOOT), axis(end_of_trunk), radii, reflectivity=shade, roughness=bark)
    for _ in range(branches):
        height = rng.uniform(0.6, min(3.5, crown_base))
        direction, rise = rng.uniform(0.0, 2.0 * np.pi), np.tan(rng.uniform(-0.2, 0.7))
        length = rng.uniform(0.4, 1.3)
        thick = rng.uniform(0.006, 0.018)
        end = axis(height) + (length + radius(height)) * _ahead(direction, rise)
        scene.solids.cone(owner, axis(height), end, (thick, 0.003), reflectivity=shade)
    if crown_base >= top:
        return
    width = np.clip(0.9 + 3.0 * dbh, 1.0, 2.4)
    depth = top + 0.8 - crown_base
    for n in range(3):
        middle = crown_base + depth * (n + 0.5) / 3.0
        half = np.array([width, width, depth / 5.0]) * rng.uniform(0.75, 1.1, 3) * (1.0 - 0.18 * n)
        shift = 0.2 * width * rng.standard_normal(2)
        centre = [*(axis(middle)[:2] + shift), ground + max(middle, crown_base + half[2])]
        _foliage(scene, owner, centre, half, 1.2)


def add_pole(scene: SceneBuilder, x: float, y: float, radius: float) -> None:
    """Add a straight, upright pole of a radius [m], 1.8 to 4 m above the ground, at x, y [m] to scene and
    ground truth."""
    owner, foot = scene.true_object("pole", x, y), scene.foot(x, y)
    top = foot + _up(scene.uniform(1.8, 4.0))
    scene.solids.cone(owner, foot - _up(0.3), top, (radius, radius), reflectivity=0.6)


def add_bush(scene: SceneBuilder, x: float, y: float, radius: float) -> None:
    """Add two or three porous blobs near the ground, with thin stems in them, within `radius` of x, y [m], to
    scene and ground truth."""
    rng, owner, foot = scene.rng, scene.true_object("bush", x, y), scene.foot(x, y)
    for _ in range(int(rng.integers(2, 4))):
        half = radius * rng.uniform(0.6, 0.9, 3) * np.array([1.0, 1.0, 0.9])
        at = foot[:2] + (radius - half[:2].max()) * rng.uniform(-0.8, 0.8, 2)
        _foliage(scene, owner, [*at, foot[2] + 0.75 * half[2]], half, 0.22)
    for _ in range(4):
        lean = rng.uniform(-0.35, 0.35, 2) * radius
        scene.solids.cone(owner, foot - _up(0.05), foot + np.array([*lean, radius]), (0.012, 0.004))


def add_box(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a piece of wall or a crate at x, y [m], 0.8 to 2.4 m long and 0.8 to 1.6 m above the ground, to
    scene and ground truth."""
    half = np.array([scene.uniform(0.4, 1.2), scene.uniform(0.12, 0.4), scene.uniform(0.5, 0.9)])
    owner, centre = scene.true_object("other", x, y), scene.foot(x, y) + _up(half[2]) - _up(0.2)
    scene.solids.box(owner, centre, half, yaw=scene.uniform(0.0, np.pi))


def add_undergrowth(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a tuft of ferns or grass at x, y [m], up to half a metre high; not to the ground truth."""
    half = np.array([scene.uniform(0.2, 0.5), scene.uniform(0.2, 0.5), scene.uniform(0.15, 0.5)])
    centre = scene.foot(x, y) + _up(0.1 * half[2])
    _foliage(scene, scene.owner("undergrowth"), centre, half, 0.35, reflectivity=0.45)


def person(owner: int, stride: float = 0.0) -> Solids:
    """Return the shapes of a person of 1.74 m at the origin with the heading along x.

    Args:
        owner: Number of the object.
        stride: Swing of the legs and arms [rad], 0 when standing.
    """
    builder = SolidsBuilder()
    for side in (-1.0, 1.0):
        swing = side * np.sin(stride)
        hip: Float = np.array([0.0, 0.10 * side, 0.86])
        foot = hip + 0.86 * np.array([swing, 0.02 * side, -np.cos(stride)])
        builder.cone(owner, foot, hip, (0.055, 0.085), reflectivity=0.3)
        shoulder = np.array([0.0, 0.24 * side, 1.42])
        hand = shoulder + 0.62 * np.array([-0.7 * swing, 0.06 * side, -np.cos(stride)])
        builder.cone(owner, hand, shoulder, (0.035, 0.05), reflectivity=0.4)
    builder.ellipsoid(owner, [0.0, 0.0, 1.14], [0.13, 0.22, 0.38], reflectivity=0.45)
    builder.ellipsoid(owner, [0.0, 0.0, 1.62], [0.10, 0.08, 0.12], reflectivity=0.5)
    return builder.build()


# --- trees of streets and parks --------------------------------------------------------------------


def add_street_tree(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a trunk at x, y [m], to scene and ground truth (kind "trunk", without DBH), in most cases with a
    crown, in some with branches, more stems, ivy, shrubs or a stake."""
    rng = scene.rng
    radius = 0.5 * (scene.uniform(0.08, 0.2) if rng.random() < 0.35 else scene.uniform(0.15, 0.7))
    height = float(np.clip(5.0 + 30.0 * radius, 3.0, 12.0)) * scene.uniform(0.8, 1.2)
    lowest, highest = ((0.5, 1.5), (1.2, 3.0), (2.5, 5.0))[int(rng.integers(0, 3))]
    base = min(scene.uniform(lowest, highest), 0.75 * height)
    lean = np.tan(np.radians(rng.choice([1.5, 4.0, 9.0], p=[0.6, 0.3, 0.1]) * rng.standard_normal(2)))
    foot = scene.foot(x, y)
    start = foot - np.array([*(1.6 * lean), 0.3])
    end = foot + np.array([*((height - 1.3) * lean), height])
    owner = _trunk(scene, x, y, start, end, (1.1 * radius, 0.35 * radius))
    for _ in range(int(rng.integers(0, 6)) if rng.random() < 0.5 else 0):
        at = scene.uniform(0.8, base + 0.5)
        _leafy_branch(scene, owner, start + (end - start) * (at / height))
    if rng.random() < 0.93:
        _crown(scene, start + (end - start) * (base / height), height - base, scene.uniform(0.8, 3.5))
    if rng.random() < 0.12:
        _further_stems(scene, owner, foot, radius, 0.7 * height)
    if rng.random() < 0.12:
        _ivy(scene, start, end, radius)
    for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.35 else 0):
        side = scene.uniform(0.0, 0.9) * _ahead(scene.uniform(0.0, 2.0 * np.pi))
        add_shrub(scene, x + side[0], y + side[1], (0.2, 0.8), (0.3, 1.6))
    if rng.random() < 0.1:
        side = 0.45 * _ahead(scene.uniform(0.0, 2.0 * np.pi))
        add_post(scene, x + side[0], y + side[1], (0.04, 0.04), (1.2, 2.2))


def add_young_tree(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a thin tree of up to 7 m at x, y [m], whose upper end is in free air, like that of a pole, to scene
    and ground truth (kind "trunk", without DBH).

    Its crown is sparse, dense or narrow, or it only has branches; some have stakes or a second stem.
    """
    rng, solids = scene.rng, scene.solids
    form = str(rng.choice(["sparse", "dense", "narrow", "bare"]))
    height, radius = scene.uniform(2.2, 7.0), scene.uniform(0.02, 0.12)
    base = scene.uniform(0.2, 0.75) * height
    lean = np.tan(np.radians(3.0 * rng.standard_normal(2)))
    foot = scene.foot(x, y)
    start, end = foot - _up(0.3), foot + np.array([*(height * lean), 0.95 * height])
    owner = _trunk(scene, x, y, start, end, (1.1 * radius, 0.3 * radius))
    if rng.random() < 0.1:
        second = start + np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])
        top = end + np.array([*rng.uniform(-0.6, 0.6, 2), -0.2 * height])
        solids.cone(owner, second, top, (0.8 * radius, 0.2 * radius))
    for part in rng.uniform(base / height, 0.95, int(rng.integers(3, 16 if form == "bare" else 7))):
        at = start + (end - start) * part
        way = _ahead(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(0.2, 2.0))
        length = max(0.35 * (height - base) * scene.uniform(0.3, 1.0), 0.15)
        solids.cone(owner, at, at + length * way, (scene.uniform(0.006, 0.02), 0.003))
    if form != "bare":
        owner, depth = scene.owner("foliage"), height - base
        width = scene.uniform(0.2, 0.5) if form == "narrow" else scene.uniform(0.4, 1.0 + 0.2 * height)
        free_path = scene.uniform(0.8, 3.0) if form == "sparse" else scene.uniform(0.1, 0.8)
        for _ in range(int(rng.integers(1, 8))):
            half = np.array([width, width, 0.5 * depth]) * rng.uniform(0.4, 1.0, 3)
            up = base + scene.uniform(half[2], max(depth - half[2], half[2]))
            out = np.maximum(width - half[:2], 0.0) * rng.uniform(-1.0, 1.0, 2)
            _foliage(scene, owner, foot + np.array([*(up * lean + out), up]), half, free_path)
    if rng.random() < 0.3:
        first = scene.uniform(0.0, 2.0 * np.pi)
        for angle in first + np.arange(int(rng.integers(1, 4))) * 2.0 * np.pi / 3.0:
            side = scene.uniform(0.15, 0.5) * _ahead(angle)
            add_post(scene, x + side[0], y + side[1], (0.02, 0.05), (1.0, 2.4))


def add_shrub(
    scene: SceneBuilder,
    x: float,
    y: float,
    radius: tuple[float, float] = (0.3, 1.4),
    height: tuple[float, float] = (0.4, 3.2),
) -> None:
    """Add porous blobs and thin stems at x, y [m], kind "foliage", not to the ground truth.

    Args:
        scene: The scene.
        x, y: Position [m].
        radius, height: Bounds from which radius and height are drawn uniformly [m].
    """
    rng, owner, foot = scene.rng, scene.owner("foliage"), scene.foot(x, y)
    wide, tall, free_path = scene.uniform(*radius), scene.uniform(*height), scene.uniform(0.1, 0.45)
    for _ in range(int(rng.integers(2, 6))):
        half = np.array([wide, wide, 0.5 * tall]) * rng.uniform(0.4, 0.8, 3)
        shift = (wide - half[:2].max()) * rng.uniform(-1.0, 1.0, 2)
        up = scene.uniform(0.6 * half[2], max(tall - half[2], 0.7 * half[2]))
        _foliage(scene, owner, foot + np.array([*shift, up]), half, free_path, reflectivity=0.3)
    for _ in range(int(rng.integers(0, 7))):
        end = foot + np.array([*(0.6 * wide * rng.uniform(-1.0, 1.0, 2)), 0.8 * tall])
        scene.solids.cone(owner, foot - _up(0.1), end, (scene.uniform(0.01, 0.03), 0.005))


def add_crown(scene: SceneBuilder, x: float, y: float) -> None:
    """Add foliage above x, y [m] that hangs over from a tree out of view; not to the ground truth."""
    _crown(scene, scene.foot(x, y) + _up(scene.uniform(1.0, 3.5)), scene.uniform(2.0, 5.0), 2.0)


def _trunk(
    scene: SceneBuilder, x: float, y: float, start: Float, end: Float, radii: tuple[float, float]
) -> int:
    """Add a trunk to scene and ground truth (kind "trunk"); return its number.

    Args:
        scene: Receives it.
        x, y: Position in the ground truth [m].
        start, end: Ends of the axis, shape (3,) [m].
        radii: Radius at `start` and at `end` [m].
    """
    owner = scene.true_object("trunk", x, y)
    scene.solids.cone(owner, start, end, radii, roughness=0.018 * radii[0])
    return owner


def _foliage(
    scene: SceneBuilder,
    owner: int,
    centre: Float | list[float],
    half: Float,
    free_path: float,
    reflectivity: float = 0.5,
) -> None:
    """Add a porous ellipsoid with a random yaw.

    Args:
        scene: Receives it.
        owner: Number of its object.
        centre: Centre, shape (3,) [m].
        half: Half sizes, shape (3,) [m].
        free_path: Mean distance that a ray passes in it [m].
        reflectivity: Share of the light that is reflected.
    """
    yaw = scene.uniform(0.0, np.pi)
    scene.solids.ellipsoid(owner, centre, half, yaw=yaw, free_path=free_path, reflectivity=reflectivity)


def _crown(scene: SceneBuilder, base: Float, depth: float, width: float) -> None:
    """Add the foliage of a crown: 4 to 11 porous ellipsoids.

    Args:
        scene: Receives it.
        base: Middle of its lower end, shape (3,) [m].
        depth: Its height [m].
        width: About its radius [m].
    """
    rng, owner = scene.rng, scene.owner("foliage")
    free_path = float(rng.choice([rng.uniform(0.15, 0.5), rng.uniform(0.5, 1.5)]))
    for _ in range(int(rng.integers(4, 12))):
        half = np.array([width, width, 0.5 * depth]) * rng.uniform(0.25, 0.65, 3)
        out = max(width - half[:2].max(), 0.0) * rng.uniform(-1.0, 1.0, 2)
        up = scene.uniform(0.7 * half[2], max(depth - half[2], half[2]))
        _foliage(scene, owner, base + np.array([*out, up]), half, free_path)


def _further_stems(scene: SceneBuilder, owner: int, foot: Float, radius: float, height: float) -> None:
    """Add one to three more stems that part from a trunk at its foot.

    Args:
        scene: Receives them.
        owner: Number of the tree.
        foot: Foot of the trunk, shape (3,) [m].
        radius: Radius of the trunk [m].
        height: Their height [m].
    """
    for _ in range(int(scene.rng.integers(1, 4))):
        way = _ahead(scene.uniform(0.0, 2.0 * np.pi))
        lean = np.tan(np.radians(scene.uniform(3.0, 15.0)))
        start = foot + scene.uniform(0.0, 1.5) * radius * way - _up(0.3)
        thick = scene.uniform(0.5, 0.9) * radius
        end = start + height * (lean * way + _up(1.0))
        scene.solids.cone(owner, start, end, (thick, 0.35 * thick), roughness=0.02 * thick)


def _ivy(scene: SceneBuilder, start: Float, end: Float, radius: float) -> None:
    """Add leaves around the lower 20 to 60 % of a trunk.

    Args:
        scene: Receives them.
        start, end: Ends of the trunk, shape (3,) [m].
        radius: Its radius [m].
    """
    owner = scene.owner("foliage")
    thick, top = radius + scene.uniform(0.05, 0.2), scene.uniform(0.2, 0.6)
    for part in np.arange(0.05, top, 0.08):
        half = np.array([thick, thick, 0.45]) * scene.rng.uniform(0.8, 1.2, 3)
        _foliage(
            scene, owner, start + part * (end - start), half, scene.uniform(0.05, 0.25), reflectivity=0.3
        )


def _leafy_branch(scene: SceneBuilder, owner: int, start: Float) -> None:
    """Add a branch that begins at `start`, shape (3,) [m], to the object `owner`; half of the branches have
    leaves."""
    rng = scene.rng
    way = scene.uniform(0.4, 1.5) * _ahead(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(-0.1, 1.0))
    scene.solids.cone(owner, start, start + way, (scene.uniform(0.01, 0.03), 0.004))
    if rng.random() < 0.5:
        half = rng.uniform(0.1, 0.35, 3)
        _foliage(scene, scene.owner("foliage"), start + way, half, 0.3, reflectivity=0.3)


# --- street furniture ------------------------------------------------------------------------------


def add_post(
    scene: SceneBuilder, x: float, y: float, radius: tuple[float, float], height: tuple[float, float]
) -> None:
    """Add a bare, nearly upright post at x, y [m], kind "pole", not to the ground truth.

    Args:
        scene: The scene.
        x, y: Position [m].
        radius, height: Bounds from which radius and height are drawn uniformly [m].
    """
    _post(scene, scene.owner("pole"), x, y, scene.uniform(*radius), scene.uniform(*height))


def add_lamp(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a lamp post of 3 to 9 m at x, y [m] with an arm, often with a thicker base; kind "pole", not to the
    ground truth."""
    owner = scene.owner("pole")
    radius, height = scene.uniform(0.04, 0.12), scene.uniform(3.0, 9.0)
    _post(scene, owner, x, y, radius, height)
    if scene.rng.random() < 0.6:
        _post(scene, owner, x, y, 1.5 * radius, scene.uniform(0.3, 1.4))
    top = scene.foot(x, y) + _up(height)
    end = top + scene.uniform(0.3, 2.0) * _ahead(scene.uniform(0.0, 2.0 * np.pi), 0.1)
    scene.solids.cone(owner, top, end, (0.04, 0.04), reflectivity=0.6)
    scene.solids.ellipsoid(owner, end, scene.rng.uniform(0.1, 0.3, 3), reflectivity=0.6)


def add_sign(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a thin post at x, y [m] with one to three plates or boxes, kinds "pole" and "sign"; not to the
    ground truth."""
    owner, plate = scene.owner("pole"), scene.owner("sign")
    height, yaw = scene.uniform(1.2, 4.0), scene.uniform(0.0, np.pi)
    _post(scene, owner, x, y, scene.uniform(0.02, 0.06), height)
    top = height
    for _ in range(int(scene.rng.integers(1, 4))):
        half = np.array([scene.uniform(0.1, 0.6), scene.uniform(0.01, 0.12), scene.uniform(0.1, 0.5)])
        centre = scene.foot(x, y) + _up(max(top - half[2], 0.4 + half[2]))
        scene.solids.box(plate, centre, half, yaw=yaw, reflectivity=0.8)
        top -= 2.0 * half[2] + scene.uniform(0.0, 0.5)


def add_car(scene: SceneBuilder, x: float, y: float, yaw: float) -> None:
    """Add a parked car or van at x, y [m] with a yaw [rad], kind "vehicle"; not to the ground truth."""
    owner, foot = scene.owner("vehicle"), scene.foot(x, y)
    length, is_van = scene.uniform(1.8, 2.6), scene.rng.random() < 0.25
    top = scene.uniform(1.8, 2.4) if is_van else scene.uniform(0.85, 1.05)
    scene.solids.box(owner, foot + _up(0.5 * (top + 0.3)), [length, 0.88, 0.5 * (top - 0.3)], yaw=yaw)
    if not is_van:
        scene.solids.box(owner, foot + _up(top + 0.28), [0.55 * length, 0.75, 0.28], yaw=yaw)
    for ahead in (-0.62 * length, 0.62 * length):
        for side in (-0.85, 0.85):
            wheel = foot + ahead * _ahead(yaw) + side * _ahead(yaw + 0.5 * np.pi) + _up(0.3)
            scene.solids.ellipsoid(owner, wheel, [0.31, 0.1, 0.31], yaw=yaw)


def add_motorcycle(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a motorcycle or a bicycle on its stand at x, y [m], kind "vehicle"; not to the ground truth."""
    owner, foot, solids = scene.owner("vehicle"), scene.foot(x, y), scene.solids
    yaw, thick = scene.uniform(0.0, np.pi), scene.uniform(0.02, 0.2)
    way, across = _ahead(yaw), 0.35 * _ahead(yaw + 0.5 * np.pi)
    for ahead in (-0.65, 0.65):
        solids.ellipsoid(owner, foot + ahead * way + _up(0.32), [0.32, 0.06, 0.32], yaw=yaw)
    solids.ellipsoid(owner, foot + _up(0.65), [0.6, thick, 0.12 + thick], yaw=yaw)
    bar = foot + 0.35 * way + _up(1.05)
    solids.cone(owner, foot + 0.55 * way + _up(0.3), bar, (0.04, 0.04))
    solids.cone(owner, bar - across, bar + across, (0.02, 0.02))
    if scene.rng.random() < 0.5:
        solids.box(owner, foot - 0.7 * way + _up(1.0), [0.22, 0.22, 0.2], yaw=yaw)


def add_bin(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a bin or a switch box at x, y [m], kind "vehicle"; not to the ground truth."""
    half = np.array([scene.uniform(0.2, 0.6), scene.uniform(0.2, 0.4), scene.uniform(0.4, 0.8)])
    centre = scene.foot(x, y) + _up(half[2])
    scene.solids.box(scene.owner("vehicle"), centre, half, yaw=scene.uniform(0.0, np.pi))


def add_drum(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a round object as wide as a trunk at x, y [m]: a barrel, an advertising column, a thick bollard;
    kind "vehicle", not to the ground truth."""
    owner, foot = scene.owner("vehicle"), scene.foot(x, y)
    radius, top = scene.uniform(0.12, 0.6), foot + _up(scene.uniform(0.6, 2.8))
    scene.solids.cone(owner, foot - _up(0.2), top, (radius, radius * scene.uniform(0.7, 1.1)))
    scene.solids.ellipsoid(owner, top, [radius, radius, 0.1])


def add_person(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a person who stands at x, y [m] with a random heading, kind "person"; not to the ground truth."""
    body = person(scene.owner("person"), scene.uniform(-0.3, 0.3))
    scene.solids.extend(body.placed(scene.foot(x, y), scene.uniform(0.0, 2.0 * np.pi)))


def add_hedge(scene: SceneBuilder, start: Float, end: Float) -> None:
    """Add a row of dense foliage between two places (2,) [m], with a rough or a flat top, kind "foliage"; not
    to the ground truth."""
    rng, owner = scene.rng, scene.owner("foliage")
    height, half = scene.uniform(0.6, 2.6), scene.uniform(0.25, 0.6)
    free_path, rough = scene.uniform(0.05, 0.25), scene.uniform(0.02, 0.3)
    for place in _stations(start, end, 0.7 * half):
        x, y = place + 0.3 * rough * rng.standard_normal(2)
        top = height * (1.0 + rough * scene.uniform(-1.0, 1.0))
        size = np.array([*(half * rng.uniform(0.8, 1.2, 2)), 0.55 * top])
        _foliage(scene, owner, scene.foot(x, y) + _up(0.5 * top), size, free_path, reflectivity=0.3)


def add_fence(scene: SceneBuilder, start: Float, end: Float) -> None:
    """Add posts between two places (2,) [m], with rails, with slats, or with neither between them; kind
    "fence", not to the ground truth."""
    owner, form = scene.owner("fence"), int(scene.rng.integers(0, 3))
    height, radius = scene.uniform(0.8, 1.9), scene.uniform(0.025, 0.07)
    for x, y in _stations(start, end, scene.uniform(1.2, 3.0)):
        _post(scene, owner, x, y, radius, height)
    if form == 1:
        for part in (0.4, 0.85):
            rail = [scene.foot(*place) + _up(part * height) for place in (start, end)]
            scene.solids.cone(owner, rail[0], rail[1], (0.03, 0.03))
    elif form == 2:
        for x, y in _stations(start, end, scene.uniform(0.12, 0.25)):
            _post(scene, owner, x, y, 0.025, 0.95 * height)


def add_wall(scene: SceneBuilder, start: Float, end: Float, height: float, thickness: float) -> None:
    """Add a wall or the face of a house between two places; one higher than 2.5 m may have a pipe (kind
    "pole"). Kind "building", not to the ground truth.

    Args:
        scene: The scene.
        start, end: Ends, shape (2,) [m]; they must differ.
        height: Height above the ground [m].
        thickness: Thickness [m].
    """
    way = end - start
    half = [0.5 * float(np.hypot(*way)), 0.5 * thickness, 0.5 * height + 0.3]
    centre = scene.foot(*(0.5 * (start + end))) + _up(0.5 * height)
    scene.solids.box(scene.owner("building"), centre, half, yaw=float(np.arctan2(way[1], way[0])))
    if height > 2.5 and scene.rng.random() < 0.5:
        side = (0.5 * thickness + 0.08) * np.array([way[1], -way[0]]) / np.hypot(*way)
        x, y = start + way * scene.rng.random() + side
        _post(scene, scene.owner("pole"), x, y, 0.05, height)


def _stations(start: Float, end: Float, spacing: float) -> Float:
    """Return positions on the line from `start`, inclusive, to `end`, exclusive, both of shape (2,) [m], at
    multiples of a spacing [m] from `start`; shape (N, 2)."""
    length = float(np.hypot(*(end - start)))
    along = np.arange(0.0, length, spacing)
    return start + along[:, None] * (end - start) / max(length, 0.1)


def _post(scene: SceneBuilder, owner: int, x: float, y: float, radius: float, height: float) -> None:
    """Add a nearly upright post to an object.

    Args:
        scene: Receives it.
        owner: Number of the object.
        x, y: Position of the foot [m].
        radius: Radius at the foot [m].
        height: Height above the ground [m].
    """
    foot = scene.foot(float(x), float(y))
    top = foot + np.array([*(0.01 * height * scene.rng.standard_normal(2)), height])
    scene.solids.cone(owner, foot - _up(0.3), top, (radius, 0.8 * radius), reflectivity=0.6)


def add_bench(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a bench with a back at x, y [m], kind "vehicle"; not to the ground truth."""
    owner, foot, yaw = scene.owner("vehicle"), scene.foot(x, y), scene.uniform(0.0, np.pi)
    half = scene.uniform(0.6, 1.0)
    scene.solids.box(owner, foot + _up(0.45), [half, 0.22, 0.03], yaw=yaw)
    scene.solids.box(owner, foot + 0.2 * _ahead(yaw + 0.5 * np.pi) + _up(0.7), [half, 0.03, 0.15], yaw=yaw)
    for side in (-0.8, 0.8):
        scene.solids.box(owner, foot + side * half * _ahead(yaw) + _up(0.22), [0.04, 0.2, 0.22], yaw=yaw)


def add_stump(scene: SceneBuilder, x: float, y: float) -> None:
    """Add the stump of a felled tree at x, y [m], kind "trunk"; not to the ground truth."""
    owner, foot = scene.owner("trunk"), scene.foot(x, y)
    radius, top = scene.uniform(0.1, 0.3), foot + _up(scene.uniform(0.15, 0.6))
    scene.solids.cone(owner, foot - _up(0.2), top, (1.3 * radius, radius), roughness=0.01)
    scene.solids.ellipsoid(owner, top, [radius, radius, 0.03], reflectivity=0.5)


def add_log(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a log on the ground that begins at x, y [m], with stubs of branches, kind "trunk"; not to the
    ground truth."""
    owner, way = scene.owner("trunk"), _ahead(scene.uniform(0.0, 2.0 * np.pi))
    radius, length = scene.uniform(0.08, 0.25), scene.uniform(1.5, 6.0)
    ends = [scene.foot(x + side * way[0], y + side * way[1]) + _up(radius) for side in (0.0, length)]
    scene.solids.cone(owner, ends[0], ends[1], (radius, 0.7 * radius), roughness=0.01)
    for part in scene.rng.uniform(0.1, 0.9, int(scene.rng.integers(0, 6))):
        start = ends[0] + part * (ends[1] - ends[0])
        stub = scene.uniform(0.2, 0.9) * _ahead(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(0.2, 2.0))
        scene.solids.cone(owner, start, start + stub, (scene.uniform(0.008, 0.025), 0.005))


def _free_hedge(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a hedge of 2 to 10 m that begins at x, y [m], in a random direction."""
    start = np.array([x, y])
    add_hedge(scene, start, start + scene.uniform(2.0, 10.0) * _ahead(scene.uniform(0.0, np.pi))[:2])


#: Objects that a layout places at x, y [m] by their name.
KINDS: dict[str, Callable[[SceneBuilder, float, float], None]] = {
    "tree": add_street_tree,
    "young tree": add_young_tree,
    "shrub": add_shrub,
    "crown": add_crown,
    "hedge": _free_hedge,
    "post": partial(add_post, radius=(0.02, 0.1), height=(0.6, 3.0)),
    "bollard": partial(add_post, radius=(0.04, 0.12), height=(0.5, 1.3)),
    "mast": partial(add_post, radius=(0.04, 0.16), height=(2.5, 9.0)),
    "lamp": add_lamp,
    "sign": add_sign,
    "motorcycle": add_motorcycle,
    "bin": add_bin,
    "drum": add_drum,
    "person": add_person,
    "bench": add_bench,
    "stump": add_stump,
    "log": add_log,
}
