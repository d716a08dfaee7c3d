"""Lines of the scene: a path that grows, and circles on the ground."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes

Float = NDArray[np.float64]

CHUNK = 200  # segments of a path in one node, so that a long path is not sent again with each scan


class Line:
    """A growing line in chunks: only the chunks that changed are sent."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: colours.Rgb, height: float) -> None:
        self._scene, self._name, self._height = scene, name, height
        self._colour = colours.of_lines(np.array(colour, dtype=np.uint8))
        self._chunks: list[viser.LineSegmentsHandle] = []
        self._sent: Float = np.zeros((0, 3))
        self._visible = True

    def show(self, places: Float, ground: Float | None = None) -> None:
        """Show the line through places of shape (N, 2) [m], above the ground's heights there, (N,) [m]."""
        places = np.array(places, dtype=np.float64).reshape(-1, 2)
        points = np.column_stack(
            [places, self._height + (np.zeros(len(places)) if ground is None else ground)]
        )
        shared = min(len(points), len(self._sent))
        changed = np.nonzero(np.any(points[:shared] != self._sent[:shared], axis=1))[0]
        first = int(changed[0]) if len(changed) else shared
        if first == len(points) == len(self._sent):
            return
        self._sent = points
        needed = max(-(-(len(points) - 1) // CHUNK), 0)
        for number in range(max(first - 1, 0) // CHUNK, needed):
            self._send(number, points[number * CHUNK : (number + 1) * CHUNK + 1])
        for chunk in self._chunks[needed:]:
            chunk.visible = False

    @property
    def visible(self) -> bool:
        """Whether it is seen."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        needed = max(-(-(len(self._sent) - 1) // CHUNK), 0)
        for chunk in self._chunks[:needed]:
            chunk.visible = visible

    def _send(self, number: int, points: Float) -> None:
        segments = meshes.polyline(points)
        if number < len(self._chunks):
            self._chunks[number].points = segments
            self._chunks[number].visible = self._visible
            return
        self._chunks.append(
            self._scene.add_line_segments(
                f"{self._name}/{number}",
                segments,
                self._colour,
                thickness=2.5,
                thickness_units="screen",
                visible=self._visible,
            )
        )


class Circles:
    """Circles on the ground as one node. Lines keep their exact colour; lit meshes do not."""

    def __init__(self, scene: viser.SceneApi, name: str, height: float, thickness: float) -> None:
        self._height = height
        self._node = scene.add_line_segments(
            name,
            np.zeros((1, 2, 3), dtype=np.float32),
            np.zeros((1, 2, 3), dtype=np.uint8),
            thickness=thickness,
            thickness_units="screen",
            visible=False,
        )
        self._wanted, self._count = True, 0

    def show(self, centres: Float, radii: Float, each: colours.Colours, ground: Float | None = None) -> None:
        """Show circles at centres (N, 2) [m] with radii (N,) [m] in N colours, above the ground at heights
        (N,) [m]."""
        self._count = len(centres)
        if self._count:
            self._node.points = meshes.circles(
                centres, radii, self._height + (np.zeros(len(centres)) if ground is None else ground)
            )
            self._node.colors = np.repeat(colours.of_lines(each), 2 * meshes.SIDES, axis=0).reshape(-1, 2, 3)
        self.wanted = self._wanted

    @property
    def wanted(self) -> bool:
        """Whether people want to see them; without any they stay hidden all the same."""
        return self._wanted

    @wanted.setter
    def wanted(self, wanted: bool) -> None:
        self._wanted = wanted
        self._node.visible = wanted and self._count > 0
