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
#: Usual position of a camera relative to the robot [m].
BEHIND = (-8.0, -4.5, 6.0)
# Sizes of labels [rad], measured in the middle of a picture with viser's field of view of 75 degrees: a text
# keeps its share of the height of the picture.
TREE_WIDTH, CLUSTER_WIDTH, TEXT_HEIGHT = 0.17, 0.15, 0.05
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
        """Send a label to its node if text or position changed."""
        node, before = self._node_of[key], self._shown.get(key)
        # Moves of a few centimetres make a label hard to read, and each one is a message.
        if before is not None and math.dist(before.place, label.place) < 0.15:
            label = replace(label, place=before.place)
        if label == before:
            return
        self._shown[key] = label
        node.text, node.position, node.visible = label.text, label.place, True


Place = tuple[float, float, float]


def apart(
    places: NDArray[np.float64],
    order: NDArray[np.int64],
    robot: NDArray[np.float64],
    width: float,
    most: int,
    taken: Sequence[Place] = (),
) -> list[int]:
    """Return rows of places whose labels do not overlap as seen from BEHIND the robot, in order of
    preference, at most `most`.

    Args:
        places: x, y, z in the frame of the map, shape (N, 3) [m].
        order: Rows, the preferred ones first.
        robot: x, y, z of the robot, shape (3,) [m].
        width: Width of a label [rad].
        most: Largest number of labels, at least 1.
        taken: Places of other labels.
    """
    kept: list[int] = []
    used = [_direction(np.array(place), robot) for place in taken]
    for row in order.tolist():
        azimuth, elevation = _direction(places[row], robot)
        if all(
            abs(math.remainder(azimuth - other, math.tau)) * math.cos(elevation) >= width
            or abs(elevation - above) >= TEXT_HEIGHT
            for other, above in used
        ):
            kept.append(row)
            used.append((azimuth, elevation))
            if len(kept) == most:
                break
    return kept


def _direction(place: NDArray[np.float64], robot: NDArray[np.float64]) -> tuple[float, float]:
    """Return azimuth and elevation [rad] of a place (x, y, z) [m] as seen from BEHIND the robot."""
    x, y, z = (place - robot - BEHIND).tolist()
    return math.atan2(y, x), math.atan2(z, math.hypot(x, y))


def cluster_labels(
    frame: Frame, numbers: np.ndarray, label_by: str, taken: Sequence[Place] = ()
) -> list[Label]:
    """Return labels for the clusters of a scan without overlaps: trees first, then the nearest, at most
    MOST_LABELS. Clusters without a text, such as those without a circle by "DBH", have none; [] by "none".

    Args:
        frame: Results of the scan.
        numbers: Persistent number of each cluster, shape (K,).
        label_by: One of colours.LABEL_BY.
        taken: Places of the labels of trees; a cluster at one of these trees has no label.
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
    robot = np.array([pose.x, pose.y, frame.base_z])
    return [
        Label(int(numbers[k]), texts[k], tuple(places[k].tolist()))
        for k in apart(places, np.array(named, np.int64), robot, CLUSTER_WIDTH, MOST_LABELS, taken)
    ]


def _cluster_text(frame: Frame, k: int, label_by: str) -> str:
    """Return the text of a cluster; "" if its DBH is unknown. An external stem, which has no eccentricity,
    has its verdict.

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
    """Return the drawn height of clusters, shape (K,) [m]: at least 0.2, and STEM_HEIGHT for NaN, because an
    external stem has no measured height."""
    return np.where(np.isnan(height), STEM_HEIGHT, np.maximum(height, 0.2))


def short(value: float) -> str:
    """Return a number as text that rarely changes: one decimal below 10, a whole number below 100, above that
    one significant digit; "∞" if it is not finite."""
    if not np.isfinite(value):
        return "∞"
    if value >= 100.0:
        return f"{float(f'{value:.1g}'):.0f}"
    return f"{value:.1f}" if value < 10.0 else f"{value:.0f}"
