"""Small runs whose results are stored, so that a change of detection, SLAM or tracking that is not intended
is found. Voxel columns and the search of loops are not covered: they need more points and stems.

Each run takes less than a second even without numba. `tests/data/small_runs.json` holds the results. After an
intended change, `python -m tests.pipeline.test_small_runs` writes them again, and the difference of the file
shows its effect.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.front_end import detect, segment
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.types.records import SHARED, PoseMeasurement, Sensor, Stems, Step, Turn
from tests.pipeline.strategies import SENSOR, arc, step

STORED = Path(__file__).parents[1] / "data" / "small_runs.json"
DIGITS, RELATIVE, ABSOLUTE = 7, 1e-5, 1e-8
EVERY = 8  # scans of a drive of which one is stored
BEND = Pose2(0.6, 0.0, 0.15)  # motion between two scans on a circle of 4 m

# --- results as JSON ------------------------------------------------------------------------------------


def plain(value: Any) -> Any:
    """Return a result as JSON: numbers with DIGITS digits, arrays as lists, records as dictionaries."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else str(value)
    return value


def differences(now: Any, stored: Any, at: str = "") -> Iterator[str]:
    """Yield where two results differ by more than rounding."""
    if isinstance(now, dict) and isinstance(stored, dict) and now.keys() == stored.keys():
        for name in now:
            yield from differences(now[name], stored[name], f"{at}.{name}")
    elif isinstance(now, list) and isinstance(stored, list) and len(now) == len(stored):
        for k, (one, other) in enumerate(zip(now, stored, strict=True)):
            yield from differences(one, other, f"{at}[{k}]")
    elif isinstance(now, float) and isinstance(stored, int | float):
        if not math.isclose(now, stored, rel_tol=RELATIVE, abs_tol=ABSOLUTE):
            yield f"{at}: {now} instead of {stored}"
    elif now != stored:
        yield f"{at}: {now!r} instead of {stored!r}"


# --- drives past stems ----------------------------------------------------------------------------------


def stand(seed: int, trees: int, half: float, apart: float) -> np.ndarray:
    """Return positions of trees in a square, none nearer to another than `apart`, shape (trees, 2) [m]."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < trees:
        place = rng.uniform(-half, half, 2)
        if all(np.hypot(*(place - other)) > apart for other in places):
            places.append(place)
    return np.array(places)


def stem_step(index: int, centre: np.ndarray, dbh: np.ndarray, odometry: Pose2 | None, **rest: Any) -> Step:
    """Return a step with detected stems at positions in the base frame, which lean a little."""
    now = step(index, np.column_stack([centre, np.ones(len(centre))]), odometry, **rest)
    axis = np.tile(np.array([0.02, -0.01, 1.0]) / math.sqrt(1.0005), (len(centre), 1))
    seen: Step = replace(now, scan=replace(now.scan, stems=Stems(axis, dbh)))
    return seen


def drive(
    scans: int = 50,
    *,
    trees: np.ndarray | None = None,
    motion: Pose2 = BEND,
    changed: Callable[[int, Pose2, Pose2], dict[str, Any]] | None = None,
    visible: Callable[[int, np.ndarray], np.ndarray] | None = None,
    **parameters: Any,
) -> dict[str, Any]:
    """Map a drive past stems with noisy odometry and return its results.

    Args:
        scans: Number of scans.
        trees: Positions of the trees, shape (N, 2) [m]; a stand around a circle of 4 m by default.
        motion: True motion between two scans.
        changed: Attributes of a step that differ, from its number, the true pose, and that by odometry.
        visible: Numbers of the trees that the scan shows, from its number and those within 7 m.
        parameters: Changes of the preset "stems", with "__" in place of the dot.
    """
    rng = np.random.default_rng(7)
    trees = stand(1, 16, 9.0, 1.2) if trees is None else trees
    # Quarters of a hit are exact in float32, so that no decision depends on the rounding of a sum.
    given = {"slam__particles": 8, "slam__misses_per_hit": 4} | parameters
    p = preset("stems").replace({name.replace("__", "."): value for name, value in given.items()})
    mapper = Mapper(p, sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=2)
    dbh = rng.uniform(0.15, 0.5, len(trees))
    origin = truth = Pose2(0.0, -4.0)
    odometry, results, frame = Pose2(), [], None
    for k in range(scans):
        if k > 0:
            truth = truth @ motion
            error = rng.normal([0.0, 0.0, 0.004], [0.03, 0.01, 0.01])
            odometry = odometry @ Pose2(*(motion.as_array() + error))
        centre = truth.inverse().apply(trees)
        rows = np.flatnonzero(np.hypot(*centre.T) < 7.0)
        rows = rows if visible is None else visible(k, rows)
        centre = centre[rows] + rng.normal(0.0, 0.04, (len(rows), 2))
        thick = dbh[rows] + rng.normal(0.0, 0.02, len(rows))
        rest = {"odometry": odometry}
        if changed is not None:
            rest |= changed(k, origin.inverse() @ truth, odometry)
        frame = mapper.process(stem_step(k, centre, thick, **rest))
        e = frame.estimate
        results.append([e.T_map_base.as_array(), e.covariance, e.health, e.landmark_of, frame.warnings])
    assert frame
    state = mapper.snapshot()
    slam, path = state.slam, mapper.path
    return {
        "scans": [*results[::EVERY], results[-1]],
        "trees": frame.trees,
        "tracks": state.tracks,
        "map": slam.map_of(slam.best),
        "keyframes": slam.graph.pose,
        "path": [path.x, path.y, path.yaw, path.sigma_xy],
    }


def frozen_odometry(begin: int, end: int) -> Callable[[int, Pose2, Pose2], dict[str, Any]]:
    """Return a change after which the odometry stands still from one scan to another."""
    held: list[Pose2] = []

    def changed(k: int, _truth: Pose2, odometry: Pose2) -> dict[str, Any]:
        if k == begin:
            held.append(odometry)
        if k < begin:
            return {}
        # After the end, the odometry continues from the pose at which it was frozen.
        if k == end:
            held.append(odometry)
        return {"odometry": held[0] if k < end else held[0] @ held[1].inverse() @ odometry}

    return changed


def missing_odometry(begin: int, end: int) -> Callable[[int, Pose2, Pose2], dict[str, Any]]:
    """Return a change after which the odometry is absent from one scan to another."""
    last: list[Pose2] = []

    def changed(k: int, _truth: Pose2, odometry: Pose2) -> dict[str, Any]:
        if k < begin:
            last[:] = [odometry]
        if begin <= k < end:
            return {"odometry": None, "doubt": "no odometry", "slack": (0.3, 0.1)}
        if k == end:
            return {"unreported": last[0].inverse() @ odometry}
        return {}

    return changed


def measured_poses(k: int, truth: Pose2, _odometry: Pose2) -> dict[str, Any]:
    """Change a step in three to one with a pose by another source, with errors that all of them share."""
    if k % 3:
        return {}
    rng = np.random.default_rng([5, k])
    shared = np.zeros((3, SHARED))
    shared[0, 0] = shared[1, 1] = 0.2
    shared[:2, 2] = [-0.02 * truth.y, 0.02 * truth.x]
    own = np.diag([0.1, 0.1, 0.03]) ** 2
    pose = truth.as_array() + np.array([0.15, -0.1, 0.0]) + rng.normal(0.0, [0.1, 0.1, 0.03])
    covariance = own + shared @ shared.T
    at_ns = 1 + k * 100_000_000
    return {"measured": PoseMeasurement(at_ns, Pose2(*pose), covariance, gate=20.0, shared=shared)}


def turns(k: int, _truth: Pose2, odometry: Pose2) -> dict[str, Any]:
    """Add the turn by a gyroscope, whose wheels slip in a bend."""
    slip = Pose2(0.0, 0.0, 0.3) if k > 20 else Pose2()
    return {"odometry": odometry @ slip, "turn": Turn(0.15, 0.01) if k else None, "turn_rate": 1.5}


def offset_odometry(k: int, _truth: Pose2, odometry: Pose2) -> dict[str, Any]:
    """Add an offset to the odometry from scan 25 on."""
    return {"odometry": Pose2(3.0, -2.0, 0.8) @ odometry if k >= 25 else odometry}


ROWS = np.stack(np.meshgrid(np.arange(-8.5, 9.6, 2.0), np.arange(-8.7, 9.4, 2.0)), axis=-1).reshape(-1, 2)
DOUBLED_STEMS = (stand(1, 16, 9.0, 1.2)[:, None] + np.array([[0.0, 0.0], [0.35, 0.0]])).reshape(-1, 2)

#: Drives by name.
DRIVES: dict[str, Callable[[], dict[str, Any]]] = {
    "circle": lambda: drive(60),
    "circle, FastSLAM 1.0": lambda: drive(40, slam__method="fastslam1"),
    "close stems": lambda: drive(30, trees=stand(3, 40, 9.0, 0.5), slam__particles=6),
    "rows of a plantation": lambda: drive(25, trees=ROWS, motion=Pose2(0.6, 0.0, 0.0)),
    "frozen odometry": lambda: drive(26, changed=frozen_odometry(10, 20)),
    "missing odometry": lambda: drive(50, changed=missing_odometry(20, 32)),
    "odometry with an offset": lambda: drive(50, changed=offset_odometry),
    "turns by a gyroscope": lambda: drive(40, changed=turns),
    "measured poses": lambda: drive(50, changed=measured_poses),
    "trees that vanish": lambda: drive(
        45, visible=lambda k, rows: rows[(rows % 3 > 0) | (k < 15)], slam__miss_weight=0.5
    ),
    "no trees for a while": lambda: drive(45, visible=lambda k, rows: rows[: 0 if 15 < k < 30 else None]),
    "a robot that stands": lambda: drive(30, motion=Pose2()),
    "trees that may move": lambda: drive(
        30, tracking__velocity_sigma=0.2, tracking__acceleration_sigma=0.1, tracking__engine="filterpy"
    ),
    "a tree seen as two": lambda: drive(40, trees=DOUBLED_STEMS),
}

# --- scans of a few objects -----------------------------------------------------------------------------

PLANAR = Sensor("planar", rings=1, azimuth_step=math.radians(1.0))


@cache
def grove(seed: int = 0) -> np.ndarray:
    """Return the points of stems, one of them leaning, a wall, a bush and a slope, shape (N, 3) [m]."""
    rng = np.random.default_rng(seed)
    half = math.radians(75.0)
    stems = [
        arc(0.15, half, distance=4.0, bearing=0.3, rows=10, n=12, height=1.5),
        arc(0.25, half, distance=5.0, bearing=1.3, rows=10, n=14, height=1.5, lean=(0.1, 0.05)),
        arc(0.12, half, distance=3.0, bearing=-0.8, rows=10, n=10, height=1.5),
        arc(0.13, half, distance=3.35, bearing=-0.82, rows=10, n=10, height=1.5),
        arc(0.20, 0.4, distance=6.0, bearing=2.6, rows=6, n=8, height=0.4),
    ]
    wall = np.stack(np.meshgrid([-4.0], np.linspace(-2, 1, 20), np.linspace(0, 1.5, 6)), -1).reshape(-1, 3)
    bush = rng.normal([2.5, 3.5, 0.6], [0.25, 0.25, 0.2], (60, 3))
    objects = np.concatenate([*stems, wall, bush]) + rng.normal(0.0, 0.008, (sum(map(len, stems)) + 180, 3))
    bearing, reach = np.meshgrid(np.linspace(-np.pi, np.pi, 30, endpoint=False), [1.5, 2.5, 4.0, 6.0, 8.0])
    x, y = reach.ravel() * np.cos(bearing.ravel()), reach.ravel() * np.sin(bearing.ravel())
    slope = np.stack([x, y, -0.5 + 0.05 * x], axis=1) + rng.normal(0.0, 0.01, (x.size, 3))
    return np.concatenate([objects, slope])


def scanned(points: np.ndarray, *, name: str = "forest", sensor: Sensor = SENSOR, **parameters: Any) -> Any:
    """Return clusters, detections, clearance and counts of one scan."""
    p = preset(name).replace({key.replace("__", "."): value for key, value in parameters.items()})
    one = step(0, points, Pose2(), roll=0.02, pitch=-0.03, tilt_known=True)
    found = segment(one, sensor, Pose3.from_euler(np.array([0.1, -0.15, 0.2]), 0.0, 0.0, 0.1), p)
    return {
        "clusters": detect(found, p.detection).clusters,
        "detections": detect(found, p.detection).detections,
        "labels": found.labels[::7],
        "free": found.free[::9],
        "heights": found.heights,
        "clearance": found.clearance,
        "counts": found.counts,
        "warnings": found.warnings,
    }


def walls_of(bearings: int) -> np.ndarray:
    """Return a scan of a planar laser: stems before a distant wall, shape (N, 3) [m]."""
    bearing = np.linspace(-np.pi, np.pi, bearings, endpoint=False)
    reach = np.full(bearings, 9.0)
    for at, distance, radius in ((0.4, 4.0, 0.2), (1.9, 6.0, 0.3), (-2.0, 3.0, 0.15), (-2.12, 3.5, 0.2)):
        off = distance * np.sin(bearing - at)
        hit = (np.abs(off) < radius) & (np.cos(bearing - at) > 0.0)
        near = distance * np.cos(bearing - at) - np.sqrt(np.maximum(radius**2 - off**2, 0.0))
        reach = np.where(hit, np.minimum(reach, near), reach)
    return np.stack([reach * np.cos(bearing), reach * np.sin(bearing), np.zeros(bearings)], axis=1)


def past_points(scans: int = 8) -> dict[str, Any]:
    """Map scans of a grove from a robot that drives by, and return its trees and tracks."""
    p = preset("forest").replace({"classification.method": "none", "slam.particles": 6})
    mapper = Mapper(p, sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=3)
    rng, frame = np.random.default_rng(8), None
    for k in range(scans):
        pose = Pose2(0.3 * k, -0.05 * k, 0.04 * k)
        points = grove(k)
        points = np.column_stack([pose.inverse().apply(points[:, :2]), points[:, 2]])
        frame = mapper.process(step(k, points, pose @ Pose2(*rng.normal(0.0, 0.01, 3))))
    assert frame
    return {"trees": frame.trees, "tracks": mapper.snapshot().tracks, "estimate": frame.estimate}


#: Scans by name.
SCANS: dict[str, Callable[[], Any]] = {
    "grove": lambda: scanned(grove()),
    "grove, other noise": lambda: scanned(grove(1), shape__split_slices=3, filters__voxel_size=0.05),
    "grove, all as trees": lambda: scanned(
        grove(2), detection__arc_min=10.0, detection__size_max=3.0, detection__whole=False
    ),
    "grove, clusters in 3D": lambda: scanned(
        grove(), clustering__dimensions=3, clustering__eps=0.25, clustering__min_points=5
    ),
    "grove, centroids": lambda: scanned(grove(), shape__centre="centroid", shape__split_slices=0),
    "planar laser": lambda: scanned(walls_of(360), name="laser2d", sensor=PLANAR),
    "planar laser, arcs": lambda: scanned(
        walls_of(720), name="laser2d", sensor=PLANAR, clustering__eps=0.3, detection__arc_min=20.0
    ),
    "past a grove": past_points,
}

RUNS = {**DRIVES, **SCANS}


@cache
def stored() -> dict[str, Any]:
    """Return the stored results."""
    results: dict[str, Any] = json.loads(STORED.read_text(encoding="utf-8"))
    return results


@pytest.mark.parametrize("name", RUNS)
def test_a_small_run_has_the_stored_results(name):
    found = list(differences(plain(RUNS[name]()), stored()[name]))
    assert not found, f"{len(found)} differences, the first: {found[:5]}"


def test_each_stored_result_has_its_run():
    assert stored().keys() == RUNS.keys()


if __name__ == "__main__":
    lines = [f"{json.dumps(name)}: {json.dumps(plain(run()))}" for name, run in RUNS.items()]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
