"""The height map, moved with a path that was bent."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.ground.terrain_map.cell_update import CELL, COLUMNS, MEAN, SIDE, VARIANCE, VIEWS, WEIGHT
from pipeline.loop_closure.map_correction import Bend
from pipeline.types.records import Float32, Int

Tile = tuple[int, int]


def bent(tiles: Mapping[Tile, Float32], bend: Bend) -> dict[Tile, Float32]:
    """The tiles where they are now: each cell goes by whole cells with the scan that was taken nearest, so
    that no gap comes about inside of a piece; cells that meet are averaged by their weights."""
    from scipy.spatial import cKDTree

    keys = np.array(list(tiles), np.int64).reshape(-1, 2)
    if not len(keys):
        return {}
    cells = np.stack(list(tiles.values())).reshape(-1, SIDE, SIDE, COLUMNS)
    n, i, j = np.nonzero(cells[..., VIEWS])
    row: Float = cells[n, i, j].astype(np.float64)
    place = SIDE * keys[n] + np.column_stack([i, j])
    centre: Float = (place.astype(np.float64) + 0.5) * CELL
    _, scan = cKDTree(bend.before[: bend.last + 1, :2]).query(centre)
    shift = np.round((bend.moved(centre, np.asarray(scan)) - centre) / CELL).astype(np.int64)
    moved, of = np.unique(place + shift, axis=0, return_inverse=True)
    fresh = _averaged(row, of.ravel(), len(moved))
    home, rest = np.divmod(moved, SIDE)
    # In the order in which they were seen, as far as they were there before.
    order = {tile: k for k, tile in enumerate(tiles)}
    names = [(int(a), int(b)) for a, b in np.unique(home, axis=0)]
    names.sort(key=lambda tile: order.get(tile, len(order)))
    out = {tile: np.zeros((SIDE, SIDE, COLUMNS), np.float32) for tile in names}
    for k, (a, b) in enumerate(home):
        out[(int(a), int(b))][rest[k, 0], rest[k, 1]] = fresh[k]
    return out


def _averaged(row: Float, of: Int, cells: int) -> Float32:
    """Rows of cells that fall into one, by their weights."""
    weight = np.bincount(of, row[:, WEIGHT], cells)
    mean = np.bincount(of, row[:, WEIGHT] * row[:, MEAN], cells) / weight
    apart = row[:, VARIANCE] + (row[:, MEAN] - mean[of]) ** 2
    fresh = np.zeros((cells, COLUMNS), np.float32)
    fresh[:, WEIGHT], fresh[:, MEAN] = weight, mean
    fresh[:, VARIANCE] = np.bincount(of, row[:, WEIGHT] * apart, cells) / weight
    fresh[:, VIEWS] = np.bincount(of, row[:, VIEWS], cells)
    return fresh
