"""Terrain map: the ground height of all scans in the map frame, in tiles of cells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.scan_ground import Terrain, ground_at, ring_at
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, HeightMap, Int

CELL = 0.5  # m
SIDE = 16  # cells along each side of a tile
# Columns of a cell: sum of weights [1/m^2], weighted mean [m] and variance [m^2] of the heights, number of
# views.
WEIGHT, MEAN, VARIANCE, VIEWS = range(4)
COLUMNS = 4
SIGMA, SIGMA_A_METRE = 0.03, 0.005  # m, m/m; sigma of one view: grass, and residual tilt
MOST = 50.0  # maximum weight of a cell, in views at 5 m


@compiled
def observe_cells(
    corner: Float, at: Float, yaw: float, height: Float, seen: Bool, reach: float
) -> tuple[Float, Float]:
    """Return the ground heights that a scan shows in the cells of some tiles.

    Args:
        corner: Lower corner of each tile in the map frame, shape (T, 2) [m].
        at: Position of the sensor in the map frame, shape (2,) [m].
        yaw: Yaw of the sensor in the map frame [rad].
        height, seen: Attributes of the Terrain of the scan.
        reach: Maximum distance of the middle of a cell from the sensor [m].

    Returns:
        Height of the ground in the level sensor frame at the middle of each cell [m], NaN if the ground was
        not seen there or the cell is beyond `reach`; and the weight of each height, the inverse of its
        variance [1/m^2], which decreases with the distance, 0 where the height is NaN. Both have the shape
        (T, SIDE, SIDE), indexed by tile, x and y.
    """
    tiles = corner.shape[0]
    below, weight = np.full((tiles, SIDE, SIDE), np.nan), np.zeros((tiles, SIDE, SIDE))
    c, s = np.cos(yaw), np.sin(yaw)
    for t in range(tiles):
        for i in range(SIDE):
            dx = corner[t, 0] + (i + 0.5) * CELL - at[0]
            for j in range(SIDE):
                dy = corner[t, 1] + (j + 0.5) * CELL - at[1]
                distance = np.sqrt(dx * dx + dy * dy)
                if distance > reach:
                    continue
                x, y = c * dx + s * dy, c * dy - s * dx
                ring = int(ring_at(distance))
                if ring < seen.shape[1] and seen[direction_bin(x, y, seen.shape[0]), ring]:
                    below[t, i, j] = ground_at(height, x, y)
                    weight[t, i, j] = 1.0 / (SIGMA**2 + (SIGMA_A_METRE * distance) ** 2)
    return below, weight


@compiled
def fuse(block: Float32, below: Float, weight: Float, sensor_z: float) -> None:
    """Update the weighted mean and variance of the cells with one view, in place; cells without weight
    remain. The weight of a cell is limited to MOST views.

    Args:
        block: Cells, float32, shape (T, SIDE, SIDE, COLUMNS); changed.
        below, weight: Results of `observe_cells`.
        sensor_z: Height of the sensor in the map frame [m].
    """
    most = MOST / (SIGMA**2 + (5.0 * SIGMA_A_METRE) ** 2)
    for t in range(block.shape[0]):
        for i in range(SIDE):
            for j in range(SIDE):
                w = weight[t, i, j]
                if w > 0.0:
                    cell = block[t, i, j]
                    total = min(cell[WEIGHT] + w, most)
                    a, d = w / total, below[t, i, j] + sensor_z - cell[MEAN]
                    cell[WEIGHT] = total
                    if cell[VIEWS] == 0.0:
                        cell[MEAN] = below[t, i, j] + sensor_z
                    else:
                        cell[MEAN] += a * d
                        cell[VARIANCE] = (1.0 - a) * (cell[VARIANCE] + a * d * d)
                    cell[VIEWS] += 1.0


Tile = tuple[int, int]


def corrected_tiles(tiles: Mapping[Tile, Float32], correction: PathCorrection) -> dict[Tile, Float32]:
    """Return a dict from indices of tiles to their cells after a correction of the path; the argument is not
    changed.

    Each cell moves by whole cells, with the nearest scan of the path before the correction. Cells that
    coincide afterwards are averaged by their weights, and their weights and views are added. The number of
    tiles is not limited. Remaining tiles keep their order, new ones follow; a tile without a known cell is
    left out.

    Args:
        tiles: Dict from indices of tiles to their cells, see HeightMapState; may be empty.
        correction: Path before and after, with at least one scan.
    """
    from scipy.spatial import cKDTree

    if not tiles:
        return {}
    place, row = _cells_of(tiles)
    centre: Float = (place.astype(np.float64) + 0.5) * CELL
    _, scan = cKDTree(correction.before[:, :2]).query(centre)
    corrected, _ = correction.moved(centre, np.asarray(scan))
    shift = np.round((corrected - centre) / CELL).astype(np.int64)
    return _tiles_of(place + shift, row, tiles)


def _tiles_of(place: Int, row: Float, order: Iterable[Tile]) -> dict[Tile, Float32]:
    """Return a dict from indices of tiles to their cells. Cells that coincide are averaged by their weights,
    and their weights and views are added.

    Args:
        place: Indices of the cells along x and y of the whole map, shape (N, 2).
        row: Cells, shape (N, COLUMNS).
        order: Tiles that come first in the result, in their order; all other ones follow.
    """
    moved, of = np.unique(place, axis=0, return_inverse=True)
    fresh = _averaged(row, of.ravel(), len(moved))
    home, rest = np.divmod(moved, SIDE)
    first = {tile: k for k, tile in enumerate(order)}
    names = [(int(a), int(b)) for a, b in np.unique(home, axis=0)]
    names.sort(key=lambda tile: first.get(tile, len(first)))
    out = {tile: np.zeros((SIDE, SIDE, COLUMNS), np.float32) for tile in names}
    for k, (a, b) in enumerate(home):
        out[(int(a), int(b))][rest[k, 0], rest[k, 1]] = fresh[k]
    return out


def _cells_of(tiles: Mapping[Tile, Float32]) -> tuple[Int, Float]:
    """Return the known cells of tiles: their indices along x and y of the whole map, int64, shape (N, 2), and
    their columns, float64, shape (N, COLUMNS)."""
    keys = np.array(list(tiles), np.int64).reshape(-1, 2)
    cells = np.array(list(tiles.values()), np.float32).reshape(-1, SIDE, SIDE, COLUMNS)
    n, i, j = np.nonzero(cells[..., VIEWS])
    return SIDE * keys[n] + np.column_stack([i, j]), cells[n, i, j].astype(np.float64)


def merged_terrain(a: HeightMapState, b: HeightMapState, T_a_b: Pose2) -> HeightMapState:
    """Return the terrain of two runs in the frame of the first, with a newly published map and the height of
    the sensor at the end of the second; the arguments are unchanged. With more than MOST_TILES tiles, the
    least recently seen ones are left out.

    Each run has its own height 0; that of b is moved by the median difference of the cells that both know. If
    both know fewer than LEAST cells, the terrain of a is returned.

    Args:
        a, b: Terrain of the two runs.
        T_a_b: Pose of the frame of b in that of a.
    """
    known, row = _cells_of(a.tiles)
    other, other_row = _cells_of(b.tiles)
    # Each cell of the result takes the cell of b at its centre, so that a turned grid has no gaps.
    centre: Float = (other.astype(np.float64) + 0.5) * CELL
    around = np.floor(T_a_b.apply(centre) / CELL).astype(np.int64)
    near = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    place = np.unique((around[:, None] + near).reshape(-1, 2), axis=0)
    wanted = np.floor(T_a_b.inverse().apply((place + 0.5) * CELL) / CELL).astype(np.int64)
    row_of = {cell: k for k, cell in enumerate(map(tuple, other.tolist()))}
    found = np.array([row_of.get(cell, -1) for cell in map(tuple, wanted.tolist())], np.int64)
    place, moved = place[found >= 0], other_row[found[found >= 0]]
    mean_of = dict(zip(map(tuple, known.tolist()), row[:, MEAN].tolist(), strict=True))
    means = np.array([mean_of.get(cell, np.nan) for cell in map(tuple, place.tolist())])
    both = np.isfinite(means)
    if np.count_nonzero(both) < LEAST:
        return replace(a, record=_record(a.tiles))
    rise = float(np.median(means[both] - moved[both, MEAN]))
    moved[:, MEAN] += rise
    seen = set(map(tuple, np.unique(place // SIDE, axis=0).tolist()))
    older = [tile for tile in a.tiles if tile not in seen]
    tiles = _tiles_of(np.concatenate([known, place]), np.concatenate([row, moved]), older)
    while len(tiles) > MOST_TILES:
        del tiles[next(iter(tiles))]
    sensor_z = None if b.sensor_z is None else b.sensor_z + rise
    return HeightMapState(tiles, sensor_z, a.scans + b.scans, _record(tiles))


def _averaged(row: Float, of: Int, cells: int) -> Float32:
    """Return the weighted average of the cells that coincide, float32, shape (cells, COLUMNS).

    Args:
        row: Cells, shape (N, COLUMNS).
        of: Index of the result to which each cell belongs, int64, shape (N,).
        cells: Number of results.
    """
    weight = np.bincount(of, row[:, WEIGHT], cells)
    mean = np.bincount(of, row[:, WEIGHT] * row[:, MEAN], cells) / weight
    apart = row[:, VARIANCE] + (row[:, MEAN] - mean[of]) ** 2
    fresh = np.zeros((cells, COLUMNS), np.float32)
    fresh[:, WEIGHT], fresh[:, MEAN] = weight, mean
    fresh[:, VARIANCE] = np.bincount(of, row[:, WEIGHT] * apart, cells) / weight
    fresh[:, VIEWS] = np.bincount(of, row[:, VIEWS], cells)
    return fresh


TILE = SIDE * CELL  # m
REACH = 15.0  # m; beyond it, a cell of the scan is much wider than a cell of the map
NEAR_WEIGHT = 200.0  # 1/m^2; weight of a view within 12 m
LEAST = 50  # minimum number of known cells for an estimate of the height of the sensor
# Scans between two updates of the published map: RENEW, plus one per TILES_A_SCAN tiles, which bounds the
# cost per scan.
RENEW, TILES_A_SCAN = 5, 100
MOST_TILES = 1 << 13  # 52 hectares, 34 MB; beyond it, the least recently seen tile is removed
_FARTHEST = 1e6  # m; scans at larger coordinates are ignored
_UNKNOWN: Float32 = np.zeros((SIDE, SIDE, COLUMNS), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class HeightMapState:
    """State of the terrain map between two scans. Its arrays are never modified, so that states can share
    them.

    Attributes:
        tiles: Dict from the index along x and y of a tile to its cells, float32, shape (SIDE, SIDE, COLUMNS),
            least recently seen first.
        sensor_z: Height of the sensor in the map frame [m]; None before the first scan.
        scans: Number of scans.
        record: The most recently published map.
    """

    tiles: Mapping[Tile, Float32]
    sensor_z: float | None
    scans: int
    record: HeightMap


class HeightMapper:
    """Map of the ground height, fused from the terrain of all scans.

    Height 0 is the ground below the sensor at the first scan. Odometry and SLAM are planar; the height of the
    sensor is estimated at each scan from the cells that are known already.

    Attributes:
        state: State after the last scan; it is replaced, never modified.
    """

    def __init__(self) -> None:
        self.state = HeightMapState({}, None, 0, no_height_map())

    def add(self, terrain: Terrain, T_map_base: Pose2, sensor_offset: Float) -> None:
        """Add the terrain of one scan, and replace the state. A scan whose sensor is 1,000 km or more from
        the origin, or at NaN, is ignored.

        The weight of a cell is bounded, so that later views replace heights that were added before a
        correction of the pose. With more than MOST_TILES tiles, the least recently seen ones are removed. The
        published map is updated after the first two scans and then every RENEW or more scans.

        Args:
            terrain: Terrain in the level sensor frame.
            T_map_base: Pose of the base in the map.
            sensor_offset: Position of the sensor in the level base frame, shape (3,) [m].
        """
        at = T_map_base.apply(np.asarray(sensor_offset[:2], np.float64))
        if not np.all(np.abs(at) < _FARTHEST):
            return
        old = self.state
        keys = _around(at)
        corner = TILE * np.array(keys, np.float64)
        block = np.stack([old.tiles.get(key, _UNKNOWN) for key in keys])
        below, weight = observe_cells(corner, at, T_map_base.yaw, terrain.height, terrain.seen, REACH)
        z = _register(block, below, weight, old.sensor_z)
        if z is None:
            z = -float(ground_at(terrain.height, 0.0, 0.0))
        fuse(block, below, weight, z)
        tiles = dict(old.tiles)
        for n in np.flatnonzero(weight.any(axis=(1, 2))):
            tiles.pop(keys[n], None)
            tiles[keys[n]] = block[n].copy()  # a view would reference the whole block
        while len(tiles) > MOST_TILES:
            del tiles[next(iter(tiles))]
        scans = old.scans + 1
        due = scans <= 2 or scans % (RENEW + len(tiles) // TILES_A_SCAN) == 0
        self.state = HeightMapState(tiles, z, scans, _record(tiles) if due else old.record)

    def correct(self, correction: PathCorrection) -> None:
        """Replace the state by one whose terrain is moved with a corrected path, and publish it. The height
        of the sensor and the number of scans remain.

        Args:
            correction: Path before and after, with at least one scan; see `corrected_tiles`.
        """
        tiles = corrected_tiles(self.state.tiles, correction)
        self.state = replace(self.state, tiles=tiles, record=_record(tiles))

    def record(self) -> HeightMap:
        """Return the map of all tiles at this time. `state.record` is the map that was last published, which
        may be some scans old."""
        return _record(self.state.tiles)

    def heights(self, places: Float) -> Float:
        """Return the height of the ground in the frame of the map at positions, shape (N,) [m].

        It is the height of the cell that contains the position. In an unknown cell it is the weighted mean of
        the known cells among the eight neighbours; NaN if none is known.

        Args:
            places: Finite positions x, y in the frame of the map, shape (N, 2) [m].
        """
        cell = np.floor(places / CELL).astype(np.int64)
        return np.array([self._at(int(i), int(j)) for i, j in cell])

    def _at(self, i: int, j: int) -> float:
        """Return the height at the cell with the indices i, j along x and y (of the whole map) [m]: its own,
        else the weighted mean of its known neighbours, else NaN."""
        mean, weight = 0.0, 0.0
        for di, dj in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            tile = self.state.tiles.get(((i + di) // SIDE, (j + dj) // SIDE))
            if tile is not None:
                row = tile[(i + di) % SIDE, (j + dj) % SIDE]
                mean, weight = mean + float(row[WEIGHT] * row[MEAN]), weight + float(row[WEIGHT])
            if di == 0 and dj == 0 and weight > 0.0:
                break
        return mean / weight if weight > 0.0 else float("nan")


def no_height_map() -> HeightMap:
    """Return an empty map: no rows, cells of side CELL."""
    return _record({})


def _around(at: Float) -> list[Tile]:
    """Return the indices along x and y of the tiles that overlap the square of half side REACH around a
    finite position, shape (2,) [m], in the frame of the map; sorted."""
    low, high = np.floor((at - REACH) / TILE), np.floor((at + REACH) / TILE)
    return [
        (i, j) for i in range(int(low[0]), int(high[0]) + 1) for j in range(int(low[1]), int(high[1]) + 1)
    ]


def _register(block: Float32, below: Float, weight: Float, before: float | None) -> float | None:
    """Return the height of the sensor in the map frame [m]: the median of map height minus scan height over
    known cells.

    Cells within 12 m (NEAR_WEIGHT) are used if there are LEAST of them, else all.

    Args:
        block, below, weight: Cells of the map before the scan, and the view; see `fuse`. Not changed.
        before: Height at the scan before, None before the first; returned if fewer than LEAST cells are
            known.
    """
    known = (block[..., VIEWS] > 0.0) & (weight > NEAR_WEIGHT)
    if np.count_nonzero(known) < LEAST:
        known = (block[..., VIEWS] > 0.0) & (weight > 0.0)
        if np.count_nonzero(known) < LEAST:
            return before
    return float(np.median(block[known, MEAN] - below[known]))


def _record(tiles: Mapping[Tile, Float32]) -> HeightMap:
    """Return the map of tiles as a table of the known cells, sorted by tile; empty if there are no tiles. The
    arrays are copies."""
    keys = sorted(tiles)
    cells = np.stack([tiles[key] for key in keys]) if keys else np.zeros((0, SIDE, SIDE, COLUMNS), np.float32)
    n, i, j = np.nonzero(cells[..., VIEWS])
    row = cells[n, i, j]
    first = SIDE * np.array(keys, np.int64).reshape(-1, 2)
    return HeightMap(
        cell=CELL,
        place=(first[n] + np.stack([i, j], axis=1)).astype(np.int32),
        height=row[:, MEAN].copy(),
        sigma=np.sqrt(row[:, VARIANCE] + 1.0 / row[:, WEIGHT]),
        views=row[:, VIEWS].astype(np.int32),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PackedHeightMap:
    """HeightMapState as arrays and numbers for saving, with the tiles in their order; an unknown `sensor_z`
    is NaN.

    Attributes:
        tile: Tile indices, int64, shape (T, 2).
        cells: Cells of the tiles, float32, shape (T * SIDE * SIDE, COLUMNS).
    """

    tile: Int
    cells: Float32
    sensor_z: float
    scans: int
    record: HeightMap

    @classmethod
    def of(cls, state: HeightMapState) -> PackedHeightMap:
        """Return the state in this form; the arrays are copies except for the published map."""
        cells = np.zeros((len(state.tiles), SIDE, SIDE, COLUMNS), np.float32)
        for n, tile in enumerate(state.tiles.values()):
            cells[n] = tile
        return cls(
            np.array(list(state.tiles), np.int64).reshape(-1, 2),
            cells.reshape(-1, COLUMNS),
            float("nan") if state.sensor_z is None else state.sensor_z,
            state.scans,
            state.record,
        )

    @classmethod
    def empty(cls) -> PackedHeightMap:
        """Return the state before the first scan in this form."""
        return cls.of(HeightMapState({}, None, 0, no_height_map()))

    def unpacked(self) -> HeightMapState:
        """Return the state, identical to the bit; the tiles are copies.

        Raises:
            ValueError: The arrays, which come from a file, do not match each other, contain numbers that are
                not finite, or hold more than MOST_TILES tiles.
        """
        n = len(self.tile)
        if self.tile.shape != (n, 2) or self.cells.shape != (n * SIDE * SIDE, COLUMNS) or n > MOST_TILES:
            raise ValueError("the tiles of the terrain map have a wrong shape")
        if not np.all(np.isfinite(self.cells)) or np.isinf(self.sensor_z) or self.scans < 0:
            raise ValueError("a height is not finite")
        record = self.record
        k = len(record.height)
        if record.place.shape != (k, 2) or not len(record.sigma) == len(record.views) == k:
            raise ValueError("the columns of the terrain map have different lengths")
        keys = [(int(i), int(j)) for i, j in self.tile]
        if len(set(keys)) < n:
            raise ValueError("two tiles of the terrain map have the same index")
        tiles = self.cells.reshape(n, SIDE, SIDE, COLUMNS)
        z = None if np.isnan(self.sensor_z) else self.sensor_z
        return HeightMapState(
            {key: tile.copy() for key, tile in zip(keys, tiles, strict=True)}, z, self.scans, record
        )
