"""Repairs of loops: edges of the keyframe graph that a person adds or forbids, and the path that follows.

A tie says that a stem seen at one scan is the stem seen at another one. The stems around both scans then give
the relative pose: the rotation about the stem at which most of them coincide. The associations that the
drifted path made on the way to the later scan are removed, landmarks that the tie brings to the same position
are joined from the tied scan outwards, and what is left is associated anew, as `FastSlam.close` does.

A forbidden loop is removed, and landmarks that it had joined are separated: from LATELY before the end of the
loop on, only landmarks that were begun there are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.pose_arrays import PathCorrection, composed, inverse
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.loop_closure.detection import LATELY, through
from pipeline.repairs.record import Repair
from pipeline.slam.keyframe_graph import (
    TWICE,
    KeyframeGraph,
    Revisit,
    Solution,
    corrected_path,
)
from pipeline.slam.places import REVISIT_DISTANCE
from pipeline.types.records import Int, Path

#: Path before a tied scan from which on known landmarks are associated anew [m]: half of REVISIT_DISTANCE;
#: and path before and after it whose stems are compared, on which the path hardly bends.
AROUND, COMPARED = 15.0, 5.0
#: Distance between two views of the same stem around a tie [m], as that of a displacement in `detection`.
SAME = 0.5
TURNS = np.radians(np.arange(-180.0, 180.0, 1.0))
CLICK = 0.1  # m, sigma of the position of a tied stem; its centre moves by so much between views
TURN_KNOWN, TURN_UNKNOWN = 0.01, 1.0  # rad, sigma of the rotation of a tie with LEAST stems, and with fewer
LEAST = 3  # stems, with that of the tie, that determine the rotation
STEPS = 4  # of closest points
AGAIN = 1 << 40  # added to the birth numbers of landmarks that a forbidden loop had joined
NEAR_LOOP = 10.0  # m of path between the ends of a loop and the times of the repair that forbids it
OWN = np.diag(np.square([0.05, 0.05, 0.01]))  # m, rad; of a keyframe among its own stems


@dataclass(frozen=True, slots=True, eq=False)
class LoopRepair:
    """A path after the repairs of its loops.

    Attributes:
        graph: The graph with the added loops and without the forbidden ones.
        path: Path x, y [m], yaw [rad] after the repairs, shape (N, 3).
        problems: Why each repair does not apply; "" if it does.
        agreeing: How many stems around each applied tie coincide by its rotation, the tied one among them,
            and of how many: those of the end with fewer stems; () for other repairs.
    """

    graph: KeyframeGraph
    path: Float
    problems: tuple[str, ...]
    agreeing: tuple[tuple[int, ...], ...]


def with_loops(graph: KeyframeGraph, path: Path, repairs: tuple[Repair, ...]) -> LoopRepair:
    """Return the path after repairs of its loops, in their order.

    Args:
        graph: Keyframes of the path, with its loops; unchanged.
        path: The path.
        repairs: Repairs of loops.
    """
    poses = np.column_stack([path.x, path.y, path.yaw])
    graph = replace(graph, pose=poses[graph.scans]) if len(graph.keyframes) else graph
    problems, agreeing, ties = list[str](), list[tuple[int, ...]](), 0
    # Forbidden loops first: an added one is always among the last, which have no kernel.
    for repair in sorted(repairs, key=lambda each: each.kind == "tie"):
        agreeing.append(())
        if len(graph.keyframes) < 2 or max(repair.stamps_ns) > path.stamp_ns[-1]:
            problems.append("the run has not come to this place yet")
            continue
        if min(repair.stamps_ns) < path.stamp_ns[0]:
            problems.append("the run begins after this place")
            continue
        ends = [_keyframe(graph, path, stamp) for stamp in repair.stamps_ns]
        if ends[0] == ends[1]:
            problems.append("both ends are the same part of the path")
            continue
        if repair.kind == "forbid":
            found = _without_loop(graph, path, repair)
            if found is None:
                problems.append("there is no loop between these places")
                continue
            changed, solved = found, found.solve(added=ties)
        else:
            changed, solved, stems = _tied(graph, path, poses, repair, ties)
            agreeing[-1] = stems if solved is not None else ()
        if solved is None:
            problems.append("the graph has no solution with it")
            continue
        poses = corrected_path(poses, changed, solved)
        graph = changed.solved_by(solved)
        ties += repair.kind == "tie"
        problems.append("")
    order = np.argsort([repair.kind == "tie" for repair in repairs], kind="stable")
    given = np.argsort(order).tolist()
    return LoopRepair(graph, poses, tuple(problems[k] for k in given), tuple(agreeing[k] for k in given))


def _without_loop(graph: KeyframeGraph, path: Path, repair: Repair) -> KeyframeGraph | None:
    """Return the graph without the loops whose ends are within NEAR_LOOP of path of the times of a repair;
    None if there is none. Landmarks from before are new ones from LATELY before the end of the loop on."""
    way = np.array([k.distance for k in graph.keyframes])
    wanted = way[[_keyframe(graph, path, stamp) for stamp in repair.stamps_ns]]
    rows = [np.searchsorted(graph.scans, loop.scans) for loop in graph.loops]
    found = [bool((np.abs(way[row] - wanted) <= NEAR_LOOP).all()) for row in rows]
    if not any(found):
        return None
    begin, end = min(wanted), max(wanted)
    cut = int(np.searchsorted(way, max(end - LATELY, 0.5 * (begin + end))))
    first_birth = graph.keyframes[cut].first_birth
    keyframes = list(graph.keyframes)
    for row in range(cut, len(keyframes)):
        k = keyframes[row]
        known = (k.birth < first_birth) | (k.birth >= AGAIN)
        keyframes[row] = replace(k, birth=np.where(known, k.birth + AGAIN, k.birth))
    loops = tuple(loop for loop, is_found in zip(graph.loops, found, strict=True) if not is_found)
    # The poses begin at the odometry, because the minimum with the loop is far from the one without it.
    pose = graph.pose.copy()
    for row in range(cut + 1, len(keyframes)):
        if np.isfinite(keyframes[row].covariance).all():
            pose[row] = composed(pose[row - 1][None], keyframes[row].motion[None])[0]
    return replace(graph, keyframes=tuple(keyframes), loops=loops, pose=pose)


def _keyframe(graph: KeyframeGraph, path: Path, stamp_ns: int) -> int:
    """Return the row of the last keyframe at or before a time, or of the first one."""
    scan = int(np.searchsorted(path.stamp_ns, stamp_ns, side="right")) - 1
    return max(int(np.searchsorted(graph.scans, scan, side="right")) - 1, 0)


def _tied(
    graph: KeyframeGraph, path: Path, poses: Float, repair: Repair, ties: int
) -> tuple[KeyframeGraph, Solution | None, tuple[int, int]]:
    """Return the graph with a tie, its solution (None if there is none), and the numbers of stems of
    `LoopRepair.agreeing`.

    Args:
        graph: The graph with at least two keyframes.
        path, poses: Times and poses of the scans.
        repair: The tie.
        ties: Number of ties before.
    """
    order = np.argsort(repair.stamps_ns, kind="stable")
    rows = [_keyframe(graph, path, repair.stamps_ns[k]) for k in order]
    stems = np.array([_in_map(path, poses, repair.stamps_ns[k], repair.places[k]) for k in order])
    turn, sigma, agreeing = _rotation(graph, poses, rows, stems)
    T_map_stem = Pose2(float(stems[0, 0]), float(stems[0, 1]), turn)
    x, y, yaw = poses[graph.keyframes[rows[1]].scan].tolist()
    T_stem_base = Pose2(x - float(stems[1, 0]), y - float(stems[1, 1]), yaw)
    covariance = np.diag(np.square([CLICK, CLICK, sigma]))
    T_map_base, R = through(T_map_stem, covariance, T_stem_base, OWN)

    way = np.array([k.distance for k in graph.keyframes])
    revisits = _revisits(graph, way[rows])
    whole = graph
    for revisit in revisits:
        graph = graph.without(revisit)
    anchor, end = (graph.keyframes[row].scan for row in rows)
    graph = graph.with_loop(anchor, T_map_base, R, poses, end=end)
    solution = graph.solve(added=ties + 1)
    reach = AROUND
    while solution is not None:
        graph = replace(graph, pose=solution.pose)
        near = [k.birth for k in graph.keyframes if abs(k.distance - way[rows[1]]) <= reach]
        pairs = _same_places(solution, revisits, np.unique(np.concatenate(near)))
        if len(pairs):
            graph = graph.renamed(pairs[:, 0], pairs[:, 1])
            solution = graph.solve(added=ties + 1)
        if reach > way[-1]:
            break
        reach *= 2.0
    if solution is None:
        return whole, None, agreeing
    for revisit in revisits:
        graph = graph.with_known(whole, revisit, solution)
    return graph, replace(graph, pose=solution.pose).solve(added=ties + 1), agreeing


def _revisits(graph: KeyframeGraph, tied: Float) -> list[Revisit]:
    """Return the parts of the path whose associations with landmarks from before are not trusted: those with
    landmarks of the place that the robot left, from where it may have come back to it; and those with all
    landmarks, from AROUND before the later tied keyframe on.

    Args:
        graph: The graph.
        tied: Distances driven until the tied keyframes, ascending, shape (2,) [m].
    """
    way = np.array([k.distance for k in graph.keyframes])
    half = 0.5 * float(tied.sum())
    left = min(tied[0] + REVISIT_DISTANCE, half)
    back = max(float(tied[1]) - AROUND, half)
    begins = ((left, min(left + REVISIT_DISTANCE, back)), (back, back))
    rows = [(int(np.searchsorted(way, known)), begin) for known, begin in begins]
    return [Revisit(graph.keyframes[row].first_birth, begin) for row, begin in rows]


def _in_map(path: Path, poses: Float, stamp_ns: int, place: tuple[float, float]) -> Float:
    """Return the position in the map, shape (2,), of a place in the frame of the robot at a time."""
    scan = max(int(np.searchsorted(path.stamp_ns, stamp_ns, side="right")) - 1, 0)
    return composed(poses[scan][None], np.array([[*place, 0.0]]))[0, :2]


def _rotation(
    graph: KeyframeGraph, poses: Float, rows: list[int], stems: Float
) -> tuple[float, float, tuple[int, int]]:
    """Return the rotation [rad] of the stems around the later of two keyframes onto those around the earlier
    one, about the tied stem, its standard deviation, and how many stems agree, of how many that the sparser
    end has. The rotation is 0 if fewer than LEAST stems agree.

    Args:
        graph: The graph.
        poses: Pose of each scan, shape (N, 3).
        rows: Rows of both keyframes, ascending.
        stems: Positions of the tied stem by each, shape (2, 2) [m].
    """
    from scipy.spatial import cKDTree

    known = _stems_around(graph, poses, rows[0]) - stems[0]
    seen = _stems_around(graph, poses, rows[1]) - stems[1]
    most = min(len(known), len(seen))
    if most < LEAST:
        return 0.0, TURN_UNKNOWN, (1, most)
    tree = cKDTree(known)

    def agreeing(turn: float) -> tuple[Float, Int]:
        away, nearest = tree.query(Pose2(0.0, 0.0, turn).apply(seen))
        return np.asarray(away), np.asarray(nearest)

    # Among equal numbers of stems, the smaller rotation.
    scores = [np.maximum(1.0 - agreeing(float(a))[0] / SAME, 0.0).sum() - 0.2 * abs(a) for a in TURNS]
    turn = float(TURNS[int(np.argmax(scores))])
    for _ in range(STEPS):
        away, nearest = agreeing(turn)
        near = away < SAME
        p, q = seen[near], known[nearest[near]]
        if not len(p):
            break
        turn = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    away, nearest = agreeing(turn)
    found = len(np.unique(nearest[away < SAME]))
    if found < LEAST:
        return 0.0, TURN_UNKNOWN, (found, most)
    return float(wrap_angle(turn)), TURN_KNOWN, (found, most)


def _stems_around(graph: KeyframeGraph, poses: Float, row: int) -> Float:
    """Return the mean positions of the landmarks that keyframes within COMPARED of path of a keyframe detect,
    in the map by the path there, shape (L, 2) [m]."""
    distance = graph.keyframes[row].distance
    near = [k for k in graph.keyframes if abs(k.distance - distance) <= COMPARED]
    birth = np.concatenate([k.birth for k in near])
    place = np.concatenate([Pose2(*poses[k.scan].tolist()).apply(k.centre) for k in near])
    names, of = np.unique(birth, return_inverse=True)
    count = np.bincount(of, minlength=len(names))
    return np.column_stack([np.bincount(of, place[:, a], len(names)) / count for a in range(2)])


def _same_places(solution: Solution, revisits: list[Revisit], near: Int) -> Int:
    """Return pairs of birth numbers, shape (P, 2), the first ascending: landmarks that are among `near` and
    were begun after those that a revisit knows, and these within TWICE of them, one to one; each landmark is
    in pairs of the first such revisit only."""
    from pipeline.evaluation import match

    found: Int = np.zeros((0, 2), np.int64)
    for revisit in revisits:
        free = ~np.isin(solution.birth, found)
        is_known = solution.birth < revisit.first_birth
        young = np.flatnonzero(~is_known & free & np.isin(solution.birth, near))
        old = np.flatnonzero(is_known & free)
        if len(young) and len(old):
            of = match(solution.position[young], solution.position[old], TWICE)
            again = of >= 0
            pairs = np.column_stack([solution.birth[young[again]], solution.birth[old[of[again]]]])
            found = np.concatenate([found, pairs])
    return found[np.argsort(found[:, 0])]


def corrected_from(before: Float, after: Float, path: Float) -> PathCorrection:
    """Return the correction of a path, shape (N, 3), by an earlier one: each scan moves rigidly as the same
    scan of `before` moved to `after`, and later ones as the last."""
    moved = composed(after, inverse(before))
    rows = np.minimum(np.arange(len(path)), len(before) - 1)
    return PathCorrection(path, composed(moved[rows], path))
