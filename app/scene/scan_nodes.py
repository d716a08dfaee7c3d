"""The standing scan in the scene: its points by stage, the fitted circles and the clusters' labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, meshes
from app.scene.batch import Batch
from app.scene.cloud import Cloud
from app.scene.colours import Colours
from app.scene.companions import Companions
from app.scene.labels import Labels, cluster_labels, shown_height
from app.scene.picking import meant
from app.scene.posed import add_posed
from app.scene.view import View
from pipeline.types.records import Frame

Float = NDArray[np.float64]
Vector = tuple[float, float, float]
OnCluster = Callable[[int | None, Vector, Vector], None]

# The lengths that the ramps span: about what trunks and ground of a stand reach.
HEIGHT_LOW, HEIGHT_HIGH = -1.0, 3.0
WIDEST_MARKER = 0.6  # m; as thick as a trunk may be


class ScanNodes:
    """Nodes below the robot's frame, so that a scan stays in the frame of its sensor: viser sends points in
    16 bits, which at the far end of a map would be steps of decimetres.

    Args:
        scene: Where the nodes are added.
        robot: Name of the node that stands at T_map_base.
        on_cluster: Called in viser's thread with which marker was clicked, and the ray (origin, direction)
            in the frame of viser's world.
    """

    def __init__(self, scene: viser.SceneApi, robot: str, on_cluster: OnCluster) -> None:
        self._sensor = add_posed(scene, f"{robot}/scan")
        self._raw = Cloud(scene, f"{robot}/scan/raw", 0.02)
        self._filtered = Cloud(scene, f"{robot}/scan/filtered", 0.03)
        self._clusters = Cloud(scene, f"{robot}/scan/clusters", 0.045)
        self._fits = Batch(scene, f"{robot}/scan/fits", meshes.cylinder(), opacity=0.4, side="double")
        self._markers = Batch(scene, f"{robot}/scan/markers", meshes.cylinder(), opacity=0.14)
        self._axes: tuple[Float, Float, Float] = (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        self._labels = Labels(scene, "/world/labels")
        self._companions = Companions()
        self._numbers: NDArray[np.int64] = np.zeros(0, dtype=np.int64)

        for batch in (self._markers, self._fits):
            _report(batch, self._markers, on_cluster)

    def show(self, frame: Frame, view: View) -> None:
        """Show a new scan."""
        centroid = frame.clusters.centroid[:, :2] + frame.sensor_offset[:2]
        self._numbers = self._companions.follow(frame.estimate.T_map_base.apply(centroid))
        self._sensor.position = frame.sensor_offset
        self._show_fits(frame)
        self._show_markers(frame)
        self.repaint(frame, view)

    def repaint(self, frame: Frame, view: View) -> None:
        """Show the same scan after a choice of colours, labels or layers."""
        for cloud, layer in ((self._raw, "raw"), (self._filtered, "filtered"), (self._clusters, "clusters")):
            if cloud.visible != view.layers[layer]:
                cloud.visible = view.layers[layer]
        self._fits.wanted = view.layers["fits"]
        self._markers.wanted = view.layers["clusters"]
        self._raw.show(frame.raw, self._ramp_or(frame.raw, view, colours.RAW))
        self._filtered.show(frame.filtered, self._ramp_or(frame.filtered, view, colours.FILTERED))
        member = frame.labels >= 0
        self._clusters.show(
            frame.filtered[member], cluster_colours(frame, self._numbers, view.colour_by)[member]
        )
        shown = cluster_labels(frame, self._numbers, view.label_by) if view.layers["labels"] else []
        self._labels.show(shown)

    def meant(self, instance: int | None, origin: Float, direction: Float) -> int | None:
        """The cluster of the newest scan that a click was meant for.

        Args:
            instance: Number of the marker that was hit, in the scan that the browser showed.
            origin, direction: Of the click's ray in the frame of the map, shape (3,) each.
        """
        return meant(origin, direction, *self._axes, instance)

    @property
    def texts(self) -> list[str]:
        """The labels that are to be read now."""
        return self._labels.texts

    @staticmethod
    def _ramp_or(points: NDArray[np.float32], view: View, plain: colours.Rgb) -> Colours | colours.Rgb:
        if view.colour_by == "height":
            return colours.ramp(points[:, 2], HEIGHT_LOW, HEIGHT_HIGH)
        return plain

    def _show_fits(self, frame: Frame) -> None:
        rows = frame.detections.cluster
        rows = rows[np.isfinite(frame.clusters.radius[rows])]
        clusters = frame.clusters
        height = shown_height(clusters.extent[rows, 2])
        foot = clusters.centroid[rows, 2] - 0.5 * height
        radius = clusters.radius[rows]
        self._fits.show(
            np.column_stack([clusters.centre[rows], foot]),
            np.column_stack([radius, radius, height]),
            colours.by_verdict(clusters.verdict[rows]),
        )

    def _show_markers(self, frame: Frame) -> None:
        """A cylinder about each cluster, because point clouds take no clicks; a post in the middle of a wide
        one, which must not cover what stands beside it."""
        c = frame.clusters
        height = shown_height(c.extent[:, 2]) + 0.06
        # fmax: a ready stem has no extent, and a cluster may have no circle.
        width = np.fmax(0.5 * np.hypot(c.extent[:, 0], c.extent[:, 1]), c.radius)
        radius = np.minimum(np.fmax(width, 0.06), WIDEST_MARKER) + 0.03
        foot = np.column_stack([c.centroid[:, :2], c.centroid[:, 2] - 0.5 * height])
        self._markers.show(foot, np.column_stack([radius, radius, height]), colours.by_verdict(c.verdict))
        low = foot + frame.sensor_offset + np.array([0.0, 0.0, frame.base_z])
        low[:, :2] = frame.estimate.T_map_base.apply(low[:, :2])
        self._axes = (low, low + np.column_stack([np.zeros((len(height), 2)), height]), radius)


def _report(batch: Batch, markers: Batch, on_cluster: OnCluster) -> None:
    @batch.node.on_click
    async def _(event: viser.SceneNodePointerEvent[Any]) -> None:
        # Circles are fewer than clusters: which one was hit is told by the ray alone.
        instance = event.instance_index if batch is markers else None
        on_cluster(instance, event.ray_origin, event.ray_direction)


def cluster_colours(frame: Frame, numbers: NDArray[np.int64], colour_by: str) -> Colours:
    """Colours of the filtered points by what people chose, shape (M, 3).

    Args:
        frame: The scan's results.
        numbers: What each cluster is known by from scan to scan, shape (K,).
        colour_by: One of view.COLOUR_BY.
    """
    clusters = frame.clusters
    if colour_by == "height":
        return colours.ramp(frame.filtered[:, 2], HEIGHT_LOW, HEIGHT_HIGH)
    if colour_by == "cluster":
        table = colours.by_category(numbers)
    elif colour_by == "eccentricity":  # 1 is round, 100 a line
        table = colours.ramp(np.log10(np.fmax(clusters.eccentricity, 1.0)), 0.0, 2.0)
    elif colour_by == "stage":
        table = np.tile(np.array([colours.CLUSTERED], dtype=np.uint8), (len(clusters.size), 1))
        table[frame.detections.cluster] = colours.TREE
    else:
        table = colours.by_verdict(clusters.verdict)
    return colours.of_points(table, frame.labels, colours.FILTERED)
