"""The ground in the scene: one mesh over the known cells of the terrain map."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from pipeline.types.records import HeightMap

Float = NDArray[np.float64]

MOST_CELLS = 40_000  # of the mesh; in a larger map two by two cells are averaged
NOTHING = np.full((1, 1), np.nan)


class GroundNode:
    """The mesh of the ground, and its heights for the other nodes.

    The mesh is sent again only for another height map.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._node = scene.add_mesh_simple(
            "/world/surface",
            np.eye(3, dtype=np.float32),
            np.array([[0, 1, 2]], dtype=np.uint32),
            color=colours.GROUND,
            opacity=colours.GROUND_OPACITY,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        self._faces = 0
        self._shown: HeightMap | None = None
        self._raster, self._low, self._cell = NOTHING, np.zeros(2), 1.0
        self._visible = True

    @property
    def visible(self) -> bool:
        """Whether the layer is on."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        if self._node.visible != (visible and self._faces > 0):
            self._node.visible = visible and self._faces > 0

    @property
    def faces(self) -> int:
        """Number of faces of the mesh."""
        return self._faces

    def show(self, ground: HeightMap | None) -> bool:
        """Show a height map; None keeps the present one. Return whether the height map changed."""
        if ground is None or ground is self._shown:
            return False
        self._shown = ground
        self._raster, self._low, self._cell = raster(ground)
        vertices, faces = surface(self._raster, self._low, self._cell)
        self._faces = len(faces)
        if self._faces:
            self._node.vertices = vertices
            if not np.array_equal(faces, self._node.faces):
                self._node.faces = faces
        self.visible = self._visible
        return True

    def heights(self, places: NDArray[np.floating], otherwise: float) -> Float:
        """Return the height of the ground at places (N, 2) [m]; `otherwise` where it is unknown."""
        cell = np.floor((np.asarray(places, np.float64).reshape(-1, 2) - self._low) / self._cell)
        inside = np.all((cell >= 0) & (cell < self._raster.shape), axis=1)
        i, j = np.where(inside[:, None], cell, 0).astype(np.int64).T
        height = np.where(inside, self._raster[i, j], np.nan)
        return np.where(np.isfinite(height), height, otherwise)


def raster(ground: HeightMap) -> tuple[Float, Float, float]:
    """Return the heights of a grid around all known cells, its lower corner, and the side of a cell.

    Heights have shape (I, J) [m] and are NaN where unknown; the corner has shape (2,) [m]. A map with more
    than `MOST_CELLS` cells gets larger cells.
    """
    place, height, cell = ground.place.astype(np.int64), ground.height.astype(np.float64), ground.cell
    if len(place) == 0:
        return NOTHING, np.zeros(2), cell
    while len(place) > MOST_CELLS or np.prod(np.ptp(place, axis=0) + 1.0) > 100 * MOST_CELLS:
        place, which = np.unique(place // 2, axis=0, return_inverse=True)
        which = which.reshape(-1)
        height, cell = np.bincount(which, height) / np.bincount(which), 2.0 * cell
    low = place.min(axis=0)
    grid = np.full(place.max(axis=0) - low + 1, np.nan)
    grid[tuple((place - low).T)] = height
    return grid, low * cell, cell


def surface(grid: Float, low: Float, cell: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return a mesh through the centres of the known cells: vertices (V, 3) [m] and faces (F, 3).

    Four neighbouring known centres become two triangles.
    """
    known = np.isfinite(grid)
    square = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    used = np.zeros_like(known)
    i, j = np.nonzero(square)
    for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)):
        used[i + di, j + dj] = True
    number = np.full(grid.shape, -1)
    number[used] = np.arange(np.count_nonzero(used))
    a, b, c, d = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    at = np.stack(np.nonzero(used), axis=1)
    vertices = np.column_stack([low + (at + 0.5) * cell, grid[used]])
    return vertices.astype(np.float32), faces.astype(np.uint32)
