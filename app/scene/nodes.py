"""Building blocks of the scene: meshes, batches of meshes, point clouds, lines, and the ground.

Each block is sent to the browsers only when it changed. All coordinates are those of the map and part of the
content of a node: viser's client draws a new pose of a node one picture before new content, so a scan whose
points move with a pose would be drawn away from the trees.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from app.common.arrays import first_difference
from app.scene import colours
from app.scene.colours import Colours, Rgb
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame, HeightMap

SIDES = 32  # of a circle

N = TypeVar("N", bound=viser.SceneNodeHandle)
Float = NDArray[np.float64]
Points = NDArray[np.floating]
Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


def cylinder() -> Mesh:
    """Return a closed cylinder of radius 1 and height 1 whose base is centred on the origin."""
    return _mesh(trimesh.creation.cylinder(radius=1.0, height=1.0, sections=20), (0.0, 0.0, 0.5))


def box() -> Mesh:
    """Return a cube of side 1 with a corner at the origin."""
    return _mesh(trimesh.creation.box(extents=(1.0, 1.0, 1.0)), (0.5, 0.5, 0.5))


def _mesh(shape: trimesh.Trimesh, moved: tuple[float, float, float]) -> Mesh:
    """Return vertices, float32, shape (V, 3), and faces, uint32, shape (F, 3), of a shape that is moved by an
    offset."""
    return (shape.vertices + moved).astype(np.float32), shape.faces.astype(np.uint32)


def placed(points: Points, pose: Pose2, z: float) -> NDArray[np.float32]:
    """Return points of the level base frame in the frame of the map, float32, of the same shape (..., 3) [m].

    Args:
        points: shape (..., 3) [m].
        pose: Pose of the robot in the map.
        z: Height of the base [m].
    """
    moved = np.empty(points.shape, np.float32)
    moved[..., :2] = pose.apply(np.asarray(points[..., :2], np.float64))
    moved[..., 2] = points[..., 2] + z
    return moved


def scan_in_map(frame: Frame, points: Points) -> NDArray[np.float32]:
    """Return points of the sensor frame of a scan in the frame of the map, float32, shape (N, 3) [m]."""
    return placed(points + frame.sensor_offset, frame.estimate.T_map_base, frame.base_z)


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
    """Return the segments between consecutive points (N, 3), float32, shape (N - 1, 2, 3); shape (0, 2, 3)
    for one point."""
    xyz = points.astype(np.float32)
    return np.stack([xyz[:-1], xyz[1:]], axis=1)


class LayerNode(Generic[N]):
    """A node of a layer. It is visible while the layer is on and has content, because viser's client logs an
    error for an empty node."""

    def __init__(self, node: N) -> None:
        self.node = node
        self._on, self._filled = True, False

    @property
    def visible(self) -> bool:
        """Whether the layer is on."""
        return self._on

    @visible.setter
    def visible(self, on: bool) -> None:
        self._on = on
        self._update(self._filled)

    def _update(self, filled: bool) -> None:
        """Set whether the node has content, and send its visibility if it changed."""
        self._filled = filled
        if self.node.visible != (self._on and filled):
            self.node.visible = self._on and filled


class Batch(LayerNode[viser.BatchedMeshHandle]):
    """Copies of one mesh as one node, because viser is slow with a thousand nodes.

    Args:
        scene: Scene of viser.
        name: Name of the node.
        mesh: Vertices and faces.
        look: Further arguments of `add_batched_meshes_simple`.
    """

    def __init__(self, scene: viser.SceneApi, name: str, mesh: Mesh, **look: Any) -> None:  # noqa: ANN401
        node = scene.add_batched_meshes_simple(
            name,
            *mesh,
            batched_wxyzs=_turned(1),
            batched_positions=np.zeros((1, 3), dtype=np.float32),
            batched_scales=np.ones((1, 3), dtype=np.float32),
            batched_colors=np.zeros((1, 3), dtype=np.uint8),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
            **look,
        )
        super().__init__(node)
        self.count, self._yaw = 0, 0.0

    def show(self, positions: Points, scales: Points, colours: NDArray[np.uint8], yaw: float = 0.0) -> None:
        """Replace the copies; without any the node is hidden.

        Args:
            positions: Positions of the copies, shape (N, 3) [m].
            scales: Their sizes along x, y, z in units of the mesh, shape (N, 3).
            colours: Their colours, uint8, shape (N, 3).
            yaw: Rotation of each copy about the vertical [rad].

        Raises:
            ValueError: The lengths differ.
        """
        if not len(positions) == len(scales) == len(colours):
            raise ValueError("positions, scales and colours must have the same length")
        if len(positions) > 0:
            if (len(positions), yaw) != (self.count, self._yaw):
                self.node.batched_wxyzs = _turned(len(positions), yaw)
                self._yaw = yaw
            self.node.batched_positions = positions.astype(np.float32)
            self.node.batched_scales = scales.astype(np.float32)
            self.node.batched_colors = colours
        self.count = len(positions)
        self._update(self.count > 0)


def _turned(count: int, yaw: float = 0.0) -> NDArray[np.float32]:
    """Return quaternions (w, x, y, z) of a rotation about the vertical [rad], float32, shape (count, 4)."""
    return np.tile(np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], dtype=np.float32), (count, 1))


class CloudNode(LayerNode[viser.PointCloudHandle]):
    """One point cloud. While it is hidden nothing is sent; when it is shown, the newest points are sent.

    Args:
        scene: Scene of viser.
        name: Name of the node.
        size: Diameter of a point [m].
    """

    def __init__(self, scene: viser.SceneApi, name: str, size: float) -> None:
        node = scene.add_point_cloud(
            name,
            np.zeros((1, 3), dtype=np.float32),
            np.zeros((1, 3), dtype=np.uint8),
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",  # 16 bits are steps of decimetres far from the origin of a large map
            visible=False,
        )
        super().__init__(node)
        self._waiting: tuple[Points, Colours] | None = None
        self._size = size

    @property
    def size(self) -> float:
        """Diameter of a point [m]."""
        return self._size

    @size.setter
    def size(self, size: float) -> None:
        if size != self._size:
            self._size = self.node.point_size = size

    def show(self, points: Points, colours: Colours | Rgb) -> None:
        """Replace the points; without any the node is hidden. While the layer is off, they are kept and sent
        when it is switched on.

        Args:
            points: shape (N, 3) [m] in the frame of the map.
            colours: One colour, or one for each point.

        Raises:
            ValueError: The number of colours differs from that of the points.
        """
        each = np.asarray(colours, dtype=np.uint8)
        if each.shape not in ((3,), points.shape):  # viser accepts a wrong length silently
            raise ValueError(f"{len(points)} points have colours of shape {each.shape}")
        self._waiting = (points, np.broadcast_to(each, points.shape))
        self._update(self._filled)

    def _update(self, filled: bool) -> None:
        """Send the newest points if they were not sent and the layer is on; then as `LayerNode._update`."""
        if self._waiting is not None and self._on:
            (points, colours), self._waiting = self._waiting, None
            filled = len(points) > 0
            if filled:
                self.node.points, self.node.colors = points, colours
        super()._update(filled)


class Segments(LayerNode[viser.LineSegmentsHandle]):
    """Line segments as one node. Unlike meshes they are not shaded, so they keep their colour.

    Args:
        scene: Scene of viser.
        name: Name of the node.
        thickness: Width of the lines [pixels].
    """

    def __init__(self, scene: viser.SceneApi, name: str, thickness: float) -> None:
        node = scene.add_line_segments(
            name,
            np.zeros((1, 2, 3), dtype=np.float32),
            np.zeros((1, 2, 3), dtype=np.uint8),
            thickness=thickness,
            thickness_units="screen",
            visible=False,
        )
        super().__init__(node)

    def show(self, segments: Points, each: Colours) -> None:
        """Replace the segments; without any the node is hidden.

        Args:
            segments: Ends of the segments, shape (S, 2, 3) [m].
            each: Colour of each segment, uint8, shape (S, 3).
        """
        if len(segments):
            self.node.points = segments.astype(np.float32)
            self.node.colors = np.repeat(colours.of_lines(each), 2, axis=0).reshape(-1, 2, 3)
        self._update(len(segments) > 0)


class Circles(Segments):
    """Circles at a height above the ground.

    Args:
        scene: Scene of viser.
        name: Name of the node.
        height: Height above the ground [m].
        thickness: Width of the lines [pixels].
    """

    def __init__(self, scene: viser.SceneApi, name: str, height: float, thickness: float) -> None:
        super().__init__(scene, name, thickness)
        self._height = height

    def show_at(self, centres: Float, radii: Float, each: Colours, ground: Float) -> None:
        """Replace the circles.

        Args:
            centres: x, y, shape (N, 2) [m].
            radii: shape (N,) [m].
            each: Colours, uint8, shape (N, 3).
            ground: Heights of the ground, shape (N,) [m].
        """
        self.show(circles(centres, radii, self._height + ground), np.repeat(each, SIDES, axis=0))


CHUNK = 200  # segments per node, so that a long path is not sent again with each scan


class LineNode:
    """A growing line in chunks; only the chunks that changed are sent.

    Args:
        scene: Scene of viser.
        name: Name of the nodes.
        colour: Colour of the line.
        height: Height above the ground [m].
    """

    def __init__(self, scene: viser.SceneApi, name: str, colour: Rgb, height: float) -> None:
        self._scene, self._name, self._height = scene, name, height
        self._colour = colours.of_lines(np.array(colour, dtype=np.uint8))
        self._chunks: list[viser.LineSegmentsHandle] = []
        self._sent: Float = np.zeros((0, 3))
        self._visible = True

    def show(self, places: Float, ground: Float | float = 0.0) -> None:
        """Show the line through places; fewer than two hide it. Only chunks from the first change on are
        sent.

        Args:
            places: Points of the line, shape (N, 2) [m].
            ground: Heights of the ground there, scalar or shape (N,) [m].
        """
        places = np.array(places, dtype=np.float64).reshape(-1, 2)
        points = np.column_stack([places, np.broadcast_to(self._height + ground, len(places))])
        first = first_difference(self._sent, points)
        if first == len(points) == len(self._sent):
            return
        self._sent = points
        for number in range(max(first - 1, 0) // CHUNK, self._needed):
            self._send(number, points[number * CHUNK : (number + 1) * CHUNK + 1])
        for chunk in self._chunks[self._needed :]:
            chunk.visible = False

    @property
    def visible(self) -> bool:
        """Whether the layer is on."""
        return self._visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._visible = visible
        for chunk in self._chunks[: self._needed]:
            chunk.visible = visible

    @property
    def _needed(self) -> int:
        """Number of chunks of the line."""
        return max(-(-(len(self._sent) - 1) // CHUNK), 0)

    def _send(self, number: int, points: Float) -> None:
        """Send one chunk, adding its node if necessary.

        Args:
            number: Number of the chunk.
            points: Its points, shape (P, 3) [m].
        """
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


MOST_CELLS = 40_000  # of the mesh; in a larger map two by two cells are averaged
NOTHING = np.full((1, 1), np.nan)


class GroundNode(LayerNode[viser.MeshHandle]):
    """The mesh of the ground over the known cells of the terrain map, and its heights for the other nodes.

    The mesh is sent again only for another height map.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        node = scene.add_mesh_simple(
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
        super().__init__(node)
        self.faces = 0
        self._shown: HeightMap | None = None
        self._raster, self._low, self._cell = NOTHING, np.zeros(2), 1.0

    def show(self, ground: HeightMap | None) -> bool:
        """Show a height map; None keeps the present one. Return whether it is another object than the present
        one."""
        if ground is None or ground is self._shown:
            return False
        self._shown = ground
        self._raster, self._low, self._cell = raster(ground)
        vertices, faces = surface(self._raster, self._low, self._cell)
        self.faces = len(faces)
        if self.faces:
            self.node.vertices = vertices
            if not np.array_equal(faces, self.node.faces):
                self.node.faces = faces
        self._update(self.faces > 0)
        return True

    def heights(self, places: NDArray[np.floating], otherwise: float) -> Float:
        """Return the heights of the ground, shape (N,) [m], of the cell at each position without
        interpolation.

        Args:
            places: Positions, shape (N, 2) [m].
            otherwise: Height where the ground is unknown, also outside of the map [m].
        """
        cell = np.floor((np.asarray(places, np.float64).reshape(-1, 2) - self._low) / self._cell)
        inside = np.all((cell >= 0) & (cell < self._raster.shape), axis=1)
        i, j = np.where(inside[:, None], cell, 0).astype(np.int64).T
        height = np.where(inside, self._raster[i, j], np.nan)
        return np.where(np.isfinite(height), height, otherwise)


def raster(ground: HeightMap) -> tuple[Float, Float, float]:
    """Return the heights of a grid around all known cells of a height map, its lower corner, and the side of
    a cell.

    Heights have shape (I, J) [m] and are NaN where unknown; one NaN, shape (1, 1), for a map without cells.
    The corner, shape (2,) [m], is the outer corner of cell (0, 0). Two by two cells are averaged, and the
    side doubles, until at most `MOST_CELLS` cells are known in a grid of at most 100 times as many.
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
    """Return a mesh through the centres of the known cells: vertices, float32, shape (V, 3) [m], and faces,
    uint32, shape (F, 3).

    Four neighbouring known centres become two triangles; cells without such neighbours have no vertex. V and
    F are 0 if there are none.

    Args:
        grid, low, cell: Result of `raster`.
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
