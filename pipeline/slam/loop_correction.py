"""Correction of path and landmarks by a solution of the keyframe graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.pose_arrays import composed, interpolated, inverse, rotated_rows
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam.association import associate
from pipeline.slam.keyframe_graph import KeyframeGraph, Solution
from pipeline.slam.motion import Noise
from pipeline.slam.particle_maps import MapColumns
from pipeline.types.records import Int

JUMP, JUMP_TURN = 1.0, 1.0  # m, rad; a larger difference between path and odometry is no motion
TWICE = 1.0  # m; closer landmarks of before and after the loop are the same tree


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A loop: the robot is at a known place again.

    Attributes:
        first: Scan at which the robot left the place.
        anchor: Scan at or before `first` that was taken near the place.
        T_map_base: Pose of the base at the newest scan.
        covariance: Covariance of this pose relative to the trees there, x, y [m], yaw [rad], shape (3, 3).
    """

    first: int
    anchor: int
    T_map_base: Pose2
    covariance: Float


def corrected_path(path: Float, graph: KeyframeGraph, solution: Solution) -> Float:
    """Return the path with the keyframes of a solution, x, y [m], yaw [rad], shape (N, 3).

    Between two keyframes the path keeps its shape, and the difference at the second one is spread evenly.
    Scans before the first keyframe and after the last one move with it. A section without odometry (infinite
    covariance) moves with the keyframe at its start. `path` is the path before, with the same shape; the
    graph has at least one keyframe.
    """
    scans = graph.scans
    keyframe = np.maximum(np.searchsorted(scans, np.arange(len(path)), side="right") - 1, 0)
    before = path[scans]
    since = composed(inverse(before[keyframe]), path)
    motions = np.concatenate([np.full((1, 3), np.nan), composed(inverse(before[:-1]), before[1:])])
    motions[[not np.isfinite(k.covariance).all() for k in graph.keyframes]] = np.nan
    return interpolated(solution.pose, motions, scans, keyframe, since)


def corrected_landmarks(
    known: MapColumns, graph: KeyframeGraph, solution: Solution, path: Float
) -> MapColumns:
    """Return the landmarks of one particle after a correction of the path.

    A landmark of the graph is at its solution; another one moves with the keyframe that began it. All
    covariances turn with that keyframe. Hits, scores and births are unchanged.

    Args:
        known: Landmarks of the particle.
        graph: Keyframes with the births of their landmarks.
        solution: Corrected keyframes and landmarks.
        path: Path of the particle before the correction, shape (N, 3).
    """
    mean, turn = _moved_rigidly(known.mean, known.birth, graph, solution, path)
    _, ours, theirs = np.intersect1d(known.birth, solution.birth, return_indices=True)
    mean[ours] = solution.position[theirs]
    return known._replace(mean=mean, covariance=rotated_rows(known.covariance, turn))


def _moved_rigidly(
    place: Float, birth: Int, graph: KeyframeGraph, solution: Solution, path: Float
) -> tuple[Float, Float]:
    """Return positions, each moved with the keyframe that began it, shape (L, 2) [m], and their rotations,
    shape (L,) [rad]. Landmarks from before the first keyframe move with the first one.

    Args:
        place: Positions of the landmarks, shape (L, 2) [m].
        birth: Their birth numbers, int64, shape (L,).
        graph, solution: Keyframes and their corrected poses.
        path: Path before the correction, shape (N, 3).
    """
    first = np.array([k.first_birth for k in graph.keyframes], np.int64)
    row = np.maximum(np.searchsorted(first, birth, side="right") - 1, 0)
    was, now = path[graph.scans][row], solution.pose[row]
    turn = wrap_angle(now[:, 2] - was[:, 2])
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = (place - was[:, :2]).T
    return now[:, :2] + np.column_stack([c * dx - s * dy, s * dx + c * dy]), turn


def same_trees(known: MapColumns, first_birth: int) -> tuple[Int, Int]:
    """Return pairs of landmarks within TWICE of each other, one begun before a loop and one after it, each
    landmark in at most one pair (most likely pairs first): the birth numbers of the later ones, ascending,
    and of the earlier ones, int64, shape (N,) each.

    Args:
        known: Landmarks of one particle after the correction.
        first_birth: Birth number of the first landmark after the loop.
    """
    old, young = np.flatnonzero(known.birth < first_birth), np.flatnonzero(known.birth >= first_birth)
    of, _ = associate(
        known.mean[young], known.covariance[young], known.mean[old], known.covariance[old], np.inf, TWICE
    )
    again = np.flatnonzero(of >= 0)
    birth, name = known.birth[young[again]], known.birth[old[of[again]]]
    order = np.argsort(birth)
    return birth[order], name[order]


def joined(known: MapColumns, birth: Int, name: Int) -> MapColumns:
    """Return the landmarks without those of the birth numbers `birth`; their hits are added to the landmarks
    of the birth numbers `name`, which keep position and covariance and get the better score of the pair.

    Args:
        known: Landmarks of one particle.
        birth: Landmarks that are removed, int64, shape (N,).
        name: The remaining landmark of each pair, int64, shape (N,); see `same_trees`.

    Raises:
        KeyError: A birth number does not exist.
    """
    hits, score = known.hits.copy(), known.score.copy()
    keep = np.ones(len(known.birth), np.bool_)
    row = {int(b): k for k, b in enumerate(known.birth)}
    for young, old in zip(birth.tolist(), name.tolist(), strict=True):
        k, o = row[young], row[old]
        hits[o] += hits[k]
        score[o] = max(score[o], score[k])
        keep[k] = False
    return MapColumns(known.mean[keep], known.covariance[keep], hits[keep], score[keep], known.birth[keep])


def without_jumps(path: Float, motion: Float) -> tuple[Float, int]:
    """Return a copy of the path with each jump replaced by the motion of the odometry, and the number of
    jumps; the path after a jump moves rigidly.

    A jump is a step of the path that differs from the odometry by more than JUMP or JUMP_TURN: a correction
    moved the pose, not the robot. A long step that the odometry reports is no jump, since scans may be lost.

    Args:
        path: x, y [m], yaw [rad], shape (N, 3).
        motion: Motion by odometry from the scan before to each scan, shape (N, 3); row 0 is ignored.
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
    """Return the covariance of the last pose relative to that of scan `first`, x, y [m], yaw [rad], shape (3,
    3), if only odometry connects the two. A heading error moves all later positions. Zeros if `first` is the
    last scan. `path` has the shape (N, 3)."""
    step = np.diff(path[first:], axis=0)
    distance = np.hypot(step[:, 0], step[:, 1])
    heading = noise.turn_distance**2 * distance + noise.turn**2 * np.abs(wrap_angle(step[:, 2]))
    ahead = path[-1, :2] - path[first + 1 :, :2]
    lever = np.column_stack([-ahead[:, 1], ahead[:, 0], np.ones(len(ahead))])
    total: Float = (lever * heading[:, None]).T @ lever
    total += noise.distance**2 * float(distance.sum()) * np.diag([1.0, 1.0, 0.0])
    return total
