"""Scenes to learn from: simulated ones, whose truth is exact, and folders of scans with a label a point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from app.training.fit_forest import DOUBTFUL, Examples
from app.training.stands import furnished_stand
from app.training.streets import simulate_street
from pipeline.classification import Gathering, View, depth_image, steepest_by_direction
from pipeline.classification.forest import CLASSES, Forest
from pipeline.config import Parameters
from pipeline.detection.free_space import clear_range
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground import scan_ground
from pipeline.ground.terrain import height_above
from pipeline.io.readers import open_source
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing.acquisition import acquire
from pipeline.simulation.run import open_run
from pipeline.simulation.uri import parse_uri
from pipeline.types.records import Columns, Float, Float32, Int, Sensor, Step, TruthTrees, Verdict

MARKS = (
    1,
    2,
    3,
    8,
    40,
    100,
)  # scans after which examples are taken too: a map is judged from its first scan on
LEAST_RETURNS = 30  # of a trunk that counts as one
SAME, DOUBT = 0.3, 0.6  # m: a column so near to a trunk is it; up to there nobody can tell
KIND_OF_LABEL = {71: Verdict.TREE, 80: Verdict.POLE, 81: Verdict.POLE, 30: Verdict.PERSON, 70: Verdict.BUSH,
                 50: Verdict.WALL, 51: Verdict.WALL, 52: Verdict.WALL}  # fmt: skip
REACH_OF_KIND = {"pole": 0.35, "person": 0.5, "bush": 0.9, "other": 1.3}
_VERDICT_OF_KIND = {
    "pole": Verdict.POLE, "person": Verdict.PERSON, "bush": Verdict.BUSH, "other": Verdict.WALL,
}  # fmt: skip


def gathered(
    run: Iterable[Step], sensor: Sensor, T_base_lidar: Pose3, parameters: Parameters
) -> Iterator[Columns]:
    """The columns of a run mapped with the poses it tells, after each of MARKS scans and at the end."""
    taken = 0
    gathering = Gathering(parameters.classification, all_around=sensor.rings > 0, forests=_no_forest)
    before = b""
    for step in run:
        repeated = step.scan.points.tobytes()
        if repeated == before:
            continue
        before = repeated
        raw, offset = acquire(step, T_base_lidar, parameters.acquisition)
        terrain = scan_ground.find_terrain(raw, parameters.ground)
        height = height_above(raw, terrain)
        free = clear_range(raw, scan_ground.in_band(raw, height, parameters.ground), offset)
        steepest = steepest_by_direction(raw, offset, sensor.rings > 0)
        pose = step.T_odom_base or Pose2()
        view = View(pose, offset, free, steepest, depth_image(raw), terrain.height)
        gathering.add(raw, height, step.index, view)
        taken += 1
        if taken in MARKS:
            yield gathering.columns
    if taken not in MARKS:
        yield gathering.columns


def _gathered_from_place(folder: Path, parameters: Parameters) -> Iterator[Columns]:
    with closing(open_source(str(folder))) as source:
        about = source.description
        run = steps(source.records(), odometry="static")
        yield from gathered(run, about.sensor, about.T_base_lidar, parameters)


def street_examples(seed: int, one_way: bool, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Of a simulated street or park; see `simulate_street`."""
    street = simulate_street(seed, one_way=one_way)
    name = f"{'park' if one_way else 'street'} {seed}"
    sure, any_trunk = street.trunk[street.seen >= LEAST_RETURNS], street.trunk[street.seen > 0]
    for columns in gathered(street.steps, street.sensor, street.T_base_lidar, parameters):
        near = np.hypot(columns.axis[:, 0], columns.axis[:, 1]) < reach
        axis, figures = columns.axis[near], columns.figures[near]
        label = label_by_points(axis, street.points, street.label, sure, any_trunk)
        yield Examples(name, True, not one_way, axis, figures, label)


def stand_examples(
    uri: str, parameters: Parameters, every: int, *, furnished: bool = False
) -> Iterator[Examples]:
    """Of a simulated run, as it is or with more of what is no tree; of so many scans one is made."""
    source = SimulatedSource(uri, open_run(furnished_stand(uri) if furnished else parse_uri(uri)))
    about, truth = source.description, source.run.scene.truth
    run = steps(source.records(every=every))
    for columns in gathered(run, about.sensor, about.T_base_lidar, parameters):
        label = label_by_truth(columns.axis, truth)
        yield Examples(stand_name(uri, furnished), True, True, columns.axis, columns.figures, label)


def stand_name(uri: str, furnished: bool) -> str:
    """Of the scene of a simulated run."""
    return f"furnished {uri}" if furnished else uri


def label_by_truth(axis: Float, truth: TruthTrees) -> Int:
    """What stands at each column, as places in CLASSES."""
    label = np.full(len(axis), CLASSES.index(Verdict.OTHER), np.int64)
    place = np.stack([truth.x, truth.y], axis=1)
    kind = np.array(truth.kind)
    for name, reach in REACH_OF_KIND.items():
        near = _distance(axis, place[kind == name]) < reach
        label[near] = CLASSES.index(_VERDICT_OF_KIND[name])
    to_tree = _distance(axis, place[kind == "tree"])
    label[(to_tree >= SAME) & (to_tree < DOUBT)] = DOUBTFUL
    label[to_tree < SAME] = CLASSES.index(Verdict.TREE)
    return label


def labelled_examples(folder: Path, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Of a folder of scans from one place (`velodyne/*.bin`, `labels/*.label`), or one such pair of files."""
    points, label = labelled_points(folder)
    all_around = looks_all_around(folder)
    sure, any_trunk = trunks(points, label, LEAST_RETURNS, np.inf), trunks(points, label, 1, np.inf)
    for columns in _gathered_from_place(folder, parameters):
        near = np.hypot(columns.axis[:, 0], columns.axis[:, 1]) < reach
        axis, figures = columns.axis[near], columns.figures[near]
        kind = label_by_points(axis, points, label, sure, any_trunk)
        yield Examples(str(folder), False, all_around, axis, figures, kind)


def looks_all_around(folder: Path) -> bool:
    """Whether the sensor of labelled scans does."""
    with closing(open_source(str(folder))) as source:
        return source.description.sensor.rings > 0


def labelled_points(folder: Path) -> tuple[Float, Int]:
    """All points (N, 3) [m] of a place and their classes; returns at the origin are left out."""
    scans = labelled_scans(folder)
    cloud = np.concatenate([points for points, _ in scans]).astype(np.float64)
    return cloud, np.concatenate([label for _, label in scans])


def labelled_scans(folder: Path) -> list[tuple[Float32, Int]]:
    """The points (N, 3) [m] of each scan of a place, and their classes, as `labelled_points`."""
    if folder.is_file():
        files = [(folder, folder.with_suffix(".label"))]
    else:
        files = [
            (scan, folder / "labels" / f"{scan.stem}.label")
            for scan in sorted((folder / "velodyne").glob("*.bin"))
        ]
    scans = []
    for scan, label in files:
        points = np.fromfile(scan, "<f4").reshape(-1, 4)[:, :3]
        there = np.abs(points).max(axis=1) > 0.0
        scans.append((points[there], (np.fromfile(label, "<u4").astype(np.int64) & 0xFFFF)[there]))
    return scans


def trunks(points: Float, label: Int, least: int, reach: float) -> Float:
    """Middles (N, 2) [m] of the labelled trunks: points of class 71, linked at 0.3 m."""
    from sklearn.cluster import DBSCAN

    cloud = points[label == 71]
    if len(cloud) == 0:
        return np.zeros((0, 2))
    group = DBSCAN(eps=0.3, min_samples=1).fit(cloud).labels_
    size = np.bincount(group)
    middle = np.stack([np.bincount(group, cloud[:, a]) / size for a in range(2)], axis=1)
    return np.asarray(middle[(size >= least) & (np.hypot(middle[:, 0], middle[:, 1]) <= reach)])


def label_by_points(axis: Float, points: Float, label: Int, sure: Float, any_trunk: Float) -> Int:
    """What stands at each column, as places in CLASSES: a trunk, or what most points around it are.

    Args:
        axis: Columns; points, label: see `labelled_points`.
        sure, any_trunk: Places (T, 2) [m] of trunks of LEAST_RETURNS returns, and of all.
    """
    from scipy.spatial import cKDTree

    kind = np.full(len(axis), CLASSES.index(Verdict.OTHER), np.int64)
    tree = cKDTree(points[:, :2])
    for k, rows in enumerate(tree.query_ball_point(axis[:, :2], 0.35)):
        names, counts = np.unique(label[rows], return_counts=True)
        order = [int(names[i]) for i in np.argsort(-counts, kind="stable") if names[i] in KIND_OF_LABEL]
        order = [name for name in order if name != 71]
        if order:
            kind[k] = CLASSES.index(KIND_OF_LABEL[order[0]])
    to_tree, to_any = _distance(axis, sure), _distance(axis, any_trunk)
    kind[(to_tree >= SAME) & (to_any < 0.5)] = DOUBTFUL
    kind[(to_tree >= SAME) & (to_tree < DOUBT)] = DOUBTFUL
    kind[to_tree < SAME] = CLASSES.index(Verdict.TREE)
    return kind


def _distance(axis: Float, place: Float) -> Float:
    """Of each column from the nearest place [m]."""
    if len(place) == 0:
        return np.full(len(axis), np.inf)
    from scipy.spatial import cKDTree

    distance: Float = cKDTree(place).query(axis[:, :2])[0]
    return distance


def _no_forest(_name: str, _all_around: bool) -> Forest:
    """One leaf that knows nothing: the trees are what is being made."""
    none = np.full(1, -1, np.int32)
    zero = np.zeros(1, np.int32)
    return Forest(
        zero, none, np.zeros(1), zero.copy(), zero.copy(), np.full((1, len(CLASSES)), 1.0 / len(CLASSES))
    )
