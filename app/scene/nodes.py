"""Building blocks of the scene: meshes, batches of meshes, point clouds, lines, labels, and the ground.

Of each block only what changed is sent to the browsers. All coordinates are those of the map and part of the
content of a node: viser's client draws a new pose of a node one picture before new content, so a scan whose
points move with a pose would be drawn away from the trees.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from app.scene.colours import Colours, Rgb
from app.scene.viser_server import send_properties
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame, HeightMap

SIDES = 32  # of a circle
OWN_TREE = 0.5  # m; a cluster this near to a tree is that tree

N = TypeVar("N", bound=viser.SceneNodeHandle)
Float = NDArray[np.float64]
Points = NDArray[np.floating]
Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]


def cylinder(sides: int = 20) -> Mesh:
    """Return a closed cylinder of radius 1 and height 1 whose base is centred on the origin: vertices,
    float32, shape (V, 3), and faces, uint32, shape (F, 3), counter-clockwise from outside."""
    angle = np.arange(sides) * (2.0 * math.pi / sides)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
    vertices = np.vstack([ring, ring + np.array([0.0, 0.0, 1.0]), [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]])
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = np.vstack(
        [
            np.column_stack([here, there, there + sides]),
            np.column_stack([here, there + sides, here + sides]),
            np.column_stack([there, here, bottom]),
            np.column_stack([here + sides, there + sides, top]),
        ]
    )
    return vertices.astype(np.float32), faces.astype(np.uint32)


def box() -> Mesh:
    """Return a cube of side 1 with a corner at the origin, in the form of `cylinder`."""
    vertices = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
    squares = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [corners for a, b, c, d in squares for corners in ((a, b, c), (a, c, d))]
    return vertices, np.array(faces, np.uint32)


def placed(points: Points, pose: Pose2, z: float) -> NDArray[np.float32]:
    """Return points of the level base frame in the frame of the map, float32, of the same shape (..., 3) [m].

    Args:
        points: Points in the level base frame, shape (..., 3) [m].
        pose: Pose of the robot in the map.
        z: Height of the base in the map [m].
    """
    moved = np.empty(points.shape, np.float32)
    moved[..., :2] = pose.apply(np.asarray(points[..., :2], np.float64))
    moved[..., 2] = points[..., 2] + z
    return moved


def scan_in_map(frame: Frame, points: Points) -> NDArray[np.float32]:
    """Return points of the level frame of the sensor, shape (N, 3) [m], in the frame of the map by the pose
    of a scan, float32, shape (N, 3) [m]."""
    return placed(points + frame.sensor_offset, frame.estimate.T_map_base, frame.base_z)


def circles(
    centres: NDArray[np.floating], radii: NDArray[np.floating], z: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return circles as line segments, `SIDES` for each circle.

    Args:
        centres: Positions x, y, shape (N, 2) [m].
        radii: Radii, shape (N,) [m].
        z: Heights, shape (N,) [m].

    Returns:
        Ends of the segments, circle by circle, float32, shape (N * SIDES, 2, 3) [m].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    xy = centres[:, None, :] + radii[:, None, None] * rim[None, :, :]
    xyz = np.concatenate([xy, np.broadcast_to(z[:, None, None], (*xy.shape[:2], 1))], axis=2)
    return np.stack([xyz[:, :-1], xyz[:, 1:]], axis=2).reshape(-1, 2, 3).astype(np.float32)


def polyline(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the segments between consecutive points (N, 3), float32, shape (N - 1, 2, 3); shape (0, 2, 3)
    for less than two points."""
    xyz = points.astype(np.float32)
    return np.stack([xyz[:-1], xyz[1:]], axis=1)


class Node(Generic[N]):
    """A node of the scene, of which only changes are sent. It is visible while its layer is on and it has
    content, because viser's client logs an error for an empty node."""

    def __init__(self, node: N) -> None:
        self.node = node
        self._sent: dict[str, Any] = {}

    def update(self, on: bool, **content: Any) -> None:  # noqa: ANN401 - the properties of the node
        """Set properties of the node and show it, or hide it; a hidden node keeps its content, and `content`
        is not sent to it.

        Args:
            on: Whether it is visible.
            content: Dict from names of properties, the same in each call, to values; unchanged ones are not
                sent. Arrays are kept and must not be modified.
        """
        changed = [
            name
            for name, value in content.items()
            if name not in self._sent or not np.array_equal(self._sent[name], value)
        ]
        if on and changed:
            self._sent = content
            self._send(content, changed)
        if self.node.visible != on:
            self.node.visible = on

    def _send(self, content: dict[str, Any], changed: list[str]) -> None:
        """Send the changed ones of all properties of the node."""
        for name in changed:
            setattr(self.node, name, content[name])


class Batch(Node[viser.BatchedMeshHandle]):
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

    def show(
        self, on: bool, positions: Points, scales: Points, colours: NDArray[np.uint8], yaw: float = 0.0
    ) -> None:
        """Replace the copies.

        Args:
            on: Whether they are visible.
            positions: Positions of the copies, shape (N, 3) [m].
            scales: Sizes of the copies along x, y, z in units of the mesh, shape (N, 3).
            colours: Colours of the copies, uint8, shape (N, 3).
            yaw: Rotation of each copy about the vertical [rad].

        Raises:
            ValueError: The lengths differ.
        """
        if not len(positions) == len(scales) == len(colours):
            raise ValueError("positions, scales and colours must have the same length")
        self.update(
            on and len(positions) > 0,
            batched_wxyzs=_turned(len(positions), yaw),
            batched_positions=positions.astype(np.float32),
            batched_scales=scales.astype(np.float32),
            batched_colors=colours,
        )

    def _send(self, content: dict[str, Any], changed: list[str]) -> None:  # noqa: ARG002 - see the base class
        """Send all properties together, because viser's client drops colours of another number than the
        copies."""
        send_properties(self.node, content)


def _turned(count: int, yaw: float = 0.0) -> NDArray[np.float32]:
    """Return quaternions (w, x, y, z) of a rotation about the vertical [rad], float32, shape (count, 4)."""
    return np.tile(np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], dtype=np.float32), (count, 1))


class CloudNode(Node[viser.PointCloudHandle]):
    """One point cloud.

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

    def show(self, on: bool, points: Points, colours: Colours | Rgb, **look: float) -> None:
        """Replace the points.

        Args:
            on: Whether they are visible.
            points: Points in the frame of the map, shape (N, 3) [m].
            colours: One colour, shape (3,), or one for each point, shape (N, 3).
            look: `point_size`, the diameter of the points [m]; without it the size does not change.

        Raises:
            ValueError: The number of colours differs from that of the points.
        """
        each = np.asarray(colours, dtype=np.uint8)
        if each.shape not in ((3,), points.shape):  # viser accepts a wrong length silently
            raise ValueError(f"{len(points)} points have colours of shape {each.shape}")
        each = np.broadcast_to(each, points.shape)
        self.update(on and len(points) > 0, points=points, colors=each, **look)


class Segments(Node[viser.LineSegmentsHandle]):
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

    def show(self, on: bool, segments: Points, each: Colours | Rgb) -> None:
        """Replace the segments.

        Args:
            on: Whether they are visible.
            segments: Ends of the segments in the map, shape (S, 2, 3) [m].
            each: One colour, or one for each segment, uint8, shape (S, 3).
        """
        # Never one colour for all: viser's client takes that as sRGB, and keeps the colours of single ones.
        one_each = np.broadcast_to(np.asarray(each, np.uint8), (len(segments), 3))
        drawn = np.repeat(colours.of_lines(one_each), 2, axis=0).reshape(-1, 2, 3)
        self.update(on and len(segments) > 0, points=segments.astype(np.float32), colors=drawn)

    def _send(self, content: dict[str, Any], changed: list[str]) -> None:  # noqa: ARG002 - see the base class
        """Send points and colours together, because there are as many colours as points."""
        send_properties(self.node, content)


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

    def show_at(self, on: bool, centres: Float, radii: Float, each: Colours, ground: Float) -> None:
        """Replace the circles. If there are none, nothing is shown.

        Args:
            on: Whether they are visible.
            centres: Positions x, y in the map, shape (N, 2) [m].
            radii: Radii, shape (N,) [m].
            each: Colour of each circle, uint8, shape (N, 3).
            ground: Heights z of the ground in the map at the centres, shape (N,) [m]. The circles are the
                height of the constructor above it.
        """
        self.show(on, circles(centres, radii, self._height + ground), np.repeat(each, SIDES, axis=0))


def short(value: float) -> str:
    """Return a number as text: with one decimal below 10, as an integer below 100, and from 100 on with one
    significant digit; "∞" if it is not finite."""
    if not np.isfinite(value):
        return "∞"
    if value >= 100.0:
        return f"{float(f'{value:.1g}'):.0f}"
    return f"{value:.1f}" if value < 10.0 else f"{value:.0f}"


MOST_LABELS = 60  # more than 200 halve the frame rate of a browser
Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a position in the frame of the map [m]; `key` identifies the labelled object."""

    key: int
    text: str
    place: Place


class LabelNodes:
    """A pool of label nodes. A node keeps its object, so that an unchanged text is not sent again.

    Args:
        scene: Scene of viser.
        name: Name of the parent node.
        scale: Size of the text on the screen.
    """

    def __init__(self, scene: viser.SceneApi, name: str, scale: float = 0.9) -> None:
        self._scene, self._name, self._scale = scene, name, scale
        self._node_of: dict[int, viser.LabelHandle] = {}
        self._shown: dict[int, Label] = {}
        self._free: list[viser.LabelHandle] = []

    def show(self, labels: Iterable[Label]) -> None:
        """Show these labels, at most the first `MOST_LABELS`, and hide all others. Of labels with the same
        key the last counts; a label that moves less than 15 cm keeps its position."""
        wanted = {label.key: label for label in list(labels)[:MOST_LABELS]}
        for key in self._shown.keys() - wanted.keys():
            node = self._node_of.pop(key)
            node.visible = False
            self._free.append(node)
            del self._shown[key]
        for key, label in wanted.items():
            if key not in self._shown:
                self._node_of[key] = self._free.pop() if self._free else self._another()
            self._place(key, label)

    def _another(self) -> viser.LabelHandle:
        """Add a hidden node to the pool and return it."""
        return self._scene.add_label(
            f"{self._name}/{len(self._node_of)}",
            "",
            font_screen_scale=self._scale,
            anchor="bottom-center",
            visible=False,
        )

    def _place(self, key: int, label: Label) -> None:
        """Send a label to its node if its text changed or it moved by 15 cm or more."""
        node, before = self._node_of[key], self._shown.get(key)
        # Moves of a few centimetres make a label hard to read, and each one is a message.
        if before is not None and math.dist(before.place, label.place) < 0.15:
            label = replace(label, place=before.place)
        if label == before:
            return
        self._shown[key] = label
        node.text, node.position, node.visible = label.text, label.place, True


CHUNK = 200  # segments per node, so that a long path is not sent again with each scan


class LineNode:
    """A growing line in chunks.

    Args:
        scene: Scene of viser.
        name: Name of the nodes.
        colour: Colour of the line.
        height: Height above the ground [m].
    """

    def __init__(self, scene: viser.SceneApi, name: str, colour: Rgb, height: float) -> None:
        self._scene, self._name, self._height, self._colour = scene, name, height, colour
        self._chunks: list[Segments] = []

    def show(self, on: bool, places: Float, ground: Float | float = 0.0) -> None:
        """Show the line through the points, `height` of the constructor above the ground; only chunks that
        changed are sent.

        Args:
            on: Whether it is visible.
            places: Points x, y of the line in the map, shape (N, 2) [m].
            ground: Heights of the ground at the points, scalar or shape (N,) [m].
        """
        segments = polyline(np.column_stack([places, np.broadcast_to(self._height + ground, len(places))]))
        while len(self._chunks) * CHUNK < len(segments):
            self._chunks.append(Segments(self._scene, f"{self._name}/{len(self._chunks)}", 3.5))
        for number, chunk in enumerate(self._chunks):
            chunk.show(on, segments[number * CHUNK : (number + 1) * CHUNK], self._colour)


MOST_CELLS = 40_000  # of the mesh; in a larger map two by two cells are averaged
NOTHING = np.full((1, 1), np.nan)


class GroundNode(Node[viser.MeshHandle]):
    """The mesh of the ground over the known cells of the terrain map, and its heights for the other nodes.

    Attributes:
        shown: The height map that is shown; None before the first.
        faces: Number of triangles of the mesh.
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
        self.shown: HeightMap | None = None
        self._mesh: Mesh = node.vertices, node.faces
        self._raster, self._low, self._cell = NOTHING, np.zeros(2), 1.0

    def show(self, on: bool, ground: HeightMap | None) -> None:
        """Show the ground of a height map, or hide it (`on` False); `heights` are then those of this map as
        well. None keeps the present map."""
        if ground is not None and ground is not self.shown:
            self.shown = ground
            known, self._low, self._cell = raster(ground)
            self._raster = without_small_holes(known)
            self._mesh = surface(self._raster, self._low, self._cell)
            self.faces = len(self._mesh[1])
        vertices, faces = self._mesh
        self.update(on and self.faces > 0, vertices=vertices, faces=faces)

    def heights(self, places: NDArray[np.floating], otherwise: float | Float) -> Float:
        """Return the heights of the ground, shape (N,) [m], of the cell at each position without
        interpolation.

        Args:
            places: Positions x, y in the map, shape (N, 2) [m].
            otherwise: Height where the ground is unknown, also outside of the map, scalar or shape (N,) [m].
        """
        cell = np.floor((np.asarray(places, np.float64).reshape(-1, 2) - self._low) / self._cell)
        inside = np.all((cell >= 0) & (cell < self._raster.shape), axis=1)
        i, j = np.where(inside[:, None], cell, 0).astype(np.int64).T
        height = np.where(inside, self._raster[i, j], np.nan)
        return np.where(np.isfinite(height), height, otherwise)


def raster(ground: HeightMap) -> tuple[Float, Float, float]:
    """Return the heights of a grid around all known cells of a height map, the lower corner of the grid, and
    the side of a cell [m].

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


def without_small_holes(grid: Float) -> Float:
    """Return the heights of a grid, shape (I, J) [m], in which an unknown cell (NaN) with at least five known
    ones among its eight neighbours has their mean, in three passes: holes up to three cells wide, such as the
    shadow of a trunk, are closed, and larger ones stay."""
    for _ in range(3):
        around = np.lib.stride_tricks.sliding_window_view(np.pad(grid, 1, constant_values=np.nan), (3, 3))
        known = np.isfinite(around).sum(axis=(2, 3))
        mean = np.nansum(around, axis=(2, 3)) / np.maximum(known, 1)
        grid = np.where(np.isnan(grid) & (known >= 5), mean, grid)
    return grid


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


def nearest_within(places: Float, points: NDArray[np.floating], reach: float) -> NDArray[np.int64]:
    """Return the row of the place nearest to each point, shape (N,); -1 if none is within `reach` [m]. Each
    place is compared with the points of its strip along y; a tree of SciPy would load SciPy into the web
    process.

    Args:
        places: Positions x, y, shape (T, 2) [m].
        points: Positions x, y, shape (N, 2) [m].
        reach: Maximum distance [m].
    """
    order = np.argsort(points[:, 0], kind="stable")
    ordered = points[order].astype(np.float64)
    nearest, row = np.full(len(points), reach), np.full(len(points), -1)
    strips = np.searchsorted(ordered[:, 0], places[:, :1] + np.array([-reach, reach]))
    for k, (first, last) in enumerate(strips.tolist()):
        distance = np.hypot(*(ordered[first:last] - places[k]).T)
        is_nearer = distance < nearest[first:last]
        row[first:last][is_nearer] = k
        nearest[first:last][is_nearer] = distance[is_nearer]
    rows = np.empty_like(row)
    rows[order] = row
    return rows
