"""The voxel map: the returns of all scans in voxels of bounded number.

A voxel holds the number of returns in it and their mean position. Many scans of one trunk need no more memory
than its surface, and the mean is more precise than a single return.
"""

from __future__ import annotations

import math
import mmap
import sys
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from pipeline.geometry.hash_grid import SPREAD
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int, Int32

SMALL = 1 << 16  # bytes; smaller arrays use the heap


def zeros(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros of a shape and type, like numpy.zeros; of a large array (SMALL bytes or more) only pages
    that were written to take memory.

    The system provides a page at the first write and takes back all pages when the array is deleted. On the
    heap of the allocator, long-lived arrays of different sizes leave holes, which the process keeps.
    """
    kind = np.dtype(dtype)
    count = shape if isinstance(shape, int) else math.prod(shape)
    if count * kind.itemsize < SMALL:
        return np.zeros(shape, kind)
    return np.frombuffer(_mapped(count * kind.itemsize), kind, count).reshape(shape)


def _mapped(size: int) -> mmap.mmap:
    """Return anonymous private memory of `size` bytes, filled with zeros."""
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def copied(array: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of the same shape and type; one of SMALL bytes or more is on pages of its own, which the
    system takes back when it is deleted."""
    copy = zeros(array.shape, array.dtype)
    copy[...] = array
    return copy


SIDE = 0.1  # m; horizontal side of a voxel
SLICE = 0.2  # m; its height
SLICES = 30  # voxels up to 6 m above the ground
TILE_CELLS = 40  # columns are classified by tiles of 4 m
TILE = TILE_CELLS * SIDE
# Classified per scan after the first scans, of which a short recording may have no others.
MOST_TILES, FIRST_SCANS = 4, 10
# Voxels in the tiles that each of the first scans after the first one classifies, which set its time: all
# voxels of one scan of 64 rings (28,600 in a street, KITTI), and all of ten scans of 16 rings (18,000 in
# sim:stand).
MOST_VOXELS = 1 << 15
_OFFSET = TILE_CELLS << 18  # cells; keys stay positive within 1,000 km of the origin
_FARTHEST = np.float32((_OFFSET - 2 * TILE_CELLS) * SIDE)
KEPT = ("key", "mean", "returns", "scans", "latest")  # columns from which all others follow


class _Tables(NamedTuple):
    """The columns of `VoxelMap` for the kernels."""

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


_columns_of = attrgetter(*_Tables._fields)


@dataclass(slots=True, eq=False)
class VoxelMap:
    """Voxels as columns, of which the first `used` rows are valid, and tiles as columns, of which the first
    `tiles` rows are valid.

    Attributes:
        key: Key of the cell, int64, see `keys_of`.
        slot: Hash table of row + 1, 0 for a free position, int32.
        mean: Mean x, y in the map and mean height above the ground of the returns, float32, shape (rows, 3)
            [m].
        returns, scans, latest: Number of returns, number of scans with returns, and number of the last scan
            with returns, int32.
        following: Next voxel of the same tile, -1 for none, int32.
        home: Row of the tile, int32.
        tile_key, tile_slot: Keys (`tiles_of`) and hash table of the tiles, as for voxels.
        tile_first: First voxel of each tile, int32.
        tile_returns, tile_judged: Number of returns, and that number when the tile was last classified,
            int64.
        used, tiles: Number of voxels and tiles in use.
        added: Number of scans that were added.
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
    def empty(cls, room: int = 1 << 12, tile_room: int = 1 << 8) -> VoxelMap:
        """Return an empty map.

        All columns are zero, so the system provides pages when rows are first used: unused rows take no
        memory.

        Args:
            room: Rows for voxels, a power of two.
            tile_room: Rows for tiles, a power of two.
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

    def copy(self) -> VoxelMap:
        """Return an independent copy with the same room; only rows in use take memory."""
        return self._with_room(np.arange(self.used), len(self.key), len(self.tile_key))

    def add(self, points: Float32, scan: int, most: int) -> None:
        """Add the points of a scan, in place. Points below the ground, at SLICES * SLICE or higher, farther
        than 1,000 km, or with NaN are ignored; the scan counts in `added` even without points.

        When the map is full, its room grows to `most` voxels; a map with `most` voxels or more of room
        removes the half that was seen longest ago instead. A smaller `most` than before does not shrink the
        map.

        Args:
            points: Points x, y in the map and height above the ground, float32, shape (N, 3) [m].
            scan: Number of the scan, not negative.
            most: Maximum number of voxels, a power of two.
        """
        begin = 0
        self.added += 1
        while True:
            begin, self.used, self.tiles = _add(points, begin, scan, self._tables(), self.used, self.tiles)
            if begin == len(points):
                return
            self._make_room(most)

    def due_tiles(self, grown: float) -> Int:
        """Return the indices along x and y of the tiles, int64, shape (T, 2), whose returns have grown by
        more than the factor `grown` since they were last classified, and mark them as classified. Tiles that
        were never classified are due.

        After the first scan, which may be the only one, so many of the tiles with the largest growth (of
        equal ones the older) are returned as have together at most MOST_VOXELS voxels, but at least one;
        after FIRST_SCANS scans at most MOST_TILES. The others remain due."""
        n = self.tiles
        returns, judged = self.tile_returns[:n], self.tile_judged[:n]
        due = np.flatnonzero(returns > grown * judged)
        due = due[np.argsort(-(returns[due] / np.maximum(judged[due], 1)), kind="stable")]
        if self.added > FIRST_SCANS:
            due = due[:MOST_TILES]
        elif self.added > 1 and self.used > MOST_VOXELS:
            voxels = np.bincount(self.home[: self.used], minlength=n)[due]
            due = due[: max(np.searchsorted(np.cumsum(voxels), MOST_VOXELS, side="right"), 1)]
        due = np.sort(due)
        judged[due] = returns[due]
        x, y = self.tile_key[due] >> 31, self.tile_key[due] & ((1 << 31) - 1)
        return np.stack([x, y], axis=1) - _OFFSET // TILE_CELLS

    def around(self, tile: Int, margin: float) -> tuple[Float32, Int32]:
        """Return mean, float32, shape (N, 3) [m], and number of returns, int32, shape (N,), of the voxels
        whose mean is in a tile or within `margin` [m] around it, as copies; empty where nothing was seen.

        Args:
            tile: Indices of the tile along x and y, shape (2,).
            margin: Width of the border around the tile [m].
        """
        rows = _rows_around(tile[0], tile[1], margin, self._tables())
        return self.mean[rows], self.returns[rows]

    def _tables(self) -> _Tables:
        """Return the columns for the kernels; they share their memory with this map."""
        return _Tables(*_columns_of(self))

    def _make_room(self, most: int) -> None:
        """Make room in the table that is full, in place.

        If the tiles are full, their rows are doubled. Otherwise the rows of voxels grow to `most`; if there
        are that many already, the half of the voxels that was seen longest ago is removed. If both tables
        are full, a second call is needed.

        Args:
            most: Maximum number of voxels, a power of two.
        """
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

    def _with_room(self, rows: Int, room: int, tile_room: int) -> VoxelMap:
        """Return a new map of some voxels. Tiles without voxels are left out; the others keep the number of
        returns at their last classification.

        Args:
            rows: Rows of the voxels to copy, in the new order, shape (N,).
            room, tile_room: Rows for voxels and tiles of the new map, powers of two that suffice.
        """
        fresh = VoxelMap.empty(room, tile_room)
        for name in KEPT:
            np.take(getattr(self, name), rows, axis=0, out=getattr(fresh, name)[: len(rows)])
        fresh.added = self.added
        index(fresh, len(rows))
        _keep_judged(self._tables(), self.tiles, fresh._tables())
        return fresh


@compiled
def keys_of(mean: Float32) -> Int:
    """Return the key of each position, int64, shape (N,): cell along x and y and the slice; -1 outside of the
    map (height below 0 or from SLICES * SLICE on, about 1,000 km from the origin) and for NaN.

    Args:
        mean: Positions, the third column the height above the ground, shape (N, 3) [m].
    """
    keys = np.full(mean.shape[0], -1, np.int64)
    for i in range(mean.shape[0]):
        x, y, h = mean[i, 0], mean[i, 1], np.floor(mean[i, 2] / SLICE)
        if 0 <= h < SLICES and abs(x) < _FARTHEST and abs(y) < _FARTHEST:  # false for NaN
            ix, iy = np.int64(np.floor(x / SIDE)) + _OFFSET, np.int64(np.floor(y / SIDE)) + _OFFSET
            keys[i] = (ix << 36) | (iy << 5) | np.int64(h)
    return keys


def tiles_of(keys: Int) -> Int:
    """Return the key of the tile of each cell, int64, shape (N,), for keys of `keys_of`, which must not be
    negative."""
    ix, iy = keys >> 36, (keys >> 5) & ((1 << 31) - 1)
    return (ix // TILE_CELLS) << 31 | (iy // TILE_CELLS)


@compiled
def _first_place(key: int | np.int64, mask: int) -> int:
    """Return the index in a hash table at which the search for a key begins; `mask` is the length of the
    table, a power of two, minus 1."""
    # The upper bits of the product are well mixed; 26 bits are enough for the largest table.
    return int(np.int64((np.uint64(key) * SPREAD) >> np.uint64(38)) & mask)


@compiled
def _find(key: int | np.int64, keys: Int, slot: Int32) -> int:
    """Return the index of a key in a hash table, or the free index for it.

    Args:
        key: The key.
        keys: Keys by row.
        slot: Hash table of row + 1 in `keys`, 0 for free; its length is a power of two, with at least one
            free entry.
    """
    mask = slot.shape[0] - 1
    at = _first_place(key, mask)
    while slot[at] > 0 and keys[slot[at] - 1] != key:
        at = (at + 1) & mask
    return int(at)


def index(memory: VoxelMap, rows: int) -> None:
    """Fill the hash tables, tiles and counts of a map whose first rows are set, in place.

    Args:
        memory: Map whose tables are empty, and whose columns KEPT are set in the first rows; its rows for
            tiles must suffice.
        rows: Number of these rows.
    """
    memory.used = rows
    memory.tiles = _index(rows, memory._tables())


@compiled
def _tile_of(key: int | np.int64) -> int:
    """Return the key of the tile that contains a cell, by the key of the cell (`keys_of`), which must not be
    negative; the same as `tiles_of` of one key."""
    ix, iy = key >> 36, (key >> 5) & ((1 << 31) - 1)
    return int(((ix // TILE_CELLS) << 31) | (iy // TILE_CELLS))


@compiled
def _link(row: int | np.int64, tables: _Tables, tiles: int) -> int:
    """Add the voxel `row` to the chain of its tile, in place, and the tile to the tables if it is new. Return
    the number of tiles; `tiles` is the number of tiles before."""
    tile = _tile_of(tables.key[row])
    at = _find(tile, tables.tile_key, tables.tile_slot)
    if tables.tile_slot[at] == 0:
        tables.tile_key[tiles] = tile
        tables.tile_first[tiles] = -1
        tiles += 1
        tables.tile_slot[at] = tiles
    home = tables.tile_slot[at] - 1
    tables.home[row] = home
    tables.following[row] = tables.tile_first[home]
    tables.tile_first[home] = row
    return tiles


@compiled
def _index(used: int, tables: _Tables) -> int:
    """Fill the hash tables and chains of the first `used` rows, in place; return the number of tiles."""
    tiles = 0
    for row in range(used):
        tables.slot[_find(tables.key[row], tables.key, tables.slot)] = row + 1
        tiles = _link(row, tables, tiles)
        tables.tile_returns[tables.home[row]] += tables.returns[row]
    return tiles


def corrected_voxels(memory: VoxelMap, correction: PathCorrection) -> VoxelMap:
    """Return the voxels after a correction of the path.

    The mean of each voxel moves horizontally, as `PathCorrection.moved` does for the last scan that saw it:
    with the nearest pose of the path around that scan. Its height above the ground is kept. Voxels that are
    then in the same cell are joined: returns are added, the mean is weighted by them, and the largest `scans`
    and `latest` are kept. Voxels that leave the limits of the map (about 1,000 km from the origin) are
    removed. All tiles become due for classification. Neither argument is changed.
    """
    n = memory.used
    mean = memory.mean[:n].copy()
    latest = memory.latest[:n].astype(np.int64)
    mean[:, :2], _ = correction.moved(memory.mean[:n, :2].astype(np.float64), latest)
    key = keys_of(mean)
    fresh = VoxelMap.empty(len(memory.key), _room(len(memory.tile_key), key[key >= 0]))
    fresh.added = memory.added
    index(fresh, _join(key, mean, memory._tables(), fresh._tables()))
    return fresh


def _room(room: int, keys: Int) -> int:
    """Return the number of rows for the tiles of some voxels: `room`, doubled until it exceeds the number of
    tiles. A rotated tile covers up to four tiles.

    Args:
        room: Rows so far, a power of two.
        keys: Keys of the voxels (`keys_of`), not negative, int64, shape (N,).
    """
    tiles = len(np.unique(tiles_of(keys)))
    while room <= tiles:
        room *= 2
    return room


@compiled
def _join(key: Int, mean: Float32, old: _Tables, fresh: _Tables) -> int:
    """Write the voxels of a map with new positions to an empty map, those of one cell as one voxel, in the
    order of their first; return the number of voxels. Voxels with a negative key are left out.

    Args:
        key, mean: New cells, shape (N,), and positions, shape (N, 3) [m], of the first N rows of `old`.
        old: Tables of the map.
        fresh: Tables of the empty map, whose columns KEPT and hash table of the voxels are filled.
    """
    total, rows = np.zeros((key.shape[0], 3)), 0
    for i in range(key.shape[0]):
        if key[i] < 0:
            continue
        at = _find(key[i], fresh.key, fresh.slot)
        if fresh.slot[at] == 0:
            fresh.key[rows] = key[i]
            rows += 1
            fresh.slot[at] = rows
        row = fresh.slot[at] - 1
        for a in range(3):
            total[row, a] += np.float64(old.returns[i]) * mean[i, a]
        fresh.returns[row] += old.returns[i]
        fresh.scans[row] = max(fresh.scans[row], old.scans[i])
        fresh.latest[row] = max(fresh.latest[row], old.latest[i])
    for row in range(rows):
        for a in range(3):
            fresh.mean[row, a] = total[row, a] / fresh.returns[row]
    return rows


@compiled
def _keep_judged(old: _Tables, tiles: int, fresh: _Tables) -> None:
    """Copy the number of returns at the last classification from each of the first `tiles` tiles of `old` to
    the same tile of `fresh`, where it exists; `fresh.tile_judged` is changed in place."""
    for t in range(tiles):
        at = _find(old.tile_key[t], fresh.tile_key, fresh.tile_slot)
        if fresh.tile_slot[at] > 0:
            fresh.tile_judged[fresh.tile_slot[at] - 1] = old.tile_judged[t]


@compiled
def _add(
    points: Float32, begin: int, scan: int, tables: _Tables, used: int, tiles: int
) -> tuple[int, int, int]:
    """Add points from row `begin` onwards until the tables are full, in place; points without a key (see
    `keys_of`) are skipped. Return the first point without room (the number of points when all fit), and the
    numbers of voxels and tiles in use.

    Args:
        points: See `VoxelMap.add`.
        begin: First point to add.
        scan: Number of the scan.
        tables: The tables, changed in place.
        used, tiles: Voxels and tiles in use.
    """
    keys, slot, mean, latest = tables.key, tables.slot, tables.mean, tables.latest
    returns, scans, home, tile_returns = tables.returns, tables.scans, tables.home, tables.tile_returns
    wanted = keys_of(points)
    row, last = np.int64(-1), np.int64(-1)
    for i in range(begin, points.shape[0]):
        key = wanted[i]
        if key < 0:
            continue
        if key != last:
            at = _find(key, keys, slot)
            row = np.int64(slot[at]) - 1
            if row < 0:
                if used == keys.shape[0] or tiles == tables.tile_key.shape[0]:
                    return i, used, tiles
                row = np.int64(used)
                used += 1
                slot[at] = used
                keys[row], latest[row] = key, -1
                tiles = _link(row, tables, tiles)
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
def _rows_around(tx: int, ty: int, margin: float, tables: _Tables) -> Int:
    """Return the rows of the voxels whose mean is in a tile or within `margin` of it, int64, shape (N,).

    Args:
        tx, ty: Indices of the tile along x and y.
        margin: Width of the border [m].
        tables: Tables of the map.
    """
    tile_key, tile_slot, mean, following = tables.tile_key, tables.tile_slot, tables.mean, tables.following
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
            row = np.int64(tables.tile_first[tile_slot[at] - 1])
            while row >= 0:
                if n == rows.shape[0]:
                    longer = np.empty(2 * n, np.int64)
                    for k in range(n):
                        longer[k] = rows[k]
                    rows = longer
                rows[n] = row
                x, y = mean[row, 0], mean[row, 1]
                # A sum instead of an unpredictable branch.
                n += (low_x <= x) & (x < high_x) & (low_y <= y) & (y < high_y)
                row = np.int64(following[row])
    return rows[:n].copy()


LARGEST_ROOM = 1 << 25  # rows; the parameters allow less


@dataclass(frozen=True, slots=True, eq=False)
class PackedVoxelMap:
    """An immutable copy of a voxel map: columns of the voxels and tiles in use, without the hash tables.
    `room` and `tile_room` are the sizes of the tables. See `VoxelMap`."""

    key: Int
    mean: Float32
    returns: Int32
    scans: Int32
    latest: Int32
    tile_judged: Int
    room: int
    tile_room: int
    added: int

    @classmethod
    def of(cls, memory: VoxelMap) -> PackedVoxelMap:
        """Return a packed copy, which later changes of the map do not affect."""
        columns = {name: copied(getattr(memory, name)[: memory.used]) for name in KEPT}
        judged = memory.tile_judged[: memory.tiles].copy()
        return cls(
            **columns,
            tile_judged=judged,
            room=len(memory.key),
            tile_room=len(memory.tile_key),
            added=memory.added,
        )

    def unpacked(self) -> VoxelMap:
        """Return an independent voxel map with the same bits; the columns are not checked, see `checked`."""
        n = len(self.key)
        memory = VoxelMap.empty(self.room, self.tile_room)
        for name in KEPT:
            getattr(memory, name)[:n] = getattr(self, name)
        memory.added = self.added
        index(memory, n)
        memory.tile_judged[: memory.tiles] = self.tile_judged
        return memory

    def checked(self) -> PackedVoxelMap:
        """Return this object after a check of the columns, which may come from a file. Means, numbers of
        returns and scans are not checked.

        Raises:
            ValueError: The columns have different lengths, a key is negative or repeated, the keys have
                another number of tiles, or a room is no power of two or too small or large.
        """
        n, tiles = len(self.key), len(self.tile_judged)
        for room, used in ((self.room, n), (self.tile_room, tiles)):
            if not (max(used, 1) <= room <= LARGEST_ROOM and room & (room - 1) == 0):
                raise ValueError(f"there is no room of {room} for {used} voxels or tiles")
        lengths = {len(self.mean), len(self.returns), len(self.scans), len(self.latest), n}
        if (
            len(lengths) > 1
            or self.mean.shape[1:] != (3,)
            or self.key.ndim != 1
            or self.tile_judged.ndim != 1
        ):
            raise ValueError("the columns of the voxels have other lengths")
        if n and (self.key.min() < 0 or len(np.unique(self.key)) < n):
            raise ValueError("two voxels are one")
        if len(np.unique(tiles_of(self.key))) != tiles:
            raise ValueError("the tiles are not those of the voxels")
        return self
