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
        rng: Random generator of the shapes.

    Attributes:
        solids: Solids of all objects so far.
        kinds: Kind of each object or part of an object; the index is its number (`Solids.owner`).
        truth: Tuples of x, y [m], DBH [m] (NaN if not a tree) and kind of the objects of the ground truth.
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
        """Add an object to the ground truth and to `kinds`, and return its number, the owner of its shapes.

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
        """Return a random number, uniform between `low` and `high`; the generator advances."""
        return float(self.rng.uniform(low, high))


def vertical(height: float) -> Float:
    """Return the vector of a height along z, shape (3,) [m]."""
    return np.array([0.0, 0.0, height])


def unit_vector(angle: float, rise: float = 0.0) -> Float:
    """Return the vector with a horizontal part of length 1 at an angle from x [rad] and the vertical part
    `rise`, shape (3,)."""
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
        crown_base: Height of the lower end of the foliage above the ground [m]; a tree with a crown base at
            or above `top` has no foliage.
        branches: Number of branches below the crown and below 3.5 m.
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
        end = axis(height) + (length + radius(height)) * unit_vector(direction, rise)
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
        add_foliage(scene, owner, centre, half, 1.2)


def add_pole(scene: SceneBuilder, x: float, y: float, radius: float) -> None:
    """Add a straight, upright pole of a radius [m], 1.8 to 4 m above the ground, at x, y [m] to scene and
    ground truth."""
    owner, foot = scene.true_object("pole", x, y), scene.foot(x, y)
    top = foot + vertical(scene.uniform(1.8, 4.0))
    scene.solids.cone(owner, foot - vertical(0.3), top, (radius, radius), reflectivity=0.6)


def add_bush(scene: SceneBuilder, x: float, y: float, radius: float) -> None:
    """Add two or three porous blobs near the ground, with thin stems in them, within `radius` of x, y [m], to
    scene and ground truth."""
    rng, owner, foot = scene.rng, scene.true_object("bush", x, y), scene.foot(x, y)
    for _ in range(int(rng.integers(2, 4))):
        half = radius * rng.uniform(0.6, 0.9, 3) * np.array([1.0, 1.0, 0.9])
        at = foot[:2] + (radius - half[:2].max()) * rng.uniform(-0.8, 0.8, 2)
        add_foliage(scene, owner, [*at, foot[2] + 0.75 * half[2]], half, 0.22)
    for _ in range(4):
        lean = rng.uniform(-0.35, 0.35, 2) * radius
        scene.solids.cone(owner, foot - vertical(0.05), foot + np.array([*lean, radius]), (0.012, 0.004))


def add_box(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a piece of wall or a crate at x, y [m], 0.8 to 2.4 m long and 0.8 to 1.6 m above the ground, to
    scene and ground truth."""
    half = np.array([scene.uniform(0.4, 1.2), scene.uniform(0.12, 0.4), scene.uniform(0.5, 0.9)])
    owner, centre = scene.true_object("other", x, y), scene.foot(x, y) + vertical(half[2]) - vertical(0.2)
    scene.solids.box(owner, centre, half, yaw=scene.uniform(0.0, np.pi))


def add_undergrowth(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a tuft of ferns or grass at x, y [m], up to half a metre high; not to the ground truth."""
    half = np.array([scene.uniform(0.2, 0.5), scene.uniform(0.2, 0.5), scene.uniform(0.15, 0.5)])
    centre = scene.foot(x, y) + vertical(0.1 * half[2])
    add_foliage(scene, scene.owner("undergrowth"), centre, half, 0.35, reflectivity=0.45)


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
        radius, height: Bounds of the uniform distributions of radius and height [m].
    """
    rng, owner, foot = scene.rng, scene.owner("foliage"), scene.foot(x, y)
    wide, tall, free_path = scene.uniform(*radius), scene.uniform(*height), scene.uniform(0.1, 0.45)
    for _ in range(int(rng.integers(2, 6))):
        half = np.array([wide, wide, 0.5 * tall]) * rng.uniform(0.4, 0.8, 3)
        shift = (wide - half[:2].max()) * rng.uniform(-1.0, 1.0, 2)
        up = scene.uniform(0.6 * half[2], max(tall - half[2], 0.7 * half[2]))
        add_foliage(scene, owner, foot + np.array([*shift, up]), half, free_path, reflectivity=0.3)
    for _ in range(int(rng.integers(0, 7))):
        end = foot + np.array([*(0.6 * wide * rng.uniform(-1.0, 1.0, 2)), 0.8 * tall])
        scene.solids.cone(owner, foot - vertical(0.1), end, (scene.uniform(0.01, 0.03), 0.005))


def add_foliage(
    scene: SceneBuilder,
    owner: int,
    centre: Float | list[float],
    half: Float,
    free_path: float,
    reflectivity: float = 0.5,
) -> None:
    """Add a porous ellipsoid with a random yaw.

    Args:
        scene: The scene to which the ellipsoid is added.
        owner: Number of the object to which the ellipsoid belongs.
        centre: Centre, shape (3,) [m].
        half: Half sizes, shape (3,) [m].
        free_path: Mean free path of a ray in the ellipsoid [m].
        reflectivity: Share of the light that is reflected.
    """
    yaw = scene.uniform(0.0, np.pi)
    scene.solids.ellipsoid(owner, centre, half, yaw=yaw, free_path=free_path, reflectivity=reflectivity)


# --- street furniture ------------------------------------------------------------------------------


def add_post(
    scene: SceneBuilder, x: float, y: float, radius: tuple[float, float], height: tuple[float, float]
) -> None:
    """Add a bare, nearly upright post at x, y [m], kind "pole", not to the ground truth.

    Args:
        scene: The scene.
        x, y: Position [m].
        radius, height: Bounds of the uniform distributions of radius and height [m].
    """
    post_of(scene, scene.owner("pole"), x, y, scene.uniform(*radius), scene.uniform(*height))


def add_sign(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a thin post at x, y [m] with one to three plates or boxes, kinds "pole" and "sign"; not to the
    ground truth."""
    owner, plate = scene.owner("pole"), scene.owner("sign")
    height, yaw = scene.uniform(1.2, 4.0), scene.uniform(0.0, np.pi)
    post_of(scene, owner, x, y, scene.uniform(0.02, 0.06), height)
    top = height
    for _ in range(int(scene.rng.integers(1, 4))):
        half = np.array([scene.uniform(0.1, 0.6), scene.uniform(0.01, 0.12), scene.uniform(0.1, 0.5)])
        centre = scene.foot(x, y) + vertical(max(top - half[2], 0.4 + half[2]))
        scene.solids.box(plate, centre, half, yaw=yaw, reflectivity=0.8)
        top -= 2.0 * half[2] + scene.uniform(0.0, 0.5)


def add_motorcycle(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a motorcycle or a bicycle on its stand at x, y [m], kind "vehicle"; not to the ground truth."""
    owner, foot, solids = scene.owner("vehicle"), scene.foot(x, y), scene.solids
    yaw, thick = scene.uniform(0.0, np.pi), scene.uniform(0.02, 0.2)
    way, across = unit_vector(yaw), 0.35 * unit_vector(yaw + 0.5 * np.pi)
    for ahead in (-0.65, 0.65):
        solids.ellipsoid(owner, foot + ahead * way + vertical(0.32), [0.32, 0.06, 0.32], yaw=yaw)
    solids.ellipsoid(owner, foot + vertical(0.65), [0.6, thick, 0.12 + thick], yaw=yaw)
    bar = foot + 0.35 * way + vertical(1.05)
    solids.cone(owner, foot + 0.55 * way + vertical(0.3), bar, (0.04, 0.04))
    solids.cone(owner, bar - across, bar + across, (0.02, 0.02))
    if scene.rng.random() < 0.5:
        solids.box(owner, foot - 0.7 * way + vertical(1.0), [0.22, 0.22, 0.2], yaw=yaw)


def add_hedge(scene: SceneBuilder, start: Float, end: Float) -> None:
    """Add a row of dense foliage from `start` to `end`, shape (2,) each [m], with a rough or a flat top, kind
    "foliage"; not to the ground truth. No shape is added if `start` and `end` are equal."""
    rng, owner = scene.rng, scene.owner("foliage")
    height, half = scene.uniform(0.6, 2.6), scene.uniform(0.25, 0.6)
    free_path, rough = scene.uniform(0.05, 0.25), scene.uniform(0.02, 0.3)
    for place in stations(start, end, 0.7 * half):
        x, y = place + 0.3 * rough * rng.standard_normal(2)
        top = height * (1.0 + rough * scene.uniform(-1.0, 1.0))
        size = np.array([*(half * rng.uniform(0.8, 1.2, 2)), 0.55 * top])
        add_foliage(scene, owner, scene.foot(x, y) + vertical(0.5 * top), size, free_path, reflectivity=0.3)


def stations(start: Float, end: Float, spacing: float) -> Float:
    """Return positions on the line from `start`, inclusive, to `end`, exclusive, both of shape (2,) [m], at
    multiples of a spacing [m] from `start`; shape (N, 2). N is 0 if both ends are equal."""
    length = float(np.hypot(*(end - start)))
    along = np.arange(0.0, length, spacing)
    return start + along[:, None] * (end - start) / max(length, 0.1)


def post_of(scene: SceneBuilder, owner: int, x: float, y: float, radius: float, height: float) -> None:
    """Add a nearly upright post to an object.

    Args:
        scene: The scene to which the post is added.
        owner: Number of the object.
        x, y: Position of the foot [m].
        radius: Radius at the foot [m].
        height: Height above the ground [m].
    """
    foot = scene.foot(float(x), float(y))
    top = foot + np.array([*(0.01 * height * scene.rng.standard_normal(2)), height])
    scene.solids.cone(owner, foot - vertical(0.3), top, (radius, 0.8 * radius), reflectivity=0.6)


def add_bench(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a bench with a back at x, y [m], kind "vehicle"; not to the ground truth."""
    owner, foot, yaw = scene.owner("vehicle"), scene.foot(x, y), scene.uniform(0.0, np.pi)
    half = scene.uniform(0.6, 1.0)
    scene.solids.box(owner, foot + vertical(0.45), [half, 0.22, 0.03], yaw=yaw)
    scene.solids.box(
        owner, foot + 0.2 * unit_vector(yaw + 0.5 * np.pi) + vertical(0.7), [half, 0.03, 0.15], yaw=yaw
    )
    for side in (-0.8, 0.8):
        scene.solids.box(
            owner, foot + side * half * unit_vector(yaw) + vertical(0.22), [0.04, 0.2, 0.22], yaw=yaw
        )


def add_stump(scene: SceneBuilder, x: float, y: float) -> None:
    """Add the stump of a felled tree at x, y [m], kind "trunk"; not to the ground truth."""
    owner, foot = scene.owner("trunk"), scene.foot(x, y)
    radius, top = scene.uniform(0.1, 0.3), foot + vertical(scene.uniform(0.15, 0.6))
    scene.solids.cone(owner, foot - vertical(0.2), top, (1.3 * radius, radius), roughness=0.01)
    scene.solids.ellipsoid(owner, top, [radius, radius, 0.03], reflectivity=0.5)


def add_log(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a log on the ground that begins at x, y [m], with stubs of branches, kind "trunk"; not to the
    ground truth."""
    owner, way = scene.owner("trunk"), unit_vector(scene.uniform(0.0, 2.0 * np.pi))
    radius, length = scene.uniform(0.08, 0.25), scene.uniform(1.5, 6.0)
    ends = [scene.foot(x + side * way[0], y + side * way[1]) + vertical(radius) for side in (0.0, length)]
    scene.solids.cone(owner, ends[0], ends[1], (radius, 0.7 * radius), roughness=0.01)
    for part in scene.rng.uniform(0.1, 0.9, int(scene.rng.integers(0, 6))):
        start = ends[0] + part * (ends[1] - ends[0])
        stub = scene.uniform(0.2, 0.9) * unit_vector(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(0.2, 2.0))
        scene.solids.cone(owner, start, start + stub, (scene.uniform(0.008, 0.025), 0.005))


#: Objects that a layout places at x, y [m] by their name.
KINDS: dict[str, Callable[[SceneBuilder, float, float], None]] = {
    "shrub": add_shrub,
    "post": partial(add_post, radius=(0.02, 0.1), height=(0.6, 3.0)),
    "sign": add_sign,
    "motorcycle": add_motorcycle,
    "bench": add_bench,
    "stump": add_stump,
    "log": add_log,
}
