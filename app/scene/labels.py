"""Text labels of clusters and trees that do not flicker or tremble."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import viser
from numpy.typing import NDArray

from pipeline.types.records import Frame, Verdict

MOST_LABELS = 60  # more than 200 halve the frame rate of a browser
STEM_HEIGHT = 2.0  # [m], drawn where no height was measured
OWN_TREE = 0.5  # m; a cluster this near to a labelled tree is that tree


@dataclass(frozen=True, slots=True)
class Label:
    """A text at a position in the frame of the map [m]; `key` identifies the labelled object."""

    key: int
    text: str
    place: tuple[float, float, float]


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


Place = tuple[float, float, float]


def cluster_labels(
    frame: Frame, numbers: np.ndarray, label_by: str, taken: Sequence[Place] = ()
) -> list[Label]:
    """Return at most MOST_LABELS labels for the clusters of a scan, 0.1 m above their tops in the frame of
    the map: first clusters with the verdict TREE, then others, each from near to far. Clusters without a text
    (see `_cluster_text`) have no label; [] if `label_by` is "none".

    Args:
        frame: Results of the scan.
        numbers: Persistent number of each cluster, shape (K,), the keys of the labels.
        label_by: One of colours.LABEL_BY.
        taken: Positions x, y, z of the labels of trees in the map [m]; a cluster at a horizontal distance of
            less than OWN_TREE from one of them has no label.
    """
    if label_by == "none":
        return []
    clusters, pose = frame.clusters, frame.estimate.T_map_base
    base = clusters.centroid + frame.sensor_offset
    tops = frame.base_z + base[:, 2] + 0.5 * shown_height(clusters.extent[:, 2]) + 0.1
    places = np.column_stack([pose.apply(base[:, :2]), tops])
    order = np.lexsort((np.linalg.norm(base[:, :2], axis=1), clusters.verdict != Verdict.TREE))
    texts = [_cluster_text(frame, k, label_by) for k in range(len(order))]
    trees = np.array(taken).reshape(-1, 3)[:, :2]
    named = [
        k
        for k in order.tolist()
        if texts[k] and not (np.linalg.norm(trees - places[k, :2], axis=1) < OWN_TREE).any()
    ]
    return [Label(int(numbers[k]), texts[k], tuple(places[k].tolist())) for k in named[:MOST_LABELS]]


def _cluster_text(frame: Frame, k: int, label_by: str) -> str:
    """Return the text of a cluster: the label of its verdict for "verdict"; the diameter in cm for "DBH", ""
    if it is unknown; the eccentricity for "eccentricity", or the label of the verdict if that is NaN.

    Args:
        frame: Results of the scan.
        k: Row of the cluster.
        label_by: One of colours.LABEL_BY except "none".
    """
    verdict = Verdict(int(frame.clusters.verdict[k])).label
    if label_by == "verdict":
        return verdict
    if label_by == "DBH":
        radius = float(frame.clusters.radius[k])
        return f"{200 * radius:.0f} cm" if np.isfinite(radius) else ""
    eccentricity = float(frame.clusters.eccentricity[k])
    return verdict if np.isnan(eccentricity) else f"λ1/λ2 {short(eccentricity)}"


def shown_height(height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height with which clusters are rendered, shape (K,) [m]: the height, at least 0.2, and
    STEM_HEIGHT for NaN."""
    return np.where(np.isnan(height), STEM_HEIGHT, np.maximum(height, 0.2))


def short(value: float) -> str:
    """Return a number as text: with one decimal below 10, as an integer below 100, and from 100 on with one
    significant digit; "∞" if it is not finite."""
    if not np.isfinite(value):
        return "∞"
    if value >= 100.0:
        return f"{float(f'{value:.1g}'):.0f}"
    return f"{value:.1f}" if value < 10.0 else f"{value:.0f}"
