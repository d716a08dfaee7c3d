"""Cameras of the scene: views of the robot, following, and the commands with a key."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene.viser_server import add_posed
from pipeline.geometry.poses import Pose2

WORLD = "/world"  # parent of all nodes; its children are in the frame of the map
BEHIND = (-8.0, -4.5, 6.0)  # position of a camera relative to its target [m]
ABOVE = (0.0, -0.01, 28.0)


class Follower:
    """Keeps the robot at the origin of the viewer by moving the world instead of the cameras.

    The pose of a camera arrives from the browser some frames late, so that moving it from here would
    interfere with the person who turns it. The pose of the world is sent in one group with the points. When
    following ends, the world keeps its pose.

    Args:
        server: Server of viser, to which the frame of the world is added.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._world = add_posed(server.scene, WORLD)
        self._server = server
        server.initial_camera.position = BEHIND
        server.initial_camera.look_at = (0.0, 0.0, 0.5)

    def show(self, pose: Pose2, z: float, follow: bool) -> None:
        """Move the robot at this pose and height [m] to the origin, if `follow`."""
        if follow:
            self._world.position = (-pose.x, -pose.y, -z)

    @property
    def shift(self) -> NDArray[np.float64]:
        """Position of the origin of the map in the world of viser, shape (3,) [m]."""
        return np.array(self._world.position, dtype=np.float64)

    def look(self, client: viser.ClientHandle, pose: Pose2, z: float, *, from_above: bool) -> None:
        """Turn one browser's camera to the robot at this pose and height [m]."""
        target = np.array([pose.x, pose.y, z]) + self._world.position
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0])
            client.camera.position = target + (ABOVE if from_above else BEHIND)
            client.camera.look_at = target


OnCamera = Callable[[str, viser.ClientHandle], None]


def add_hotkeys(gui: viser.GuiApi, on_camera: OnCamera, on_follow: Callable[[], None]) -> None:
    """Add commands with keys, which work while the scene has the focus; the page forwards the keys.

    Args:
        gui: viser's panel.
        on_camera: Called in the thread of viser with "top" or "behind" and the client.
        on_follow: Called in the thread of viser to start or stop following.
    """

    @gui.add_command("Top view", description="Look down on the robot", hotkey="T").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("top", event.client)

    @gui.add_command("Behind the robot", description="Look from behind", hotkey="B").on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if event.client is not None:
            on_camera("behind", event.client)

    @gui.add_command("Follow the robot", description="Start or stop following", hotkey="F").on_trigger
    async def _(_event: viser.CommandEvent) -> None:
        on_follow()
