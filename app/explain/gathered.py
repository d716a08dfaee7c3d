"""Evidence from the voxel map: the points around one tree, and a section at breast height for the 2D map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.common.arrays import evenly_spaced
from app.explain.records import MapSection
from pipeline.classification.voxel_map import SIDE, TILE, VoxelMap

# Heights above the ground of the section and of the points at breast height, which is 1.3 m [m].
BREAST_LOW, BREAST_HIGH = 1.0, 1.6
REACH = 0.75  # [m] around the axis of a tree: the stem and what touches it
_MOST_AT_BREAST, _MOST_OTHERS = 600, 900  # points of a tree
_MOST_CELLS = 20_000  # 160 kB


def points_around(voxels: VoxelMap, place: NDArray[np.float64]) -> list[tuple[float, float, float]]:
    """Return the voxels within REACH of a place: x, y from it and height above the ground, in whole
    centimetres [m]; at most 1,500, of which those at breast height come first.

    Args:
        voxels: Voxels of all scans.
        place: x, y in the map [m].
    """
    mean, _ = voxels.around(np.floor(place / TILE).astype(np.int64), REACH)
    points = mean.astype(np.float64) - [*place, 0.0]
    points = points[np.hypot(points[:, 0], points[:, 1]) <= REACH]
    at_breast = _at_breast(points[:, 2])
    chosen = [
        part[evenly_spaced(len(part), most)]
        for part, most in ((points[at_breast], _MOST_AT_BREAST), (points[~at_breast], _MOST_OTHERS))
    ]
    return [(x, y, z) for x, y, z in np.round(np.concatenate(chosen), 2).tolist()]


def section(accumulated: NDArray[np.floating]) -> MapSection:
    """Return the occupied cells between BREAST_LOW and BREAST_HIGH, seen from above. The side of a cell is
    that of a voxel, doubled until there are at most 20,000 cells.

    Args:
        accumulated: Points of all scans or of a whole cloud: x, y in the map and height above the ground,
            shape (N, 3) [m].
    """
    points = accumulated[_at_breast(accumulated[:, 2]), :2].astype(np.float64)
    origin = np.floor(points.mean(axis=0) if len(points) else np.zeros(2))
    side = SIDE
    while True:
        cells = np.unique(np.floor((points - origin) / side).astype(np.int64), axis=0)
        if len(cells) <= _MOST_CELLS:
            return MapSection(side, (float(origin[0]), float(origin[1])), cells.astype(np.int32))
        side *= 2.0


def _at_breast(height: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which heights above the ground [m] are between BREAST_LOW and BREAST_HIGH."""
    return (height >= BREAST_LOW) & (height < BREAST_HIGH)
