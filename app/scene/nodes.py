"""Building blocks of the scene: meshes, batches of meshes, point clouds and lines.

Each block is sent to the browsers only when it changed.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from app.scene.colours import Colours, Rgb

SIDES = 32  # of a circle

Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


def cylinder(sides: int = 20) -> Mesh:
    """Return a closed cylinder of radius 1 and height 1 whose base is centred on the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low = np.column_stack([rim, np.zeros(sides)])
    high = np.column_stack([rim, np.ones(sides)])
    vertices = np.vstack([low, high, [[0, 0, 0], [0, 0, 1]]])
    faces: list[tuple[int, int, int]] = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [(i, j, sides + i), (j, sides + j, sides + i)]
        faces += [(j, i, 2 * sides), (sides + i, sides + j, 2 * sides + 1)]
    return vertices.astype(np.float32), np.array(faces, dtype=np.uint32)


def box() -> Mesh:
    """Return a cube of side 1 with a corner at the origin."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32)
    squares = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [face for a, b, c, d in squares for face in ((a, b, c), (a, c, d))]
    return vertices, np.array(faces, dtype=np.uint32)


def circles(
    centres: NDArray[np.floating], radii: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return circles as line segments, `SIDES` for each circle.

    Args:
        centres: shape (N, 2) [m].
        radii: shape (N,) [m].
        z: Heights, shape (N,) [m].

    Returns:
        shape (N * SIDES, 2, 3) [m].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = centres[:, None, :] + radii[:, None, None] * rim[None, :, :]
    xyz = np.concatenate([xy, np.broadcast_to(z[:, None, None], (*xy.shape[:2], 1))], axis=2)
    return np.stack([xyz[:, :-1], xyz[:, 1:]], axis=2).reshape(-1, 2, 3).astype(np.float32)


def polyline(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the segments between consecutive points (N, 3), shape (N - 1, 2, 3)."""
    xyz = points.astype(np.float32)
    return np.stack([xyz[:-1], xyz[1:]], axis=1)


class Batch:
    """Upright copies of one mesh as one node: viser is slow with a thousand nodes."""

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
        """Whether the layer is on; without copies the node is hidden anyway."""
        return self._wanted

    @wanted.setter
    def wanted(self, wanted: bool) -> None:
        self._wanted = wanted
        self.node.visible = wanted and self.count > 0

    def show(
        self, positions: NDArray[np.floating], scales: NDArray[np.floating], colours: NDArray[np.uint8]
    ) -> None:
        """Replace the copies.

        Args:
            positions, scales: shape (N, 3) [m].
            colours: shape (N, 3).
        """
        if not len(positions) == len(scales) == len(colours):
            raise ValueError("positions, scales and colours must have the same length")
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


class Cloud:
    """One point cloud. While it is hidden nothing is sent; the newest points are sent when it is shown."""

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
        if each.shape not in ((3,), points.shape):  # viser accepts a wrong length silently
            raise ValueError(f"{len(points)} points have colours of shape {each.shape}")
        if each.ndim == 1:
            each = np.broadcast_to(each, points.shape)
        self._waiting = (points, each)
        self._send()

    @property
    def visible(self) -> bool:
        """Whether the layer is on; without points the node is hidden anyway."""
        return self._wanted

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._wanted = visible
        self._send()

    def _send(self) -> None:
        if self._waiting is not None and self._wanted:
            points, colours = self._waiting
            self._empty, self._waiting = len(points) == 0, None
            if not self._empty:  # viser's client logs an error for an empty cloud
                self.node.points, self.node.colors = points, colours
        self.node.visible = self._wanted and not self._empty


Float = NDArray[np.float64]

CHUNK = 200  # segments per node, so that a long path is not sent again with each scan


class Line:
    """A growing line in chunks; only the chunks that changed are sent."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: colours.Rgb, height: float) -> None:
        self._scene, self._name, self._height = scene, name, height
        self._colour = colours.of_lines(np.array(colour, dtype=np.uint8))
        self._chunks: list[viser.LineSegmentsHandle] = []
        self._sent: Float = np.zeros((0, 3))
        self._visible = True

    def show(self, places: Float, ground: Float | None = None) -> None:
        """Show the line through places (N, 2) [m], above the heights of the ground there, shape (N,) [m]."""
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
        """Whether the layer is on."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        needed = max(-(-(len(self._sent) - 1) // CHUNK), 0)
        for chunk in self._chunks[:needed]:
            chunk.visible = visible

    def _send(self, number: int, points: Float) -> None:
        segments = polyline(points)
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
    """Circles on the ground as one node of lines, which keep their colour; meshes are shaded."""

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
            self._node.points = circles(
                centres, radii, self._height + (np.zeros(len(centres)) if ground is None else ground)
            )
            self._node.colors = np.repeat(colours.of_lines(each), 2 * SIDES, axis=0).reshape(-1, 2, 3)
        self.wanted = self._wanted

    @property
    def wanted(self) -> bool:
        """Whether the layer is on; without circles the node is hidden anyway."""
        return self._wanted

    @wanted.setter
    def wanted(self, wanted: bool) -> None:
        self._wanted = wanted
        self._node.visible = wanted and self._count > 0
