"""The robot in the scene: pose, particles, paths, and the path ahead with its obstacles."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, nodes
from app.scene.colours import ViewSettings
from app.scene.nodes import CloudNode, Float, GroundNode, LineNode, Mesh, Node, Segments
from pipeline.config.stages import Obstacles
from pipeline.geometry.arcs import along_arc
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame, Zone

ROBOT = "/world/robot"
STEP = 0.05  # m
MOST_POINTS = 10_000  # of a line; they are less than 1 m apart in the first hours of a drive
FIRST_SCANS, FIRST_M = 10, 0.2  # the first direction is that of so many scans, if they are so far apart


class RobotNodes:
    """The mesh and frame of the robot, the particles, the path, and the path by odometry only.

    Args:
        scene: Scene of viser to which the nodes are added.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._body = [BodyNode(scene, name) for name in BODY]
        self._particles = CloudNode(scene, "/world/particles", 0.06)
        self._path = LineNode(scene, "/world/path", colours.PATH, 0.05)
        self._odometry = LineNode(scene, "/world/odometry", colours.ODOMETRY, 0.03)

    def show(self, frame: Frame, path: Float, view: ViewSettings, ground: GroundNode) -> None:
        """Show a pose and both paths.

        Args:
            frame: Results of the scan.
            path: Positions at all scans so far, see `Scene.show`.
            view: Visible layers.
            ground: Ground with its heights.
        """
        for part in self._body:
            part.show(frame)
        particles = frame.estimate.particles
        self._particles.show(
            view.layers["particles"],
            np.column_stack([particles[:, :2], np.full(len(particles), frame.base_z + 0.05)]),
            colours.PARTICLES,
        )
        thin = _thinned(path)
        for line, layer, places in (
            (self._path, "path", thin[:, :2]),
            (self._odometry, "odometry", aligned_odometry(path[: FIRST_SCANS + 1], thin)),
        ):
            line.show(view.layers[layer], places, _stepped(ground, places))


def aligned_odometry(first: Float, path: Float) -> Float:
    """Return the known positions by odometry, shape (M, 2) [m], moved to the start of the path and turned to
    its first direction, so that the drift since then is visible; as on the 2D map. There are none if they are
    unknown at all first scans.

    Args:
        first: The first rows of the path, which give its start and its first direction.
        path: Rows of the path, as in `Scene.show`.
    """
    first, path = (rows[np.isfinite(rows[:, 2])] for rows in (first, path))
    if not len(first):
        return np.zeros((0, 2))
    x, y, ahead, left = first[-1] - first[0]
    turn = np.arctan2(y, x) - np.arctan2(left, ahead) if np.hypot(ahead, left) > FIRST_M else 0.0
    return first[0, :2] + Pose2(0.0, 0.0, float(turn)).apply(path[:, 2:] - first[0, 2:])


def _thinned(path: Float) -> Float:
    """Return at most MOST_POINTS + 1 rows of a path, shape (N, 4) [m]: the rows at multiples of the smallest
    sufficient power of two, and the last row."""
    spacing = 1
    while len(path) > spacing * MOST_POINTS:
        spacing *= 2
    return np.concatenate([path[:-1:spacing], path[-1:]])


def _stepped(ground: GroundNode, places: Float) -> Float:
    """Return the heights of the ground at positions, shape (N, 2) [m], rounded to multiples of STEP, shape
    (N,) [m]; 0 where the ground is unknown."""
    return np.round(ground.heights(places, 0.0) / STEP) * STEP


def _part(mesh: Mesh, size: tuple[float, float, float], place: tuple[float, float, float]) -> Mesh:
    """Return a mesh that is scaled along x, y, z by `size` and then moved by `place` [m]."""
    vertices, faces = mesh
    return (vertices * np.array(size) + np.array(place)).astype(np.float32), faces


def _wheel(y: float) -> Mesh:
    """Return a wheel on the ground of the base frame, with its axle along y and its middle at `y` [m]."""
    vertices, faces = _part(nodes.cylinder(), (0.15, 0.15, 0.08), (0.0, 0.0, -0.04))
    return vertices[:, [0, 2, 1]] + np.array((0.0, y, 0.15), np.float32), faces[:, ::-1]


# Colour and parts of the robot in its base frame, by the name of the node.
BODY: dict[str, tuple[colours.Rgb, list[Mesh]]] = {
    "body": (colours.ROBOT, [_part(nodes.box(), (0.6, 0.36, 0.2), (-0.3, -0.18, 0.14))]),
    "wheels": ((40, 42, 46), [_wheel(0.22), _wheel(-0.22)]),
    "lidar": (
        (90, 94, 100),
        [
            _part(nodes.cylinder(), (0.02, 0.02, 0.3), (0.12, 0.0, 0.31)),
            _part(nodes.cylinder(), (0.06, 0.06, 0.08), (0.12, 0.0, 0.58)),
        ],
    ),
}


class BodyNode(Node[viser.MeshHandle]):
    """A part of the robot in one colour.

    Args:
        scene: Scene of viser.
        name: Name of the part in `BODY`.
    """

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        colour, parts = BODY[name]
        first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
        self._vertices = np.vstack([vertices for vertices, _ in parts])
        node = scene.add_mesh_simple(
            f"{ROBOT}/{name}",
            self._vertices,
            np.vstack([faces + start for (_, faces), start in zip(parts, first[:-1], strict=True)]).astype(
                np.uint32
            ),
            color=colour,
            flat_shading=True,
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        super().__init__(node)

    def show(self, frame: Frame) -> None:
        """Show the part at the pose of a scan; hide it without a drive."""
        placed = nodes.placed(self._vertices, frame.estimate.T_map_base, frame.base_z)
        self.update(frame.of_drive, vertices=placed)


HEIGHT = 0.06  # m above the base
PIECES = 12  # segments of a side
RING = 0.3  # m, around the obstacle
OF_ZONE = {
    Zone.CLEAR: colours.PATH,
    Zone.SLOW: colours.UNCERTAIN,
    Zone.STOP: colours.POLE,
    Zone.UNKNOWN: colours.OTHER,
}


class WayNode(Segments):
    """The path ahead of the robot with its stop and slow zones and the nearest obstacle, as lines."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene, f"{ROBOT}/way", 3.0)

    def show_ahead(self, on: bool, frame: Frame, parameters: Obstacles) -> None:
        """Show the path ahead of the robot in the colour of the zone, see OF_ZONE; nothing if the frame has
        no clearance. The obstacle has a ring only in the zones SLOW and STOP.

        Args:
            on: Whether the layer is on.
            frame: Results of the scan.
            parameters: Widths and lengths of the zones.
        """
        clearance = frame.clearance
        if clearance is None or not on:
            self.update(False)
            return
        segments = way_lines(clearance.curvature, clearance.backward, clearance.begins, parameters)
        if clearance.zone in (Zone.SLOW, Zone.STOP):
            place = np.array([(clearance.x, clearance.y)])
            segments = np.vstack([segments, nodes.circles(place, np.array([RING]), np.array([HEIGHT]))])
        placed = nodes.placed(segments, frame.estimate.T_map_base, frame.base_z)
        self.show(True, placed, OF_ZONE[clearance.zone])


def way_lines(curvature: float, backward: bool, begins: float, parameters: Obstacles) -> NDArray[np.float32]:
    """Return line segments in the level base frame, shape (S, 2, 3) [m]: both sides of the path ahead, and
    lines across the path at its beginning and at the ends of the stop and slow zones.

    Args:
        curvature: Curvature of the path [1/m], positive to the left.
        backward: Whether the robot drives backward.
        begins: Distance along the path from the base to its beginning [m].
        parameters: Widths and lengths of the zones.
    """
    half = 0.5 * parameters.width
    s = np.linspace(begins, begins + parameters.slow_distance, PIECES + 1)
    sides = [nodes.polyline(_on_way(s, side, curvature, backward)) for side in (-half, half)]
    bars = [
        nodes.polyline(_on_way(np.full(2, begins + end), np.array([-half, half]), curvature, backward))
        for end in (0.0, parameters.stop_distance, parameters.slow_distance)
    ]
    return np.vstack(sides + bars)


def _on_way(s: Float, left: float | Float, curvature: float, backward: bool) -> Float:
    """Return the points of `along_arc` at HEIGHT, shape (N, 3) [m]."""
    return np.column_stack([along_arc(s, left, curvature, backward), np.full(len(s), HEIGHT)])
