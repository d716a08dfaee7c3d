"""Where the map errs: how far its trees stand from the truth, trees that were missed, and false ones."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes
from app.scene.ground_node import GroundNode
from pipeline.config.stages import Evaluation
from pipeline.types.records import Trees, TruthTrees

Float = NDArray[np.float64]

TIMES = 10.0  # centimetres are drawn so many times as long, or nobody would see them
CROSS = 0.45  # half the width of a missed tree's cross [m]
AROUND = 0.6  # radius of a false tree's ring [m]
HEIGHT = 0.08  # above the ground [m]


class ErrorNode:
    """All errors as one node of lines."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._node = scene.add_line_segments(
            "/world/errors",
            np.zeros((1, 2, 3), dtype=np.float32),
            np.zeros((1, 2, 3), dtype=np.uint8),
            thickness=3.0,
            thickness_units="screen",
            visible=False,
        )
        self.count = 0

    def hide(self) -> None:
        """Show none."""
        self.count, self._node.visible = 0, False

    def show(
        self, trees: Trees, truth: TruthTrees | None, path: Float, wanted: Evaluation, ground: GroundNode
    ) -> None:
        """Show the errors of a map against the truth within reach of the path, shape (N, 2) [m]."""
        if truth is None or len(path) == 0:
            self.hide()
            return
        offsets, missed, false = errors(trees, truth, path, wanted)
        self.count = len(missed) + len(false)
        lines: list[NDArray[np.floating]] = [
            np.stack([offsets[:, 0], offsets[:, 0] + TIMES * (offsets[:, 1] - offsets[:, 0])], axis=1),
            _crosses(missed),
            meshes.circles(false, np.full(len(false), AROUND), np.zeros(len(false)))[:, :, :2],
        ]
        sizes = [len(each) for each in lines]
        flat = np.concatenate(lines).reshape(-1, 2)
        self._node.visible = len(flat) > 0
        if not len(flat):
            return
        xyz = np.column_stack([flat, ground.heights(flat, 0.0) + HEIGHT]).reshape(-1, 2, 3)
        self._node.points = xyz.astype(np.float32)
        each = np.array([colours.SELECTION, colours.ERROR, colours.ERROR], dtype=np.uint8)
        self._node.colors = np.repeat(colours.of_lines(np.repeat(each, sizes, axis=0)), 2, axis=0).reshape(
            -1, 2, 3
        )


def errors(trees: Trees, truth: TruthTrees, path: Float, wanted: Evaluation) -> tuple[Float, Float, Float]:
    """Where each matched tree really stands and where the map has it, shape (M, 2, 2); the true trees that
    are missed, (K, 2); and the map's trees where none stands, (F, 2), all [m]."""
    from scipy.spatial import cKDTree

    from pipeline.evaluation.matching import matched_rows

    true = np.column_stack([truth.x, truth.y])
    rows, truth_of = matched_rows(trees, truth, wanted.match_distance)
    offsets = np.stack([true[truth_of], trees.position[rows]], axis=1)
    way = cKDTree(path)
    missed = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    missed[truth_of] = False
    false = trees.confirmed.copy()
    false[rows] = False
    left_out, wrong = true[missed], trees.position[false]
    return offsets, left_out[_near(way, left_out, wanted.reach)], wrong[_near(way, wrong, wanted.reach)]


def _near(way: object, places: Float, reach: float) -> NDArray[np.bool_]:
    if not len(places):
        return np.zeros(0, np.bool_)
    distance: Float = way.query(places)[0]  # type: ignore[attr-defined]
    return distance <= reach


def _crosses(places: Float) -> Float:
    arms = CROSS * np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
    return (places[:, None, None, :] + arms).reshape(-1, 2, 2)
