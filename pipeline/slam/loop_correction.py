"""Correction of the path by a loop closure: least squares over the poses since the robot left a known place.

x* = argmin sum |x_k^-1 x_k+1 - u_k|^2_Q + sum |x_i^-1 x_j - z_ij|^2_T + |x_n - z|^2_R

u_k are the motions of the path before the correction, z_ij are ties between scans that saw the same trees,
and z is the pose at which the known place was found again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.loop_closure.map_correction import Bend
from pipeline.slam.association import associate
from pipeline.slam.motion import Noise
from pipeline.slam.particle_maps import MapColumns
from pipeline.slam.poses import composed, interpolated, inverse
from pipeline.types.records import Int

SPACING, MOST_NODES = 1.0, 2000  # m between two nodes; more if the path would have more nodes
TIE_SIGMA = np.array([0.1, 0.1, 0.02])  # m, m, rad
FLOOR = 1e-3  # m, rad; minimum sigma of a motion, also of a robot that stands still
ROUNDS, SETTLED = 20, 1e-6  # m, rad
JUMP, JUMP_TURN = 1.0, 1.0  # m, rad; a larger difference between path and odometry is no motion
TWICE = 1.0  # m; closer landmarks of before and after the loop are the same tree


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A loop: the robot is at a known place again.

    Attributes:
        first: Scan up to which path and map stay unchanged.
        last: Last scan that changed the map.
        anchor: Scan at or before `first` that was taken near the place.
        T_map_base: Pose of the base at the newest scan.
        covariance: Covariance of this pose relative to the trees there, x, y [m], yaw [rad], shape (3, 3).
        ties: int64, shape (K, 2): pairs of an earlier and a later scan that saw the same trees, so that their
            relative pose is known.
        motion: x, y [m], yaw [rad] by odometry from each scan to the next, shape (N, 3).
    """

    first: int
    last: int
    anchor: int
    T_map_base: Pose2
    covariance: Float
    ties: Int
    motion: Float


def bent_path(path: Float, loop: Loop, noise: Noise) -> Float:
    """Return the corrected path, x, y [m], yaw [rad], shape (N, 3).

    Args:
        path: The path before the correction, shape (N, 3).
        loop: The loop that ends at the newest scan.
        noise: Noise of the odometry. The ratio of its parts decides how the correction is distributed; its
            scale matters little.
    """
    if loop.first >= len(path) - 1:
        return path.copy()
    driven = path.copy()
    driven[loop.first :], _ = without_jumps(path[loop.first :], loop.motion[loop.first :])
    nodes = _nodes(driven, loop.first)
    between = composed(inverse(driven[nodes[:-1]]), driven[nodes[1:]])
    edges = _edges(driven, nodes, between, loop, noise, _tied(path, driven, nodes, loop))
    solved = _solved(driven[nodes], *edges)
    scans = np.arange(loop.first, len(path))
    node = np.searchsorted(nodes, scans, side="right") - 1
    since = composed(inverse(driven[nodes[node]]), driven[scans])
    motions = np.concatenate([np.full((1, 3), np.nan), between])
    rows = interpolated(solved, motions, node, since)
    return np.concatenate([path[: loop.first + 1], rows[1:]])


def without_jumps(path: Float, motion: Float) -> tuple[Float, int]:
    """Return the path with each jump replaced by the motion of the odometry, and the number of jumps.

    A jump is a step of the path that differs from the odometry by more than JUMP or JUMP_TURN: a correction
    moved the pose, not the robot. A long step that the odometry reports is no jump, since scans may be lost.

    Args:
        path: x, y [m], yaw [rad], shape (N, 3).
        motion: Motion by odometry from each scan to the next, shape (N, 3).
    """
    step = composed(inverse(path[:-1]), path[1:])
    apart = step - motion[1:]
    turned = np.abs(wrap_angle(apart[:, 2])) > JUMP_TURN
    jumps = np.flatnonzero((np.hypot(*apart[:, :2].T) > JUMP) | turned).tolist()
    out = path.copy()
    for k in jumps:
        go_on = composed(out[k][None], motion[k + 1][None])
        tail = composed(inverse(out[k + 1][None]).repeat(len(out) - k - 1, axis=0), out[k + 1 :])
        out[k + 1 :] = composed(go_on.repeat(len(tail), axis=0), tail)
    return out, len(jumps)


def drift_of(path: Float, first: int, noise: Noise) -> Float:
    """Return the covariance of the last pose relative to that of scan `first`, x, y [m], yaw [rad], shape
    (3, 3), if only odometry connects the two. A heading error moves all later positions."""
    step = np.diff(path[first:], axis=0)
    distance = np.hypot(step[:, 0], step[:, 1])
    heading = noise.turn_distance**2 * distance + noise.turn**2 * np.abs(wrap_angle(step[:, 2]))
    ahead = path[-1, :2] - path[first + 1 :, :2]
    lever = np.column_stack([-ahead[:, 1], ahead[:, 0], np.ones(len(ahead))])
    total: Float = (lever * heading[:, None]).T @ lever
    total += noise.distance**2 * float(distance.sum()) * np.diag([1.0, 1.0, 0.0])
    return total


def bent_landmarks(known: MapColumns, scan: Int, bend: Bend) -> MapColumns:
    """Return the landmarks after a correction of the path.

    A landmark moves with the scan that began it. Duplicates of before and after the loop are joined one to
    one and keep the older birth.

    Args:
        known: The landmarks before the correction.
        scan: int64, shape (L,): the scan that began each landmark.
        bend: The correction.
    """
    mean, turn = bend.of_trees(known.mean, scan)
    c, s = np.cos(turn), np.sin(turn)
    C = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    flat = (C @ known.covariance[:, [[0, 1], [1, 2]]] @ C.transpose(0, 2, 1))[:, [0, 0, 1], [0, 1, 1]]
    covariance = np.where((scan > bend.first)[:, None], flat, known.covariance)
    old, young = np.flatnonzero(scan <= bend.first), np.flatnonzero(scan > bend.first)
    of, _ = associate(mean[young], covariance[young], mean[old], covariance[old], np.inf, TWICE)
    hits, score = known.hits.copy(), known.score.copy()
    again = of >= 0
    hits[old[of[again]]] += known.hits[young[again]]
    score[old[of[again]]] = np.maximum(score[old[of[again]]], known.score[young[again]])
    keep = np.ones(len(mean), np.bool_)
    keep[young[again]] = False
    moved = known._replace(mean=mean, covariance=covariance, hits=hits, score=score)
    return MapColumns(
        moved.mean[keep], moved.covariance[keep], moved.hits[keep], moved.score[keep], moved.birth[keep]
    )


def _nodes(path: Float, first: int) -> Int:
    """Return the scans from `first` to the last one that are nodes of the graph, about SPACING apart."""
    way = _way(path)[first:]
    spacing = max(SPACING, float(way[-1] - way[0]) / MOST_NODES)
    cell = np.floor((way - way[0]) / spacing)
    nodes = first + np.flatnonzero(np.diff(cell, prepend=-1.0) > 0)
    return np.append(nodes, len(path) - 1) if nodes[-1] < len(path) - 1 else nodes


def _way(path: Float) -> Float:
    """Return the distance driven until each scan, shape (N,) [m]; a turn counts one metre per radian."""
    step = np.diff(path, axis=0, prepend=path[:1])
    way: Float = np.cumsum(np.hypot(step[:, 0], step[:, 1]) + np.abs(wrap_angle(step[:, 2])))
    return way


_Edges = tuple[Int, Int, Float, Float]


def _edges(
    path: Float, nodes: Int, between: Float, loop: Loop, noise: Noise, tied: tuple[Int, Int, Float]
) -> _Edges:
    """Return the edges of the graph: first node, second node, measured motion, shape (E, 3), and the square
    root of its information matrix, shape (E, 3, 3)."""
    step = np.diff(path, axis=0, prepend=path[:1])
    distance = np.cumsum(np.hypot(step[:, 0], step[:, 1]))[nodes]
    turn = np.cumsum(np.abs(wrap_angle(step[:, 2])))[nodes]
    along = noise.distance**2 * np.diff(distance) + FLOOR**2
    heading = noise.turn_distance**2 * np.diff(distance) + noise.turn**2 * np.diff(turn) + FLOOR**2
    chain = np.zeros((len(between), 3, 3))
    chain[:, 0, 0] = chain[:, 1, 1] = 1.0 / np.sqrt(along)
    chain[:, 2, 2] = 1.0 / np.sqrt(heading)
    start = path[loop.first]
    c, s = np.cos(start[2]), np.sin(start[2])
    C = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    found = composed(inverse(start[None]), loop.T_map_base.as_array()[None])
    R = C.T @ loop.covariance @ C + FLOOR**2 * np.eye(3)
    root = np.linalg.cholesky(np.linalg.inv(R)).T
    k = np.arange(len(between))
    return (
        np.concatenate([k, tied[0], [0]]),
        np.concatenate([k + 1, tied[1], [len(nodes) - 1]]),
        np.concatenate([between, tied[2], found]),
        np.concatenate([chain, np.tile(np.diag(1.0 / TIE_SIGMA), (len(tied[0]), 1, 1)), root[None]]),
    )


def _tied(path: Float, driven: Float, nodes: Int, loop: Loop) -> tuple[Int, Int, Float]:
    """Return the ties as edges between nodes: first node, second node, motion. A tie with a scan that stays
    fixes the other scan. Both scans saw the same trees, so the motion is that of the path with its jumps."""
    scans = np.maximum(loop.ties, loop.first)
    ends = np.searchsorted(nodes, scans)
    apart = ends[:, 1] > ends[:, 0] + 1
    (early, late), (i, j) = scans[apart].T, ends[apart].T
    motion = composed(inverse(path[early]), path[late])
    before, after = (composed(inverse(driven[s]), driven[nodes[k]]) for s, k in ((early, i), (late, j)))
    return i, j, composed(composed(inverse(before), motion), after)


def _solved(x: Float, i: Int, j: Int, z: Float, root: Float) -> Float:
    """Return the poses that minimise the squared errors of the edges, by Gauss-Newton from the poses x, shape
    (K, 3); the first pose is fixed."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    x = x.copy()
    n, E = 3 * len(x), len(i)
    rows = np.broadcast_to(3 * np.arange(E)[:, None, None] + np.arange(3)[:, None], (E, 3, 3))
    columns = [np.broadcast_to(3 * k[:, None, None] + np.arange(3), (E, 3, 3)) for k in (i, j)]
    at = np.concatenate([rows.ravel()] * 2), np.concatenate([c.ravel() for c in columns])
    for _ in range(ROUNDS):
        c, s = np.cos(x[i, 2]), np.sin(x[i, 2])
        dx, dy = (x[j, :2] - x[i, :2]).T
        error = np.column_stack([c * dx + s * dy, c * dy - s * dx, x[j, 2] - x[i, 2]]) - z
        error[:, 2] = wrap_angle(error[:, 2])
        J = np.zeros((2, E, 3, 3))  # by the pose where an edge begins, and where it ends
        J[1, :, 0, 0], J[1, :, 0, 1], J[1, :, 1, 0], J[1, :, 1, 1] = c, s, -s, c
        J[1, :, 2, 2] = 1.0
        J[0] = -J[1]
        J[0, :, 0, 2], J[0, :, 1, 2] = c * dy - s * dx, -c * dx - s * dy
        A = sparse.csc_matrix(((root @ J).ravel(), at), shape=(3 * E, n))[:, 3:]
        b = (root @ error[:, :, None]).ravel()
        step = spsolve((A.T @ A).tocsc(), -(A.T @ b)).reshape(-1, 3)
        x[1:] += step
        if np.abs(step).max() < SETTLED:
            break
    x[:, 2] = wrap_angle(x[:, 2])
    return x
