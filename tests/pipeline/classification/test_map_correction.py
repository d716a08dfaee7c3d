"""What was gathered goes with a path that is bent, and no voxel is lost or lies in two tiles."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.classification.column_classifier import bent
from pipeline.classification.voxel_map import TILE, VoxelMap, keys_of, tiles_of
from pipeline.loop_closure.map_correction import Bend


def filled(side: int, room: int) -> VoxelMap:
    """A square of tiles with a voxel in each corner and in the middle of every one."""
    memory = VoxelMap.empty(1 << 14, room)
    corners = np.array([[0.2, 0.2], [3.8, 0.2], [0.2, 3.8], [3.8, 3.8], [2.0, 2.0]])
    origin = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2) * TILE
    places = (origin + corners).reshape(-1, 2)
    points = np.column_stack([places, np.full(len(places), 1.3)]).astype(np.float32)
    memory.add(points, 5, 1 << 14)
    return memory


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 4])
@pytest.mark.parametrize("side", [3, 15])  # 15: as many tiles as there is room for, but a few
def test_a_map_that_is_turned_over_more_tiles_stays_whole(side, turn):
    memory = filled(side, 256)
    assert memory.tiles == side**2
    before = np.array([[0.0, 0.0, 0.0], [30.0, 30.0, 0.0]])
    bend = Bend(before, before + np.array([0.9, 0.7, turn]), 0, 1)
    fresh = bent(memory, bend)
    assert len(fresh.tile_key) > fresh.tiles >= memory.tiles
    assert int(fresh.returns[: fresh.used].sum()) == int(memory.returns[: memory.used].sum())
    keys = fresh.key[: fresh.used]
    np.testing.assert_array_equal(keys_of(fresh.mean[: fresh.used]), keys)
    np.testing.assert_array_equal(fresh.tile_key[fresh.home[: fresh.used]], tiles_of(keys))
    assert int(fresh.tile_returns[: fresh.tiles].sum()) == int(memory.tile_returns[: memory.tiles].sum())
    # Each tile's chain holds its voxels, each once.
    seen = 0
    for tile in range(fresh.tiles):
        row = int(fresh.tile_first[tile])
        while row >= 0:
            assert fresh.home[row] == tile
            row, seen = int(fresh.following[row]), seen + 1
    assert seen == fresh.used
