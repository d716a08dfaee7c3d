"""Loops: whether the trees that were found lately stand on the map already, at another place.

The odometry drifts, and where it drifted by more than the trees stand apart, no association brings the
robot back: it would map the same trees once more. So the constellation of the trees that were begun lately
is looked for among those that were left long ago, as long as the pose is uncertain. What is found must agree
with how far the path can have drifted; else the robot was carried, or the place is another one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.config.stages import Relocalisation
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.loop_closure.stem_matching import Stems, find_constellation
from pipeline.loop_closure.stem_matching.stem_constellation import worst_sigma
from pipeline.slam import Loop
from pipeline.slam.loop_correction import drift_of, without_jumps
from pipeline.slam.motion import Noise
from pipeline.types.records import Int, PoseEstimate, Trees

EVERY = 10  # scans between two searches
UNSURE = 0.4  # m, sigma of the position; who knows it better recognises the trees one by one
RECENT = 300  # scans in which it was unsure
LATELY = 40.0  # m driven, in which what is looked for was begun
REACH = 30.0  # m around the robot
LEAST_HITS = 3
HYPOTHESES = 30_000
LEAST_GAP = 0.5  # m; what is less the particles settle, and the trees recognised one by one
DRIFT = 5.0  # sigma; what lies farther off is no drift
OWN = np.diag(np.square([0.05, 0.05, 0.01]))  # m, rad; of a particle's pose among its own landmarks
LEAST_LEFT = 2  # trees, of those that agree
FARTHEST = 90.0  # m around the robot is searched at the most
SIGMA = 0.1  # m, of a place among its neighbours at the most
# Ties: two scans of one place, and the trees that must have been seen at both times.
TIE_NEAR, TIE_APART, TIE_VIEW, TIE_TREES, TIE_SPACING = 6.0, 30.0, 12.0, 3, 2.0  # m, m, m, -, m


@dataclass(frozen=True, slots=True, eq=False)
class RunHistory:
    """Path and map of a run.

    Attributes:
        stamp_ns: int64, of its scans, shape (N,); path: x, y [m], yaw [rad], shape (N, 3).
        trees: The trees of the map.
        begun_since: Returns the landmarks that were begun at a scan or later, see FastSlam.begun_since.
        estimate: Of the pose at the newest scan; noise: of the odometry.
        motion: By it to each scan from the one before, x, y [m], yaw [rad], shape (N, 3).
        placed: Scan; the path is driven since then, for the robot was put there.
        closed: Scan at which the last loop was closed: until then the path has no drift left to find.
    """

    stamp_ns: Int
    path: Float
    trees: Trees
    begun_since: Callable[[int], tuple[Float, Float]]
    estimate: PoseEstimate
    noise: Noise
    motion: Float
    placed: int
    closed: int = 0

    def scan_of(self, stamp_ns: Int) -> Int:
        """The scans of times."""
        scan: Int = np.minimum(np.searchsorted(self.stamp_ns, stamp_ns), len(self.stamp_ns) - 1)
        return scan


def is_due(index: int, sigma_xy: Float) -> bool:
    """Whether a loop is worth a search after a scan; `sigma_xy`: of the pose at each scan so far [m].

    A pose that was unsure and is not any more may have been made sure by the wrong trees.
    """
    return index % EVERY == 0 and bool(sigma_xy[-RECENT:].max(initial=0.0) > UNSURE)


def find_loop(run: RunHistory, parameters: Relocalisation) -> Loop | None:
    """The loop that the robot has just closed, if it has."""
    way = _way(run.path)
    lately = max(int(np.searchsorted(way, way[-1] - LATELY)), run.placed)
    if lately == 0:
        return None
    here = run.path[-1, :2]
    place, covariance = run.begun_since(lately)
    near = np.hypot(*(place - here).T) < REACH
    if np.count_nonzero(near) < parameters.stems_min:
        return None
    trees = run.trees
    # A tree that a drifted scan took for another one counts as seen then, so it is old by its first view.
    old = (trees.observations >= LEAST_HITS) & (run.scan_of(trees.first_seen_ns) < lately)
    drift = drift_of(run.path, 0, run.noise)
    reach = min(REACH + DRIFT * math.sqrt(max(drift[0, 0], drift[1, 1])), FARTHEST)
    old &= np.hypot(*(trees.position - here).T) < reach
    rows = np.flatnonzero(old)
    if len(rows) < parameters.stems_min:
        return None
    flat = trees.covariance[rows][:, [0, 0, 1], [0, 1, 1]]
    match = find_constellation(
        _stems(place[near], covariance[near]),
        _stems(trees.position[rows], flat),
        parameters,
        hypotheses=HYPOTHESES,
    )
    if match.pose is None:
        return None
    pose = Pose2(*(float(value) for value in run.path[-1]))
    T, R = through(match.pose, match.covariance, pose, OWN)
    return loop_to(run, trees.number[rows[match.reference]], T, R, len(run.path) - 1)


def loop_to(
    run: RunHistory, numbers: Int, T_map_base: Pose2, R: Float, last_mapped: int, spread: Float | None = None
) -> Loop | None:
    """The loop that leads from known trees to where they were found again; None where the path cannot have
    drifted so far.

    Args:
        numbers: Of the trees that agree.
        T_map_base: Where the base is by them; R: covariance of that, shape (3, 3).
        last_mapped: Scan; later ones mapped nothing.
        spread: Covariance of the pose, shape (3, 3); None takes what the odometry may have drifted since.
    """
    trees, path = run.trees, run.path
    rows = np.flatnonzero(np.isin(trees.number, numbers))
    # What was driven before the robot was put somewhere did not lead there, and no loop bends it; and what a
    # loop has bent has drifted no more: else trees that still stand twice would close it again, wrongly.
    left = _left(run.scan_of(trees.last_seen_ns[rows]), _way(path))
    first = max(left, run.placed, run.closed)
    if first >= last_mapped:
        return None
    gap = _gap(T_map_base, path[-1])
    if np.hypot(gap[0], gap[1]) < LEAST_GAP:
        return None
    since = drift_of(path, first, run.noise)
    if _is_beyond(gap, (since if spread is None else spread) + R):
        return None
    driven, jumps = without_jumps(path[first:], run.motion[first:])
    if jumps and _is_beyond(_gap(T_map_base, driven[-1]), since + R):
        return None
    anchor = int(np.argmin(np.hypot(*(path[: first + 1, :2] - [T_map_base.x, T_map_base.y]).T)))
    ties = _ties(run, first, last_mapped)
    return Loop(first, last_mapped, anchor, T_map_base, R, ties, run.motion)


def _gap(T_map_base: Pose2, pose: Float) -> Float:
    """What a pose lacks, x, y [m], yaw [rad], shape (3,)."""
    gap = T_map_base.as_array() - pose
    gap[2] = wrap_angle(gap[2])
    return gap


def _is_beyond(gap: Float, covariance: Float) -> bool:
    """Whether a gap is more than drift can make."""
    return bool(gap @ np.linalg.solve(covariance, gap) > DRIFT**2)


def through(T_map_local: Pose2, covariance: Float, T_local_base: Pose2, own: Float) -> tuple[Pose2, Float]:
    """The pose of the base in the map, and its covariance from those of a match and of the pose in the frame
    of what was matched, shapes (3, 3)."""
    C = np.eye(3)
    C[:2, :2] = T_map_local.rotation()
    T_map_base = T_map_local @ T_local_base
    J = np.eye(3)
    J[0, 2], J[1, 2] = T_map_local.y - T_map_base.y, T_map_base.x - T_map_local.x
    return T_map_base, J @ covariance @ J.T + C @ own @ C.T


def _left(seen: Int, way: Float) -> int:
    """The scan at which trees were left that were seen last at these scans. Some of them may have been taken
    for others since, by a scan that had drifted, so the first time counts when a quarter of them was left."""
    seen = np.sort(seen)
    group = np.cumsum(np.diff(way[seen], prepend=way[seen[0]]) > TIE_APART)
    counts = np.bincount(group)
    return int(np.median(seen[group == np.argmax(counts >= max(LEAST_LEFT, len(seen) / 4))]))


def nearby(estimate: PoseEstimate) -> Float:
    """The covariance of a pose with respect to the trees around, shape (3, 3)."""
    return estimate.covariance if estimate.relative is None else estimate.relative


def _way(path: Float) -> Float:
    step = np.diff(path[:, :2], axis=0, prepend=path[:1, :2])
    way: Float = np.cumsum(np.hypot(step[:, 0], step[:, 1]))
    return way


def _stems(place: Float, covariance: Float) -> Stems:
    """Without diameters, which are of far trees not known; the common error of places is what is sought."""
    unknown = np.full(len(place), np.nan)
    return Stems(place, np.minimum(worst_sigma(covariance), SIGMA), unknown, unknown)


def _ties(run: RunHistory, first: int, last: int) -> Int:
    """Pairs of scans of one place between which the path need not bend, see Loop: trees stand there that were
    known at the earlier one and seen until the later one, so that the second was found by them."""
    from scipy.spatial import cKDTree

    path, trees = run.path, run.trees
    way = _way(path[: last + 1])
    nodes = np.flatnonzero(np.diff(np.floor(way / TIE_SPACING), prepend=-1.0) > 0)
    pairs = cKDTree(path[nodes, :2]).query_pairs(TIE_NEAR, output_type="ndarray")
    early, late = nodes[pairs.min(axis=1)], nodes[pairs.max(axis=1)]
    apart = (late > first) & (way[late] - way[early] > TIE_APART)
    early, late = early[apart], late[apart]
    begun, seen = run.scan_of(trees.first_seen_ns), run.scan_of(trees.last_seen_ns)
    kept: list[int] = []
    for k in np.lexsort((early, late)).tolist():
        if kept and late[k] == late[kept[-1]]:
            continue  # one tie a scan, and the earlier the better
        near = np.hypot(*(trees.position - path[late[k], :2]).T) < TIE_VIEW
        both = near & (begun <= early[k]) & (seen >= late[k])
        if np.count_nonzero(both) >= TIE_TREES:
            kept.append(k)
    return np.column_stack([early[kept], late[kept]]).astype(np.int64)
