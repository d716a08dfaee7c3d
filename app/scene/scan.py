"""The current scan in the scene: points by stage, voxels, fitted circles, labels, clicks on clusters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from app.common.height_range import height_range
from app.scene import colours, nodes
from app.scene.colours import Colours, ViewSettings
from app.scene.nodes import MOST_LABELS, OWN_TREE, Batch, CloudNode, Float, Label, LabelNodes, Place, short
from app.scene.robot import ROBOT
from pipeline.types.records import Frame, Verdict

Vector = tuple[float, float, float]
OnCluster = Callable[[int | None, Vector, Vector], None]

SCAN = f"{ROBOT}/scan"
FILTERED_SIZE, CLUSTER_SIZE = 0.03, 0.045  # diameter of a point of a scan [m]
# Without a drive: diameters of a point [m], and points across the map.
POINT_SIZES, POINTS_ACROSS = (0.02, 0.1), 700.0
WIDEST_MARKER = 0.6  # [m], the radius of a thick trunk


class ScanNodes:
    """Nodes of the current scan.

    Args:
        scene: Scene of viser to which the nodes are added.
        on_cluster: Called in the thread of viser with the number of the clicked marker and the ray (origin,
            direction) in the world frame of viser.
    """

    def __init__(self, scene: viser.SceneApi, on_cluster: OnCluster) -> None:
        self._raw = CloudNode(scene, f"{SCAN}/raw", 0.02)
        self._filtered = CloudNode(scene, f"{SCAN}/filtered", FILTERED_SIZE)
        self._clusters = CloudNode(scene, f"{SCAN}/clusters", CLUSTER_SIZE)
        self._fits = Batch(scene, f"{SCAN}/fits", nodes.cylinder(), opacity=0.4, side="double")
        self._markers = Batch(scene, f"{SCAN}/markers", nodes.cylinder(), opacity=0.14)
        self._axes: tuple[Float, Float, Float] = (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        self._labels = LabelNodes(scene, "/world/labels")
        self._cluster_numbers = ClusterNumbers()

        for batch in (self._markers, self._fits):
            _report(batch, self._markers, on_cluster)

    def show(
        self,
        frame: Frame,
        view: ViewSettings,
        labelled: Sequence[Place],
        reflectance: NDArray[np.uint8] | None = None,
    ) -> None:
        """Show a scan. Without a drive, points of clusters are not shown as filtered points, and clusters
        have neither labels nor fitted circles.

        Args:
            frame: Results of the scan.
            view: Visible layers, colours and labels.
            labelled: Positions of the labels of trees, see `cluster_labels`.
            reflectance: Of the raw points, uint8, shape (N,); None if unknown.
        """
        layers = view.layers
        centroid = frame.clusters.centroid[:, :2] + frame.sensor_offset[:2]
        numbers = self._cluster_numbers.follow(frame.estimate.T_map_base.apply(centroid))
        raw, filtered = nodes.scan_in_map(frame, frame.raw), nodes.scan_in_map(frame, frame.filtered)
        size = None if frame.of_drive else point_size(frame)
        # The points of the trees without a drive are those of the clusters, and are not drawn twice.
        rest = slice(None) if frame.of_drive else frame.labels < 0
        of_raw: Colours | colours.Rgb = colours.RAW
        of_filtered: Colours | colours.Rgb = colours.FILTERED
        of_clusters = cluster_colours(frame, numbers, view.colour_by)
        if view.colour_by == "height":
            of_raw, of_filtered = colours.ramp(frame.raw[:, 2], *height_range(frame)), of_clusters[rest]
        elif view.colour_by == "intensity" and reflectance is not None:
            of_raw = colours.ramp(np.arange(256.0), 0.0, 255.0)[reflectance]
        self._raw.show(layers["raw"], raw, of_raw)
        self._filtered.show(
            layers["filtered"],
            filtered[rest],
            of_filtered,
            point_size=size or FILTERED_SIZE,
        )
        member = frame.labels >= 0
        self._clusters.show(
            layers["clusters"],
            filtered[member],
            of_clusters[member],
            point_size=size or CLUSTER_SIZE,
        )
        self._show_fits(frame, layers["fits"])
        self._show_markers(frame, layers["clusters"])
        named = layers["labels"] and frame.of_drive  # the trees have labels; others are too many
        self._labels.show(cluster_labels(frame, numbers, view.label_by, labelled) if named else [])

    def meant(self, instance: int | None, origin: Float, direction: Float) -> int | None:
        """Return the row of the cluster of the newest scan that a click hit; None if there is none, see
        `meant`.

        Args:
            instance: Number of the hit marker in the scan that the browser showed; None if unknown.
            origin, direction: Origin [m] and direction of the ray of the click in the frame of the map, shape
                (3,) each.
        """
        return meant(origin, direction, *self._axes, instance)

    def _show_fits(self, frame: Frame, on: bool) -> None:
        """Show a cylinder for each detected stem with a fitted circle; none without a drive, where circles
        are those of its trees."""
        rows = frame.detections.cluster if frame.of_drive else np.zeros(0, np.int64)
        rows = rows[np.isfinite(frame.clusters.radius[rows])]
        clusters = frame.clusters
        height, foot = shown_height(clusters.extent[rows, 2]), bases(frame)[rows]
        radius = clusters.radius[rows]
        self._fits.show(
            on,
            nodes.scan_in_map(frame, np.column_stack([clusters.centre[rows], foot])),
            np.column_stack([radius, radius, height]),
            colours.by_verdict(clusters.verdict[rows]),
        )

    def _show_markers(self, frame: Frame, on: bool) -> None:
        """Show a cylinder around each cluster that receives clicks, because point clouds do not.

        Its radius is limited, so that a wide cluster does not cover its neighbours. A candidate of a whole
        cloud without a circle has a cylinder of size 0.
        """
        c = frame.clusters
        height = shown_height(c.extent[:, 2]) + 0.06
        # fmax: an external stem has no extent, and a cluster may have no circle.
        width = np.fmax(0.5 * np.hypot(c.extent[:, 0], c.extent[:, 1]), c.radius)
        radius = np.minimum(np.fmax(width, 0.06), WIDEST_MARKER) + 0.03
        foot = np.column_stack([c.centroid[:, :2], bases(frame) - 0.03])
        low = nodes.scan_in_map(frame, foot).astype(np.float64)
        size = np.column_stack([radius, radius, height])
        if not frame.of_drive:  # candidates without a circle are many
            size[np.isnan(c.radius)] = 0.0
        self._markers.show(on, low, size, colours.by_verdict(c.verdict))
        self._axes = (low, low + np.column_stack([np.zeros((len(height), 2)), height]), radius)


def _report(batch: Batch, markers: Batch, on_cluster: OnCluster) -> None:
    """Let clicks on the copies of a batch call `on_cluster`.

    Args:
        batch: Batch whose clicks are reported.
        markers: Batch whose copies are the clusters in order; only for this batch the number of the copy is
            passed to `on_cluster`.
        on_cluster: Called in the thread of viser, see `ScanNodes`.
    """

    @batch.node.on_click
    async def _(event: viser.SceneNodePointerEvent[Any]) -> None:
        # There are fewer circles than clusters, so their number is not that of a cluster; the ray decides.
        instance = event.instance_index if batch is markers else None
        on_cluster(instance, event.ray_origin, event.ray_direction)


def point_size(frame: Frame) -> float:
    """Return the diameter of the points without a drive [m]; it grows with the width of the plot within
    POINT_SIZES."""
    return float(np.clip(extent(frame) / POINTS_ACROSS, *POINT_SIZES))


def extent(frame: Frame) -> float:
    """Return the longer side of the bounding box of the filtered points in x and y [m]; 0 if there are no
    points."""
    return float(np.ptp(frame.filtered[:, :2], axis=0).max()) if len(frame.filtered) else 0.0


def cluster_colours(frame: Frame, numbers: NDArray[np.int64], colour_by: str) -> Colours:
    """Return the colours of the filtered points, uint8, shape (M, 3).

    By "height", each point is coloured by its height. Otherwise it has the colour of its cluster, or FILTERED
    without a cluster: by its number ("cluster"), the logarithm of its eccentricity, clipped to 1 to 100, with
    NaN as 1 ("eccentricity"), whether it is a detection ("stage"), CLUSTERED ("intensity", which raw points
    show), or else its verdict.

    Args:
        frame: Results of the scan.
        numbers: Persistent number of each cluster, shape (K,).
        colour_by: One of colours.COLOUR_BY.
    """
    clusters = frame.clusters
    if colour_by == "height":
        return colours.ramp(frame.filtered[:, 2], *height_range(frame))
    if colour_by == "cluster":
        table = colours.by_category(numbers)
    elif colour_by == "eccentricity":  # 1 is round, 100 a line
        table = colours.ramp(np.log10(np.fmax(clusters.eccentricity, 1.0)), 0.0, 2.0)
    elif colour_by in ("stage", "intensity"):
        table = np.tile(np.array([colours.CLUSTERED], dtype=np.uint8), (len(clusters.size), 1))
        if colour_by == "stage":
            table[frame.detections.cluster] = colours.TREE
    else:
        table = colours.by_verdict(clusters.verdict)
    return colours.of_points(table, frame.labels, colours.FILTERED)


def bases(frame: Frame) -> Float:
    """Return the height of the lower end of the cylinder of each cluster in the level frame of the sensor,
    shape (K,) [m]: its lowest point; without points, and in a whole cloud, whose candidates are stems with
    crowns, half the height below the centroid."""
    clusters = frame.clusters
    low = np.full(len(clusters.size), np.inf)
    if frame.of_drive:
        member = frame.labels >= 0
        np.minimum.at(low, frame.labels[member], frame.filtered[member, 2])
    middle = clusters.centroid[:, 2] - 0.5 * shown_height(clusters.extent[:, 2])
    return np.where(np.isfinite(low), low, middle)


STEM_HEIGHT = 2.0  # [m], drawn where no height was measured


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
    ends = bases(frame) + shown_height(clusters.extent[:, 2])
    tops = frame.base_z + frame.sensor_offset[2] + ends + 0.1
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
    return verdict if np.isnan(eccentricity) else f"e {short(eccentricity)}"


def shown_height(height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height with which clusters are rendered, shape (K,) [m]: the height, at least 0.2, and
    STEM_HEIGHT for NaN."""
    return np.where(np.isnan(height), STEM_HEIGHT, np.maximum(height, 0.2))


MOST_VOXELS = 20_000  # drawn; boxes are slower than points


class VoxelNode:
    """The occupied voxels of the voxel grid filter as boxes."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._boxes = Batch(scene, f"{SCAN}/voxels", nodes.box(), opacity=0.5)
        self.count = 0

    def show(self, on: bool, frame: Frame, size: float) -> None:
        """Show the voxels, in the level frame of the sensor, that contain filtered points. At most
        MOST_VOXELS are rendered. `count` becomes the number of all of them; 0 while nothing is shown.

        Args:
            on: Whether the layer is on; otherwise nothing is computed.
            frame: Results of the scan.
            size: Side of a voxel [m]; 0 shows none.
        """
        if not on or size <= 0.0:
            self.count = 0
            self._boxes.update(False)
            return
        low = size * np.unique(np.floor(np.asarray(frame.filtered, np.float64) / size), axis=0)
        self.count = len(low)
        drawn = low[:MOST_VOXELS]
        each = np.tile(np.array([colours.VOXELS], dtype=np.uint8), (len(drawn), 1))
        places, yaw = nodes.scan_in_map(frame, drawn), frame.estimate.T_map_base.yaw
        self._boxes.show(True, places, np.full((len(drawn), 3), size), each, yaw)


Int = NDArray[np.int64]


REACH = 0.5  # largest distance between the places of one cluster in consecutive scans [m]


class ClusterNumbers:
    """Gives clusters the numbers of the clusters at the same positions in the previous scan.

    Colours and labels follow these numbers, so that they do not flicker.
    """

    def __init__(self) -> None:
        self._places: Float = np.zeros((0, 2))
        self._numbers: Int = np.zeros(0, dtype=np.int64)
        self._next = 0

    def follow(self, places: Float) -> Int:
        """Return a number for each cluster at these positions: that of the cluster of the previous call with
        which it is paired, else the next unused one, from 0 on. Two clusters are a pair if each is the
        nearest one to the other, within REACH.

        Args:
            places: Positions of the clusters in the frame of the map, shape (K, 2) [m].

        Returns:
            Different numbers, int64, shape (K,).
        """
        numbers = np.full(len(places), -1, dtype=np.int64)
        before = nodes.nearest_within(self._places, places, REACH)
        after = nodes.nearest_within(places, self._places, REACH)
        mutual = np.flatnonzero(after >= 0)
        mutual = mutual[before[after[mutual]] == mutual]
        numbers[after[mutual]] = self._numbers[mutual]
        new = numbers < 0
        numbers[new] = self._next + np.arange(int(new.sum()))
        self._next += int(new.sum())
        self._places, self._numbers = np.array(places, dtype=np.float64), numbers
        return numbers


NEAR = 0.5  # [m]; a ray that misses a marker by more hit a marker of another scan


def meant(
    origin: Float, direction: Float, low: Float, high: Float, radius: Float, instance: int | None
) -> int | None:
    """Return the row of the upright cylinder that a ray hits; None if none is within NEAR of it, or without
    cylinders.

    While a run plays, the browser shows an older scan, in which the numbers belong to other clusters. If the
    ray passes the cylinder with the reported number by more than 5 cm, the cylinder nearest to the ray is
    returned.

    Args:
        origin, direction: Ray, shape (3,) each; the direction may have any length.
        low, high, radius: Base and top of each axis, shape (K, 3) [m], and radii, shape (K,) [m].
        instance: Number that the browser reports; None if unknown.
    """
    if not len(radius):
        return None
    gap = distances(origin, direction, low, high) - radius
    if instance is not None and 0 <= instance < len(radius) and gap[instance] <= 0.05:
        return instance
    best = int(np.argmin(gap))
    return best if gap[best] <= NEAR else None


def distances(origin: Float, direction: Float, low: Float, high: Float) -> Float:
    """Return the distances between a ray, which begins at `origin`, and vertical or inclined segments, shape
    (K,) [m].

    Args:
        origin, direction: Ray, shape (3,) each; the direction may have any length.
        low, high: Ends of the segments, shape (K, 3) [m].
    """
    d = direction / max(float(np.linalg.norm(direction)), 1e-12)
    axis, away = high - low, low - origin
    # Closest points of two lines: s along the segment within 0..1, t along the ray not behind its origin.
    aa, ad = np.einsum("ij,ij->i", axis, axis), axis @ d
    da, dd = np.einsum("ij,ij->i", axis, away), away @ d
    flat = np.maximum(aa - ad**2, 1e-12)
    s = np.clip((ad * dd - da) / flat, 0.0, 1.0)
    t = np.maximum(dd + s * ad, 0.0)
    s = np.clip((t * ad - da) / np.maximum(aa, 1e-12), 0.0, 1.0)
    nearest: Float = np.linalg.norm(away + s[:, None] * axis - t[:, None] * d, axis=1)
    return nearest
