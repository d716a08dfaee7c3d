"""Maps of the particles: owners of shared blocks, and landmarks in reach against all landmarks."""

from __future__ import annotations

import numpy as np
from hypothesis import given

from pipeline.slam.particle_maps import (
    ROOM,
    MapColumns,
    is_sound,
    known_near,
    map_of,
    own_block,
    shared_map,
    taken,
    with_room,
)
from tests.pipeline.strategies import seeds

PARTICLES = 5


def partly_shared(rng):
    """Maps of some particles in a pool with free rows, in which each particle has changed some of its blocks;
    some places are unused."""
    n = int(rng.integers(1, 4 * ROOM))
    columns = MapColumns(
        rng.uniform(-20.0, 20.0, (n, 2)),
        rng.uniform(0.0, 1.0, (n, 3)),
        rng.integers(0, 4, n).astype(np.int32),
        rng.uniform(0.0, 5.0, n).astype(np.float32),
        np.arange(n),
    )
    columns.mean[:] = columns.mean[np.argsort(columns.mean[:, 0])]  # narrow blocks along x
    maps = shared_map(PARTICLES, columns)
    k = maps.block.shape[1]
    maps = with_room(maps, 0, PARTICLES * k)
    for p, b in np.argwhere(rng.random((PARTICLES, k)) < 0.5):
        row = own_block(maps, p, b)
        maps.hits[row, 0] = 1 + p
    return maps


@given(seeds)
def test_taken_maps_keep_all_landmarks_and_each_block_counts_its_particles(seed):
    rng = np.random.default_rng(seed)
    maps = partly_shared(rng)
    rows = rng.integers(0, PARTICLES, rng.integers(1, 9))
    chosen = taken(maps, rows)
    assert is_sound(chosen, len(rows))
    particles = [np.count_nonzero(chosen.block == b) for b in range(len(chosen.owners))]
    assert chosen.owners.tolist() == particles
    assert min(particles) >= 1, "no row is unused"
    for p, row in enumerate(rows):
        for column, wanted in zip(map_of(chosen, p), map_of(maps, row), strict=True):
            np.testing.assert_array_equal(column, wanted)


@given(seeds)
def test_the_landmarks_in_reach_are_those_at_a_smaller_distance(seed):
    rng = np.random.default_rng(seed)
    maps, at, reach = partly_shared(rng), rng.uniform(-25.0, 25.0, 2), rng.uniform(0.0, 15.0)
    for p in range(PARTICLES):
        mean, covariance, hits, _, birth = map_of(maps, p)
        near = np.hypot(*(mean - at).T) < reach
        wanted = mean[near], covariance[near], hits[near], birth[near]
        for expected, found in zip(wanted, known_near(maps, p, at[0], at[1], reach), strict=True):
            np.testing.assert_array_equal(found, expected)
