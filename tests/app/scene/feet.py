"""Where drawn stems begin, and what is around them."""

from __future__ import annotations

import numpy as np
import viser

from app.scene import Scene
from app.scene.nodes import raster, without_small_holes
from pipeline.types.records import Frame, HeightMap

ROUNDED = 0.05 + 1e-6  # m; heights of drawn trees are rounded to decimetres


def path_of(frame: Frame) -> np.ndarray:
    pose = frame.estimate.T_map_base
    return np.array([[pose.x, pose.y, pose.x, pose.y]])


def bases(scene: Scene, name: str) -> np.ndarray:
    """The base of each drawn cylinder in the map."""
    node = scene._server.scene.get_handle_by_name(name)
    assert isinstance(node, viser.BatchedMeshHandle)
    return np.asarray(node.batched_positions, np.float64)


def on_terrain(ground: HeightMap | None, base: np.ndarray) -> np.ndarray:
    """Which bases are at the height of a mapped terrain cell."""
    if ground is None:
        return np.zeros(len(base), bool)
    grid, low, cell = raster(ground)
    grid = without_small_holes(grid)
    place = np.floor((base[:, :2] - low) / cell).astype(np.int64)
    inside = np.all((place >= 0) & (place < grid.shape), axis=1)
    i, j = np.where(inside[:, None], place, 0).T
    found: np.ndarray = inside & (np.abs(grid[i, j] - base[:, 2]) <= ROUNDED)
    return found


def within(lower: np.ndarray, upper: np.ndarray, base: np.ndarray, reach: float = 0.8) -> np.ndarray:
    """Which bases are not below the lowest of one set of points around them, nor above the highest of another
    set; of the first one where the second has none."""
    out = np.zeros(len(base), bool)
    for row, (x, y, z) in enumerate(base):
        low, high = (part[np.hypot(*(part[:, :2] - (x, y)).T) < reach, 2] for part in (lower, upper))
        high = high if len(high) else low
        out[row] = len(low) > 0 and low.min() - ROUNDED <= z <= high.max()
    return out
