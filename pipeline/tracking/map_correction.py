"""Trees moved with a path that was bent; what stood twice on the map is one tree again."""

from __future__ import annotations

import numpy as np

from pipeline.loop_closure.map_correction import Bend
from pipeline.slam.association import associate
from pipeline.tracking.merge import join
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Bool, Int, Landmarks, Verdict

TWICE = 1.0  # m; trees of before and after a loop that are nearer are one


def bent(tracks: TrackTable, first: Int, bend: Bend) -> TrackTable:
    """The trees after a loop was closed. Of two that were one tree all the time the older number stays, one
    to one, so that two trees that stand close together stay two.

    Args:
        first: int64, shape (T,): the scan that each tree was seen in first.
    """
    moved = tracks.copy()
    place = tracks.x[:, :2]
    moved.x[:, :2], turn = bend.of_trees(place, first)
    c, s = np.cos(turn), np.sin(turn)
    C = np.zeros((len(tracks), 4, 4))
    C[:, 0, 0] = C[:, 1, 1] = C[:, 2, 2] = C[:, 3, 3] = c
    C[:, 1, 0] = C[:, 3, 2] = s
    C[:, 0, 1] = C[:, 2, 3] = -s
    moved.x[:, 2:] = np.einsum("nij,nj->ni", C[:, 2:, 2:], tracks.x[:, 2:])
    moved.P[:] = C @ tracks.P @ C.transpose(0, 2, 1)
    moved.shared[:] = C[:, :2, :2] @ tracks.shared @ C[:, :2, :2].transpose(0, 2, 1)
    old, young = np.flatnonzero(first <= bend.first), np.flatnonzero(first > bend.first)
    flat = moved.P[:, [0, 0, 1], [0, 1, 1]]
    of, _ = associate(moved.x[young, :2], flat[young], moved.x[old, :2], flat[old], np.inf, TWICE)
    standing = np.ones(len(tracks), np.bool_)
    for k in np.flatnonzero(of >= 0):
        join(moved, int(old[of[k]]), int(young[k]))
        standing[young[k]] = False
    return moved.take(standing)


def held(tracks: TrackTable, young: Bool, known: Landmarks, distance_max: float) -> tuple[TrackTable, Int]:
    """The trees held to SLAM's landmarks, and the rows of the landmarks without a tree, shape (K,).

    A young tree whose place was never known as well as trees are told apart stands at its landmark; without
    one it is what a wrong hypothesis left behind, and goes, unless what was gathered says that it is a tree.

    Args:
        tracks: Copied; young: shape (T,), which of them are of the way that was bent.
        distance_max: How far from a tree its detection may lie [m].
    """
    t = tracks.copy()
    own = t.P[:, [0, 0, 1], [0, 1, 1]]
    total = known.covariance + known.shared
    landmark_of, _ = associate(t.x[:, :2], own, known.position, total[:, [0, 0, 1], [0, 1, 1]], np.inf, TWICE)
    doubtful = young & (np.sqrt(0.5 * (own[:, 0] + own[:, 2])) > distance_max)
    moved = np.flatnonzero(doubtful & (landmark_of >= 0))
    at = landmark_of[moved]
    t.x[moved, :2], t.shared[moved] = known.position[at], known.shared[at]
    t.P[moved, :2, :2] = total[at]
    t.P[moved, :2, 2:] = 0.0
    t.P[moved, 2:, :2] = 0.0
    near = np.zeros(len(known.position), np.bool_)
    near[landmark_of[landmark_of >= 0]] = True
    gone = doubtful & (landmark_of < 0) & (t.verdict != Verdict.TREE)
    left: Int = np.flatnonzero(~near)
    return t.take(~gone), left
