"""Augmentation: labelled scans from one position, with simulated poles and young trees inserted.

Only every second park has a pole, which is not enough for the training, and the trees of simulated parks
differ from real ones. Therefore simulated poles are inserted into real scans, where the ground was seen, with
the occlusions in both directions. The same number of simulated young trees is inserted, so that a forest does
not learn to recognise simulated objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from app.extensions.learning.examples import Examples, stored_or_computed
from pipeline.config import Parameters
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import open_source
from pipeline.jit import compiled
from pipeline.simulation.lidar import SolidStateLidar, sweep_scene
from pipeline.simulation.primitives import Solids
from pipeline.simulation.ray_casting import meet_solid, random_unit
from pipeline.simulation.scene_objects import SceneBuilder
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Bool, Float, Float32, Int, Scan, Step
from tests.benchmarks.package_forest.labelled_scenes import (
    LABELS,
    columns_of,
    examples_by_points,
    labelled_scans,
    trunks,
)
from tests.benchmarks.package_forest.street_objects import KINDS
from tests.benchmarks.package_forest.street_scenes import PERIOD_NS, add_any

FORMAT = 3  # raise it with every change of the copies
COPIES = 48  # of each scene
FOLDER = "pasted"  # in the folder of the stored examples
LEAST_RETURNS = 8  # of a trunk that counts as a tree; copies have fewer scans, and young trees are small
GROUND = (40, 72)  # labels of road and terrain
NEAR, FAR, ASIDE = 5.0, 24.0, 0.5  # m, m and rad; positions of inserted objects
CLEAR, APART = 0.9, 2.0  # m from a trunk, and between inserted objects
GROUND_REACH = 0.8  # m; radius in which the ground height is measured
SAME_DIRECTION = float(np.radians(0.4))  # a real return this near in direction can hide an inserted one
HIDDEN, BEHIND = 0.2, 0.1  # m
POLES = {"lamp": 0.3, "sign": 0.25, "post": 0.15, "mast": 0.15, "person": 0.15}  # probabilities
_NO_GROUND = SimulatedTerrain(
    np.array([[0.0, 0.0, -1000.0, 0.0]])
)  # far below: the real scans have their own ground

_Scans = list[tuple[Float32, Int]]


@dataclass(frozen=True, slots=True, eq=False)
class AugmentedScans:
    """Labelled scans with inserted objects.

    Attributes:
        scans: Points (N, 3) [m] in the sensor frame and their labels, for each scan.
        pose: Pose of all scans in the map.
        place: x, y of the inserted objects in the map, shape (M, 2) [m].
        tree: Which of them are trees, shape (M,).
    """

    scans: _Scans
    pose: Pose2
    place: Float
    tree: Bool


def copies(
    folder: Path, kept: Path | None, parameters: Parameters, reach: float, number: int = COPIES
) -> list[Examples]:
    """Return the examples of copies of labelled scans into which objects are inserted.

    Args:
        folder: The labelled scans, see `labelled_scans`.
        kept: Folder in which examples are stored by the digest of the scans and the number of the copy, and
            from which they are read the next time; None stores nothing.
        parameters: Parameters of the classification.
        reach: Distance from the sensor within which columns become examples [m].
        number: Number of copies.

    Raises:
        StemmapError: The stored examples are damaged.
    """
    digest, found = digest_of(folder), list[Examples]()
    for copy in range(number):
        make = partial(pasted_examples, folder, copy, parameters, reach)
        found += stored_or_computed(kept, f"{name_of_copy(str(folder), copy)}, {digest}", make)
    return found


def name_of_copy(scene: str, copy: int) -> str:
    """Return the name of the scene of a copy."""
    return f"{scene.rstrip('/')} with things {copy}"


def is_of(name: str, scene: str) -> bool:
    """Return whether a name is that of a copy of a scene, whatever its number."""
    return name.startswith(f"{scene.rstrip('/')} with things ")


def digest_of(folder: Path) -> str:
    """Return the first 16 hex digits of a SHA-256 of everything that decides the copies of labelled scans:
    FORMAT, points and labels."""
    digest = sha256(f"{FORMAT}".encode())
    for points, label in labelled_scans(folder):
        digest.update(points.tobytes() + label.tobytes())
    return digest.hexdigest()[:16]


def pasted_examples(folder: Path, copy: int, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Yield the examples of a copy of labelled scans with inserted objects, see `paste`: one set at each of
    MARKS scans and at the end, see `columns_of`.

    Args:
        folder: The labelled scans, see `labelled_scans`.
        copy: Number of the copy, which seeds its objects.
        parameters: See `columns_of`.
        reach: Distance from the sensor within which columns become examples [m].
    """
    made = paste(folder, copy)
    pose = made.pose
    run = [
        Step(k, Scan(k * PERIOD_NS, points), pose, elapsed_ns=k * PERIOD_NS, period_ns=PERIOD_NS)
        for k, (points, _) in enumerate(made.scans)
    ]
    points = _to_map(np.concatenate([points for points, _ in made.scans]), pose)
    label = np.concatenate([label for _, label in made.scans])
    of_trunks = trunks(points, label, LEAST_RETURNS, np.inf), trunks(points, label, 1, np.inf)
    with closing(open_source(str(folder))) as source:
        about = source.description
    found = columns_of(run, about.sensor, about.T_base_lidar, parameters)
    named = (name_of_copy(str(folder), copy), True, False)
    yield from examples_by_points(found, points, label, of_trunks, reach, named, (pose.x, pose.y))


def paste(folder: Path, copy: int) -> AugmentedScans:
    """Return a copy of labelled scans: some of the scans and returns, scaled, perhaps mirrored, with inserted
    objects, at another pose in the map, so that voxels contain other returns.

    The same folder contents and number give the same copy. Fewer objects than drawn (8 to 16) are inserted if
    there is too little free ground.

    Args:
        folder: The labelled scans, see `labelled_scans`.
        copy: Number of the copy.
    """
    rng = np.random.default_rng([int(digest_of(folder), 16), copy])
    scans = _changed(_without_repeats(labelled_scans(folder)), rng)
    points, label = (np.concatenate(each) for each in zip(*scans, strict=True))
    poles, trees = (int(n) for n in rng.integers(4, 9, 2))
    place = _places(points, label, poles + trees, rng)
    tree = rng.permutation(np.arange(len(place)) % 2 == 0)
    solids, classes = _inserted(place, tree, rng)
    scans = [_seen_with(*scan, solids, classes, rng) for scan in scans]
    pose = Pose2(*(float(v) for v in rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi])))
    return AugmentedScans(scans, pose, _to_map(place, pose)[:, :2], tree)


def _without_repeats(scans: _Scans) -> _Scans:
    """Return the scans without those that equal the scan before them: a recording may hold a scan twice."""
    return [s for k, s in enumerate(scans) if k == 0 or s[0].tobytes() != scans[k - 1][0].tobytes()]


def _changed(scans: _Scans, rng: np.random.Generator) -> _Scans:
    """Return 1 to 8 random scans in their order, each with a random share (0.6 to 1) of its points, all
    scaled by the same random factor (0.88 to 1.14) and perhaps mirrored left to right."""
    number = min(int(rng.choice([1, 2, 3, 6, 8])), len(scans))
    chosen = np.sort(rng.permutation(len(scans))[:number])
    size = float(rng.uniform(0.88, 1.14)) * np.array([1.0, rng.choice([-1.0, 1.0]), 1.0])
    part = float(rng.uniform(0.6, 1.0))
    changed = []
    for k in chosen:
        points, label = scans[k]
        kept = rng.random(len(points)) < part
        changed.append(((points[kept] * size).astype(np.float32), label[kept]))
    return changed


def _inserted(place: Float, tree: Bool, rng: np.random.Generator) -> tuple[Solids, Int]:
    """Return simulated objects and the label of each owner of solids.

    Args:
        place: Position x, y and ground height of each object in the sensor frame, shape (M, 3) [m].
        tree: Whether the object is a young tree, shape (M,); the others are drawn from POLES.
        rng: Random numbers of the objects.
    """
    scene = SceneBuilder(_NO_GROUND, rng)
    for (x, y, ground), is_tree in zip(place.tolist(), tree.tolist(), strict=True):
        scene.terrain = SimulatedTerrain(np.array([[0.0, 0.0, ground, 0.0]]))
        if is_tree:
            KINDS["young tree"](scene, x, y)
        else:
            add_any(scene, POLES, x, y)
    # The plate of a sign belongs to its pole.
    labels = [LABELS["pole" if kind == "sign" else kind] for kind in scene.kinds]
    return scene.solids.build(), np.array(labels, np.int64)


def _seen_with(
    points: Float32, label: Int, solids: Solids, classes: Int, rng: np.random.Generator
) -> tuple[Float32, Int]:
    """Return points and labels of a scan with inserted objects: without the returns that the objects hide,
    and with the visible returns of the objects.

    Args:
        points: The scan, float32, shape (N, 3) [m], sensor frame.
        label: Its labels, shape (N,).
        solids: The objects in the sensor frame.
        classes: Label of each owner of solids.
        rng: Random numbers of the simulated sensor.
    """
    lidar = SolidStateLidar(range_sigma=0.02, pattern=int(rng.integers(0, 2**31)))
    level = np.tile(np.eye(3), (lidar.columns, 1, 1)), np.zeros((lidar.columns, 3))
    sweep = sweep_scene(lidar, solids, _NO_GROUND, *level, 0, rng)
    new, solid = sweep.scan.points, sweep.solid
    hit = solid >= 0
    new, kind = new[hit], classes[solids.owner[solid[hit]]]
    to_real, towards = _directions(points)
    key = int(rng.integers(0, 2**62))
    kept = to_real < first_along(solids, towards, key) + BEHIND
    seen = ~_hidden(new, points)
    return np.concatenate([points[kept], new[seen]]), np.concatenate([label[kept], kind[seen]])


@compiled
def first_along(solids: Solids, directions: Float, key: int) -> Float:
    """Return the range [m] at which each ray from the origin first meets a shape, infinite without, shape
    (N,). There is no ground.

    Args:
        solids: The shapes, relative to the origin of the rays.
        directions: Unit vectors, shape (N, 3).
        key: Seed of the depths at which foliage stops light.
    """
    kind, shape, surface = solids.kind, solids.shape, solids.surface
    ranges, origin = np.full(directions.shape[0], np.inf), np.zeros(3)
    for n in range(kind.shape[0]):
        for k in range(directions.shape[0]):
            met = meet_solid(kind[n], shape[n], surface[n], origin, directions[k], random_unit(key, k, n))
            ranges[k] = min(ranges[k], met)
    return ranges


def _hidden(new: Float32, real: Float32) -> Bool:
    """Return which new points are behind the real point that is nearest in direction, shape (N,). Only real
    points within `SAME_DIRECTION` count; a new point must be more than `HIDDEN` farther. All False if either
    set is empty.

    Args:
        new, real: Points in the sensor frame, shapes (N, 3) and (K, 3) [m].
    """
    from scipy.spatial import cKDTree

    (to_new, towards), (to_real, known) = _directions(new), _directions(real)
    if not len(new) or not len(real):
        return np.zeros(len(new), np.bool_)
    angle, nearest = cKDTree(known).query(towards, distance_upper_bound=SAME_DIRECTION)
    hidden: Bool = np.isfinite(angle) & (to_new > np.append(to_real, np.inf)[nearest] + HIDDEN)
    return hidden


def _directions(points: Float32) -> tuple[Float, Float]:
    """Return the distances of points from the origin [m], shape (N,), and unit vectors towards them, shape
    (N, 3); a point at the origin has a zero vector."""
    away = np.linalg.norm(points.astype(np.float64), axis=1)
    return away, points / np.maximum(away, 1e-9)[:, None]


def _places(points: Float32, label: Int, number: int, rng: np.random.Generator) -> Float:
    """Return random positions x, y on visible ground and its height there, shape (M, 3) [m]; M is less than
    `number` if 50 `number` tries find too few. Positions are between NEAR and FAR from the sensor, within
    ASIDE of the x axis, and apart from trunks and one another.

    Args:
        points: All points of the scans in the sensor frame, shape (N, 3) [m].
        label: Their labels, shape (N,).
        number: Number of positions.
        rng: Random numbers.
    """
    ground = points[np.isin(label, GROUND)].astype(np.float64)
    trunk, found = trunks(points.astype(np.float64), label, 1, np.inf), np.zeros((0, 3))
    for _ in range(50 * number):
        away, angle = rng.uniform(NEAR, FAR), rng.uniform(-ASIDE, ASIDE)
        place = away * np.array([np.cos(angle), np.sin(angle)])
        under = ground[np.hypot(*(ground[:, :2] - place).T) < GROUND_REACH, 2]
        far = np.all(np.hypot(*(trunk - place).T) > CLEAR) and np.all(
            np.hypot(*(found[:, :2] - place).T) > APART
        )
        if len(under) > 2 and far and len(found) < number:
            found = np.vstack([found, [*place, np.percentile(under, 20.0)]])
    return found


def _to_map(points: Float32 | Float, pose: Pose2) -> Float:
    """Return points (N, 3) [m] of the sensor frame in the map; heights remain unchanged."""
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    moved: Float = points.astype(np.float64) @ turn + np.array([pose.x, pose.y, 0.0])
    return moved
