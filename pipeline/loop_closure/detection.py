"""Loop detection: recently mapped trees that are on the map already, at another position.

If the odometry drifts by more than the distance between trees, the data association cannot correct it, and
the robot maps the same trees a second time. While the pose is uncertain, this module therefore searches for
the constellation of the recently begun landmarks among the trees that the robot left long ago. A match must
agree with the possible drift of the path; otherwise the robot was carried, or the match is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.config.stages import Relocalisation
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.loop_closure.stem_matching import (
    LEAST,
    MapStems,
    find_constellation,
    find_displacement,
    worst_sigma,
)
from pipeline.slam import Loop
from pipeline.slam.keyframe_graph import drift_of, without_jumps
from pipeline.slam.motion import Noise
from pipeline.types.records import Int, PoseEstimate, Trees

EVERY = 10.0  # m of driven path between two searches at an uncertain pose, a quarter of LATELY
UNSURE = 0.4  # m, sigma of the position; below it the data association recognises the trees one by one
LATELY = 40.0  # m of driven path, in which the landmarks to be found were begun
REACH = 30.0  # m around the robot, in which these landmarks are
LEAST_HITS = 3
HYPOTHESES = 30_000
LEAST_GAP = 0.5  # m; the particles correct smaller errors themselves
DRIFT = 5.0  # sigma; a larger error is not drift
OWN = np.diag(np.square([0.05, 0.05, 0.01]))  # m, rad; of a particle's pose among its own landmarks
LEAST_LEFT = 2  # trees that agree, at least, that the robot left at the same time
FARTHEST = 90.0  # m, maximum radius of the search around the robot
SIGMA = 0.1  # m, maximum sigma of a position relative to its neighbours
GROUP_APART = 30.0  # m of the path between groups of trees that the robot left


@dataclass(frozen=True, slots=True, eq=False)
class RunHistory:
    """Path and map of a run.

    Attributes:
        stamp_ns: Time of each scan [ns], int64, shape (N,).
        path: Pose x, y [m], yaw [rad] of the base in the map at each scan, shape (N, 3).
        trees: The trees of the map.
        begun_since: Function of a scan number that returns the landmarks begun at this scan or later, see
            FastSlam.begun_since.
        T_map_particle: Pose of the particle with these landmarks at the newest scan.
        estimate: Pose at the newest scan.
        noise: Noise of the odometry.
        motion: Motion x, y [m], yaw [rad] by odometry from the scan before to each scan, shape (N, 3).
        placed: Scan at which the pose was last set from outside; the path begins there.
        closed: Scan at which the last loop was closed; the path before it has no drift left.
        contradicted: Whether the newest scan shows trees where known places have others; see
            `slam.places`.
    """

    stamp_ns: Int
    path: Float
    trees: Trees
    begun_since: Callable[[int], tuple[Float, Float]]
    T_map_particle: Pose2
    estimate: PoseEstimate
    noise: Noise
    motion: Float
    placed: int
    closed: int = 0
    contradicted: bool = False

    def scan_of(self, stamp_ns: Int) -> Int:
        """Return the index of the first scan at or after each time [ns], int64, of the shape of `stamp_ns`;
        the newest scan for later times."""
        scan: Int = np.minimum(np.searchsorted(self.stamp_ns, stamp_ns), len(self.stamp_ns) - 1)
        return scan


def is_uncertain(sigma_xy: Float) -> bool:
    """Return whether the position was uncertain by more than UNSURE in one of some scans.

    A pose that was uncertain and is no longer may have been corrected by the wrong trees. The search of loops
    therefore continues while landmarks that were begun at an uncertain pose are among those to be found.

    Args:
        sigma_xy: Standard deviation of the position at each scan of the last LATELY metres [m]; may be empty.
    """
    return bool(sigma_xy.max(initial=0.0) > UNSURE)


def search_loops(
    run: RunHistory, parameters: Relocalisation, *, is_due: bool
) -> tuple[Loop | None, Loop | None]:
    """Return the loop by a constellation (`find_loop`), which is searched for if it is due, and otherwise
    that by doubled trees (`find_displaced`); None for none."""
    loop = find_loop(run, parameters) if is_due else None
    return loop, find_displaced(run, parameters) if loop is None else None


def find_loop(run: RunHistory, parameters: Relocalisation) -> Loop | None:
    """Search for a loop that ends at the newest scan.

    Landmarks that were begun in the last LATELY metres, but not before `placed` of the run, and are within
    REACH of the robot are matched with trees of at least LEAST_HITS observations that were first seen before
    and are within the possible drift, at most FARTHEST.

    Args:
        run: Path and map with at least one scan; unchanged.
        parameters: Parameters of the stage.

    Returns:
        The loop. None if the path is shorter than LATELY and the pose was not set from outside, either side
        has fewer than `stems_min` stems, the constellation is not found (see `find_constellation`), or
        `loop_to` rejects the match.
    """
    way = _way(run.path)
    lately = max(int(np.searchsorted(way, way[-1] - LATELY)), run.placed)
    if lately == 0:
        return None
    here = run.T_map_particle.as_array()[:2]
    place, covariance = run.begun_since(lately)
    near = np.hypot(*(place - here).T) < REACH
    if np.count_nonzero(near) < parameters.stems_min:
        return None
    trees = run.trees
    # A drifted scan may have associated a tree wrongly, which changes its last view but not its first one.
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
    T, R = through(match.pose, match.covariance, run.T_map_particle, OWN)
    return loop_to(run, trees.number[rows[match.reference]], T, R, len(run.path) - 1)


#: Largest drift of the odometry as a share of the driven path: LiDAR odometry drifts by 0.5 to 1 % of it,
#: wheels by 1 to 2 %.
DRIFT_SHARE = 0.02
UNSEEN = 2.0  # m of the path; a tree that was seen on it still has its detections
LEAST_DISPLACEMENT = 0.2  # m; the association of the filter tolerates less


def find_displaced(run: RunHistory, parameters: Relocalisation) -> Loop | None:
    """Search for a loop that ends at the newest scan by trees that stand twice in the map, next to one
    another.

    A drift that is larger than the gate of the data association and smaller than the distance between trees
    begins each tree of a known place a second time. Confirmed trees that were begun in the last LATELY metres
    are compared with older ones that are not seen any more, though the robot is among them. The displacement
    is at most DRIFT_SHARE of the path since these were begun, and half the distance between trees.

    Args:
        run: Path and map with at least one scan; unchanged.
        parameters: Parameters of the stage.

    Returns:
        The loop; None if either side has fewer than LEAST stems, no displacement is found (see
        `find_displacement`), it is below LEAST_DISPLACEMENT, or half as many known trees as agree are seen at
        their places.
    """
    way, trees = _way(run.path), run.trees
    lately = max(int(np.searchsorted(way, way[-1] - LATELY)), run.placed)
    T_map_base = run.estimate.T_map_base
    near = trees.confirmed & (np.hypot(*(trees.position - T_map_base.as_array()[:2]).T) < REACH)
    left, begun = run.scan_of(trees.last_seen_ns), run.scan_of(trees.first_seen_ns)
    known = near & (begun < lately)
    is_seen = way[left] >= way[-1] - UNSEEN
    old = np.flatnonzero(known & ~is_seen)
    new = np.flatnonzero(near & (begun >= lately))
    if min(len(old), len(new)) < LEAST:
        return None
    drift = DRIFT_SHARE * float(way[-1] - way[begun[old]].min())
    flat = trees.covariance[:, [0, 0, 1], [0, 1, 1]]
    match = find_displacement(
        _stems(trees.position[new], flat[new]),
        _stems(trees.position[old], flat[old]),
        parameters,
        min(drift, 0.5 * _spacing(trees.position[old])),
    )
    # Known trees that are seen at their places contradict a displacement.
    if match.pose is None or 2 * np.count_nonzero(known & is_seen) >= len(match.local):
        return None
    T, R = through(match.pose, match.covariance, T_map_base, OWN)
    if np.hypot(T.x - T_map_base.x, T.y - T_map_base.y) < LEAST_DISPLACEMENT:
        return None
    return _loop(run, lately, T, R)


def _spacing(position: Float) -> float:
    """Return the median distance of N > 1 positions, shape (N, 2), to their nearest neighbours [m]."""
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(position).query(position, k=2)[0][:, 1]))


def loop_to(
    run: RunHistory, numbers: Int, T_map_base: Pose2, R: Float, last_mapped: int, spread: Float | None = None
) -> Loop | None:
    """Return the loop from the scan at which known trees were left to the newest scan, at which they are
    found again; None if it is rejected. The trees count as left at `placed` or `closed` of the run at the
    earliest. The anchor of the loop is the scan whose pose is nearest to `T_map_base`, among the scans up to
    the one at which the trees were left.

    The gap is `T_map_base` minus the newest pose of the path. A loop is rejected if the trees were left at
    `last_mapped` or later; if the gap in x, y is below LEAST_GAP and the run is not `contradicted`; if the
    gap exceeds DRIFT sigma of `spread` + R; or if the path since then has jumps, and the gap of the path
    without them exceeds DRIFT sigma of the drift of the odometry + R.

    Args:
        run: Path and map; unchanged.
        numbers: Numbers of the trees that agree, int64, shape (K,); at least one exists in the map.
        T_map_base: Pose of the base in the map by these trees.
        R: Covariance of T_map_base (x, y [m], yaw [rad]), shape (3, 3).
        last_mapped: Last scan that changed the map.
        spread: Covariance of the newest pose of the path, shape (3, 3); None uses the drift of the odometry
            since the trees were left.

    Raises:
        LinAlgError: The sum of the covariances is singular.
    """
    trees, path = run.trees, run.path
    rows = np.flatnonzero(np.isin(trees.number, numbers))
    # The path before `placed` does not lead to the newest scan. The path before `closed` has no drift left;
    # duplicate trees that remain there would otherwise close the same loop again.
    left = _left(run.scan_of(trees.last_seen_ns[rows]), _way(path))
    first = max(left, run.placed, run.closed)
    if first >= last_mapped:
        return None
    gap = _gap(T_map_base, path[-1])
    if np.hypot(gap[0], gap[1]) < LEAST_GAP and not run.contradicted:
        return None
    since = drift_of(path, first, run.noise)
    if _is_beyond(gap, (since if spread is None else spread) + R):
        return None
    driven, jumps = without_jumps(path[first:], run.motion[first:])
    if jumps and _is_beyond(_gap(T_map_base, driven[-1]), since + R):
        return None
    return _loop(run, first, T_map_base, R)


def _loop(run: RunHistory, first: int, T_map_base: Pose2, R: Float) -> Loop:
    """Return the loop to the nearest scan up to scan `first`; see `loop_to`."""
    away = run.path[: first + 1, :2] - [T_map_base.x, T_map_base.y]
    return Loop(first, int(np.argmin(np.hypot(*away.T))), T_map_base, R)


def _gap(T_map_base: Pose2, pose: Float) -> Float:
    """Return the difference x, y [m], yaw [rad], shape (3,), of T_map_base minus `pose` along the axes of the
    map, with the yaw wrapped."""
    gap = T_map_base.as_array() - pose
    gap[2] = wrap_angle(gap[2])
    return gap


def _is_beyond(gap: Float, covariance: Float) -> bool:
    """Return whether a difference of poses, shape (3,), is larger than DRIFT sigma of its covariance, shape
    (3, 3).

    Raises:
        LinAlgError: The covariance is singular.
    """
    return bool(gap @ np.linalg.solve(covariance, gap) > DRIFT**2)


def through(T_map_local: Pose2, covariance: Float, T_local_base: Pose2, own: Float) -> tuple[Pose2, Float]:
    """Return the pose of the base in the map, T_map_local @ T_local_base, and its covariance, shape (3, 3).

    Args:
        T_map_local: Pose of a local frame in the map, by a match.
        covariance: Covariance of T_map_local, shape (3, 3).
        T_local_base: Pose of the base in the local frame.
        own: Covariance of T_local_base, shape (3, 3), independent of `covariance`.
    """
    C = np.eye(3)
    C[:2, :2] = T_map_local.rotation()
    T_map_base = T_map_local @ T_local_base
    J = np.eye(3)
    J[0, 2], J[1, 2] = T_map_local.y - T_map_base.y, T_map_base.x - T_map_local.x
    return T_map_base, J @ covariance @ J.T + C @ own @ C.T


def _left(seen: Int, way: Float) -> int:
    """Return the scan at which the robot left a group of trees.

    A drifted scan may have associated some of the trees wrongly since, so the trees are grouped by the path
    at which they were last seen (groups are GROUP_APART from each other), and the result is the median scan
    of the first group with at least a quarter of the trees and LEAST_LEFT trees. If there is no such group,
    it is the median scan of the first group.

    Args:
        seen: Scan in which each tree was seen last, int64, shape (K,), K > 0.
        way: Distance driven at each scan, shape (N,) [m].
    """
    seen = np.sort(seen)
    group = np.cumsum(np.diff(way[seen], prepend=way[seen[0]]) > GROUP_APART)
    counts = np.bincount(group)
    return int(np.median(seen[group == np.argmax(counts >= max(LEAST_LEFT, len(seen) / 4))]))


def _way(path: Float) -> Float:
    """Return the distance driven at each pose of a path, shape (N,) [m], 0 at the first one. `path` is x, y
    [m], yaw, shape (N, 3)."""
    step = np.diff(path[:, :2], axis=0, prepend=path[:1, :2])
    way: Float = np.cumsum(np.hypot(step[:, 0], step[:, 1]))
    return way


def _stems(place: Float, covariance: Float) -> MapStems:
    """Return stems without diameters, which are unknown for distant trees. Their sigma, that of the
    most uncertain direction, is limited to SIGMA, since the error that all positions share is what the match
    finds. `place` has the shape (N, 2) [m], `covariance` xx, xy, yy, shape (N, 3) [m^2]."""
    unknown = np.full(len(place), np.nan)
    return MapStems(place, np.minimum(worst_sigma(covariance), SIGMA), unknown, unknown)
