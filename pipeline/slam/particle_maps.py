"""The maps of all particles: positions by particle, and what the data association decides in common.

The particles share the data association of a scan up to ambiguous detections, so hits, misses and
covariance of a landmark are the same in all maps (the covariance of a Kalman filter depends on no measured
value). Only the positions differ. They are in one pool of small blocks that particles share until one of
them writes, so that the cost of resampling does not grow with what is out of sight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.types.records import Float32, Int, Int32

ROOM = 16  # landmarks per block, 256 bytes: four lines of the cache
ABSENT = 1e9  # m; position of a landmark that a particle does not have, out of reach of any scan


class EarlierMaps(NamedTuple):
    """Maps of version 0.1.0, in which each particle had slots, hits and covariances of its own."""

    block: Int32
    places: Int32
    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int
    box: Float
    owners: Int32
    free: Int32
    free_count: Int

    def upgraded(self) -> Maps:
        """Return maps with the landmarks of the first particle. Each other particle keeps its positions of
        those that it has too, by their births.

        Raises:
            ValueError: The columns do not fit.
        """
        try:
            known = [self._of(p) for p in range(len(self.block))]
        except IndexError:
            raise ValueError("the particles' maps do not fit") from None
        maps = shared_map(len(known), known[0])
        maps = with_room(maps, 0, maps.block.size)
        slot = {int(birth): j for j, birth in enumerate(known[0].birth)}
        for p, other in enumerate(known):
            for birth, mean in zip(other.birth.tolist(), other.mean, strict=True):
                j = slot.get(birth)
                if j is not None:
                    maps.mean[own_block(maps, p, j // ROOM), j % ROOM] = mean
        return maps

    def _of(self, p: int) -> MapColumns:
        slots = np.arange(self.places[p])
        rows = self.block[p, slots // ROOM], slots % ROOM
        used = self.hits[rows] > 0
        return MapColumns(*(column[rows][used] for column in (
            self.mean, self.covariance, self.hits, self.score, self.birth
        )))  # fmt: skip


class Maps(NamedTuple):
    """Maps of P particles with K blocks of ROOM slots each; a slot is the same landmark in all maps.

    Attributes:
        block: Row of the pool for each block of each particle, -1 for none yet, int32, shape (P, K).
        mean: Pool of positions, shape (N, ROOM, 2) [m].
        owners: Number of particles that use a row of the pool, int32, shape (N,).
        free: Unused rows of the pool, int32, shape (N,); the first `free_count[0]` are valid.
        covariance: xx, xy, yy of each slot, shape (K * ROOM, 3) [m^2].
        hits: Number of detections, 0 for a slot without landmark, int32, shape (K * ROOM,).
        score: Hits less misses, float32, shape (K * ROOM,).
        birth: Serial number of the first detection, int64, shape (K * ROOM,).
    """

    block: Int32
    mean: Float
    owners: Int32
    free: Int32
    free_count: Int
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int

    @staticmethod
    def earlier() -> type[EarlierMaps]:
        """Return the type of maps in files of version 0.1.0; see io.checkpoints.codec."""
        return EarlierMaps


class MapColumns(NamedTuple):
    """The landmarks of one particle as columns of length L; see Maps."""

    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int


def empty_maps(particles: int) -> Maps:
    """Return maps without landmarks."""
    return shared_map(
        particles,
        MapColumns(
            np.zeros((0, 2)),
            np.zeros((0, 3)),
            np.zeros(0, np.int32),
            np.zeros(0, np.float32),
            np.zeros(0, np.int64),
        ),
    )


def shared_map(particles: int, columns: MapColumns) -> Maps:
    """Return maps that all have the same landmarks."""
    K = max(-(-len(columns.hits) // ROOM), 1)

    def filled(column: np.ndarray) -> np.ndarray:
        padded = np.zeros((K * ROOM, *column.shape[1:]), column.dtype)
        padded[: len(column)] = column
        return padded

    return Maps(
        block=np.tile(np.arange(K, dtype=np.int32), (particles, 1)),
        mean=filled(columns.mean).reshape(K, ROOM, 2),
        owners=np.full(K, particles, np.int32),
        free=np.zeros(K, np.int32),
        free_count=np.zeros(1, np.int64),
        covariance=filled(columns.covariance),
        hits=filled(columns.hits),
        score=filled(columns.score),
        birth=filled(columns.birth),
    )


@compiled
def with_room(maps: Maps, landmarks: int, rows: int) -> Maps:
    """Return the maps with free slots for a number of landmarks, and free rows in the pool."""
    P, K = maps.block.shape
    slots, used = len(maps.hits), 0
    for j in range(slots):
        used += maps.hits[j] > 0
    if used + landmarks > slots:
        more = max((used + landmarks - slots + ROOM - 1) // ROOM, K)
        block = np.full((P, K + more), -1, np.int32)
        block[:, :K] = maps.block
        maps = Maps(
            block, maps.mean, maps.owners, maps.free, maps.free_count,
            np.concatenate((maps.covariance, np.zeros((more * ROOM, 3)))),
            np.concatenate((maps.hits, np.zeros(more * ROOM, np.int32))),
            np.concatenate((maps.score, np.zeros(more * ROOM, np.float32))),
            np.concatenate((maps.birth, np.zeros(more * ROOM, np.int64))),
        )  # fmt: skip
    n, count = len(maps.owners), maps.free_count[0]
    if rows <= count:
        return maps
    more = max(rows - count, n // 2)
    free = np.zeros(n + more, np.int32)
    free[:count] = maps.free[:count]
    free[count : count + more] = np.arange(n, n + more)
    return Maps(
        maps.block,
        np.concatenate((maps.mean, np.zeros((more, ROOM, 2)))),
        np.concatenate((maps.owners, np.zeros(more, np.int32))),
        free,
        np.array([count + more]),
        maps.covariance, maps.hits, maps.score, maps.birth,
    )  # fmt: skip


def taken(maps: Maps, rows: Int) -> Maps:
    """Return the maps of redrawn particles: particle k gets the map of particle rows[k]. The pool is new and
    has no free rows; its order depends only on the maps, so that a saved state has the same bytes."""
    slots = np.flatnonzero(maps.hits)
    K = max(int(slots.max(initial=-1)) // ROOM + 1, 1)
    names, first, inverse = np.unique(maps.block[rows, :K], return_index=True, return_inverse=True)
    rank = np.empty(len(names), np.int32)
    order = np.argsort(first)
    rank[order] = np.arange(len(names))
    block = rank[inverse.reshape(len(rows), K)]
    return maps._replace(
        block=block,
        mean=maps.mean[names[order]],
        owners=np.bincount(block.ravel(), minlength=len(names)).astype(np.int32),
        free=np.zeros(len(names), np.int32),
        free_count=np.zeros(1, np.int64),
        **{name: getattr(maps, name)[: K * ROOM].copy() for name in ("covariance", "hits", "score", "birth")},
    )


def is_sound(maps: Maps, particles: int) -> bool:
    """Return whether maps that come from a file fit a number of particles and their own pool."""
    if maps.block.ndim != 2 or maps.block.shape[0] != particles:
        return False
    slots, rows, free = maps.block.shape[1] * ROOM, len(maps.owners), int(maps.free_count.sum())
    shapes = {
        "mean": (rows, ROOM, 2), "owners": (rows,), "free": (rows,), "free_count": (1,),
        "covariance": (slots, 3), "hits": (slots,), "score": (slots,), "birth": (slots,),
    }  # fmt: skip
    if any(getattr(maps, name).shape != shape for name, shape in shapes.items()):
        return False
    if not (maps.block.min(initial=0) >= -1 and maps.block.max(initial=-1) < rows and 0 <= free <= rows):
        return False
    held = np.bincount(maps.block[maps.block >= 0], minlength=rows)
    return (
        not np.any(maps.block[:, np.flatnonzero(maps.hits) // ROOM] < 0)
        and np.array_equal(held, maps.owners)
        and np.array_equal(np.sort(maps.free[:free]), np.flatnonzero(held == 0))
    )


@compiled
def slots_near(maps: Maps, p: int, x: float, y: float, reach: float) -> tuple[Int, Float]:
    """Return the landmarks of one particle within a distance of a place: slots, shape (L,), and their
    positions, shape (L, 2) [m]."""
    slots, mean, n = np.empty(len(maps.hits), np.int64), np.empty((len(maps.hits), 2)), 0
    for j in range(len(maps.hits)):
        if maps.hits[j] == 0:
            continue
        b = maps.block[p, j // ROOM]
        u, v = maps.mean[b, j % ROOM, 0], maps.mean[b, j % ROOM, 1]
        if (u - x) * (u - x) + (v - y) * (v - y) < reach * reach:
            slots[n], mean[n, 0], mean[n, 1] = j, u, v
            n += 1
    return slots[:n], mean[:n]


@compiled
def map_of(maps: Maps, p: int) -> tuple[Float, Float, Int32, Float32, Int]:
    """Return the landmarks of one particle, copied; the columns of MapColumns."""
    slots, mean = slots_near(maps, p, 0.0, 0.0, 0.5 * ABSENT)
    return mean, maps.covariance[slots], maps.hits[slots], maps.score[slots], maps.birth[slots]


@compiled_within
def own_block(maps: Maps, p: int, k: int) -> int:
    """Return the row of block k of particle p for writing; it is copied before if others share it."""
    b = maps.block[p, k]
    if b >= 0 and maps.owners[b] == 1:
        return int(b)
    maps.free_count[0] -= 1
    n = maps.free[maps.free_count[0]]
    for o in range(ROOM):
        for a in range(2):
            maps.mean[n, o, a] = maps.mean[b, o, a] if b >= 0 else 0.0
    if b >= 0:
        maps.owners[b] -= 1
    maps.owners[n] = 1
    maps.block[p, k] = n
    return int(n)


@compiled_borrowing
def take_ancestors(ancestors: Int, pose: Float, maps: Maps) -> None:
    """Give each particle pose and map of its ancestor, in place; blocks are shared until one writes.

    Needs ancestors[ancestors] == ancestors, so that no particle is read after it was overwritten.
    """
    for i in range(ancestors.shape[0]):
        a = ancestors[i]
        if a == i:
            continue
        for j in range(3):
            pose[i, j] = pose[a, j]
        for k in range(maps.block.shape[1]):
            old, new = maps.block[i, k], maps.block[a, k]
            if old == new:
                continue
            if new >= 0:
                maps.owners[new] += 1
            if old >= 0:
                maps.owners[old] -= 1
                if maps.owners[old] == 0:
                    maps.free[maps.free_count[0]] = old
                    maps.free_count[0] += 1
            maps.block[i, k] = new
