"""The memory: what was seen at each place of the map over the scans, in voxels, bounded.

A voxel holds how many returns fell into it and their mean position; many scans of one trunk then take
no more memory than its surface does, and their mean is sharper than any one return.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.geometry.mmap_arrays import zeros
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int, Int32

SIDE = 0.1  # m, of a voxel seen from above
SLICE = 0.2  # m, its height
SLICES = 30  # so that 6 m above the ground are remembered
TILE_CELLS = 40  # places are judged again tile by tile, of 4 m
TILE = TILE_CELLS * SIDE
MOST_TILES = 4  # are judged anew at a scan,
FIRST_SCANS = 10  # but for these, when a map may end soon
_OFFSET = TILE_CELLS << 18  # cells; keys stay positive within 1,000 km of the origin
_FARTHEST = np.float32((_OFFSET - 2 * TILE_CELLS) * SIDE)
_SPREAD = np.uint64(0x9E3779B97F4A7C15)
KEPT = ("key", "mean", "returns", "scans", "latest")  # of each voxel; all else follows from these

_Tables = tuple[Int, Int32, Float32, Int32, Int32, Int32, Int32, Int32, Int, Int32, Int32, Int]


@dataclass(slots=True, eq=False)
class Memory:
    """Voxels as columns, of which the first `used` rows count, and likewise tiles.

    Attributes:
        key: int64, the cell; slot: int32, hash table of row + 1, 0 where free.
        mean: float32, shape (rows, 3): x, y in the frame of the map, height above the ground [m].
        returns, scans: int32, how many fell into it, and in how many scans; latest: the last of these.
        following: int32, the next voxel of the same tile, -1 for none; home: int32, row of that tile.
        tile_key, tile_slot: As for voxels; tile_first: int32, the first voxel of each tile.
        tile_returns: int64; tile_judged: int64, the returns that it had when it was last judged.
        used, tiles: Voxels and tiles in use; added: scans that were taken.
    """

    key: Int
    slot: Int32
    mean: Float32
    returns: Int32
    scans: Int32
    latest: Int32
    following: Int32
    home: Int32
    tile_key: Int
    tile_slot: Int32
    tile_first: Int32
    tile_returns: Int
    tile_judged: Int
    used: int
    tiles: int
    added: int

    @classmethod
    def empty(cls, room: int = 1 << 12, tile_room: int = 1 << 8) -> Memory:
        """Nothing is known; `room` and `tile_room` are powers of two.

        All is zeros, so that the system gives pages only as rows come into use: room for a whole map
        costs nothing before it is filled, and a map that grows need never move.
        """
        return cls(
            key=zeros(room, np.int64),
            slot=zeros(2 * room, np.int32),
            mean=zeros((room, 3), np.float32),
            returns=zeros(room, np.int32),
            scans=zeros(room, np.int32),
            latest=zeros(room, np.int32),
            following=zeros(room, np.int32),
            home=zeros(room, np.int32),
            tile_key=zeros(tile_room, np.int64),
            tile_slot=zeros(2 * tile_room, np.int32),
            tile_first=zeros(tile_room, np.int32),
            tile_returns=zeros(tile_room, np.int64),
            tile_judged=zeros(tile_room, np.int64),
            used=0,
            tiles=0,
            added=0,
        )

    def copy(self) -> Memory:
        """An independent copy with the same room; only what is in use takes memory."""
        return self._with_room(np.arange(self.used), len(self.key), len(self.tile_key))

    def add(self, points: Float32, scan: int, most: int) -> None:
        """Take the points of one scan.

        When more than `most` voxels are known, the half that was seen longest ago is forgotten.

        Args:
            points: float32, shape (N, 3): x, y in the frame of the map, height above the ground [m].
            scan: Its number.
            most: Voxels kept, a power of two.
        """
        begin = 0
        self.added += 1
        while True:
            begin, self.used, self.tiles = _add(points, begin, scan, *self._tables(), self.used, self.tiles)
            if begin == len(points):
                return
            self._make_room(most)

    def judge_anew(self, grown: float) -> Int:
        """Tiles, shape (T, 2), that hold `grown` times what they held when they were judged last; from
        now on they count as judged. After the first scans the `MOST_TILES` that grew most come first, so
        that no scan takes long; the others' turn comes soon."""
        most = MOST_TILES if self.added > FIRST_SCANS else self.tiles
        return _due_tiles(self.tile_key, self.tile_returns, self.tile_judged, self.tiles, grown, most)

    def around(self, tile: Int, margin: float) -> tuple[Float32, Int32]:
        """Mean (N, 3) and returns (N,) of the voxels of a tile and `margin` [m] around it."""
        rows = _rows_around(
            tile[0],
            tile[1],
            margin,
            self.tile_key,
            self.tile_slot,
            self.tile_first,
            self.following,
            self.mean,
        )
        return self.mean[rows], self.returns[rows]

    def _tables(self) -> _Tables:
        return (
            self.key, self.slot, self.mean, self.returns, self.scans, self.latest, self.following, self.home,
            self.tile_key, self.tile_slot, self.tile_first, self.tile_returns,
        )  # fmt: skip

    def _make_room(self, most: int) -> None:
        rows = np.arange(self.used)
        room, tile_room = len(self.key), len(self.tile_key)
        if self.tiles == tile_room:
            tile_room *= 2
        elif room < most:
            room = most
        else:
            rows = np.sort(np.argsort(self.latest[: self.used], kind="stable")[self.used // 2 :])
        fresh = self._with_room(rows, room, tile_room)
        for f in fields(self):
            setattr(self, f.name, getattr(fresh, f.name))

    def _with_room(self, rows: Int, room: int, tile_room: int) -> Memory:
        fresh = Memory.empty(room, tile_room)
        for name in KEPT:
            np.take(getattr(self, name), rows, axis=0, out=getattr(fresh, name)[: len(rows)])
        fresh.added = self.added
        index(fresh, len(rows))
        _keep_judged(
            self.tile_key[: self.tiles], self.tile_judged, fresh.tile_key, fresh.tile_slot, fresh.tile_judged
        )
        return fresh


def keys_of(mean: Float32) -> Int:
    """The cells of places, shape (N, 3); -1 where there is none."""
    place = mean.astype(np.float64)
    cell = np.floor(place / np.array([SIDE, SIDE, SLICE]))
    inside = (cell[:, 2] >= 0) & (cell[:, 2] < SLICES) & np.all(np.abs(place[:, :2]) < _FARTHEST, axis=1)
    ix, iy, h = np.where(inside[:, None], cell, 0.0).astype(np.int64).T
    return np.where(inside, (ix + _OFFSET << 36) | (iy + _OFFSET << 5) | h, -1)


def tiles_of(keys: Int) -> Int:
    """The tiles of cells, shape (N,)."""
    ix, iy = keys >> 36, (keys >> 5) & ((1 << 31) - 1)
    return (ix // TILE_CELLS) << 31 | (iy // TILE_CELLS)


@compiled
def _first_place(key: int | np.int64, mask: int) -> int:
    # The upper bits of the product are well mixed, 26 of them enough for any table that is allowed.
    return int(np.int64((np.uint64(key) * _SPREAD) >> np.uint64(38)) & mask)


@compiled
def _find(key: int | np.int64, keys: Int, slot: Int32) -> int:
    """The place in the hash table of a key, or where it would go."""
    mask = slot.shape[0] - 1
    at = _first_place(key, mask)
    while slot[at] > 0 and keys[slot[at] - 1] != key:
        at = (at + 1) & mask
    return int(at)


def index(memory: Memory, rows: int) -> None:
    """Fill the tables of a memory of which the first rows of columns were set."""
    memory.used = rows
    memory.tiles = _index(rows, *memory._tables())


@compiled
def _tile_of(key: int | np.int64) -> int:
    ix, iy = key >> 36, (key >> 5) & ((1 << 31) - 1)
    return int(((ix // TILE_CELLS) << 31) | (iy // TILE_CELLS))


@compiled
def _hang_in(
    row: int | np.int64,
    key: int | np.int64,
    following: Int32,
    home: Int32,
    tile_key: Int,
    tile_slot: Int32,
    tile_first: Int32,
    tiles: int,
) -> int:
    """Put a voxel into the chain of its tile; returns the tiles in use."""
    tile = _tile_of(key)
    at = _find(tile, tile_key, tile_slot)
    if tile_slot[at] == 0:
        tile_key[tiles] = tile
        tile_first[tiles] = -1
        tiles += 1
        tile_slot[at] = tiles
    home[row] = tile_slot[at] - 1
    following[row] = tile_first[home[row]]
    tile_first[home[row]] = row
    return tiles


@compiled
def _index(
    used: int,
    keys: Int,
    slot: Int32,
    mean: Float32,  # noqa: ARG001 - the tables come as one
    returns: Int32,
    scans: Int32,  # noqa: ARG001
    latest: Int32,  # noqa: ARG001
    following: Int32,
    home: Int32,
    tile_key: Int,
    tile_slot: Int32,
    tile_first: Int32,
    tile_returns: Int,
) -> int:
    """Fill the hash tables and chains of rows that are there already; returns the number of tiles."""
    tiles = 0
    for row in range(used):
        slot[_find(keys[row], keys, slot)] = row + 1
        tiles = _hang_in(row, keys[row], following, home, tile_key, tile_slot, tile_first, tiles)
        tile_returns[home[row]] += returns[row]
    return tiles


@compiled
def _keep_judged(old_key: Int, old_judged: Int, key: Int, slot: Int32, judged: Int) -> None:
    for t in range(old_key.shape[0]):
        at = _find(old_key[t], key, slot)
        if slot[at] > 0:
            judged[slot[at] - 1] = old_judged[t]


@compiled
def _due_tiles(key: Int, returns: Int, judged: Int, tiles: int, grown: float, most: int) -> Int:
    """Tiles, shape (T, 2), at most so many, that are due, in the order of the table; marks them judged."""
    growth = np.zeros(tiles)
    due = 0
    for t in range(tiles):
        if returns[t] > grown * judged[t]:
            growth[t] = returns[t] / max(judged[t], 1)
            due += 1
    for _ in range(due - most):  # rarely more than a few stay behind, and rarely many are due
        least = -1
        for t in range(tiles):
            if growth[t] > 0.0 and (least < 0 or growth[t] <= growth[least]):
                least = t
        growth[least] = 0.0
    found, n, origin = np.empty((min(due, most), 2), np.int64), 0, _OFFSET // TILE_CELLS
    for t in range(tiles):
        if growth[t] > 0.0:
            judged[t] = returns[t]
            found[n, 0], found[n, 1] = (key[t] >> 31) - origin, (key[t] & ((1 << 31) - 1)) - origin
            n += 1
    return found


@compiled
def _add(
    points: Float32,
    begin: int,
    scan: int,
    keys: Int,
    slot: Int32,
    mean: Float32,
    returns: Int32,
    scans: Int32,
    latest: Int32,
    following: Int32,
    home: Int32,
    tile_key: Int,
    tile_slot: Int32,
    tile_first: Int32,
    tile_returns: Int,
    used: int,
    tiles: int,
) -> tuple[int, int, int]:
    """Returns the first point that found no room (their number when all did), voxels and tiles in use."""
    wanted, guess = _guess(points, begin, keys, slot)
    row, last = np.int64(-1), np.int64(-1)
    for i in range(begin, points.shape[0]):
        key = wanted[i]
        if key < 0:
            continue
        if key != last:
            row = guess[i]
            if row < 0:
                at = _find(key, keys, slot)
                row = np.int64(slot[at]) - 1
                if row < 0:
                    if used == keys.shape[0] or tiles == tile_key.shape[0]:
                        return i, used, tiles
                    row = np.int64(used)
                    used += 1
                    slot[at] = used
                    keys[row], latest[row] = key, -1
                    tiles = _hang_in(row, key, following, home, tile_key, tile_slot, tile_first, tiles)
            last = key
        returns[row] += 1
        for a in range(3):
            mean[row, a] += (points[i, a] - mean[row, a]) / np.float32(returns[row])
        if latest[row] != scan:
            latest[row] = scan
            scans[row] += 1
        tile_returns[home[row]] += 1
    return points.shape[0], used, tiles


@compiled
def _guess(points: Float32, begin: int, keys: Int, slot: Int32) -> tuple[Int, Int]:
    """Of each point its key, -1 where it has none, and the row of its voxel where that is the first that
    the hash table tells, else -1.

    The table lies far from the processor, and a look into it takes as long as all else. Here no look waits
    for another one, so that many are under way at a time.
    """
    n = points.shape[0]
    wanted, guess = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(begin, n):
        x, y = points[i, 0], points[i, 1]
        h = np.int64(np.floor(points[i, 2] / SLICE))
        # Written so that a coordinate that is not a number fails it.
        if not (0 <= h < SLICES and abs(x) < _FARTHEST and abs(y) < _FARTHEST):
            wanted[i] = -1
            continue
        ix, iy = np.int64(np.floor(x / SIDE)) + _OFFSET, np.int64(np.floor(y / SIDE)) + _OFFSET
        wanted[i] = (ix << 36) | (iy << 5) | h
    mask = slot.shape[0] - 1
    for i in range(begin, n):
        guess[i] = slot[_first_place(wanted[i], mask)] - 1
    for i in range(begin, n):
        guess[i] = guess[i] if keys[max(guess[i], 0)] == wanted[i] else -1
    return wanted, guess


@compiled
def _rows_around(
    tx: int,
    ty: int,
    margin: float,
    tile_key: Int,
    tile_slot: Int32,
    tile_first: Int32,
    following: Int32,
    mean: Float32,
) -> Int:
    low_x, low_y = tx * TILE - margin, ty * TILE - margin
    high_x, high_y = (tx + 1) * TILE + margin, (ty + 1) * TILE + margin
    reach = int(np.ceil(margin / TILE))
    rows = np.empty(1024, np.int64)
    n = 0
    origin = _OFFSET // TILE_CELLS
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            key = ((tx + dx + origin) << 31) | (ty + dy + origin)
            at = _find(key, tile_key, tile_slot)
            if tile_slot[at] == 0:
                continue
            row = np.int64(tile_first[tile_slot[at] - 1])
            while row >= 0:
                if low_x <= mean[row, 0] < high_x and low_y <= mean[row, 1] < high_y:
                    if n == rows.shape[0]:
                        rows = np.append(rows, np.empty(n, np.int64))
                    rows[n] = row
                    n += 1
                row = np.int64(following[row])
    return rows[:n].copy()
