"""Front end: from one scan to detections (sections 3.1 to 3.3 of the paper). It uses no other scan.

`segment` does the expensive part: filters, ground, clusters. `detect` gives each cluster its verdict, which
costs next to nothing. The two are apart so that a cached segmentation can be used again with other verdict
rules (see `pipeline.remapping`). Stems that another program detected (external stems) become clusters without
segmentation; the following stages are the same for them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pipeline.classification import view_by_direction
from pipeline.config import Parameters
from pipeline.config.stages import Acquisition, Detection, Ground
from pipeline.detection.cluster_shape import describe_stems, no_lift
from pipeline.detection.clustering import cluster
from pipeline.detection.free_space import clear_range, seen_range
from pipeline.detection.obstacles import find_clearance
from pipeline.detection.truncation import is_truncated
from pipeline.detection.verdicts import classify_clusters, detections
from pipeline.geometry.columns import GROUND, POINT, rounded
from pipeline.geometry.poses import Float, Pose3
from pipeline.ground import scan_ground
from pipeline.ground.scan_ground import NO_GROUND, Terrain, height_above, heights_of_places, shows_ground
from pipeline.preprocessing import acquire, acquire_near, base_velocity, pass_through, voxel_grid
from pipeline.types.records import (
    Clearance,
    Clusters,
    Detections,
    Float32,
    Int32,
    Sensor,
    Stems,
    Step,
    UInt16,
    Verdict,
)

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Function of the name of a stage that returns the context in which the stage runs."""


def no_timer(_stage: str) -> AbstractContextManager[None]:
    """Return a context that measures nothing, for any name of a stage: the default for callers that need no
    times."""
    return nullcontext()


@dataclass(frozen=True, slots=True, eq=False)
class ColumnInput:
    """What the voxel columns integrate of one scan (see `pipeline.classification`).

    Attributes:
        points: Points of the box in the level sensor frame, float32, shape (N, 3) [m].
        height: Their heights above the ground, float32, shape (N,) [m].
        steepest: Tangent of the steepest elevation seen by direction (see `view_by_direction`).
        depth: Range of the nearest return by direction and elevation (see `view_by_direction`).
        terrain: Ground height below the scan, as `Terrain.height`.

    Points, heights and terrain are rounded to the steps of `pipeline.geometry.columns`.
    """

    points: Float32
    height: Float32
    steepest: Float
    depth: UInt16
    terrain: Float


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedScan:
    """One scan after filtering, ground segmentation and clustering. `Frame` describes the other attributes.

    Attributes:
        clusters: Clusters without verdicts.
        heights: Mean height of each cluster above the ground, shape (K,) [m]; None if no ground is in view.
        free: Free range by direction (see `pipeline.detection.free_space.clear_range`).
        seen: Range up to which stems are in view, by direction (see
            `pipeline.detection.free_space.seen_range`).
        column_input: Input of the voxel columns; None for scans that do not update them or do not show the
            ground.
        terrain: Ground that updates the terrain map; None likewise.
        clearance: Free space in the path of the robot; None if obstacle detection is off.
    """

    raw: Float32
    filtered: Float32
    labels: Int32
    clusters: Clusters
    heights: Float | None
    free: Float
    seen: Float
    sensor_offset: Float
    column_input: ColumnInput | None
    terrain: Terrain | None
    warnings: tuple[str, ...]
    counts: dict[str, int]
    clearance: Clearance | None = None

    @property
    def view(self) -> Float:
        """`free` and `seen`, shape (2, BINS) [m]."""
        return np.stack([self.free, self.seen])


class DetectionResult(NamedTuple):
    """Verdicts of one scan.

    Attributes:
        clusters: All clusters with their verdicts.
        detections: The clusters that are trees.
        heights: Mean height above the ground of each detection, shape (D,) [m]; None without ground.
    """

    clusters: Clusters
    detections: Detections
    heights: Float | None


def segment(
    step: Step, sensor: Sensor, T_base_lidar: Pose3, parameters: Parameters, timer: StageTimer = no_timer
) -> SegmentedScan:
    """Return a scan filtered and segmented into ground and clusters. It may have no points. Without ground in
    view, and always for detected stems, heights are None; a warning is added only if the ground was searched
    for, i.e. for points within range and a `ground.method` other than "none". The step is unchanged.

    Its counts are "returns", "without a value", "out of range", "out of the box", "ground or too high",
    "averaged in voxels", "clustered" and "noise"; of detected stems, the first three and "clustered".

    Args:
        step: The scan: points of a LiDAR, or stems that another program has detected, each of which becomes a
            cluster of one point if it is within the range limits.
        sensor: The LiDAR.
        T_base_lidar: Pose of the LiDAR on the robot.
        parameters: Parameters of all stages.
        timer: Called with the name of each stage; its context encloses the stage.

    Raises:
        ValueError: The cloud is too wide for the clustering engine "grid", see `dbscan_grid`.
    """
    if step.scan.stems is not None:
        return _segment_stems(step, step.scan.stems, T_base_lidar, parameters, timer)
    return _segment_points(step, sensor, T_base_lidar, parameters, timer)


def detect(scan: SegmentedScan, parameters: Detection, timer: StageTimer = no_timer) -> DetectionResult:
    """Return the verdicts on the clusters of a scan, and the clusters that are trees as detections. The scan
    is unchanged.

    Args:
        scan: The segmented scan.
        parameters: Rules of the verdicts and sigmas of the detections.
        timer: Called with the name of the stage, "detection"; its context encloses the stage.
    """
    with timer("detection"):
        clusters = classify_clusters(scan.clusters, parameters)
        found = detections(clusters, scan.sensor_offset, parameters)
        heights = None if scan.heights is None else scan.heights[found.cluster]
    return DetectionResult(clusters, found, heights)


def _segment_points(
    step: Step, sensor: Sensor, T_base_lidar: Pose3, p: Parameters, timer: StageTimer
) -> SegmentedScan:
    """Return the segmented scan of a LiDAR; arguments and errors as in `segment`.

    `column_input` is None unless the parameter `classification.method` is "columns" and the scan is due after
    `classification.interval`; `terrain` is None unless the scan updates the terrain map, which is due midway
    between, so that no scan has both costs. Both are None for a scan that does not show the ground, whose
    heights are a guess.
    """
    interval = p.classification.interval
    with timer("acquisition"):
        raw, sensor_offset = acquire(step, T_base_lidar, p.acquisition)

    with timer("pass-through"):
        boxed = pass_through(raw, p.filters)

    with timer("ground"):
        terrain = None if p.ground.method == "none" else scan_ground.find_terrain(raw, p.ground)
        height = height_above(boxed, terrain) if terrain else None
        band = boxed if height is None else scan_ground.in_band(boxed, height, p.ground)

    with timer("voxel grid"):
        filtered = voxel_grid(band, p.filters)

    with timer("clustering"):
        labels = cluster(filtered, sensor, p.clustering)

    with timer("shape"):
        # A leaning axis is compared between views at one height; without ground, at that of the points.
        seen = terrain if terrain is not None and shows_ground(terrain) else None
        lift_of = no_lift if seen is None else partial(_lift, seen, p.tracking.breast_height)
        radius_bounds = (p.detection.radius_min, p.detection.radius_max)
        labels, described = describe_stems(filtered, labels, sensor, p.shape, radius_bounds, lift_of)
        cut = is_truncated(filtered, labels, raw, sensor, p.filters, p.acquisition)
        described = replace(described, cut=cut)

    with timer("free view"):
        free = clear_range(raw, filtered, sensor_offset)
        in_view = _seen_range(boxed, height, seen, sensor_offset, p.ground, free)

    with timer("obstacles"):
        near = acquire_near(step, T_base_lidar, p.acquisition)
        twist = base_velocity(step, p.acquisition)
        clearance = find_clearance(raw, near, seen, sensor_offset, twist, p.obstacles)

    return SegmentedScan(
        raw=raw,
        filtered=filtered,
        labels=labels.label,
        clusters=described,
        heights=None if seen is None else heights_of_places(described.centroid, seen.height),
        free=free,
        seen=in_view,
        sensor_offset=sensor_offset,
        column_input=_column_input(raw, boxed, height, seen, sensor_offset, sensor)
        if p.classification.method == "columns" and step.is_due(interval)
        else None,
        terrain=replace(seen, height=rounded(seen.height, GROUND))
        if seen is not None and step.is_due(interval, interval / 2.0)
        else None,
        warnings=(NO_GROUND,) if terrain is not None and len(raw) and seen is None else (),
        counts={
            **_returns(step, raw),
            "out of the box": len(raw) - len(boxed),
            "ground or too high": len(boxed) - len(band),
            "averaged in voxels": len(band) - len(filtered),
            "clustered": int(np.count_nonzero(labels.label >= 0)),
            "noise": int(np.count_nonzero(labels.label < 0)),
        },
        clearance=clearance,
    )


def _lift(terrain: Terrain, height: float, centroid: Float) -> Float:
    """Return how far the height above the ground `height` [m] is above each centroid, shape (K,) [m];
    `centroid` are the centroids of clusters, level sensor frame, shape (K, 3) [m]."""
    return height - heights_of_places(centroid, terrain.height)


def _seen_range(
    boxed: Float32,
    height: Float32 | None,
    terrain: Terrain | None,
    sensor_offset: Float,
    parameters: Ground,
    free: Float,
) -> Float:
    """Return the `seen_range` of the points in the box with their heights. Without a ground model, no band
    limits it: it ends at the farthest points. It is `free` if no ground is in view."""
    if height is not None and terrain is None:
        return free
    if height is None or terrain is None:
        everything = np.zeros(len(boxed), np.float32)
        return seen_range(boxed, everything, sensor_offset, 0.0, (-math.inf, math.inf), free)
    sensor_height = -scan_ground.ground_at(terrain.height, 0.0, 0.0)
    band = (parameters.height_min, parameters.height_max)
    return seen_range(boxed, height, sensor_offset, sensor_height, band, free)


def _column_input(
    raw: Float32,
    boxed: Float32,
    height: Float32 | None,
    terrain: Terrain | None,
    sensor_offset: Float,
    sensor: Sensor,
) -> ColumnInput | None:
    """Return the input of the voxel columns, see ColumnInput; None without heights or terrain.

    Args:
        raw: All points in the level sensor frame, float32, shape (N, 3) [m].
        boxed: Points in the box, float32, shape (M, 3) [m].
        height: Their heights above the ground, float32, shape (M,) [m], or None.
        terrain: Ground of the scan, or None.
        sensor_offset: Position of the sensor in the base frame, shape (3,) [m].
        sensor: The LiDAR.
    """
    if height is None or terrain is None:
        return None
    steepest, depth = view_by_direction(raw, sensor_offset, sensor.rings > 0)
    return ColumnInput(
        rounded(boxed, POINT),
        rounded(height, POINT),
        steepest,
        depth,
        rounded(terrain.height, GROUND),
    )


def _returns(step: Step, raw: Float32) -> dict[str, int]:
    """Return the numbers of returns by name: "returns", all with a value; "without a value"; and "out of
    range", those outside of the range limits, which are missing in `raw`."""
    returns = len(step.scan.points)
    return {
        "returns": returns,
        "without a value": step.scan.dropped,
        "out of range": returns - len(raw),
    }


def _segment_stems(
    step: Step, stems: Stems, T_base_lidar: Pose3, p: Parameters, timer: StageTimer
) -> SegmentedScan:
    """Return the segmented scan of stems that another program detected: each stem within the range limits is
    a cluster of one point, without ground, column input and clearance. `timer` as in `segment`."""
    with timer("acquisition"):
        places, sensor_offset, clusters = external_clusters(step, stems, T_base_lidar, p.acquisition)

    with timer("free view"):
        free = clear_range(places, places, sensor_offset)

    return SegmentedScan(
        raw=places,
        filtered=places,
        labels=np.arange(len(places), dtype=np.int32),
        clusters=clusters,
        heights=None,
        free=free,
        seen=free,
        sensor_offset=sensor_offset,
        column_input=None,
        terrain=None,
        warnings=(),
        counts={**_returns(step, places), "clustered": len(places)},
    )


#: Standard deviation of an external DBH [m]: DBH of the same trees differ by a median of 4.9 cm between
#: frames of the Oxford Evo data (1.5 km of forest).
DBH_SIGMA = 0.05
#: Minimum number of stem axes from which the tilt of the robot is estimated.
AXES_TO_LEVEL = 5


def external_clusters(
    step: Step, stems: Stems, T_base_lidar: Pose3, parameters: Acquisition
) -> tuple[Float32, Float, Clusters]:
    """Return the stems of a scan in the level sensor frame, each as a cluster of one point with the verdict
    TREE.

    The positions are rotated by the tilt of the step or, if it is unknown, by the median of the stem axes,
    which are vertical on average (`_levelling`). Without levelling, pitch of the robot would displace stems
    far below the sensor. Stems outside of the range limits (inclusive) or with NaN in their position are left
    out.

    Args:
        step: Step whose scan points are the stem positions in the sensor frame.
        stems: Axes and diameters, one row per point.
        T_base_lidar: Pose of the sensor on the robot.
        parameters: Range limits and levelling.

    Returns:
        Positions, float32, shape (N, 3) [m]; position of the sensor in the level base frame, shape (3,) [m];
        and the clusters: centre and radius (NaN for an unknown DBH) are those of the stem, covariance and arc
        are 0, `hidden` and `cut` are False, other unknown values are NaN.
    """
    R_level_base = _levelling(step, stems, T_base_lidar, parameters)
    place = step.scan.points.astype(np.float64)
    reach = np.linalg.norm(place, axis=1)
    taken = (reach >= parameters.range_min) & (reach <= parameters.range_max)
    place = place[taken] @ (R_level_base @ T_base_lidar.R).T
    return place.astype(np.float32), R_level_base @ T_base_lidar.t, _clusters(place, stems.dbh[taken])


def _levelling(step: Step, stems: Stems, T_base_lidar: Pose3, parameters: Acquisition) -> Float:
    """Return R_level_base, shape (3, 3), the rotation without yaw that levels the base frame: by the tilt of
    the step, else by the median axis of the stems. It is the identity if levelling is "none" or fewer than
    AXES_TO_LEVEL stems have an axis."""
    if parameters.level == "none":
        return np.eye(3)
    if step.tilt_known:
        return Pose3.from_euler(np.zeros(3), step.roll, step.pitch, 0.0).R
    axis = stems.axis[np.isfinite(stems.axis).all(axis=1)]
    if len(axis) < AXES_TO_LEVEL:
        return np.eye(3)
    up = T_base_lidar.R @ np.median(axis, axis=0)
    # The third row of Ry(pitch) Rx(roll) is the vertical in the base frame.
    roll = float(np.arctan2(up[1], up[2]))
    pitch = float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
    return Pose3.from_euler(np.zeros(3), roll, pitch, 0.0).R


def _clusters(place: Float, dbh: Float) -> Clusters:
    """Return clusters of one point each with the verdict TREE: the centre is the position, the radius half of
    the DBH with the sigma DBH_SIGMA / 2, the horizontal extent the DBH, covariance and arc 0, `hidden` and
    `cut` False, and what is unknown NaN.

    Args:
        place: Positions, level sensor frame, shape (N, 3) [m].
        dbh: Diameters, shape (N,) [m]; NaN if unknown.
    """
    n = len(place)
    unknown = np.full(n, np.nan)
    radius = 0.5 * dbh
    return Clusters(
        size=np.ones(n, np.int64),
        centroid=place,
        eccentricity=unknown,
        centre=place[:, :2].copy(),
        covariance=np.zeros((n, 2, 2)),
        radius=radius,
        radius_sigma=np.where(np.isfinite(radius), 0.5 * DBH_SIGMA, np.nan),
        radial_std=unknown,
        arc=np.zeros(n),
        extent=np.stack([dbh, dbh, unknown], axis=1),
        hidden=np.zeros(n, np.bool_),
        cut=np.zeros(n, np.bool_),
        verdict=np.full(n, Verdict.TREE, np.int32),
    )
