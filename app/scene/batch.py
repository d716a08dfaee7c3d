"""Many copies of one mesh as one node of the scene, sent only when they changed."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene.meshes import Mesh


class Batch:
    """Upright copies of one mesh. viser is slow with a thousand nodes and quick with a thousand copies."""

    def __init__(self, scene: viser.SceneApi, name: str, mesh: Mesh, **look: Any) -> None:  # noqa: ANN401
        self.node = scene.add_batched_meshes_simple(
            name,
            *mesh,
            batched_wxyzs=_upright(1),
            batched_positions=np.zeros((1, 3), dtype=np.float32),
            batched_scales=np.ones((1, 3), dtype=np.float32),
            batched_colors=np.zeros((1, 3), dtype=np.uint8),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
            **look,
        )
        self.count = 0
        self._wanted = True

    @property
    def wanted(self) -> bool:
        """Whether people want to see it; without copies it stays hidden all the same."""
        return self._wanted

    @wanted.setter
    def wanted(self, wanted: bool) -> None:
        self._wanted = wanted
        self.node.visible = wanted and self.count > 0

    def show(
        self, positions: NDArray[np.floating], scales: NDArray[np.floating], colours: NDArray[np.uint8]
    ) -> None:
        """Place the copies.

        Args:
            positions, scales: shape (N, 3) [m].
            colours: shape (N, 3).
        """
        if not len(positions) == len(scales) == len(colours):
            raise ValueError("as many positions as scales and colours are needed")
        if len(positions) > 0:
            if len(positions) != self.count:
                self.node.batched_wxyzs = _upright(len(positions))
            self.node.batched_positions = positions.astype(np.float32)
            self.node.batched_scales = scales.astype(np.float32)
            self.node.batched_colors = colours
        self.count = len(positions)
        self.node.visible = self._wanted and self.count > 0


def _upright(count: int) -> NDArray[np.float32]:
    return np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (count, 1))
