"""Voxel map: each return is counted once, memory is bounded, and copies are independent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification.voxel_map import (
    FIRST_SCANS,
    MOST_TILES,
    SIDE,
    SLICE,
    SLICES,
    SMALL,
    TILE,
    VoxelMap,
    copied,
    zeros,
)
from tests.benchmarks.machine import resident_mib

MOST = 1 << 16


NOTHING = np.zeros((0, 3), np.float32)


def cloud(seed: int, n: int = 500, spread: float = 5.0):
    rng = np.random.default_rng(seed)
    rows = np.column_stack([spread * rng.standard_normal((n, 2)), rng.uniform(-1.0, 7.0, n)])
    return rows.astype(np.float32)


def remembered(points):
    return points[(points[:, 2] >= 0.0) & (np.floor(points[:, 2] / SLICE) < SLICES)]


@given(seed=st.integers(0, 2**16), n=st.integers(0, 400), scans=st.integers(1, 4))
def test_every_return_is_counted_once_and_the_means_are_theirs(seed, n, scans):
    memory = VoxelMap.empty(1 << 4, 1 << 1)  # so small that it must grow
    clouds = [cloud(seed + k, n) for k in range(scans)]
    for k, points in enumerate(clouds):
        memory.add(points, k, MOST)
    kept = remembered(np.concatenate(clouds))
    returns, mean = memory.returns[: memory.used], memory.mean[: memory.used]
    assert returns.sum() == len(kept) == memory.tile_returns[: memory.tiles].sum()
    assert (returns[:, None] * mean).sum(axis=0) == pytest.approx(kept.sum(axis=0), rel=1e-3, abs=0.05)
    cells = np.floor(kept / np.array([SIDE, SIDE, SLICE], np.float32)).astype(np.int64)
    assert memory.used == len(np.unique(cells, axis=0))


def test_a_voxel_knows_in_how_many_scans_it_was_seen():
    memory = VoxelMap.empty()
    point = np.array([[1.05, 2.05, 1.1]], np.float32)
    for scan in (0, 0, 3, 9):
        memory.add(point, scan, MOST)
    assert memory.returns[0] == 4
    assert memory.scans[0] == 3
    assert memory.latest[0] == 9


def test_a_full_memory_forgets_what_was_seen_longest_ago():
    memory = VoxelMap.empty(1 << 6, 1 << 4)
    for scan in range(40):
        memory.add(cloud(scan, 200), scan, 1 << 10)
    assert memory.used <= 1 << 10
    assert memory.latest[: memory.used].min() > 10
    assert memory.tile_returns[: memory.tiles].sum() == memory.returns[: memory.used].sum()


def test_around_a_tile_is_what_lies_there():
    memory = VoxelMap.empty()
    memory.add(cloud(1, 3000), 0, MOST)
    mean, returns = memory.around(np.array([-1, 0]), 1.2)
    everything = memory.mean[: memory.used]
    low, high = np.array([-TILE - 1.2, -1.2]), np.array([1.2, TILE + 1.2])
    inside = np.all((everything[:, :2] >= low) & (everything[:, :2] < high), axis=1)
    assert len(mean) == np.count_nonzero(inside)
    assert returns.sum() == memory.returns[: memory.used][inside].sum()


def test_a_tile_is_due_when_it_has_grown_and_few_are_due_at_once():
    memory = VoxelMap.empty()
    memory.add(cloud(1, 3000), 0, MOST)
    first = memory.due_tiles(1.1)
    assert len(first) == memory.tiles > MOST_TILES
    assert len(memory.due_tiles(1.1)) == 0
    for k in range(FIRST_SCANS):
        memory.add(cloud(2 + k, 3000), 1 + k, MOST)
    assert len(memory.due_tiles(1.1)) == MOST_TILES


def test_due_tiles_have_a_bounded_number_of_voxels_and_all_have_their_turn(monkeypatch):
    memory = VoxelMap.empty()
    memory.add(cloud(1, 3000), 0, MOST)
    assert len(memory.copy().due_tiles(1.1)) == memory.tiles  # of a first scan, which may be the only one
    memory.add(NOTHING, 1, MOST)
    voxels = dict(
        zip(map(tuple, memory.copy().due_tiles(1.1)), np.bincount(memory.home[: memory.used]), strict=True)
    )
    most = 2 * max(voxels.values())
    monkeypatch.setattr("pipeline.classification.voxel_map.MOST_VOXELS", most)
    turns = []
    while len(tiles := memory.due_tiles(1.1)):
        turns.append(set(map(tuple, tiles)))
    assert len(turns) > 2
    assert all(sum(voxels[tile] for tile in tiles) <= most for tiles in turns)
    assert sorted(tile for tiles in turns for tile in tiles) == sorted(voxels)  # each once


def test_one_tile_with_more_voxels_than_the_bound_is_due(monkeypatch):
    memory = VoxelMap.empty()
    memory.add(cloud(1, 3000), 0, MOST)
    memory.add(NOTHING, 1, MOST)
    monkeypatch.setattr("pipeline.classification.voxel_map.MOST_VOXELS", 1)
    assert len(memory.due_tiles(1.1)) == 1


def test_a_copy_stays_as_it_was():
    memory = VoxelMap.empty()
    memory.add(cloud(1), 0, MOST)
    copy = memory.copy()
    before = copy.mean[: copy.used].copy()
    memory.add(cloud(2), 1, MOST)
    assert copy.used == len(before) < memory.used
    assert np.array_equal(copy.mean[: copy.used], before)


def test_positions_that_are_no_numbers_or_too_far_are_left_out():
    memory = VoxelMap.empty()
    bad = np.array([[np.nan, 0, 1], [0, np.inf, 1], [0, 0, np.nan], [1e9, 0, 1], [0, 0, 1]], np.float32)
    memory.add(bad, 0, MOST)
    assert memory.used == 1


@pytest.mark.parametrize("shape", [0, 5, (0, 3), (7, 3), SMALL, (SMALL, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_they_are_zeros_that_can_be_written_and_copied(shape, dtype):
    array = zeros(shape, dtype)
    assert array.dtype == dtype
    assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
    assert not array.any()
    array += 1
    copy = copied(array)
    array += 1
    assert (copy == 1).all()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell")
def test_untouched_pages_take_no_memory_and_dropped_ones_are_given_back():
    before = resident_mib()
    array = zeros(1 << 25, np.float64)  # 256 MiB
    assert resident_mib() < before + 64
    array[: 1 << 24] = 1.0
    assert resident_mib() > before + 100
    del array
    assert resident_mib() < before + 64
