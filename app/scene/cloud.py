"""A point cloud whose points and colours are assigned, never added again."""

from __future__ import annotations

from typing import Literal

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene.colours import Colours, Rgb


class Cloud:
    """One point cloud. While it is hidden nothing is sent; the newest points follow when it is shown."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        size: float,
        *,
        precision: Literal["float16", "float32"] = "float16",
        visible: bool = True,
    ) -> None:
        self.node = scene.add_point_cloud(
            name,
            np.zeros((1, 3), dtype=np.float32),
            np.zeros((1, 3), dtype=np.uint8),
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision=precision,
            visible=False,
        )
        self._wanted, self._empty = visible, True
        self._waiting: tuple[NDArray[np.floating], Colours] | None = None

    def show(self, points: NDArray[np.floating], colours: Colours | Rgb) -> None:
        """Replace the points.

        Args:
            points: shape (N, 3) [m] in the frame of the parent node.
            colours: One colour, or one for each point.
        """
        each = np.asarray(colours, dtype=np.uint8)
        if each.shape not in ((3,), points.shape):  # viser takes a wrong length in silence
            raise ValueError(f"{len(points)} points have colours of shape {each.shape}")
        if each.ndim == 1:
            each = np.broadcast_to(each, points.shape)
        self._waiting = (points, each)
        self._send()

    @property
    def visible(self) -> bool:
        """Whether people want to see it; without points it stays hidden all the same."""
        return self._wanted

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._wanted = visible
        self._send()

    def _send(self) -> None:
        if self._waiting is not None and self._wanted:
            points, colours = self._waiting
            self._empty, self._waiting = len(points) == 0, None
            if not self._empty:  # viser's client complains about a cloud without points
                self.node.points, self.node.colors = points, colours
        self.node.visible = self._wanted and not self._empty
