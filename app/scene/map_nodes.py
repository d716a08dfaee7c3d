"""The tree map in the scene: one mesh for all trees, their numbers, and the ground truth as rings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes
from app.scene.batch import Batch
from app.scene.ground_node import GroundNode
from app.scene.labels import NUMBER_WIDTH, Label, Labels, apart
from app.scene.lines import Circles
from app.scene.view import View
from pipeline.types.records import Frame, Trees, TruthTrees

Ring = tuple[float, float, float] | None

TREE_HEIGHT = 2.2  # what a robot sees of a trunk; the map knows no height of trees [m]
UNKNOWN_RADIUS = 0.08  # drawn where no arc carried a diameter [m]
NUMBERS = 20  # nearest trees that carry their number


class MapNodes:
    """Trees and ground truth.

    Args:
        scene: Where the nodes are added.
        on_tree: Called in viser's thread with the number of a tree that was clicked.
    """

    def __init__(self, scene: viser.SceneApi, on_tree: Callable[[int], None]) -> None:
        self.ground = GroundNode(scene)
        self._truth_trees: TruthTrees | None = None
        self._trees = Batch(scene, "/world/trees", meshes.cylinder(), opacity=0.55)
        self._truth = Circles(scene, "/world/truth", 0.04, 2.5)
        self._mark = Circles(scene, "/world/selection", 0.06, 5.0)
        self._labels = Labels(scene, "/world/numbers", 1.0)
        self._shown: NDArray[np.float64] = np.zeros((0, 5))
        self._numbers: list[int] = []

        @self._trees.node.on_click
        async def _(event: viser.SceneNodePointerEvent[Any]) -> None:
            numbers = self._numbers
            if event.instance_index is not None and 0 <= event.instance_index < len(numbers):
                on_tree(numbers[event.instance_index])

    def show(self, frame: Frame, selected: int | None, ring: Ring, view: View) -> None:
        """Show the map after a scan; what moved by less than a centimetre stays where it is."""
        if self.ground.show(frame.ground):
            self.show_truth(self._truth_trees)
        trees = confirmed(frame.trees)
        foot = np.round(self.ground.heights(trees.position, frame.base_z), 1)
        radius = np.where(np.isfinite(trees.dbh), 0.5 * trees.dbh, UNKNOWN_RADIUS)
        place = np.column_stack([trees.number, np.round(trees.position, 2), np.round(radius, 3), foot])
        numbers = [int(number) for number in trees.number]
        if not np.array_equal(place, self._shown) or numbers != self._numbers:
            self._shown, self._numbers = place, numbers
            self._show_trees(place, np.isfinite(trees.dbh))
        self.repaint(frame, selected, ring, view)

    def repaint(self, frame: Frame, selected: int | None, ring: Ring, view: View) -> None:
        """Show the same map after a choice of layers, of a tree, or of a cluster that stands at `ring`: x, y
        and radius [m] in the frame of the map."""
        self.ground.visible = view.layers["ground"]
        self._trees.wanted = view.layers["trees"]
        self._truth.wanted = view.layers["truth"]
        trees = confirmed(frame.trees)
        pose = frame.estimate.T_map_base
        foot = self.ground.heights(trees.position, frame.base_z)
        self._show_mark(trees, selected, ring, frame.base_z)
        self._labels.show(
            tree_labels(trees, np.array([pose.x, pose.y]), selected, foot) if view.layers["trees"] else []
        )

    def show_truth(self, trees: TruthTrees | None) -> None:
        """Rings where trees and others really stand; None takes them away."""
        self._truth_trees = trees
        if trees is None:
            self._truth.show(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3), dtype=np.uint8))
            return
        radius = np.where(np.isfinite(trees.dbh), 0.5 * trees.dbh, UNKNOWN_RADIUS) + 0.12
        is_tree = np.array([kind == "tree" for kind in trees.kind], dtype=bool)
        place = np.column_stack([trees.x, trees.y])
        self._truth.show(
            place,
            radius,
            colours.choose(is_tree, colours.TRUTH, colours.OTHER),
            self.ground.heights(place, 0.0),
        )

    @property
    def texts(self) -> list[str]:
        """The labels that are to be read now."""
        return self._labels.texts

    def _show_trees(self, place: NDArray[np.float64], measured: NDArray[np.bool_]) -> None:
        self._trees.show(
            place[:, [1, 2, 4]],
            np.column_stack([place[:, 3], place[:, 3], np.full(len(place), TREE_HEIGHT)]),
            colours.choose(measured, colours.TREE, colours.UNMEASURED),
        )

    def _show_mark(self, trees: Trees, selected: int | None, ring: Ring, base_z: float) -> None:
        # Around a cluster there is its own ring; a second one around its tree would only cover it.
        row = trees.number == (-1 if selected is None or ring is not None else selected)
        places, radii = np.round(trees.position[row], 2), []
        for dbh in trees.dbh[row]:
            radii.append(0.4 + (0.5 * dbh if np.isfinite(dbh) else UNKNOWN_RADIUS))
        if ring is not None:
            places, radii = np.vstack([places, ring[:2]]), [*radii, ring[2] + 0.12]
        each = np.tile(np.array([colours.SELECTION], dtype=np.uint8), (len(radii), 1))
        self._mark.show(places, np.array(radii), each, self.ground.heights(places, base_z))


def confirmed(trees: Trees) -> Trees:
    """The trees that are shown to people."""
    known = {name: column for name in Trees.__slots__ if (column := getattr(trees, name)) is not None}
    return Trees(**{name: column[trees.confirmed] for name, column in known.items()})


def tree_labels(
    trees: Trees, robot: NDArray[np.float64], selected: int | None, foot: NDArray[np.float64]
) -> list[Label]:
    """Numbers for the selected tree and those nearest to the robot at (x, y) [m], none upon another; `foot`
    is the height of the ground at each tree, shape (T,) [m]."""
    distance = np.linalg.norm(trees.position - robot, axis=1)
    order = np.lexsort((distance, trees.number != (-1 if selected is None else selected)))
    return [
        Label(
            int(trees.number[row]),
            _tree_text(trees, row, int(trees.number[row]) == selected),
            (
                float(trees.position[row, 0]),
                float(trees.position[row, 1]),
                round(float(foot[row]), 1) + TREE_HEIGHT + 0.15,
            ),
        )
        for row in apart(trees.position, order, robot, NUMBER_WIDTH, NUMBERS)
    ]


def _tree_text(trees: Trees, row: int, selected: bool) -> str:
    number = int(trees.number[row])
    if not selected:
        return f"{number}"
    dbh = float(trees.dbh[row])
    return (
        f"tree {number}, DBH {100 * dbh:.1f} cm" if np.isfinite(dbh) else f"tree {number}, DBH not measured"
    )
