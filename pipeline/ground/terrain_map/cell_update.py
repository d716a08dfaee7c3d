"""Cells of the height map: which of them a scan saw, and what they know afterwards."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.azimuth_bins import direction_bin
from pipeline.ground.terrain import ground_at, ring_at
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float, Float32

CELL = 0.5  # m
SIDE = 16  # cells of a tile
WEIGHT, MEAN, VARIANCE, VIEWS = range(4)
COLUMNS = 4
SIGMA, SIGMA_A_METRE = 0.03, 0.005  # of one view: grass, and the tilt that is left
MOST = 50.0  # views at 5 m that a cell counts at the most


@compiled
def look(
    corner: Float, at: Float, yaw: float, height: Float, seen: Bool, reach: float
) -> tuple[Float, Float]:
    """What a scan saw of the cells of some tiles.

    Args:
        corner: Of the tiles, shape (T, 2) [m]; at: the sensor, shape (2,) [m], both in the map.
        yaw: Of the sensor [rad].
        height, seen: Of its Terrain.
        reach: Cells farther away are left out [m].

    Returns:
        Height of the ground in the sensor's frame [m], NaN where it was not seen, and the weight of that
        view [1/m^2], 0 likewise; both of shape (T, SIDE, SIDE).
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
    """Average one view into the cells, in place.

    Args:
        block: shape (T, SIDE, SIDE, COLUMNS); below, weight: from `look`; sensor_z: see HeightMapState.
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
