"""What was gathered, moved with a path that was bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.classification.voxel_map import TILE, Memory, index, keys_of, tiles_of
from pipeline.loop_closure.map_correction import Bend
from pipeline.types.records import Columns, Int

LOW, HIGH = 0.6, 1.6  # m above the ground: what stands there tells when a column was seen


def bent(memory: Memory, bend: Bend) -> Memory:
    """The voxels where they are now: each goes with the last scan that saw it, and those that meet are one.
    Tiles that changed are judged anew in their turn."""
    n = memory.used
    mean = memory.mean[:n].copy()
    latest = memory.latest[:n].astype(np.int64)
    mean[:, :2] = bend.moved(memory.mean[:n, :2].astype(np.float64), latest)
    key = np.where(latest > bend.first, keys_of(mean), memory.key[:n])
    kept = np.flatnonzero(key >= 0)  # no drive is so long that a place has no key
    names, first, of = np.unique(key[kept], return_index=True, return_inverse=True)
    order = np.argsort(first)  # as they lay before
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    of = rank[of.ravel()]
    fresh = Memory.empty(len(memory.key), _room(len(memory.tile_key), names))
    rows = len(names)
    weight = memory.returns[kept].astype(np.float64)
    total = np.bincount(of, weight, rows)
    fresh.key[:rows] = names[order]
    for axis in range(3):
        fresh.mean[:rows, axis] = np.bincount(of, weight * mean[kept, axis], rows) / total
    fresh.returns[:rows] = total
    np.maximum.at(fresh.scans, of, memory.scans[kept])
    np.maximum.at(fresh.latest, of, memory.latest[kept])
    fresh.added = memory.added
    index(fresh, rows)
    return fresh


def _room(room: int, keys: Int) -> int:
    """Rows for tiles, at least as many as before: a tile that is turned lies on up to four."""
    tiles = len(np.unique(tiles_of(keys)))
    while room <= tiles:
        room *= 2
    return room


def bent_columns(columns: Columns, memory: Memory, bend: Bend) -> Columns:
    """The columns where they are now: each goes with the voxels around it.

    Args:
        memory: As it was before it was bent.
    """
    from scipy.spatial import cKDTree

    height = memory.mean[: memory.used, 2]
    rows = np.flatnonzero((height >= LOW) & (height < HIGH))
    if not len(rows) or not len(columns.axis):
        return columns
    _, nearest = cKDTree(memory.mean[rows, :2]).query(columns.axis[:, :2])
    scan = memory.latest[rows[nearest]].astype(np.int64)
    axis = columns.axis.copy()
    axis[:, :2] = bend.moved(columns.axis[:, :2], scan)
    turn = bend.turned(columns.axis[:, :2], scan)
    c, s = np.cos(turn), np.sin(turn)
    u, v = columns.axis[:, 2], columns.axis[:, 3]
    axis[:, 2], axis[:, 3] = c * u - s * v, s * u + c * v
    return replace(columns, axis=axis, tile=np.floor(axis[:, :2] / TILE).astype(np.int64))
