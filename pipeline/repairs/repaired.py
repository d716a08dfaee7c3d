"""The map with repairs: one function from the results of the mapper to those that people see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.columns import rows_of
from pipeline.geometry.pose_arrays import PathCorrection, rotated_rows
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.repairs.loops import LoopRepair, corrected_from, with_loops
from pipeline.repairs.record import Repair, tied_numbers
from pipeline.repairs.trees import merged_trees, number_beside, numbers_of, repaired_trees
from pipeline.slam.keyframe_graph import TWICE, KeyframeGraph
from pipeline.types.records import Bool, Columns, Frame, HeightMap, Int, Path, PoseEstimate, Trees

#: Distance between detections of one stem at the repaired path [m]; also between a tree and its detections
#: below which it stays where it is.
OF_STEM, STAYS = 0.5, 0.1
LEAST_VIEWS = 3  # keyframes that detect a stem, at least, which a wrong path had mixed with another one


@dataclass(frozen=True, slots=True, eq=False)
class MapOfRun:
    """What the mapper knows after a scan.

    Attributes:
        frame: Results of the scan.
        path: Path up to it.
        graph: Keyframes up to it; without keyframes, loops cannot be repaired.
        landmark: Birth number of the landmark of each tree of the frame, int64, shape (T,); -1 for none.
    """

    frame: Frame
    path: Path
    graph: KeyframeGraph
    landmark: Int


@dataclass(frozen=True, slots=True, eq=False)
class RepairedMap:
    """The results with repairs.

    Attributes:
        frame, path: As in `MapOfRun`, repaired.
        problems: Why each repair does not apply; "" if it does.
        numbers: Numbers of the trees that each repair is about, in the order of its positions: of trees of
            the map before it, and of "tie" before all repairs. Trees that are not found are left out.
        agreeing: For each applied "tie", how many stems agree with it, of how many, see `LoopRepair`; () for
            other repairs.
        loops: Numbers of the scans of both ends of each loop of the path, int64, shape (L, 2).
        correction: Correction of the path; None if it is unchanged.
    """

    frame: Frame
    path: Path
    problems: tuple[str, ...]
    numbers: tuple[tuple[int, ...], ...]
    agreeing: tuple[tuple[int, ...], ...]
    loops: Int
    correction: PathCorrection | None


def loops_of(graph: KeyframeGraph) -> Int:
    """Return the numbers of the scans of both ends of each loop, int64, shape (L, 2)."""
    return np.array([loop.scans for loop in graph.loops], np.int64).reshape(-1, 2)


class Repairer:
    """Applies repairs to the results of one run; the same results and repairs give the same map.

    The repair of the loops is remembered, since it takes up to a second. While the run goes on it is
    extended, and computed again once the graph has grown by the share GROWN.
    """

    def __init__(self) -> None:
        self._known: tuple[tuple[Repair, ...], KeyframeGraph, Path, LoopRepair] | None = None

    def repaired(self, run: MapOfRun, repairs: Sequence[Repair], *, hurried: bool = False) -> RepairedMap:
        """Return the results with repairs, in their order; those of loops apply before those of trees.

        Args:
            run: The results; unchanged.
            repairs: The repairs.
            hurried: Whether an earlier repair of the loops may be extended.
        """
        frame, path, correction, loops = run.frame, run.path, None, loops_of(run.graph)
        of_loop: Iterator[tuple[str, tuple[int, ...]]] = iter(())
        if of_loops := tuple(repair for repair in repairs if repair.is_of_loop):
            fixed, known = self._loops(run, of_loops, hurried=hurried)
            loops, of_loop = loops_of(fixed.graph), zip(fixed.problems, fixed.agreeing, strict=True)
            if "" in fixed.problems:
                correction = corrected_from(_poses(known), fixed.path, _poses(path))
                x, y, yaw = (column.copy() for column in correction.after.T)
                path = Path(path.stamp_ns, x, y, yaw, path.sigma_xy)
                frame = _moved_frame(frame, _moved_trees(run, correction), correction)
        problems, numbers, trees = list[str](), list[tuple[int, ...]](), frame.trees
        agreeing = list[tuple[int, ...]]()
        for repair in repairs:
            if repair.is_of_loop:
                problem, agree = next(of_loop)
                agreeing.append(agree)
                numbers.append(tied_numbers(run.frame.trees, run.path, repair))
            else:
                numbers.append(numbers_of(trees, repair))
                trees, problem = repaired_trees(trees, repair)
                agreeing.append(())
            problems.append(problem)
        return RepairedMap(
            replace(frame, trees=trees),
            path,
            tuple(problems),
            tuple(numbers),
            tuple(agreeing),
            loops,
            correction,
        )

    def _loops(self, run: MapOfRun, repairs: tuple[Repair, ...], *, hurried: bool) -> tuple[LoopRepair, Path]:
        """Return the repair of the loops and the path before it, which may be that of an earlier scan."""
        if self._known is not None:
            of, graph, path, fixed = self._known
            slow = hurried and len(run.graph.keyframes) < (1.0 + GROWN) * len(graph.keyframes)
            # A loop that the mapper closed meanwhile has changed the path, to which no correction is known.
            slow = slow and np.array_equal(loops_of(graph), loops_of(run.graph))
            ends = max(stamp for repair in repairs for stamp in repair.stamps_ns)
            reached = ends <= path.stamp_ns[-1] or ends > run.path.stamp_ns[-1]
            if of == repairs and len(path.x) <= len(run.path.x) and reached and (graph is run.graph or slow):
                return fixed, path
        fixed = with_loops(run.graph, run.path, repairs)
        self._known = (repairs, run.graph, run.path, fixed)
        return fixed, run.path


GROWN = 0.1  # share of new keyframes after which the loops of a playing run are solved again


def _poses(path: Path) -> Float:
    """Return the poses of a path, x, y [m], yaw [rad], shape (N, 3)."""
    return np.column_stack([path.x, path.y, path.yaw])


def _moved_trees(run: MapOfRun, correction: PathCorrection) -> Trees:
    """Return the trees after a repair of the path. A tree with a landmark stands where most of its detections
    are at the repaired path; another one moves with the path. Trees at one place, of which one was seen only
    after the other one, are merged. Where further detections of a landmark are at another place, because the
    path had mixed two stems, a tree without a diameter is added unless one stands there.

    Args:
        run: The results before the repair; unchanged.
        correction: The repair of the path.
    """
    trees, stamps = run.frame.trees, run.path.stamp_ns
    scan = np.minimum(np.searchsorted(stamps, trees.first_seen_ns), len(stamps) - 1)
    position, turn = correction.moved(trees.position, scan)
    birth, place, scans = _detections(run.graph, correction.after)
    order = np.argsort(birth, kind="stable")
    names, begin = np.unique(birth[order], return_index=True)
    row_of = {int(b): k for k, b in enumerate(run.landmark.tolist()) if b >= 0}
    others: list[tuple[int, Float, Int]] = []  # number of the tree, mean and scans of a second stem
    for name, rows in zip(names.tolist(), np.split(order, begin[1:]), strict=True):
        row = row_of.get(name)
        if row is None:
            continue
        stem = _most(place[rows])
        mean = place[rows[stem]].mean(axis=0)
        position[row] = mean if np.hypot(*(mean - trees.position[row])) > STAYS else trees.position[row]
        rest = rows[~stem]
        if len(rest) >= LEAST_VIEWS and trees.confirmed[row]:
            second = rest[_most(place[rest])]
            if len(second) >= LEAST_VIEWS:
                others.append((int(trees.number[row]), place[second].mean(axis=0), scans[second]))
    flat = rotated_rows(trees.covariance[:, [0, 0, 1], [0, 1, 1]], turn)
    covariance = flat[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    moved = replace(trees, position=position, covariance=covariance)
    return _with_separated(_joined(moved, trees.position), others, stamps)


def _detections(graph: KeyframeGraph, poses: Float) -> tuple[Int, Float, Int]:
    """Return birth numbers, positions in the map at `poses`, shape (D, 2), and scans of all detections."""
    birth = np.concatenate([k.birth for k in graph.keyframes])
    place = np.concatenate([Pose2(*poses[k.scan].tolist()).apply(k.centre) for k in graph.keyframes])
    return birth, place, np.repeat(graph.scans, [len(k.birth) for k in graph.keyframes])


def _most(place: Float) -> Bool:
    """Return which positions, shape (N, 2), are within OF_STEM of the one with the most others so near, and
    of the first of several; shape (N,), N > 0."""
    near = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1)) <= OF_STEM
    found: Bool = near[int(np.argmax(near.sum(axis=1)))]
    return found


def _joined(trees: Trees, before: Float) -> Trees:
    """Return the trees in which those at one place are merged, the one that was seen first with the other
    one: within OF_STEM if they were not so near before, or within TWICE if one was left before the other one
    was seen.

    Args:
        trees: The trees after the repair.
        before: Their positions before it, shape (T, 2) [m].
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(trees.confirmed)
    pairs = cKDTree(trees.position[rows]).query_pairs(TWICE, output_type="ndarray")
    a, b = rows[pairs[:, 0]], rows[pairs[:, 1]]
    later = trees.first_seen_ns[a] > trees.first_seen_ns[b]
    a, b = np.where(later, b, a), np.where(later, a, b)
    away = np.hypot(*(trees.position[a] - trees.position[b]).T)
    came_near = np.hypot(*(before[a] - before[b]).T) > OF_STEM  # else the mapper has seen two stems there
    same = ((away <= OF_STEM) & came_near) | (trees.last_seen_ns[a] < trees.first_seen_ns[b])
    taken, into, others = set[int](), list[int](), list[int]()
    for k in np.flatnonzero(same)[np.argsort(away[same], kind="stable")].tolist():
        pair = {int(a[k]), int(b[k])}
        if not pair & taken:
            taken |= pair
            into.append(int(a[k]))
            others.append(int(b[k]))
    return merged_trees(trees, np.array(into, np.int64), np.array(others, np.int64))


def _with_separated(trees: Trees, stems: Sequence[tuple[int, Float, Int]], stamps: Int) -> Trees:
    """Return the trees and further ones without diameters.

    Args:
        trees: The trees.
        stems: Position [m] and scans of each further stem, after the number of the tree with which it was
            mixed.
        stamps: Time of each scan [ns].
    """
    found, numbers = list[tuple[Float, Int]](), trees.number
    known = trees.position[trees.confirmed]
    for of, place, scans in stems:
        if not len(known) or np.hypot(*(known - place).T).min() > TWICE:
            found.append((place, scans))
            numbers = np.append(numbers, number_beside(numbers, of))
            known = np.concatenate([known, place[None]])
    if not found:
        return trees
    number = len(trees.number)
    table = rows_of(trees, np.append(np.arange(number), np.zeros(len(found), np.int64)))
    nothing = np.full(len(found), np.nan)
    columns = {
        "number": numbers[number:],
        "position": np.array([place for place, _ in found]),
        "observations": np.array([len(scans) for _, scans in found]),
        "first_seen_ns": stamps[[scans.min() for _, scans in found]],
        "last_seen_ns": stamps[[scans.max() for _, scans in found]],
        "confirmed": np.ones(len(found), np.bool_),
        "coverage": np.zeros(len(found)),
        "sides": np.zeros(len(found), np.int64),
    }
    columns |= dict.fromkeys(("dbh", "dbh_sigma", "eccentricity", "height", "height_sigma", "lean"), nothing)
    changed = {
        name: np.concatenate([column[:number], values])
        for name, values in columns.items()
        if (column := getattr(table, name)) is not None
    }
    return replace(table, **changed)


def _moved_frame(frame: Frame, trees: Trees, correction: PathCorrection) -> Frame:
    """Return the results with a corrected path: the pose with its particles, the columns and the terrain;
    `trees` are corrected already. The reason of the quality of the pose, also of a good one, says that it is
    of the map before the repairs: it follows from what the scans found in that map."""
    health = frame.health
    reason = f"before the repairs: {health.reason}" if health.reason else "before the repairs"
    estimate = replace(frame.estimate, health=replace(health, reason=reason))
    before, after = correction.before[-1], correction.after[-1]
    turn = float(wrap_angle(after[2] - before[2]))
    move = Pose2(*after.tolist()) @ Pose2(*before.tolist()).inverse()
    return replace(
        frame,
        trees=trees,
        estimate=_moved_estimate(estimate, move, turn),
        columns=None if frame.columns is None else _moved_columns(frame.columns, correction),
        ground=None if frame.ground is None else _moved_ground(frame.ground, correction),
    )


def _moved_estimate(estimate: PoseEstimate, move: Pose2, turn: float) -> PoseEstimate:
    """Return a pose that moves rigidly in the map."""
    C = np.eye(3)
    C[:2, :2] = Pose2(0.0, 0.0, turn).rotation()
    particles = np.column_stack(
        [move.apply(estimate.particles[:, :2]), wrap_angle(estimate.particles[:, 2] + turn)]
    )
    relative = None if estimate.relative is None else C @ estimate.relative @ C.T
    return replace(
        estimate,
        T_map_base=move @ estimate.T_map_base,
        covariance=C @ estimate.covariance @ C.T,
        particles=particles,
        landmarks=move.apply(estimate.landmarks),
        relative=relative,
    )


def _nearest_scans(places: Float, path: Float) -> Int:
    """Return the number of the scan nearest to each position, int64, shape (N,)."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(path[:, :2]).query(places)[1], np.int64)


def _moved_columns(columns: Columns, correction: PathCorrection) -> Columns:
    """Return columns that move with the nearest scan; their lean stays."""
    if not len(columns.axis):
        return columns
    axis = columns.axis.copy()
    scans = _nearest_scans(axis[:, :2], correction.before)
    axis[:, :2], _ = correction.moved(columns.axis[:, :2], scans)
    return replace(columns, axis=axis)


def _moved_ground(ground: HeightMap, correction: PathCorrection) -> HeightMap:
    """Return terrain that moves by whole cells with the nearest scan. Of cells that coincide, the one with
    most views stays."""
    if not len(ground.place):
        return ground
    centre: Float = (ground.place.astype(np.float64) + 0.5) * ground.cell
    moved, _ = correction.moved(centre, _nearest_scans(centre, correction.before))
    place = ground.place + np.round((moved - centre) / ground.cell).astype(np.int32)
    order = np.argsort(-ground.views, kind="stable")
    _, first = np.unique(place[order], axis=0, return_index=True)
    rows = order[first]
    return HeightMap(ground.cell, place[rows], ground.height[rows], ground.sigma[rows], ground.views[rows])
