"""The robot in the scene: where it stands, where it came from, and how sure SLAM is of it."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from app.scene.cloud import Cloud
from app.scene.ground_node import GroundNode
from app.scene.lines import Line
from app.scene.posed import add_posed
from app.scene.view import View
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Frame

Float = NDArray[np.float64]

ROBOT = "/world/robot"
STEP = 0.05  # m


class RobotNodes:
    """The robot's mesh and frame, its particles, its path and the path by odometry alone."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._frame = add_posed(scene, ROBOT)
        _add_body(scene)
        self._particles = Cloud(scene, "/world/particles", 0.06, precision="float32")
        self._path = Line(scene, "/world/path", colours.PATH, 0.05)
        self._odometry = Line(scene, "/world/odometry", colours.ODOMETRY, 0.03)
        self._dead_reckoning: list[tuple[int, float, float]] = []
        self._start = Pose2()
        self._ground: GroundNode | None = None

    def show(self, frame: Frame, path: Float, view: View, ground: GroundNode) -> None:
        """Show a new pose.

        Args:
            frame: The scan's results.
            path: shape (N, 2) [m], all poses so far in the frame of the map.
            view: What is to be seen.
            ground: On which all of it stands.
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

    def repaint(self, view: View) -> None:
        """Show the same pose after a choice of layers."""
        self._particles.visible = view.layers["particles"]
        self._path.visible = view.layers["path"]
        self._odometry.visible = view.layers["odometry"]
        if self._odometry.visible:
            places = np.array(self._dead_reckoning)[:, 1:]
            self._odometry.show(places, self._stepped(places))

    def _stepped(self, places: Float) -> Float:
        """Heights of the ground, in steps, so that a line is not sent again for a centimetre."""
        if self._ground is None:
            return np.zeros(len(places))
        return np.round(self._ground.heights(places, 0.0) / STEP) * STEP

    def _follow_odometry(self, frame: Frame) -> None:
        while self._dead_reckoning and self._dead_reckoning[-1][0] >= frame.index:  # played back
            self._dead_reckoning.pop()
        if not self._dead_reckoning:  # both paths begin together, and the eye sees what drifts from there
            self._start = frame.estimate.T_map_base @ frame.T_odom_base.inverse()
        at = self._start @ frame.T_odom_base
        self._dead_reckoning.append((frame.index, at.x, at.y))


def _add_body(scene: viser.SceneApi) -> None:
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
