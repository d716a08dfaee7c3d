"""The robot in the scene: pose, particles, paths, and the path ahead with its obstacles."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, nodes
from app.scene.colours import ViewSettings
from app.scene.nodes import CloudNode, Float, GroundNode, LineNode, Segments
from app.scene.viser_server import add_posed
from pipeline.config.stages import Obstacles
from pipeline.geometry.poses import Pose2
from pipeline.types.clearance import Clearance, Zone
from pipeline.types.records import Frame

ROBOT = "/world/robot"
STEP = 0.05  # m


class RobotNodes:
    """The mesh and frame of the robot, the particles, the path, and the path by odometry only.

    Args:
        scene: Scene of viser to which the nodes are added.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._frame = add_posed(scene, ROBOT)
        _add_body(scene)
        self._particles = CloudNode(scene, "/world/particles", 0.06, precision="float32")
        self._path = LineNode(scene, "/world/path", colours.PATH, 0.05)
        self._odometry = LineNode(scene, "/world/odometry", colours.ODOMETRY, 0.03)
        self._dead_reckoning: list[tuple[int, float, float]] = []
        self._start = Pose2()
        self._ground: GroundNode | None = None

    def show(self, frame: Frame, path: Float, view: ViewSettings, ground: GroundNode) -> None:
        """Show a new pose. A scan with an index that was shown before, or a smaller one, removes the odometry
        path from there on, because the run went back.

        Args:
            frame: Results of the scan.
            path: Positions at all scans so far in the frame of the map, shape (N, 2) [m].
            view: Visible layers.
            ground: Ground with its heights; it is kept for `repaint`.
        """
        self._ground = ground
        pose = frame.estimate.T_map_base
        self._frame.position = (pose.x, pose.y, frame.base_z)
        self._frame.wxyz = (np.cos(pose.yaw / 2), 0.0, 0.0, np.sin(pose.yaw / 2))
        particles = frame.estimate.particles
        self._particles.show(
            np.column_stack([particles[:, :2], np.full(len(particles), frame.base_z + 0.05)]),
            colours.PARTICLES,
        )
        self._path.show(path, self._stepped(path))
        self._follow_odometry(frame)
        self.repaint(view)

    def repaint(self, view: ViewSettings) -> None:
        """Update the visibility of particles and paths after a change of layers. `show` must be called
        before."""
        self._particles.visible = view.layers["particles"]
        self._path.visible = view.layers["path"]
        self._odometry.visible = view.layers["odometry"]
        if self._odometry.visible:
            places = np.array(self._dead_reckoning)[:, 1:]
            self._odometry.show(places, self._stepped(places))

    def _stepped(self, places: Float) -> Float:
        """Return heights of the ground at places (N, 2) [m], shape (N,) [m], rounded to STEP, so that small
        changes do not send a line again. 0 where the ground is unknown and before the first scan."""
        if self._ground is None:
            return np.zeros(len(places))
        return np.round(self._ground.heights(places, 0.0) / STEP) * STEP

    def _follow_odometry(self, frame: Frame) -> None:
        """Add the pose by odometry only of a scan. Both paths begin at the pose of the first scan that is
        shown."""
        while self._dead_reckoning and self._dead_reckoning[-1][0] >= frame.index:  # the run went back
            self._dead_reckoning.pop()
        if not self._dead_reckoning:  # both paths start at the same pose, so that the drift is visible
            self._start = frame.estimate.T_map_base @ frame.T_odom_base.inverse()
        at = self._start @ frame.T_odom_base
        self._dead_reckoning.append((frame.index, at.x, at.y))


def _add_body(scene: viser.SceneApi) -> None:
    """Add the boxes and cylinders that represent the robot, as children of its frame."""
    scene.add_box(
        f"{ROBOT}/body", color=colours.ROBOT, dimensions=(0.6, 0.36, 0.2), position=(0.0, 0.0, 0.24)
    )
    for side, y in (("left", 0.22), ("right", -0.22)):
        scene.add_cylinder(
            f"{ROBOT}/wheel_{side}",
            radius=0.15,
            height=0.08,
            color=(40, 42, 46),
            wxyz=(np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
            position=(0.0, y, 0.15),
        )
    scene.add_cylinder(
        f"{ROBOT}/mast", radius=0.02, height=0.3, color=(90, 94, 100), position=(0.12, 0.0, 0.46)
    )
    scene.add_cylinder(
        f"{ROBOT}/lidar", radius=0.06, height=0.08, color=(30, 32, 36), position=(0.12, 0.0, 0.62)
    )


HEIGHT = 0.06  # m above the base
PIECES = 12  # segments of a side
RING = 0.3  # m, around the obstacle
# Step of the drawn curvature [1/m]: smaller changes do not send the node again.
BEND = 0.02
OF_ZONE = {
    Zone.CLEAR: colours.PATH,
    Zone.SLOW: colours.UNCERTAIN,
    Zone.STOP: colours.POLE,
    Zone.UNKNOWN: colours.OTHER,
}


class WayNode(Segments):
    """The path ahead of the robot with its stop and slow zones and the nearest obstacle, as lines."""

    def __init__(self, scene: viser.SceneApi, robot: str) -> None:
        super().__init__(scene, f"{robot}/way", 3.0)
        self._drawn: tuple[object, ...] | None = None

    def show_ahead(self, clearance: Clearance | None, parameters: Obstacles, visible: bool) -> None:
        """Show the path ahead of the robot. Nothing is sent for changes below the drawn resolution, and only
        the visibility changes while the node is hidden.

        Args:
            clearance: Path ahead and obstacles at the scan; None hides the node.
            parameters: Widths and lengths of the zones.
            visible: Whether the layer is on.
        """
        self.visible = visible and clearance is not None
        if clearance is None or not visible:
            return
        bend = round(clearance.curvature / BEND) * BEND
        place = (
            (round(clearance.x, 1), round(clearance.y, 1)) if clearance.zone in (Zone.SLOW, Zone.STOP) else ()
        )
        begins = round(clearance.begins, 1)
        drawn = (clearance.zone, clearance.backward, bend, place, begins, parameters)
        if drawn != self._drawn:
            self._drawn = drawn
            segments = way_lines(bend, clearance.backward, begins, parameters)
            if place:
                ring = nodes.circles(np.array([place]), np.array([RING]), np.array([HEIGHT]))
                segments = np.vstack([segments, ring])
            self.show(
                segments, np.tile(np.array(OF_ZONE[clearance.zone], dtype=np.uint8), (len(segments), 1))
            )


def way_lines(curvature: float, backward: bool, begins: float, parameters: Obstacles) -> NDArray[np.float32]:
    """Return both sides of the path ahead and a line at the end of each zone, in the level base frame, as
    segments of shape (S, 2, 3) [m].

    Args:
        curvature: Curvature of the path [1/m], positive to the left.
        backward: Whether the robot drives backward.
        begins: Distance of the beginning of the path from the base [m].
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
    """Return points at a lateral distance from the path ahead, shape (N, 3) [m], in the level base frame, at
    HEIGHT.

    Args:
        s: Distances along the path from the base, shape (N,) [m].
        left: Distance to the left of the path [m], scalar or shape (N,).
        curvature: Curvature of the path [1/m], positive to the left; below 1e-6 the path is straight.
        backward: Whether the robot drives backward; then x is negated.
    """
    if abs(curvature) < 1e-6:
        x, y = s, np.zeros_like(s) + left
    else:
        radius, angle = 1.0 / curvature, s * curvature
        x, y = (radius - left) * np.sin(angle), radius - (radius - left) * np.cos(angle)
    return np.column_stack([-x if backward else x, y, np.full(len(s), HEIGHT)])
