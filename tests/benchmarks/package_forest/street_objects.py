"""Objects of simulated streets and parks, besides those of `pipeline.simulation.scene_objects`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pipeline.simulation import scene_objects
from pipeline.simulation.scene_objects import (
    SceneBuilder,
    add_foliage,
    add_hedge,
    add_post,
    add_shrub,
    person,
    post_of,
    stations,
    unit_vector,
    vertical,
)
from pipeline.types.records import Float


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
        side = scene.uniform(0.0, 0.9) * unit_vector(scene.uniform(0.0, 2.0 * np.pi))
        add_shrub(scene, x + side[0], y + side[1], (0.2, 0.8), (0.3, 1.6))
    if rng.random() < 0.1:
        side = 0.45 * unit_vector(scene.uniform(0.0, 2.0 * np.pi))
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
    start, end = foot - vertical(0.3), foot + np.array([*(height * lean), 0.95 * height])
    owner = _trunk(scene, x, y, start, end, (1.1 * radius, 0.3 * radius))
    if rng.random() < 0.1:
        second = start + np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])
        top = end + np.array([*rng.uniform(-0.6, 0.6, 2), -0.2 * height])
        solids.cone(owner, second, top, (0.8 * radius, 0.2 * radius))
    for part in rng.uniform(base / height, 0.95, int(rng.integers(3, 16 if form == "bare" else 7))):
        at = start + (end - start) * part
        way = unit_vector(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(0.2, 2.0))
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
            add_foliage(scene, owner, foot + np.array([*(up * lean + out), up]), half, free_path)
    if rng.random() < 0.3:
        first = scene.uniform(0.0, 2.0 * np.pi)
        for angle in first + np.arange(int(rng.integers(1, 4))) * 2.0 * np.pi / 3.0:
            side = scene.uniform(0.15, 0.5) * unit_vector(angle)
            add_post(scene, x + side[0], y + side[1], (0.02, 0.05), (1.0, 2.4))


def add_crown(scene: SceneBuilder, x: float, y: float) -> None:
    """Add foliage above x, y [m] that hangs over from a tree out of view; not to the ground truth."""
    _crown(scene, scene.foot(x, y) + vertical(scene.uniform(1.0, 3.5)), scene.uniform(2.0, 5.0), 2.0)


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
        add_foliage(scene, owner, base + np.array([*out, up]), half, free_path)


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
        way = unit_vector(scene.uniform(0.0, 2.0 * np.pi))
        lean = np.tan(np.radians(scene.uniform(3.0, 15.0)))
        start = foot + scene.uniform(0.0, 1.5) * radius * way - vertical(0.3)
        thick = scene.uniform(0.5, 0.9) * radius
        end = start + height * (lean * way + vertical(1.0))
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
        add_foliage(
            scene, owner, start + part * (end - start), half, scene.uniform(0.05, 0.25), reflectivity=0.3
        )


def _leafy_branch(scene: SceneBuilder, owner: int, start: Float) -> None:
    """Add a branch that begins at `start`, shape (3,) [m], to the object `owner`; half of the branches have
    leaves."""
    rng = scene.rng
    way = scene.uniform(0.4, 1.5) * unit_vector(scene.uniform(0.0, 2.0 * np.pi), scene.uniform(-0.1, 1.0))
    scene.solids.cone(owner, start, start + way, (scene.uniform(0.01, 0.03), 0.004))
    if rng.random() < 0.5:
        half = rng.uniform(0.1, 0.35, 3)
        add_foliage(scene, scene.owner("foliage"), start + way, half, 0.3, reflectivity=0.3)


def add_lamp(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a lamp post of 3 to 9 m at x, y [m] with an arm, often with a thicker base; kind "pole", not to the
    ground truth."""
    owner = scene.owner("pole")
    radius, height = scene.uniform(0.04, 0.12), scene.uniform(3.0, 9.0)
    post_of(scene, owner, x, y, radius, height)
    if scene.rng.random() < 0.6:
        post_of(scene, owner, x, y, 1.5 * radius, scene.uniform(0.3, 1.4))
    top = scene.foot(x, y) + vertical(height)
    end = top + scene.uniform(0.3, 2.0) * unit_vector(scene.uniform(0.0, 2.0 * np.pi), 0.1)
    scene.solids.cone(owner, top, end, (0.04, 0.04), reflectivity=0.6)
    scene.solids.ellipsoid(owner, end, scene.rng.uniform(0.1, 0.3, 3), reflectivity=0.6)


def add_car(scene: SceneBuilder, x: float, y: float, yaw: float) -> None:
    """Add a parked car or van at x, y [m] with a yaw [rad], kind "vehicle"; not to the ground truth."""
    owner, foot = scene.owner("vehicle"), scene.foot(x, y)
    length, is_van = scene.uniform(1.8, 2.6), scene.rng.random() < 0.25
    top = scene.uniform(1.8, 2.4) if is_van else scene.uniform(0.85, 1.05)
    scene.solids.box(owner, foot + vertical(0.5 * (top + 0.3)), [length, 0.88, 0.5 * (top - 0.3)], yaw=yaw)
    if not is_van:
        scene.solids.box(owner, foot + vertical(top + 0.28), [0.55 * length, 0.75, 0.28], yaw=yaw)
    for ahead in (-0.62 * length, 0.62 * length):
        for side in (-0.85, 0.85):
            wheel = foot + ahead * unit_vector(yaw) + side * unit_vector(yaw + 0.5 * np.pi) + vertical(0.3)
            scene.solids.ellipsoid(owner, wheel, [0.31, 0.1, 0.31], yaw=yaw)


def add_bin(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a bin or a switch box at x, y [m], kind "vehicle"; not to the ground truth."""
    half = np.array([scene.uniform(0.2, 0.6), scene.uniform(0.2, 0.4), scene.uniform(0.4, 0.8)])
    centre = scene.foot(x, y) + vertical(half[2])
    scene.solids.box(scene.owner("vehicle"), centre, half, yaw=scene.uniform(0.0, np.pi))


def add_drum(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a round object as wide as a trunk at x, y [m]: a barrel, an advertising column, a thick bollard;
    kind "vehicle", not to the ground truth."""
    owner, foot = scene.owner("vehicle"), scene.foot(x, y)
    radius, top = scene.uniform(0.12, 0.6), foot + vertical(scene.uniform(0.6, 2.8))
    scene.solids.cone(owner, foot - vertical(0.2), top, (radius, radius * scene.uniform(0.7, 1.1)))
    scene.solids.ellipsoid(owner, top, [radius, radius, 0.1])


def add_person(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a person who stands at x, y [m] with a random heading, kind "person"; not to the ground truth."""
    body = person(scene.owner("person"), scene.uniform(-0.3, 0.3))
    scene.solids.extend(body.placed(scene.foot(x, y), scene.uniform(0.0, 2.0 * np.pi)))


def add_fence(scene: SceneBuilder, start: Float, end: Float) -> None:
    """Add posts between two places (2,) [m], with rails, with slats, or with neither between them; kind
    "fence", not to the ground truth."""
    owner, form = scene.owner("fence"), int(scene.rng.integers(0, 3))
    height, radius = scene.uniform(0.8, 1.9), scene.uniform(0.025, 0.07)
    for x, y in stations(start, end, scene.uniform(1.2, 3.0)):
        post_of(scene, owner, x, y, radius, height)
    if form == 1:
        for part in (0.4, 0.85):
            rail = [scene.foot(*place) + vertical(part * height) for place in (start, end)]
            scene.solids.cone(owner, rail[0], rail[1], (0.03, 0.03))
    elif form == 2:
        for x, y in stations(start, end, scene.uniform(0.12, 0.25)):
            post_of(scene, owner, x, y, 0.025, 0.95 * height)


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
    centre = scene.foot(*(0.5 * (start + end))) + vertical(0.5 * height)
    scene.solids.box(scene.owner("building"), centre, half, yaw=float(np.arctan2(way[1], way[0])))
    if height > 2.5 and scene.rng.random() < 0.5:
        side = (0.5 * thickness + 0.08) * np.array([way[1], -way[0]]) / np.hypot(*way)
        x, y = start + way * scene.rng.random() + side
        post_of(scene, scene.owner("pole"), x, y, 0.05, height)


def _free_hedge(scene: SceneBuilder, x: float, y: float) -> None:
    """Add a hedge of 2 to 10 m that begins at x, y [m], in a random direction."""
    start = np.array([x, y])
    add_hedge(scene, start, start + scene.uniform(2.0, 10.0) * unit_vector(scene.uniform(0.0, np.pi))[:2])


#: Objects that a layout places at x, y [m] by their name.
KINDS: dict[str, Callable[[SceneBuilder, float, float], None]] = {
    **scene_objects.KINDS,
    "tree": add_street_tree,
    "young tree": add_young_tree,
    "crown": add_crown,
    "hedge": _free_hedge,
    "bollard": partial(add_post, radius=(0.04, 0.12), height=(0.5, 1.3)),
    "mast": partial(add_post, radius=(0.04, 0.16), height=(2.5, 9.0)),
    "lamp": add_lamp,
    "bin": add_bin,
    "drum": add_drum,
    "person": add_person,
}
