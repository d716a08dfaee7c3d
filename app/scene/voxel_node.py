"""The voxels that the filter makes one point of, as boxes in the frame of the sensor."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes
from app.scene.batch import Batch

MOST_VOXELS = 20_000  # that are drawn; boxes are dearer than points


class VoxelNode:
    """Boxes of the voxel grid that hold a filtered point."""

    def __init__(self, scene: viser.SceneApi, sensor: str) -> None:
        self._boxes = Batch(scene, f"{sensor}/voxels", meshes.box(), opacity=0.5)
        self.count = 0

    def show(self, filtered: NDArray[np.float32], size: float, visible: bool) -> None:
        """Show the voxels of filtered points (N, 3) [m]; a size of 0 [m] has none.

        `count` tells all of them, also those above MOST_VOXELS, which are not drawn.
        """
        self._boxes.wanted = visible
        if not visible or size <= 0.0:
            self.count = 0
            self._boxes.show(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
            return
        low = size * np.unique(np.floor(np.asarray(filtered, np.float64) / size), axis=0)
        self.count = len(low)
        drawn = low[:MOST_VOXELS]
        each = np.tile(np.array([colours.VOXELS], dtype=np.uint8), (len(drawn), 1))
        self._boxes.show(drawn, np.full((len(drawn), 3), size), each)
