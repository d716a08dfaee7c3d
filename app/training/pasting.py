"""Pasting: labelled scans of a sensor that looks one way, once more with poles that never stood there.

Parks hold a pole in every second scene, too few to learn from, and whole simulated parks teach other trees
than real ones. So simulated poles are put among what is real: where the ground was seen, with what hides
them and what they hide.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from zlib import crc32

import numpy as np

from app.training.furniture import POLE, SIGN, Furniture
from app.training.growing import Examples
from app.training.scenes import gathered, label_by_points, labelled_scans, trunks
from app.training.streets import CONE, PERIOD_NS, SolidStateLidar
from pipeline.geometry import Pose2
from pipeline.parameters import Parameters
from pipeline.records import Float, Float32, Int, Scan, Step
from pipeline.simulation.lidar import sweep_scene
from pipeline.simulation.terrain import Terrain
from pipeline.sources import open_source

COPIES = 24  # of each scene
FOLDER = "pasted"  # in that of the kept examples
LEAST_RETURNS = 8  # of a trunk that counts as one: copies have fewer scans, and small trees end in free air
GROUND = (40, 72)  # road and terrain, as the labels number them
NEAR, FAR, ASIDE = 5.0, 24.0, 0.5  # m and rad; where things are put
CLEAR, APART = 0.9, 2.0  # m from a trunk, and from one another
GROUND_REACH = 0.8  # m; of the ground that is looked at
STEP = float(np.radians(0.4))  # of the directions in which what is nearer hides what is farther
HIDDEN, BEHIND = 0.2, 0.3  # m
_FLAT = Terrain.grow(0.0, 0.0, 10.0, np.random.default_rng(0))

_Scans = list[tuple[Float32, Int]]


def name_of_copy(scene: str, copy: int) -> str:
    """Under which the examples of a copy are kept."""
    return f"{scene} with poles {copy}"


def is_of(name: str, scene: str) -> bool:
    """Whether a name is that of a copy of a scene."""
    return name.startswith(f"{scene.rstrip('/')} with poles ")


def pasted_examples(folder: Path, copy: int, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Of a copy of labelled scans with poles: some of the scans, larger or smaller, mirrored or not, with
    some of the returns, on another place of the map so that the voxels lie otherwise."""
    rng = np.random.default_rng([crc32(folder.name.encode()), copy, 0x9A57ED])
    scans = _changed(_without_repeats(labelled_scans(folder)), rng)
    _paste(scans, int(rng.integers(4, 9)), rng)
    pose = Pose2(*(float(v) for v in rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi])))
    run = [Step(k, Scan(k * PERIOD_NS, points), pose) for k, (points, _) in enumerate(scans)]
    points = _to_map(np.concatenate([points for points, _ in scans]), pose)
    label = np.concatenate([label for _, label in scans])
    sure, any_trunk = trunks(points, label, LEAST_RETURNS, np.inf), trunks(points, label, 1, np.inf)
    with closing(open_source(str(folder))) as source:
        about = source.description
    for columns in gathered(run, about.sensor, about.T_base_lidar, parameters):
        near = np.hypot(columns.axis[:, 0] - pose.x, columns.axis[:, 1] - pose.y) < reach
        axis, figures = columns.axis[near], columns.figures[near]
        kind = label_by_points(axis, points, label, sure, any_trunk)
        yield Examples(name_of_copy(str(folder).rstrip("/"), copy), True, False, axis, figures, kind)


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


def _paste(scans: _Scans, number: int, rng: np.random.Generator) -> None:
    """Put so many poles into the scans, in place."""
    points, label = (np.concatenate(each) for each in zip(*scans, strict=True))
    for place in _places(points, label, number, rng):
        x, y, ground = (float(v) for v in place)
        furniture = Furniture(_FLAT, rng)
        _stand(furniture, x, y, rng)
        solids, classes = furniture.solids(), np.array(furniture.classes)
        classes[classes == SIGN] = POLE  # the plate is of the pole
        height = float(_FLAT.height(np.array([x]), np.array([y]))[0]) - ground
        for k, (points, label) in enumerate(scans):
            lidar = SolidStateLidar(range_sigma=0.02, draw=int(rng.integers(0, 2**31)))
            level = np.tile(np.eye(3), (lidar.columns, 1, 1))
            above = np.tile([0.0, 0.0, height], (lidar.columns, 1))
            sweep = sweep_scene(lidar, solids, _FLAT, level, above, k * PERIOD_NS, rng)
            seen, solid = sweep.scan.points, sweep.solid
            hit = (solid >= 0) & (seen[:, 0] > np.cos(CONE) * np.linalg.norm(seen, axis=1))
            if hit.any():
                scans[k] = _merged(points, label, seen[hit], classes[solids.owner[solid[hit]]])


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


def _merged(real: Float32, label: Int, new: Float32, kind: Int) -> tuple[Float32, Int]:
    """Both without what the other hides, and the classes."""
    (to_real, bin_real), (to_new, bin_new) = _directions(real), _directions(new)
    last = max(bin_real.max(initial=0), bin_new.max()) + 1
    nearest = np.full((2, last), np.inf)
    np.minimum.at(nearest[0], bin_real, to_real)
    np.minimum.at(nearest[1], bin_new, to_new)
    seen_new, seen_real = to_new < nearest[0, bin_new] + HIDDEN, to_real < nearest[1, bin_real] + BEHIND
    return (
        np.concatenate([real[seen_real], new[seen_new]]),
        np.concatenate([label[seen_real], kind[seen_new]]),
    )


def _directions(points: Float32) -> tuple[Float, Int]:
    """How far points are away [m], and a number for the direction in which."""
    x, y, z = points.astype(np.float64).T
    away = np.sqrt(x * x + y * y + z * z)
    across = np.floor((np.arctan2(y, x) + np.pi) / STEP).astype(np.int64)
    up = np.floor((np.arctan2(z, np.hypot(x, y)) + 0.5 * np.pi) / STEP).astype(np.int64)
    return away, across * 1000 + up


def _to_map(points: Float32, pose: Pose2) -> Float:
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    moved: Float = points.astype(np.float64) @ turn + np.array([pose.x, pose.y, 0.0])
    return moved
