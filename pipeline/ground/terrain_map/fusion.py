"""Fusion: each scan's terrain is brought to the height of the map and averaged into its cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.terrain import Terrain, ground_at
from pipeline.ground.terrain_map.cell_update import (
    CELL,
    COLUMNS,
    MEAN,
    SIDE,
    VARIANCE,
    VIEWS,
    WEIGHT,
    fuse,
    look,
)
from pipeline.ground.terrain_map.map_correction import bent
from pipeline.loop_closure.map_correction import Bend
from pipeline.types.records import Float32, HeightMap

TILE = SIDE * CELL  # m
REACH = 15.0  # m; farther away a cell of the scan's terrain is wider than a cell of the map by far
NEAR_WEIGHT = 200.0  # 1/m^2; of a cell within 12 m
LEAST = 50  # cells that must be known already to tell how high the sensor stands
RENEW = 5  # scans after which the record is made anew, and
TILES_A_SCAN = 100  # one scan more for so many tiles, so that it costs the same however large the map is
MOST_TILES = 1 << 13  # 52 hectares, 34 MB; then the tile that was seen longest ago is forgotten
_FARTHEST = 1e6  # m
_UNKNOWN: Float32 = np.zeros((SIDE, SIDE, COLUMNS), np.float32)

Tile = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class HeightMapState:
    """What is known between two scans. Nothing in it is ever changed, so that sharing it is a copy.

    Attributes:
        tiles: float32, shape (SIDE, SIDE, COLUMNS) each, by their number along x and y; the one that was
            seen longest ago comes first.
        sensor_z: Height of the sensor in the map [m]; None before the first scan.
        scans: How many were taken.
        record: The map as it was shown last.
    """

    tiles: Mapping[Tile, Float32]
    sensor_z: float | None
    scans: int
    record: HeightMap


class HeightMapper:
    """Knows the height of the ground wherever scans saw it.

    Height 0 is the ground below the sensor at the first scan. Odometry and SLAM are planar: how high the
    sensor stands is found at each scan from the ground that was seen before.
    """

    def __init__(self) -> None:
        self.state = HeightMapState({}, None, 0, no_height_map())

    def add(self, terrain: Terrain, T_map_base: Pose2, sensor_offset: Float) -> None:
        """Take the terrain of one scan.

        A cell counts few views at the most: what is seen later outweighs what was laid down before the pose
        was corrected.

        Args:
            terrain: In the level sensor frame.
            T_map_base: The pose.
            sensor_offset: The sensor in the level base frame, shape (3,) [m].
        """
        at = T_map_base.apply(np.asarray(sensor_offset[:2], np.float64))
        if not np.all(np.abs(at) < _FARTHEST):
            return
        old = self.state
        keys = _around(at)
        corner = TILE * np.array(keys, np.float64)
        block = np.stack([old.tiles.get(key, _UNKNOWN) for key in keys])
        below, weight = look(corner, at, T_map_base.yaw, terrain.height, terrain.seen, REACH)
        z = _register(block, below, weight, old.sensor_z)
        if z is None:
            z = -float(ground_at(terrain.height, 0.0, 0.0))
        fuse(block, below, weight, z)
        tiles = dict(old.tiles)
        for n in np.flatnonzero(weight.any(axis=(1, 2))):
            tiles.pop(keys[n], None)
            tiles[keys[n]] = block[n].copy()  # a view would keep the whole block alive
        while len(tiles) > MOST_TILES:
            del tiles[next(iter(tiles))]
        scans = old.scans + 1
        due = scans <= 2 or scans % (RENEW + len(tiles) // TILES_A_SCAN) == 0
        self.state = HeightMapState(tiles, z, scans, _record(tiles) if due else old.record)

    def bend(self, bend: Bend) -> None:
        """Move what is known with a path that was bent."""
        tiles = bent(self.state.tiles, bend)
        self.state = replace(self.state, tiles=tiles, record=_record(tiles))

    def record(self) -> HeightMap:
        """The whole map as it is now."""
        return _record(self.state.tiles)

    def heights(self, places: Float) -> Float:
        """Height of the ground [m] at places of shape (N, 2) [m]: of the cell there or, where it is not
        known, of the known ones next to it; NaN where those are not known either."""
        cell = np.floor(places / CELL).astype(np.int64)
        return np.array([self._at(int(i), int(j)) for i, j in cell])

    def _at(self, i: int, j: int) -> float:
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
    """Nothing is known."""
    return _record({})


def _around(at: Float) -> list[Tile]:
    low, high = np.floor((at - REACH) / TILE), np.floor((at + REACH) / TILE)
    return [
        (i, j) for i in range(int(low[0]), int(high[0]) + 1) for j in range(int(low[1]), int(high[1]) + 1)
    ]


def _register(block: Float32, below: Float, weight: Float, before: float | None) -> float | None:
    """Height of the sensor in the map: the median over the cells near by that are known already."""
    known = (block[..., VIEWS] > 0.0) & (weight > NEAR_WEIGHT)
    if np.count_nonzero(known) < LEAST:
        known = (block[..., VIEWS] > 0.0) & (weight > 0.0)
        if np.count_nonzero(known) < LEAST:
            return before
    return float(np.median(block[known, MEAN] - below[known]))


def _record(tiles: Mapping[Tile, Float32]) -> HeightMap:
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
