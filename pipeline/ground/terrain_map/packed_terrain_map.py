"""The height map as it is saved: plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.ground.terrain_map.cell_update import COLUMNS, SIDE
from pipeline.ground.terrain_map.fusion import MOST_TILES, HeightMapState, no_height_map
from pipeline.types.records import Float32, HeightMap, Int


@dataclass(frozen=True, slots=True, eq=False)
class PackedHeightMap:
    """See HeightMapState; the tiles in their order. `sensor_z` is NaN where it is not known.

    Attributes:
        tile: int64, shape (T, 2); cells: float32, shape (T * SIDE * SIDE, COLUMNS).
    """

    tile: Int
    cells: Float32
    sensor_z: float
    scans: int
    record: HeightMap

    @classmethod
    def of(cls, state: HeightMapState) -> PackedHeightMap:
        """All that the state knows."""
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
        """Nothing is known."""
        return cls.of(HeightMapState({}, None, 0, no_height_map()))

    def unpacked(self) -> HeightMapState:
        """The same state, to the bit.

        Raises:
            ValueError: Its parts do not fit one another; they come from a file.
        """
        n = len(self.tile)
        if self.tile.shape != (n, 2) or self.cells.shape != (n * SIDE * SIDE, COLUMNS) or n > MOST_TILES:
            raise ValueError("the tiles of the height map have another shape")
        if not np.all(np.isfinite(self.cells)) or np.isinf(self.sensor_z) or self.scans < 0:
            raise ValueError("a height is not finite")
        record = self.record
        k = len(record.height)
        if record.place.shape != (k, 2) or not len(record.sigma) == len(record.views) == k:
            raise ValueError("the columns of the height map have other lengths")
        keys = [(int(i), int(j)) for i, j in self.tile]
        if len(set(keys)) < n:
            raise ValueError("two tiles of the height map are one")
        tiles = self.cells.reshape(n, SIDE, SIDE, COLUMNS)
        z = None if np.isnan(self.sensor_z) else self.sensor_z
        return HeightMapState(
            {key: tile.copy() for key, tile in zip(keys, tiles, strict=True)}, z, self.scans, record
        )
