"""The way that the robot drives, with its stop and slow zones, and the nearest obstacle in it."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes
from pipeline.config.stages import Obstacles
from pipeline.types.clearance import Clearance, Zone

Float = NDArray[np.float64]

HEIGHT = 0.06  # m above the base
PIECES = 12  # segments of a side
RING = 0.3  # m, around the obstacle
# A bend that changes less is drawn as it was [1/m]: the node is sent only when something moved.
BEND = 0.02
OF_ZONE = {
    Zone.CLEAR: colours.PATH,
    Zone.SLOW: colours.UNCERTAIN,
    Zone.STOP: colours.POLE,
    Zone.UNKNOWN: colours.OTHER,
}


class WayNode:
    """One node of lines below the robot's frame."""

    def __init__(self, scene: viser.SceneApi, robot: str) -> None:
        self._node = scene.add_line_segments(
            f"{robot}/way",
            np.zeros((1, 2, 3), dtype=np.float32),
            np.zeros((1, 2, 3), dtype=np.uint8),
            thickness=3.0,
            thickness_units="screen",
            visible=False,
        )
        self._drawn: tuple[object, ...] | None = None

    def show(self, clearance: Clearance | None, parameters: Obstacles, wanted: bool) -> None:
        """Show the way of a scan; None, or what nobody wants to see, hides it."""
        if clearance is None or not wanted:
            if self._node.visible:
                self._node.visible = False
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
                ring = meshes.circles(np.array([place]), np.array([RING]), np.array([HEIGHT]))
                segments = np.vstack([segments, ring])
            each = np.tile(np.array(OF_ZONE[clearance.zone], dtype=np.uint8), (len(segments) * 2, 1))
            self._node.points = segments
            self._node.colors = colours.of_lines(each).reshape(-1, 2, 3)
        if not self._node.visible:
            self._node.visible = True


def way_lines(curvature: float, backward: bool, begins: float, parameters: Obstacles) -> NDArray[np.float32]:
    """Both sides of the way, and a bar across it where each zone ends, in the level base frame: segments of
    shape (S, 2, 3) [m]."""
    half = 0.5 * parameters.width
    s = np.linspace(begins, begins + parameters.slow_distance, PIECES + 1)
    sides = [meshes.polyline(_on_way(s, side, curvature, backward)) for side in (-half, half)]
    bars = [
        meshes.polyline(_on_way(np.full(2, begins + end), np.array([-half, half]), curvature, backward))
        for end in (0.0, parameters.stop_distance, parameters.slow_distance)
    ]
    return np.vstack(sides + bars)


def _on_way(s: Float, left: float | Float, curvature: float, backward: bool) -> Float:
    """Places so far along an arc from the base and so far to the left of it, shape (N, 3) [m]."""
    if abs(curvature) < 1e-6:
        x, y = s, np.zeros_like(s) + left
    else:
        radius, angle = 1.0 / curvature, s * curvature
        x, y = (radius - left) * np.sin(angle), radius - (radius - left) * np.cos(angle)
    return np.column_stack([-x if backward else x, y, np.full(len(s), HEIGHT)])
