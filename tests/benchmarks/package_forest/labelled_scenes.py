"""Training examples of simulated scenes with their ground truth, and of folders of scans with a label per
point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np

from app.extensions.learning.examples import UNKNOWN, Examples
from pipeline.classification import ColumnClassifier, ScanView, view_by_direction
from pipeline.classification.forest import CLASSES, DecisionTrees, Forest
from pipeline.config import Parameters
from pipeline.detection.free_space import clear_range
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground import scan_ground
from pipeline.ground.scan_ground import height_above
from pipeline.io.readers import open_source
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquire
from pipeline.simulation.run import open_run
from pipeline.simulation.scenarios import RunRequest, Scenario, parse_uri
from pipeline.types.records import HIDDEN, Columns, Float, Float32, Int, Sensor, Step, TruthTrees, Verdict
from tests.benchmarks.package_forest.street_scenes import simulate_street

# Numbers of scans after which examples are taken, besides the end: trees are classified from the first scan
# on.
MARKS = (1, 2, 3, 8, 40, 100)
LEAST_RETURNS = 30  # of a trunk that counts as a tree
SAME, DOUBT = 0.3, 0.6  # m; a column within SAME of a trunk is a tree, its class is unknown up to DOUBT
# Classes of SemanticKITTI by the kind of the parts of simulated objects.
LABELS = {
    "vehicle": 10, "person": 30, "building": 50, "fence": 51, "foliage": 70, "trunk": 71, "ground": 72,
    "pole": 80, "sign": 81,
}  # fmt: skip
TRUNK = LABELS["trunk"]
KIND_OF_LABEL = {TRUNK: Verdict.TREE, 80: Verdict.POLE, 81: Verdict.POLE, 30: Verdict.PERSON, 70:
Verdict.BUSH,
                 50: Verdict.WALL, 51: Verdict.WALL, 52: Verdict.WALL}  # fmt: skip
# Numbers of poles, standing persons, bushes, boxes and walking persons of stands with many objects that are
# not trees.
FURNISHED = {"stand": (24, 6, 12, 5, 2), "slope": (24, 6, 12, 5, 2), "dense": (12, 4, 12, 2, 1)}
REACH_OF_KIND = {"pole": 0.35, "person": 0.5, "bush": 0.9, "other": 1.3}
_VERDICT_OF_KIND = {
    "pole": Verdict.POLE, "person": Verdict.PERSON, "bush": Verdict.BUSH, "other": Verdict.WALL,
}  # fmt: skip


class FurnishedStand(RunRequest):
    """A run through a stand of FURNISHED with more objects that are not trees."""

    @property
    def scenario(self) -> Scenario:
        """The scenario with the objects."""
        poles, standing, bushes, boxes, walking = FURNISHED[self.name]
        plain = super().scenario
        return replace(plain, poles=poles, standing=standing, bushes=bushes, boxes=boxes, walking=walking)


class UprightStand(RunRequest):
    """A run through a stand of stems without lean, which are as upright as its poles."""

    @property
    def scenario(self) -> Scenario:
        """The scenario without lean."""
        return replace(super().scenario, lean=0.0)


class FurnishedUprightStand(UprightStand, FurnishedStand):
    """A run through a stand of FURNISHED with stems without lean."""


# Requests by whether the stand is furnished, and whether its stems are upright.
STANDS = {
    (False, False): RunRequest,
    (True, False): FurnishedStand,
    (False, True): UprightStand,
    (True, True): FurnishedUprightStand,
}


def columns_of(
    run: Iterable[Step], sensor: Sensor, T_base_lidar: Pose3, parameters: Parameters
) -> Iterator[Columns]:
    """Yield the columns of a run that is mapped with the poses of its odometry, each time that the number of
    scans is one of MARKS, and at the end. A scan that is equal to the one before is skipped and not counted.
    A step without a pose is at the origin.

    Args:
        run: Steps with the poses.
        sensor, T_base_lidar: The LiDAR and its pose on the robot.
        parameters: Parameters of acquisition, ground and classification.
    """
    taken = 0
    gathering = ColumnClassifier(parameters.classification, all_around=sensor.rings > 0, forests=_no_forest)
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
        steepest, depth = view_by_direction(raw, offset, sensor.rings > 0)
        pose = step.T_odom_base or Pose2()
        view = ScanView(pose, offset, free, steepest, depth, terrain.height)
        gathering.add(raw, height, step.index, view)
        taken += 1
        if taken in MARKS:
            yield gathering.columns
    if taken not in MARKS:
        yield gathering.columns


def street_examples(seed: int, one_way: bool, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Yield the examples of a simulated street or park, see `simulate_street` and `examples_by_points`.

    Args:
        seed: Seed of the scene.
        one_way: Whether the sensor looks one way, in a park; otherwise it sees all around, in a street.
        parameters: See `columns_of`.
        reach: Distance from the origin within which columns become examples [m].
    """
    street = simulate_street(seed, one_way=one_way)
    name = f"{'park' if one_way else 'street'} {seed}"
    points, kinds = street.points, np.unique(street.kind)
    label = np.array([LABELS[kind] for kind in kinds.tolist()])[np.searchsorted(kinds, street.kind)]
    sure, any_trunk = street.trunk[street.returns >= LEAST_RETURNS], street.trunk[street.returns > 0]
    found = columns_of(street.steps, street.sensor, street.T_base_lidar, parameters)
    yield from examples_by_points(found, points, label, (sure, any_trunk), reach, (name, True, not one_way))


def stand_examples(
    uri: str, parameters: Parameters, every: int, *, furnished: bool = False, upright: bool = False
) -> Iterator[Examples]:
    """Yield the examples of a simulated run, with classes by its ground truth, see `columns_of` for their
    times.

    Args:
        uri: Address of the run, `sim:`.
        parameters: See `columns_of`.
        every: Only each scan whose number is a multiple of it is simulated.
        furnished: Whether objects that are not trees are added to the scene.
        upright: Whether the stems have no lean.
    """
    request = STANDS[furnished, upright](*astuple(parse_uri(uri)))
    source = SimulatedSource(uri, open_run(request))
    about, truth = source.description, source.run.true_trees()
    run, around = steps(source.records(every=every)), about.sensor.rings > 0
    for columns in columns_of(run, about.sensor, about.T_base_lidar, parameters):
        label = label_by_truth(columns.axis, truth)
        name = stand_name(uri, furnished, upright)
        yield Examples(name, True, around, columns.axis, columns.figures, label)


def stand_name(uri: str, furnished: bool, upright: bool) -> str:
    """Return the name of the scene of a simulated run."""
    return "upright " * upright + "furnished " * furnished + uri


def label_by_truth(axis: Float, truth: TruthTrees) -> Int:
    """Return the class of each column by the objects of the ground truth near it, as indices in CLASSES,
    int64, shape (K,): OTHER without a near object, and UNKNOWN if a tree or a hidden tree is near but not at
    the column.

    Args:
        axis: Columns, x, y first [m].
        truth: Ground truth in the same frame.
    """
    label = np.full(len(axis), CLASSES.index(Verdict.OTHER), np.int64)
    place = np.stack([truth.x, truth.y], axis=1)
    kind = np.array(truth.kind)
    for name, reach in REACH_OF_KIND.items():
        near = _distance(axis, place[kind == name]) < reach
        label[near] = CLASSES.index(_VERDICT_OF_KIND[name])
    to_tree = _distance(axis, place[kind == "tree"])
    label[(to_tree >= SAME) & (to_tree < DOUBT)] = UNKNOWN
    label[_distance(axis, place[kind == HIDDEN]) < DOUBT] = UNKNOWN
    label[to_tree < SAME] = CLASSES.index(Verdict.TREE)
    return label


def labelled_examples(folder: Path, parameters: Parameters, reach: float) -> Iterator[Examples]:
    """Yield the examples of scans from one place (`velodyne/*.bin`, `labels/*.label`), or of one pair of
    files, with classes by their labels; the sensor does not move.

    Args:
        folder: The scans, see `labelled_scans`.
        parameters: See `columns_of`.
        reach: Distance from the sensor within which columns become examples [m].
    """
    points, label = labelled_points(folder)
    of_trunks = trunks(points, label, LEAST_RETURNS, np.inf), trunks(points, label, 1, np.inf)
    with closing(open_source(str(folder))) as source:
        about = source.description
        run = steps(source.records(), odometry="static")
        found = columns_of(run, about.sensor, about.T_base_lidar, parameters)
        named = (str(folder), False, about.sensor.rings > 0)
        yield from examples_by_points(found, points, label, of_trunks, reach, named)


def examples_by_points(
    found: Iterable[Columns],
    points: Float,
    label: Int,
    of_trunks: tuple[Float, Float],
    reach: float,
    named: tuple[str, bool, bool],
    centre: tuple[float, float] = (0.0, 0.0),
) -> Iterator[Examples]:
    """Yield the examples of columns within a radius, with classes by labelled points; one set for each
    element of `found`.

    Args:
        found: Columns at several times.
        points, label: See `labelled_points`.
        of_trunks: Positions of trunks with LEAST_RETURNS returns, and of all trunks, see `label_by_points`.
        reach, centre: Radius and centre of the circle [m].
        named: `scene`, `simulated` and `all_around` of the examples.
    """
    for columns in found:
        near = np.hypot(columns.axis[:, 0] - centre[0], columns.axis[:, 1] - centre[1]) < reach
        axis, figures = columns.axis[near], columns.figures[near]
        yield Examples(*named, axis, figures, label_by_points(axis, points, label, *of_trunks))


def labelled_points(folder: Path) -> tuple[Float, Int]:
    """Return all points, float64, shape (N, 3) [m], of a place and their labels, shape (N,); returns at the
    origin are left out. Raises the errors of `labelled_scans`."""
    scans = labelled_scans(folder)
    cloud = np.concatenate([points for points, _ in scans]).astype(np.float64)
    return cloud, np.concatenate([label for _, label in scans])


def labelled_scans(folder: Path) -> list[tuple[Float32, Int]]:
    """Return points, float32, shape (N, 3) [m], and labels, int64, shape (N,), of each scan of a place.

    Points are in the frame of the files; those at the origin, which are no returns, are left out. A label is
    the class, the lower 16 bits of the number in the file.

    Args:
        folder: Folder with `velodyne/*.bin` and `labels/*.label`, read in the order of their names, or one
            .bin file with a .label file next to it.

    Raises:
        OSError, ValueError, IndexError: A file cannot be read, or points and labels do not match.
    """
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
    """Return the middles, shape (N, 2) [m], of the labelled trunks: groups of points of class TRUNK, linked
    at 0.3 m. Shape (0, 2) without such points.

    Args:
        points, label: See `labelled_points`.
        least: Minimum number of points of a trunk.
        reach: Maximum distance of a middle from the origin [m].
    """
    from sklearn.cluster import DBSCAN

    cloud = points[label == TRUNK]
    if len(cloud) == 0:
        return np.zeros((0, 2))
    group = DBSCAN(eps=0.3, min_samples=1).fit(cloud).labels_
    size = np.bincount(group)
    middle = np.stack([np.bincount(group, cloud[:, a]) / size for a in range(2)], axis=1)
    return np.asarray(middle[(size >= least) & (np.hypot(middle[:, 0], middle[:, 1]) <= reach)])


def label_by_points(axis: Float, points: Float, label: Int, sure: Float, any_trunk: Float) -> Int:
    """Return the class of each column, as indices in CLASSES, int64, shape (K,): TREE within SAME of a sure
    trunk; UNKNOWN near a trunk but not at it; otherwise the most frequent labelled class within 0.35 m, OTHER
    without one.

    Args:
        axis: Axes of the columns, shape (K, 5).
        points, label: See `labelled_points`.
        sure, any_trunk: Positions (T, 2) [m] of trunks with LEAST_RETURNS returns, and of all trunks.
    """
    from scipy.spatial import cKDTree

    kind = np.full(len(axis), CLASSES.index(Verdict.OTHER), np.int64)
    tree = cKDTree(points[:, :2])
    for k, rows in enumerate(tree.query_ball_point(axis[:, :2], 0.35)):
        names, counts = np.unique(label[rows], return_counts=True)
        order = [int(names[i]) for i in np.argsort(-counts, kind="stable") if names[i] in KIND_OF_LABEL]
        order = [name for name in order if name != TRUNK]
        if order:
            kind[k] = CLASSES.index(KIND_OF_LABEL[order[0]])
    to_tree, to_any = _distance(axis, sure), _distance(axis, any_trunk)
    kind[(to_tree >= SAME) & (to_any < 0.5)] = UNKNOWN
    kind[(to_tree >= SAME) & (to_tree < DOUBT)] = UNKNOWN
    kind[to_tree < SAME] = CLASSES.index(Verdict.TREE)
    return kind


def _distance(axis: Float, place: Float) -> Float:
    """Return the distance of each column, shape (K,) [m], from the nearest position; infinite without
    positions.

    Args:
        axis: Columns, x, y first [m].
        place: Positions, shape (N, 2) [m].
    """
    if len(place) == 0:
        return np.full(len(axis), np.inf)
    from scipy.spatial import cKDTree

    distance: Float = cKDTree(place).query(axis[:, :2])[0]
    return distance


def _no_forest(_name: str, _all_around: bool) -> Forest:
    """Return a forest of one leaf with equal shares, because features do not depend on the forest."""
    none = np.full(1, -1, np.int32)
    zero = np.zeros(1, np.int32)
    shares = np.full((1, len(CLASSES)), 1.0 / len(CLASSES))
    return Forest(DecisionTrees(zero, none, np.zeros(1), zero.copy(), zero.copy(), shares))
