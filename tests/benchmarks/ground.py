"""Accuracy of the ground of a scan: `python -m tests.benchmarks.ground [park] [street] [sim] [time]`.

park, street: scans with a label a point. Recall: labelled ground within 0.2 m of the terrain; precision: what
is labelled ground of all labelled points within 0.2 m of it; trunks: the terrain under each labelled trunk
against a plane through the labelled ground within a metre of it, pooled over the scans of a place.
sim: terrain that is known exactly, at every return near the ground and under every tree within 20 m that
the scan saw.
time: CPU of the thread, from the scan to the height of each point.
In park, street and time, `pypatchworkpp` is the peer, with its defaults except for the height of the sensor,
which it is given and we find. It labels points as ground instead of giving them heights.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.ground.scan_ground import find_terrain, height_above
from pipeline.io.readers import open_source
from pipeline.io.readers.simulated import open_simulated
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquire
from pipeline.types.records import Bool, Float, Float32, Int
from tests.benchmarks.package_forest.labelled_scenes import labelled_points, trunks

DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data"))
GROUND = (40, 44, 48, 49, 72)
NEAR, REACH, AROUND = 0.2, 25.0, 1.0
STEM, SHOWS = 0.35, 5  # m, returns; a trunk with fewer of them near its axis is not seen
P = preset("forest")


def main() -> None:
    """Run the requested measurements."""
    parts: dict[str, Callable[[], None]] = {
        "park": _park, "street": _street, "sim": _sim, "time": _time,
    }  # fmt: skip
    for part in sys.argv[1:] or parts:
        parts[part]()


def heights(points: Float32, places: Float) -> tuple[Float32, Float]:
    """Return the height of each point above the terrain of its scan, and the height of the terrain at
    positions (K, 2)."""
    terrain = find_terrain(points, P.ground)
    level = np.column_stack([places, np.zeros(len(places))]).astype(np.float32)
    return height_above(points, terrain), -height_above(level, terrain).astype(np.float64)


def _park() -> None:
    for name in ("00", "02", "04", "06"):
        _labelled(f"park {name}", DATA / "park_trunks" / name)


def _street() -> None:
    _labelled("street", DATA / "semantickitti" / "000000.bin")


def _labelled(name: str, place: Path) -> None:
    cloud, kinds = labelled_points(place)
    stems = trunks(cloud, kinds, 30, REACH)
    floor = cloud[np.isin(kinds, GROUND)]
    true = np.array([_plane_at(floor, stem) for stem in stems])
    right, ground, near, errors = 0, 0, 0, []
    for points, kind in _scans(place):
        above, under = heights(points, stems)
        is_ground, told = np.isin(kind, GROUND), kind > 1
        close = np.abs(above) < NEAR
        right += int(np.count_nonzero(close & is_ground))
        ground += int(np.count_nonzero(is_ground))
        near += int(np.count_nonzero(close & told))
        errors.append(under - true)
    print(f"{name}: recall {right / ground:.4f}, precision {right / near:.4f}, trunks {_spread(errors)}")
    _labelled_by_peer(name, place)


def _labelled_by_peer(name: str, place: Path) -> None:
    right, ground, said = 0, 0, 0
    first, kind = next(_scans(place))
    label = _peer(-float(np.median(first[np.isin(kind, GROUND)][:, 2])))
    for points, kind in _scans(place):
        is_ground, told = np.isin(kind, GROUND), kind > 1
        close = label(points)
        right += int(np.count_nonzero(close & is_ground))
        ground += int(np.count_nonzero(is_ground))
        said += int(np.count_nonzero(close & told))
    print(f"{name}, pypatchworkpp: recall {right / ground:.4f}, precision {right / said:.4f}")


def _peer(height: float) -> Callable[[Float32], Bool]:
    """Return a function that labels the ground in the points of a scan by Patchwork++ (Lee et al. 2022).

    Args:
        height: Height of the sensor above the ground [m].
    """
    import pypatchworkpp

    settings = pypatchworkpp.Parameters()
    settings.sensor_height, settings.verbose, settings.enable_RNR = height, False, False  # no intensities
    engine = pypatchworkpp.patchworkpp(settings)

    def label(points: Float32) -> Bool:
        engine.estimateGround(np.column_stack([points, np.zeros(len(points), np.float32)]))
        found = np.zeros(len(points), bool)
        found[np.asarray(engine.getGroundIndices(), np.int64)] = True
        return found

    return label


def _scans(place: Path) -> Iterator[tuple[Float32, Int]]:
    files = [place] if place.is_file() else sorted((place / "velodyne").glob("*.bin"))
    for file in files:
        label = file.with_suffix(".label")
        label = label if place.is_file() else place / "labels" / label.name
        points = np.ascontiguousarray(np.fromfile(file, "<f4").reshape(-1, 4)[:, :3])
        kind = np.fromfile(label, "<u4").astype(np.int64) & 0xFFFF
        kept = _in_range(points)
        yield points[kept], kind[kept]


def _in_range(points: Float32) -> Bool:
    distance = np.linalg.norm(points, axis=1)
    inside: Bool = (distance >= P.acquisition.range_min) & (distance <= P.acquisition.range_max)
    return inside


def _plane_at(floor: Float, place: Float) -> float:
    """Height at a place of the plane through the ground around it; NaN where too little is seen."""
    there = floor[np.hypot(floor[:, 0] - place[0], floor[:, 1] - place[1]) < AROUND]
    if len(there) < 10:
        return float("nan")
    design = np.column_stack([np.ones(len(there)), there[:, :2] - place])
    return float(np.linalg.lstsq(design, there[:, 2], rcond=None)[0][0])


def _near(points: Float32, stem: Float) -> Bool:
    near: Bool = np.hypot(points[:, 0] - stem[0], points[:, 1] - stem[1]) < STEM
    return near


def _spread(errors: list[Float]) -> str:
    error = np.concatenate(errors) if errors else np.zeros(0)
    error = error[np.isfinite(error)]
    if len(error) == 0:
        return "-"
    rms = np.sqrt(np.mean(np.square(error)))
    worst = np.quantile(np.abs(error), 0.95)
    bias = error.mean()
    return f"RMSE {100 * rms:.1f} cm, bias {100 * bias:+.1f}, 95 % within {100 * worst:.0f} ({len(error)})"


def _sim() -> None:
    for name in ("stand", "slope", "dense"):
        for seed in (1, 2):
            _simulated(f"sim:{name}?seed={seed}&odometry=exact&duration=60")


def _simulated(uri: str) -> None:
    source = open_simulated(uri)
    run, truth = source.run, source.run.scene.truth
    trees = np.stack([truth.x, truth.y], axis=1)[np.array(truth.kind) == "tree"]
    at_points, at_trunks = [], []
    for step in steps(source.records()):
        if step.index % 20:
            continue
        raw, offset = acquire(step, source.description.T_base_lidar, P.acquisition)
        pose = step.T_odom_base or Pose2()
        seconds = step.index * run.lidar.period_ns * 1e-9
        z = float(run.motion.sensor_at(np.array([seconds]), run.T_base_lidar)[1][0, 2])
        stems = pose.inverse().apply(trees) - offset[:2]
        stems = stems[np.hypot(stems[:, 0], stems[:, 1]) < 20.0]
        above, under = heights(raw, stems)
        world = pose.apply(raw[:, :2].astype(np.float64) + offset[:2])
        true = raw[:, 2] + z - run.scene.terrain.height(world[:, 0].copy(), world[:, 1].copy())
        low = (np.abs(true) < 0.1) & (np.hypot(raw[:, 0], raw[:, 1]) < 20.0)
        at_points.append((true - above)[low])
        stood = (true > 0.2) & (true < 2.0)
        seen = np.array([np.count_nonzero(_near(raw[stood], stem)) >= SHOWS for stem in stems], bool)
        there, under = pose.apply(stems[seen] + offset[:2]), under[seen]
        at_trunks.append(under + z - run.scene.terrain.height(there[:, 0].copy(), there[:, 1].copy()))
    print(f"{uri}: returns {_spread(at_points)}; trunks {_spread(at_trunks)}")


def _time() -> None:
    source = open_source("sim:stand?duration=4")
    scans = [acquire(s, source.description.T_base_lidar, P.acquisition)[0] for s in steps(source.records())]
    street = next(_scans(DATA / "semantickitti" / "000000.bin"))[0]
    for name, clouds in (("sim:stand", scans), ("street", [street] * 30)):
        find, above = [], []
        for points in clouds * 3:
            begin = time.thread_time()
            terrain = find_terrain(points, P.ground)
            middle = time.thread_time()
            height_above(points, terrain)
            find.append(middle - begin)
            above.append(time.thread_time() - middle)
        n = int(np.median([len(points) for points in clouds]))
        print(
            f"{name}: {n} points, terrain {1e3 * np.median(find):.3f} ms, "
            f"heights {1e3 * np.median(above):.3f} ms CPU (medians)"
        )
        label, taken = _peer(1.7), []
        for points in clouds * 3:
            begin = time.thread_time()
            label(points)
            taken.append(time.thread_time() - begin)
        print(f"{name}, pypatchworkpp: ground {1e3 * np.median(taken):.3f} ms CPU (median)")


if __name__ == "__main__":
    main()
