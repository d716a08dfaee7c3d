"""Pasting: labelled scans of a sensor that looks one way, once more with things that never stood there.

Parks hold a pole in every second scene, too few to learn from, and whole simulated parks teach other trees
than real ones. So simulated poles are put among what is real: where the ground was seen, with what hides
them and what they hide. As many young trees are put there by the same caster: else decision trees would
learn to tell what is simulated.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from app.training.fit_forest import Examples
from app.training.keeping import stored_or_computed
from app.training.scene_objects import POLE, SIGN, Furniture
from app.training.scenes import gathered, label_by_points, labelled_scans, trunks
from app.training.streets import CONE, PERIOD_NS, SolidStateLidar
from app.training.young_trees import sapling
from pipeline.config import Parameters
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import open_source
from pipeline.simulation.lidar import sweep_scene
from pipeline.simulation.primitives import Solids
from pipeline.simulation.single_rays import first_along
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Bool, Float, Float32, Int, Scan, Step

FORMAT = 2  # of what is made here: raise it with every change that makes other copies
COPIES = 48  # of each scene
FOLDER = "pasted"  # in that of the kept examples
LEAST_RETURNS = 8  # of a trunk that counts as one: copies have fewer scans, and small trees end in free air
GROUND = (40, 72)  # road and terrain, as the labels number them
NEAR, FAR, ASIDE = 5.0, 24.0, 0.5  # m and rad; where things are put
CLEAR, APART = 0.9, 2.0  # m from a trunk, and from one another
GROUND_REACH = 0.8  # m; of the ground that is looked at
BESIDE = float(np.radians(0.4))  # so near to its direction a real return tells whether a new one was hidden
HIDDEN, BEHIND = 0.2, 0.1  # m
LIFTED = 1000.0  # m, so high above all ground rays are cast: what is real has its own
_FLAT = Terrain.grow(0.0, 0.0, 10.0, np.random.default_rng(0))

_Scans = list[tuple[Float32, Int]]


@dataclass(frozen=True, slots=True, eq=False)
class Copy:
    """Labelled scans with things pasted in.

    Attributes:
        scans: Points (N, 3) [m] in the frame of the sensor and their classes, of each scan.
        pose: Of all of them in the map.
        place: Of the things in the map, x and y, shape (M, 2) [m]; tree: which are trees, shape (M,).
    """

    scans: _Scans
    pose: Pose2
    place: Float
    tree: Bool


def copies(
    folder: Path, kept: Path | None, parameters: Parameters, reach: float, number: int = COPIES
) -> list[Examples]:
    """The examples of all copies of labelled scans; they are kept in a folder by what they are made from."""
    digest, found = digest_of(folder), list[Examples]()
    for copy in range(number):
        make = partial(pasted_examples, folder, copy, parameters, reach)
        found += stored_or_computed(kept, f"{name_of_copy(str(folder), copy)}, {digest}", make)
    return found


def name_of_copy(scene: str, copy: int) -> str:
    """The scene that examples of a copy are of."""
    return f"{scene.rstrip('/')} with things {copy}"


def is_of(name: str, scene: str) -> bool:
    """Whether a name is that of a copy of a scene."""
    return name.startswith(f"{scene.rstrip('/')} with things ")


def digest_of(folder: Path) -> str:
    """Of all that decides what copies of labelled scans are: the scans, their labels, and FORMAT."""
    digest = sha256(f"{FORMAT}".encode())
    for points, label in labelled_scans(folder):
        digest.update(points.tobytes() + label.tobytes())
    return digest.hexdigest()[:16]


def pasted_examples(folder: Path, copy: int, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Of a copy of labelled scans with things pasted in, see `paste`."""
    made = paste(folder, copy)
    pose = made.pose
    run = [Step(k, Scan(k * PERIOD_NS, points), pose) for k, (points, _) in enumerate(made.scans)]
    points = _to_map(np.concatenate([points for points, _ in made.scans]), pose)
    label = np.concatenate([label for _, label in made.scans])
    sure, any_trunk = trunks(points, label, LEAST_RETURNS, np.inf), trunks(points, label, 1, np.inf)
    with closing(open_source(str(folder))) as source:
        about = source.description
    for columns in gathered(run, about.sensor, about.T_base_lidar, parameters):
        near = np.hypot(columns.axis[:, 0] - pose.x, columns.axis[:, 1] - pose.y) < reach
        axis, figures = columns.axis[near], columns.figures[near]
        kind = label_by_points(axis, points, label, sure, any_trunk)
        yield Examples(name_of_copy(str(folder), copy), True, False, axis, figures, kind)


def paste(folder: Path, copy: int) -> Copy:
    """Some of the labelled scans, larger or smaller, mirrored or not, with some of the returns, with things
    that never stood there, on another place of the map so that the voxels lie otherwise."""
    rng = np.random.default_rng([int(digest_of(folder), 16), copy])
    scans = _changed(_without_repeats(labelled_scans(folder)), rng)
    points, label = (np.concatenate(each) for each in zip(*scans, strict=True))
    poles, trees = (int(n) for n in rng.integers(4, 9, 2))
    place = _places(points, label, poles + trees, rng)
    tree = rng.permutation(np.arange(len(place)) % 2 == 0)
    solids, classes = _things(place, tree, rng)
    scans = [_seen_with(*scan, solids, classes, rng) for scan in scans]
    pose = Pose2(*(float(v) for v in rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi])))
    return Copy(scans, pose, _to_map(place, pose)[:, :2], tree)


def _without_repeats(scans: _Scans) -> _Scans:
    """A recording may hold a scan twice."""
    return [s for k, s in enumerate(scans) if k == 0 or s[0].tobytes() != scans[k - 1][0].tobytes()]


def _changed(scans: _Scans, rng: np.random.Generator) -> _Scans:
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


def _things(place: Float, tree: Bool, rng: np.random.Generator) -> tuple[Solids, Int]:
    """What is put at places x, y, z, shape (M, 3) [m] in the sensor's frame, and the class of each owner."""
    solids, classes = Furniture(_FLAT, rng).solids(), list[int]()
    for (x, y, ground), is_tree in zip(place.tolist(), tree.tolist(), strict=True):
        one = Furniture(_FLAT, rng)
        (sapling if is_tree else _stand)(one, x, y, rng)
        height = float(_FLAT.height(np.array([x]), np.array([y]))[0])
        thing = one.solids().placed(np.array([0.0, 0.0, ground - height]), 0.0)
        solids = solids.join(replace(thing, owner=(thing.owner + len(classes)).astype(np.int32)))
        classes += [POLE if kind == SIGN else kind for kind in one.classes]  # the plate is of the pole
    return solids, np.array(classes, np.int64)


def _seen_with(
    points: Float32, label: Int, solids: Solids, classes: Int, rng: np.random.Generator
) -> tuple[Float32, Int]:
    """A scan as if these things stood there: without what they hide, with what is seen of them."""
    lidar = SolidStateLidar(range_sigma=0.02, draw=int(rng.integers(0, 2**31)))
    level = np.tile(np.eye(3), (lidar.columns, 1, 1))
    above = np.tile([0.0, 0.0, LIFTED], (lidar.columns, 1))
    sweep = sweep_scene(lidar, solids.placed(above[0], 0.0), _FLAT, level, above, 0, rng)
    new, solid = sweep.scan.points, sweep.solid
    hit = (solid >= 0) & (new[:, 0] > np.cos(CONE) * np.linalg.norm(new, axis=1))
    new, kind = new[hit], classes[solids.owner[solid[hit]]]
    to_real, towards = _directions(points)
    key = int(rng.integers(0, 2**62))
    kept = to_real < first_along(solids.kind, solids.shape, solids.capsule, towards, key) + BEHIND
    seen = ~_hidden(new, points)
    return np.concatenate([points[kept], new[seen]]), np.concatenate([label[kept], kind[seen]])


def _hidden(new: Float32, real: Float32) -> Bool:
    """Which of the new points lie behind the real one that is nearest in direction, shape (N,)."""
    from scipy.spatial import cKDTree

    (to_new, towards), (to_real, known) = _directions(new), _directions(real)
    if not len(new) or not len(real):
        return np.zeros(len(new), np.bool_)
    beside, nearest = cKDTree(known).query(towards, distance_upper_bound=BESIDE)
    hidden: Bool = np.isfinite(beside) & (to_new > np.append(to_real, np.inf)[nearest] + HIDDEN)
    return hidden


def _directions(points: Float32) -> tuple[Float, Float]:
    """How far points are away [m], shape (N,), and unit vectors towards them, shape (N, 3)."""
    away = np.linalg.norm(points.astype(np.float64), axis=1)
    return away, points / np.maximum(away, 1e-9)[:, None]


def _stand(furniture: Furniture, x: float, y: float, rng: np.random.Generator) -> None:
    kind = rng.choice(["lamp", "sign", "post", "mast", "person"], p=[0.3, 0.25, 0.15, 0.15, 0.15])
    if kind == "post":
        furniture.post(x, y, float(rng.uniform(0.03, 0.1)), float(rng.uniform(0.8, 3.0)))
    elif kind == "mast":
        furniture.post(x, y, float(rng.uniform(0.04, 0.14)), float(rng.uniform(2.5, 9.0)))
    else:
        getattr(furniture, str(kind))(x, y)


def _places(points: Float32, label: Int, number: int, rng: np.random.Generator) -> Float:
    """Places x, y on ground that was seen and its height there, shape (M, 3) [m], M at most `number`."""
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
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    moved: Float = points.astype(np.float64) @ turn + np.array([pose.x, pose.y, 0.0])
    return moved
