"""What the scans gathered, as one cloud in the frame of the map."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours
from app.scene.cloud import Cloud
from pipeline.types.records import Frame

SIDE = 0.1  # of a cell that is shown as one point [m]
MOST_POINTS = 200_000
BLOCK = 20_000  # points of one node, so that a large map is not sent again with each scan
STEP, TURN = 0.25, 0.17  # a scan is taken in after so much motion [m, rad]: those between show the same
LOW, HIGH = 0.0, 3.0  # that the ramp of colours spans [m]
_HALF = 1 << 20  # cells to each side of the origin that a key has room for


class Accumulated:
    """Points of the scans' stems and undergrowth, one a cell. Each stays where the pose of its scan put it.

    Attributes:
        points: float32, shape (N, 3) [m], in the order in which they came.
        left_out: How many cells were not taken in because there are MOST_POINTS.
    """

    def __init__(self) -> None:
        self.points = np.zeros((0, 3), np.float32)
        self.left_out = 0
        self._keys = np.zeros(0, np.int64)
        self._scans: list[tuple[int, int, NDArray[np.float64]]] = []  # scan, points before it, pose

    def take(self, frame: Frame) -> bool:
        """Take in what passed the filters of a scan; of a run that went back, forget what came later.

        Returns:
            Whether `points` is another array.
        """
        went_back = self._go_back(frame.index)
        pose = frame.estimate.T_map_base.as_array()
        if self._scans:
            moved = pose - self._scans[-1][2]
            turned = abs((moved[2] + np.pi) % (2.0 * np.pi) - np.pi)
            if np.hypot(*moved[:2]) < STEP and turned < TURN:
                return went_back
        points = frame.filtered + frame.sensor_offset.astype(np.float32)
        placed = np.column_stack(
            [frame.estimate.T_map_base.apply(points[:, :2].astype(np.float64)), points[:, 2] + frame.base_z]
        )
        keys, first = np.unique(_keys(placed), return_index=True)
        new = np.sort(first[~np.isin(keys, self._keys)])
        room = MOST_POINTS - len(self.points)
        self.left_out += max(0, len(new) - room)
        new = new[:room]
        self._scans.append((frame.index, len(self.points), pose))
        self.points = np.vstack([self.points, placed[new].astype(np.float32)])
        self._keys = np.concatenate([self._keys, _keys(placed[new])])
        return went_back or len(new) > 0

    def _go_back(self, index: int) -> bool:
        keep = None
        while self._scans and self._scans[-1][0] >= index:
            keep = self._scans.pop()[1]
        if keep is None:
            return False
        self.points, self._keys, self.left_out = self.points[:keep], self._keys[:keep], 0
        return True


class MapCloud:
    """The accumulated points in the scene, in blocks of which only those that changed are sent.

    Args:
        scene: Where the nodes are added.
        gathered: What is shown; it outlives the nodes when the scene is built anew.
    """

    def __init__(self, scene: viser.SceneApi, gathered: Accumulated) -> None:
        self._scene, self._gathered = scene, gathered
        self._blocks: list[Cloud] = []
        self._sent = np.zeros((0, 3), np.float32)
        self._visible = False

    @property
    def count(self) -> int:
        """How many points there are."""
        return len(self._gathered.points)

    def show(self, frame: Frame, visible: bool) -> None:
        """Take in a scan; what is hidden is gathered all the same."""
        self._gathered.take(frame)
        self.repaint(visible)

    def repaint(self, visible: bool) -> None:
        """Show or hide it."""
        self._visible = visible
        if visible:
            self._send(self._gathered.points)
        for number, block in enumerate(self._blocks):
            block.visible = visible and number * BLOCK < len(self._sent)

    def _send(self, points: NDArray[np.float32]) -> None:
        shared = min(len(points), len(self._sent))
        changed = np.flatnonzero(np.any(points[:shared] != self._sent[:shared], axis=1))
        first = int(changed[0]) if len(changed) else shared
        if first == len(points) == len(self._sent):
            return
        self._sent = points
        for number in range(first // BLOCK, -(-len(points) // BLOCK)):
            if number == len(self._blocks):
                name = f"/world/gathered/{number}"
                self._blocks.append(Cloud(self._scene, name, 0.05, precision="float32"))
            part = points[number * BLOCK : (number + 1) * BLOCK]
            self._blocks[number].show(part, colours.ramp(part[:, 2], LOW, HIGH))


def _keys(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """A number for the cell of each point, shape (N,)."""
    cell = (
        np.clip(np.floor(np.asarray(points, np.float64) / SIDE), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    )
    keys: NDArray[np.int64] = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    return keys
