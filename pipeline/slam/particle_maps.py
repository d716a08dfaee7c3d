"""Landmarks of the particles: their update and merging within one particle, and the maps of all particles in
one pool of small blocks, which particles share until one of them writes.

Resampling copies rows of block numbers but no landmarks, so that its cost does not depend on the size of the
map. A shared block is copied before a particle changes a landmark in it. The bounding box of a block excludes
blocks out of reach without a test of their landmarks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.hash_grid import Cells, holds_unseen
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.types.records import Bool, Float32, Int, Int32

ROOM = 16  # landmarks per block; landmarks with successive births are near each other


class Maps(NamedTuple):
    """Maps of P particles with K blocks each, in a pool of N blocks for ROOM landmarks each.

    Attributes:
        block: Row of the pool of each block, -1 for an unused block, int32, shape (P, K).
        places: Number of used places per particle, including those of removed landmarks, int32, shape (P,).
        mean: Positions, shape (N, ROOM, 2) [m].
        covariance: Covariances xx, xy, yy, shape (N, ROOM, 3) [m^2].
        hits: Number of detections, 0 for a place without landmark, int32, shape (N, ROOM).
        score: Hits minus weighted misses, float32, shape (N, ROOM); a landmark whose score is not above 0 is
            removed.
        birth: Serial number of the first detection of the landmark, int64, shape (N, ROOM). Landmarks of
            different particles with the same birth are the same tree.
        box: Minimum x, y and maximum x, y of all positions ever written to the block, shape (N, 4) [m].
        owners: Number of particles that use the block, int32, shape (N,).
        free: Unused rows of the pool, of which the first `free_count[0]` are valid, int32, shape (N,).
        free_count: Number of valid entries of `free`, int64, shape (1,).
    """

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


class MapColumns(NamedTuple):
    """Landmarks of one particle, as columns of length L; see Maps."""

    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int

    def take(self, rows: Int | Bool) -> MapColumns:
        """Return copies of some landmarks, by row numbers or by a mask of shape (L,)."""
        return MapColumns(
            self.mean[rows], self.covariance[rows], self.hits[rows], self.score[rows], self.birth[rows]
        )


def empty_maps(particles: int) -> Maps:
    """Return maps without landmarks for a number of particles, with an empty pool."""
    return _with_pool(np.full((particles, 1), -1, np.int32), np.zeros(particles, np.int32), 0)


def shared_map(particles: int, columns: MapColumns) -> Maps:
    """Return maps of a number of particles that all have the same landmarks, in shared blocks without free
    rows. Columns of length 0 give maps without landmarks."""
    n = len(columns.hits)
    k = max(-(-n // ROOM), 1)
    maps = _with_pool(
        np.tile(np.arange(k, dtype=np.int32), (particles, 1)), np.full(particles, n, np.int32), k
    )
    for name, column in zip(MapColumns._fields, columns, strict=True):
        flat = getattr(maps, name)
        flat.reshape(k * ROOM, *flat.shape[2:])[:n] = column
    maps.owners[:] = particles
    for b in range(k):
        place = columns.mean[b * ROOM : (b + 1) * ROOM]
        if len(place):
            maps.box[b] = [*place.min(axis=0), *place.max(axis=0)]
    return maps


def _with_pool(block: Int32, places: Int32, rows: int) -> Maps:
    """Return maps with these blocks and a pool of `rows` rows without landmarks: no owners, no free rows,
    empty bounding boxes. `block` and `places` are as in Maps and are not copied."""
    nowhere = np.tile([np.inf, np.inf, -np.inf, -np.inf], (rows, 1))
    return Maps(
        block=block,
        places=places,
        mean=np.zeros((rows, ROOM, 2)),
        covariance=np.zeros((rows, ROOM, 3)),
        hits=np.zeros((rows, ROOM), np.int32),
        score=np.zeros((rows, ROOM), np.float32),
        birth=np.zeros((rows, ROOM), np.int64),
        box=nowhere,
        owners=np.zeros(rows, np.int32),
        free=np.zeros(rows, np.int32),
        free_count=np.zeros(1, np.int64),
    )


def with_room(maps: Maps, landmarks: int, rows: int) -> Maps:
    """Return the maps with space for a number of further landmarks per particle and at least a number of free
    rows in the pool. The result shares arrays with `maps` where there was enough space; `places` is always
    shared."""
    particles, k = maps.block.shape
    places = int(maps.places.max(initial=0)) + landmarks
    if places > k * ROOM:
        block = np.full((particles, max(-(-places // ROOM), 2 * k)), -1, np.int32)
        block[:, :k] = maps.block
        maps = maps._replace(block=block)
    n, free = len(maps.owners), int(maps.free_count[0])
    if rows <= free:
        return maps
    more = max(rows - free, n // 2)
    grown = _with_pool(maps.block, maps.places, n + more)
    for name in (*MapColumns._fields, "box", "owners"):
        getattr(grown, name)[:n] = getattr(maps, name)
    grown.free[:free] = maps.free[:free]
    grown.free[free : free + more] = np.arange(n, n + more)
    grown.free_count[0] = free + more
    return grown


@compiled_borrowing
def _copy_row(maps: Maps, b: int, other: Maps, n: int) -> None:
    """Copy landmarks and bounding box of row b of the pool to row n of the pool of `other`, which may be the
    same; `owners` and `free` are not changed."""
    for o in range(ROOM):
        other.mean[n, o, 0], other.mean[n, o, 1] = maps.mean[b, o, 0], maps.mean[b, o, 1]
        for a in range(3):
            other.covariance[n, o, a] = maps.covariance[b, o, a]
        other.hits[n, o], other.score[n, o] = maps.hits[b, o], maps.score[b, o]
        other.birth[n, o] = maps.birth[b, o]
    for a in range(4):
        other.box[n, a] = maps.box[b, a]


def taken(maps: Maps, rows: Int) -> Maps:
    """Return a copy of the maps of the particles in `rows`, int64, shape (P,), which may repeat.

    The new pool has no free rows. Its rows are in the order in which particles use them, so that the bytes of
    a saved state do not depend on the history of the pool.
    """
    block = maps.block[rows, : max(-(-int(maps.places[rows].max(initial=0)) // ROOM), 1)]
    names, first = np.unique(block[block >= 0], return_index=True)
    held = names[np.argsort(first)]
    row_of = np.full(len(maps.owners) + 1, -1, np.int32)  # the last entry is that of -1
    row_of[held] = np.arange(len(held))
    block = row_of[block]
    kept = {
        name: getattr(maps, name)[held] for name in ("mean", "covariance", "hits", "score", "birth", "box")
    }
    return maps._replace(
        **kept,
        block=block,
        places=maps.places[rows],
        owners=np.bincount(block[block >= 0], minlength=len(held)).astype(np.int32),
        free=np.zeros(len(held), np.int32),
        free_count=np.zeros(1, np.int64),
    )


def is_sound(maps: Maps, particles: int) -> bool:
    """Return whether maps from a file are consistent: shapes, number of particles, indices, numbers of owners
    and free rows. Positions, covariances, hits and scores are not checked; the codec checks data types."""
    template = _with_pool(maps.block, maps.places, len(maps.owners))
    if any(getattr(maps, name).shape != getattr(template, name).shape for name in Maps._fields):
        return False
    if maps.block.ndim != 2 or maps.block.shape[:1] != (particles,) or maps.places.shape != (particles,):
        return False
    rows, free = len(maps.owners), int(maps.free_count[0])
    if not (maps.block.min(initial=-1) >= -1 and maps.block.max(initial=-1) < rows and 0 <= free <= rows):
        return False
    held = np.bincount(maps.block[maps.block >= 0], minlength=rows)
    needed = np.arange(maps.block.shape[1]) * ROOM < maps.places[:, None]
    return (
        bool(np.all((maps.places >= 0) & (maps.places <= maps.block.shape[1] * ROOM)))
        and not np.any(maps.block[needed] < 0)
        and np.array_equal(held, maps.owners)
        and np.array_equal(np.sort(maps.free[:free]), np.flatnonzero(held == 0))
    )


@compiled
def map_of(maps: Maps, p: int) -> tuple[Float, Float, Int32, Float32, Int]:
    """Return copies of the landmarks of particle p: the columns of `MapColumns`. Unused places (hits 0) are
    skipped; the order is that of the places."""
    places = maps.places[p]
    mean, covariance = np.empty((places, 2)), np.empty((places, 3))
    hits, score = np.empty(places, np.int32), np.empty(places, np.float32)
    birth = np.empty(places, np.int64)
    n = 0
    for i in range(places):
        b, o = maps.block[p, i // ROOM], i % ROOM
        if maps.hits[b, o] > 0:
            mean[n, 0], mean[n, 1] = maps.mean[b, o, 0], maps.mean[b, o, 1]
            for a in range(3):
                covariance[n, a] = maps.covariance[b, o, a]
            hits[n], score[n], birth[n] = maps.hits[b, o], maps.score[b, o], maps.birth[b, o]
            n += 1
    return mean[:n], covariance[:n], hits[:n], score[:n], birth[:n]


@compiled
def known_near(maps: Maps, p: int, x: float, y: float, reach: float) -> tuple[Float, Float, Int32, Int]:
    """Return the landmarks of particle p within `reach` [m] of x, y [m]: positions, shape (L, 2) [m];
    covariances xx, xy, yy, shape (L, 3) [m^2]; hits, int32, and birth numbers, int64, shape (L,). The
    distance must be smaller than `reach`; the arrays are copies, in the order of the places."""
    places = maps.places[p]
    mean, covariance, hits = np.empty((places, 2)), np.empty((places, 3)), np.empty(places, np.int32)
    birth = np.empty(places, np.int64)
    n = 0
    for k in range((maps.places[p] + ROOM - 1) // ROOM):
        b = maps.block[p, k]
        dx = max(maps.box[b, 0] - x, 0.0, x - maps.box[b, 2])
        dy = max(maps.box[b, 1] - y, 0.0, y - maps.box[b, 3])
        if not dx * dx + dy * dy < reach * reach:
            continue
        for o in range(min(ROOM, maps.places[p] - k * ROOM)):
            dx, dy = maps.mean[b, o, 0] - x, maps.mean[b, o, 1] - y
            if maps.hits[b, o] > 0 and dx * dx + dy * dy < reach * reach:
                mean[n, 0], mean[n, 1] = maps.mean[b, o, 0], maps.mean[b, o, 1]
                for a in range(3):
                    covariance[n, a] = maps.covariance[b, o, a]
                hits[n], birth[n] = maps.hits[b, o], maps.birth[b, o]
                n += 1
    return mean[:n], covariance[:n], hits[:n], birth[:n]


def blocks_in_reach(maps: Maps, pose: Float, reach: float, fresh: int) -> tuple[Int32, Int32, int]:
    """Return the blocks of each particle whose bounding box is at most `reach` from its pose.

    Args:
        maps: Maps.
        pose: Poses, shape (P, 3).
        reach: Distance from the pose [m].
        fresh: Maximum number of new landmarks per particle.

    Returns:
        Columns of `Maps.block`, ascending, int32, shape (P, K); number of valid entries per row, int32, shape
        (P,); and the number of free rows of the pool that the update may need.
    """
    near = np.empty(maps.block.shape, np.int32)
    length = np.empty(len(pose), np.int32)
    shared = _fill_in_reach(maps, pose, reach, near, length)
    return near, length, len(pose) * (fresh // ROOM + 2) + shared


@compiled_borrowing
def _fill_in_reach(maps: Maps, pose: Float, reach: float, near: Int32, length: Int32) -> int:
    """Fill the first two results of `blocks_in_reach`; return the number of shared blocks among them.

    Args:
        maps: The maps.
        pose: Poses of the particles, x, y first, shape (P, 3).
        reach: Distance [m].
        near: Filled with the blocks of each particle, shape (P, K).
        length: Filled with the number of blocks of each particle, shape (P,).
    """
    shared = 0
    for p in range(pose.shape[0]):
        n = 0
        for k in range((maps.places[p] + ROOM - 1) // ROOM):
            b = maps.block[p, k]
            dx = max(maps.box[b, 0] - pose[p, 0], 0.0, pose[p, 0] - maps.box[b, 2])
            dy = max(maps.box[b, 1] - pose[p, 1], 0.0, pose[p, 1] - maps.box[b, 3])
            if dx * dx + dy * dy <= reach * reach:
                near[p, n] = k
                n += 1
                shared += maps.owners[b] > 1
        length[p] = n
    return shared


@compiled_borrowing
def widen(maps: Maps, b: int, x_min: float, y_min: float, x_max: float, y_max: float) -> None:
    """Extend the bounding box of row b of the pool by another box. In place."""
    maps.box[b, 0], maps.box[b, 1] = min(maps.box[b, 0], x_min), min(maps.box[b, 1], y_min)
    maps.box[b, 2], maps.box[b, 3] = max(maps.box[b, 2], x_max), max(maps.box[b, 3], y_max)


@compiled_borrowing
def own_block(maps: Maps, p: int, k: int) -> int:
    """Return the row of the pool of block k of particle p for writing. A shared or unused block gets a free
    row first. The pool must have a free row. The maps change in place; the content of a shared block is
    copied."""
    b = maps.block[p, k]
    if b >= 0 and maps.owners[b] == 1:
        return int(b)
    maps.free_count[0] -= 1
    n = maps.free[maps.free_count[0]]
    if b < 0:
        for o in range(ROOM):
            maps.hits[n, o] = 0
        maps.box[n, 0] = maps.box[n, 1] = np.inf
        maps.box[n, 2] = maps.box[n, 3] = -np.inf
    else:
        _copy_row(maps, b, maps, n)
        maps.owners[b] -= 1
    maps.owners[n] = 1
    maps.block[p, k] = n
    return int(n)


@compiled_borrowing
def take_ancestors(ancestors: Int, pose: Float, maps: Maps) -> None:
    """Replace each particle by its ancestor, in place; their blocks are shared.

    Args:
        ancestors: Row of the ancestor of each particle, int64, shape (P,). An ancestor must be its own
            ancestor, so that no particle is read after it was overwritten.
        pose: Poses, shape (P, 3).
        maps: Maps.
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
        maps.places[i] = maps.places[a]


VARIANCE_MIN = 1e-4  # m^2 in each direction; all views of a trunk share an error of about one centimetre


@compiled_borrowing
def kalman_update(
    m: Float, Sigma: Float, j: int, z0: float, z1: float, R0: float, R1: float, R2: float
) -> None:
    """Update a static landmark with a measured position, in place. The variance of the result is at least
    VARIANCE_MIN in every direction.

    Args:
        m: Positions of the landmarks, shape (L, 2) [m]; row j is updated.
        Sigma: Covariances xx, xy, yy of the landmarks, shape (L, 3) [m^2]; row j is updated.
        j: Row of the landmark.
        z0, z1: Measured position [m].
        R0, R1, R2: Covariance xx, xy, yy of the measurement [m^2].
    """
    S0, S1, S2 = Sigma[j, 0], Sigma[j, 1], Sigma[j, 2]
    a, b, d = S0 + R0, S1 + R1, S2 + R2  # S = Sigma + R, H = I
    scale = 1.0 / (a * d - b * b)
    k00, k01 = (S0 * d - S1 * b) * scale, (S1 * a - S0 * b) * scale  # K = Sigma S^-1
    k10, k11 = (S1 * d - S2 * b) * scale, (S2 * a - S1 * b) * scale
    y0, y1 = z0 - m[j, 0], z1 - m[j, 1]
    m[j, 0] += k00 * y0 + k01 * y1
    m[j, 1] += k10 * y0 + k11 * y1
    # K R is (I - K) Sigma for K = Sigma S^-1, and stays positive in floating point.
    xx, yy = k00 * R0 + k01 * R1, k10 * R1 + k11 * R2
    xy = 0.5 * (k00 * R1 + k01 * R2 + k10 * R0 + k11 * R1)
    smallest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)  # eigenvalue
    lacking = max(VARIANCE_MIN - smallest, 0.0)
    Sigma[j, 0], Sigma[j, 1], Sigma[j, 2] = xx + lacking, xy, yy + lacking


@compiled_borrowing
def merge_duplicates(
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    known: int,
    seen: Bool,
    frozen: Bool,
    gate: float,
    cells: Cells,
    scale: float,
) -> None:
    """Merge each landmark that was seen with those within the gate that were not seen, are not frozen, and
    have a score above 0, in place.

    The merged position is the Kalman update of both, the hits are added, and the better score and the lower
    birth number remain; the other row gets the score 0 and is removed later. Landmarks that are both seen in
    this scan are never merged.

    Args:
        mean, covariance, hits, score, birth: Landmarks, see Maps.
        known: Number of leading rows that are examined.
        seen: Whether a landmark was detected in this scan, shape (L,).
        frozen: Whether a landmark must not change, shape (L,); a frozen one is not seen.
        gate: Maximum Mahalanobis distance [sigma].
        cells: Hash grid of these rows; the position of those that were not seen is up to date.
        scale: Cells per metre.
    """
    gate2 = gate * gate
    largest = 0.0
    for j in range(known):
        largest = max(largest, covariance[j, 0] + covariance[j, 2])
    reach2 = 2.0 * gate2 * largest
    narrow = 2.0 * scale * np.sqrt(reach2) < 1.0
    for j in range(known):
        if not seen[j]:
            continue
        if narrow and not holds_unseen(cells, mean, seen, mean[j, 0], mean[j, 1], reach2, scale):
            continue
        for k in range(known):
            y0, y1 = mean[k, 0] - mean[j, 0], mean[k, 1] - mean[j, 1]
            square = y0 * y0 + y1 * y1
            if square > reach2:
                continue
            # The trace bounds the larger eigenvalue.
            a, d = covariance[j, 0] + covariance[k, 0], covariance[j, 2] + covariance[k, 2]
            if square > gate2 * (a + d) or seen[k] or frozen[k] or score[k] <= 0.0:
                continue
            b = covariance[j, 1] + covariance[k, 1]
            if d * y0 * y0 - 2.0 * b * y0 * y1 + a * y1 * y1 > gate2 * (a * d - b * b):
                continue
            kalman_update(
                mean, covariance, j, mean[k, 0], mean[k, 1],
                covariance[k, 0], covariance[k, 1], covariance[k, 2],
            )  # fmt: skip
            hits[j] += hits[k]
            score[j] = max(score[j], score[k])
            birth[j] = min(birth[j], birth[k])
            score[k] = 0.0
