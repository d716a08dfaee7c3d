"""Trees moved with a path that was bent; what stood twice on the map is one tree again."""

from __future__ import annotations

import numpy as np

from pipeline.association import associate
from pipeline.bend import Bend
from pipeline.records import Int
from pipeline.tracking.merge import join
from pipeline.tracking.table import TrackTable

TWICE = 0.5  # m; trees of before and after a loop that are nearer are one


def bent(tracks: TrackTable, first: Int, bend: Bend) -> TrackTable:
    """The trees after a loop was closed. Of two that were one tree all the time the older number stays, one
    to one, so that two trees that stand close together stay two.

    Args:
        first: int64, shape (T,): the scan that each tree was seen in first.
    """
    moved = tracks.copy()
    place = tracks.x[:, :2]
    turn = bend.turned(place, first)
    moved.x[:, :2] = bend.moved(place, first)
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
