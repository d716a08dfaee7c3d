"""A loop that is closed: the path since a known place was left is bent, so that it ends where that place was
found again.

x* = argmin sum |x_k^-1 x_k+1 - u_k|^2_Q + sum |x_i^-1 x_j - z_ij|^2_T + |x_n - z|^2_R

u_k is the path as it was driven, z_ij are ties between scans that saw the same trees, and z is where the
robot was found.
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

SPACING, MOST_NODES = 1.0, 2000  # m between two nodes, more where there would be more of them
TIE_SIGMA = np.array([0.1, 0.1, 0.02])  # m, m, rad
FLOOR = 1e-3  # m, rad; what stood still has no sigma
ROUNDS, SETTLED = 20, 1e-6  # m, rad
JUMP, JUMP_TURN = 1.0, 1.0  # m, rad between a step of the path and that of the odometry
TWICE = 1.0  # m; landmarks of before and after the loop that are nearer are one tree


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Where the robot was found again.

    Attributes:
        first: Scan; the path until it, and what was mapped from it, stay as they are.
        last: Scan; those after it mapped nothing.
        anchor: Scan at or before `first` that was taken near the place.
        T_map_base: Where the base is at the newest scan; covariance: of x, y [m], yaw [rad], shape (3, 3),
            with respect to the trees there.
        ties: int64, shape (K, 2): pairs of scans, earlier and later, whose poses agree by the trees that both
            saw.
        motion: By the odometry to each scan from the one before, x, y [m], yaw [rad], shape (N, 3).
    """

    first: int
    last: int
    anchor: int
    T_map_base: Pose2
    covariance: Float
    ties: Int
    motion: Float


def bent_path(path: Float, loop: Loop, noise: Noise) -> Float:
    """The whole path, x, y [m], yaw [rad], shape (N, 3), after a loop was closed at its end.

    Args:
        path: As it was, shape (N, 3).
        noise: Of the odometry; its shape says where the path bends, its size matters little.
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
    """The path as if the robot had gone on by the odometry where a correction put it elsewhere, for that was
    no motion; and how many such jumps there are.

    Args:
        path: x, y [m], yaw [rad], shape (N, 3).
        motion: By the odometry to each scan from the one before, shape (N, 3). A step that it tells of is
            driven, however far it leads: scans may have been lost.
    """
    step = composed(inverse(path[:-1]), path[1:])
    apart = step - motion[1:]
    turned = np.abs(wrap_angle(apart[:, 2])) > JUMP_TURN  # a heading put right on the spot is no turn either
    jumps = np.flatnonzero((np.hypot(*apart[:, :2].T) > JUMP) | turned).tolist()
    out = path.copy()
    for k in jumps:
        go_on = composed(out[k][None], motion[k + 1][None])
        tail = composed(inverse(out[k + 1][None]).repeat(len(out) - k - 1, axis=0), out[k + 1 :])
        out[k + 1 :] = composed(go_on.repeat(len(tail), axis=0), tail)
    return out, len(jumps)


def drift_of(path: Float, first: int, noise: Noise) -> Float:
    """Covariance of x, y [m], yaw [rad] at the end of a path, shape (3, 3), by the odometry alone since scan
    `first`: an error of the heading counts with the way that lies before it."""
    step = np.diff(path[first:], axis=0)
    distance = np.hypot(step[:, 0], step[:, 1])
    heading = noise.turn_distance**2 * distance + noise.turn**2 * np.abs(wrap_angle(step[:, 2]))
    ahead = path[-1, :2] - path[first + 1 :, :2]
    lever = np.column_stack([-ahead[:, 1], ahead[:, 0], np.ones(len(ahead))])
    total: Float = (lever * heading[:, None]).T @ lever
    total += noise.distance**2 * float(distance.sum()) * np.diag([1.0, 1.0, 0.0])
    return total


def bent_landmarks(known: MapColumns, scan: Int, bend: Bend) -> MapColumns:
    """Landmarks moved with the scans that began them; two that were one tree all the time become the older
    one, one to one."""
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
    """Scans from `first` to the last, about SPACING apart."""
    way = _way(path)[first:]
    spacing = max(SPACING, float(way[-1] - way[0]) / MOST_NODES)
    cell = np.floor((way - way[0]) / spacing)
    nodes = first + np.flatnonzero(np.diff(cell, prepend=-1.0) > 0)
    return np.append(nodes, len(path) - 1) if nodes[-1] < len(path) - 1 else nodes


def _way(path: Float) -> Float:
    """Metres driven until each scan, and as many for radians turned."""
    step = np.diff(path, axis=0, prepend=path[:1])
    way: Float = np.cumsum(np.hypot(step[:, 0], step[:, 1]) + np.abs(wrap_angle(step[:, 2])))
    return way


_Edges = tuple[Int, Int, Float, Float]


def _edges(
    path: Float, nodes: Int, between: Float, loop: Loop, noise: Noise, tied: tuple[Int, Int, Float]
) -> _Edges:
    """From and to which node, the motion, shape (E, 3), and the square root of its information, (E, 3, 3)."""
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
    """The ties as edges between nodes; one with a scan that stays holds the other one where it is. Both scans
    saw the same trees, so their motion is that of the path with its jumps."""
    scans = np.maximum(loop.ties, loop.first)
    ends = np.searchsorted(nodes, scans)
    apart = ends[:, 1] > ends[:, 0] + 1
    (early, late), (i, j) = scans[apart].T, ends[apart].T
    motion = composed(inverse(path[early]), path[late])
    before, after = (composed(inverse(driven[s]), driven[nodes[k]]) for s, k in ((early, i), (late, j)))
    return i, j, composed(composed(inverse(before), motion), after)


def _solved(x: Float, i: Int, j: Int, z: Float, root: Float) -> Float:
    """Gauss-Newton over the poses x, shape (K, 3), of which the first one stays."""
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
