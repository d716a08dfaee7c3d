"""Where people look from: behind the robot, from above, and whether the picture follows it."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene.posed import add_posed
from pipeline.geometry.poses import Pose2

WORLD = "/world"  # the parent of all nodes; its children are in the frame of the map
BEHIND = (-8.0, -4.5, 6.0)  # of a camera, seen from what it looks at [m]
ABOVE = (0.0, -0.01, 28.0)


class Follower:
    """Keeps the robot at the viewer's origin by moving the world, not the cameras.

    A camera belongs to the person who turns it: its place comes back from the browser some frames late, and
    moving it from here would fight with the hand. Moving the world goes out with the points in one message
    group, so nothing trembles. When following ends the world stays where it is, and nothing jumps.

    Args:
        server: viser's server; the world's frame is added to it.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._world = add_posed(server.scene, WORLD)
        self._server = server
        server.initial_camera.position = BEHIND
        server.initial_camera.look_at = (0.0, 0.0, 0.5)

    def show(self, pose: Pose2, z: float, follow: bool) -> None:
        """Bring the robot at this pose and height [m] to the origin, if the picture is to follow it."""
        if follow:
            self._world.position = (-pose.x, -pose.y, -z)

    @property
    def shift(self) -> NDArray[np.float64]:
        """Where the origin of the map stands in viser's world, shape (3,) [m]."""
        return np.array(self._world.position, dtype=np.float64)

    def look(self, client: viser.ClientHandle, pose: Pose2, z: float, *, from_above: bool) -> None:
        """Turn one browser's camera to the robot at this pose and height [m]."""
        target = np.array([pose.x, pose.y, z]) + self._world.position
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0])
            client.camera.position = target + (ABOVE if from_above else BEHIND)
            client.camera.look_at = target
