"""The ground in the scene: one mesh over the known cells of the height map."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from pipeline.records import HeightMap

Float = NDArray[np.float64]

MOST_CELLS = 40_000  # that one mesh shows; above, cells are joined two by two
SUN = np.array([-0.4, -0.5, 0.77])  # where the shading's light comes from
LOW, HIGH = np.array([74.0, 70.0, 66.0]), np.array([150.0, 142.0, 124.0])  # colours of valley and crest
NOTHING = np.full((1, 1), np.nan)


class GroundNode:
    """The surface, and the height at which all else stands on it.

    It is sent again only when the height map is another one.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._node: viser.GlbHandle | None = None
        self._shown: HeightMap | None = None
        self._raster, self._low, self._cell = NOTHING, np.zeros(2), 1.0
        self._visible = True

    @property
    def visible(self) -> bool:
        """Whether people want to see it."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        if self._node is not None and self._node.visible != visible:
            self._node.visible = visible

    @property
    def area(self) -> float:
        """Of the known cells [m^2]."""
        return 0.0 if self._shown is None else len(self._shown.place) * self._shown.cell**2

    def show(self, ground: HeightMap | None) -> bool:
        """Show a height map; None keeps the one before. Returns whether it is another one."""
        if ground is None or ground is self._shown:
            return False
        self._shown = ground
        self._raster, self._low, self._cell = raster(ground)
        vertices, faces, shades = surface(self._raster, self._low, self._cell)
        if len(faces) == 0:
            if self._node is not None:
                self._node.remove()
                self._node = None
            return True
        # A node of the same name takes the place of the one before.
        self._node = self._scene.add_mesh_trimesh(
            "/world/ground", mesh=_painted(vertices, faces, shades), visible=self._visible,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        return True

    def heights(self, places: NDArray[np.floating], otherwise: float) -> Float:
        """Height of the ground at places of shape (N, 2) [m]; `otherwise` where it is not known."""
        cell = np.floor((np.asarray(places, np.float64).reshape(-1, 2) - self._low) / self._cell)
        inside = np.all((cell >= 0) & (cell < self._raster.shape), axis=1)
        i, j = np.where(inside[:, None], cell, 0).astype(np.int64).T
        height = np.where(inside, self._raster[i, j], np.nan)
        return np.where(np.isfinite(height), height, otherwise)


def raster(ground: HeightMap) -> tuple[Float, Float, float]:
    """Heights of all cells of the box around the known ones, shape (I, J) [m], NaN where unknown; the box's
    lower corner (2,) [m] and the side of a cell [m]. Large maps get larger cells."""
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


def surface(
    grid: Float, low: Float, cell: float
) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    """A mesh through the middles of the known cells: vertices (V, 3) [m], faces (F, 3), colours (V, 3).

    A square of four known middles becomes two triangles. The colour follows the height and the slope.
    """
    known = np.isfinite(grid)
    square = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    if not square.any():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), np.zeros((0, 3), np.uint8)
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
    return vertices.astype(np.float32), faces.astype(np.uint32), _shades(grid, cell)[used]


def _shades(grid: Float, cell: float) -> NDArray[np.uint8]:
    """Earth colours: lighter with the height, and shaded as by a low sun."""
    filled = np.where(np.isfinite(grid), grid, np.nanmedian(grid))
    gx, gy = (np.gradient(filled, cell, axis=axis) if filled.shape[axis] > 1 else 0.0 * filled for axis in (0, 1))
    light = (SUN[2] - SUN[0] * gx - SUN[1] * gy) / np.sqrt(1.0 + gx**2 + gy**2)
    low, high = np.nanquantile(grid, [0.02, 0.98])
    part = np.clip((filled - low) / max(high - low, 0.5), 0.0, 1.0)[..., None]
    rgb = (LOW + part * (HIGH - LOW)) * np.clip(0.35 + 0.85 * light, 0.3, 1.2)[..., None]
    shade: NDArray[np.uint8] = np.clip(rgb, 0, 255).astype(np.uint8)
    return shade
