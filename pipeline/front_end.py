"""From a scan to detections: sections 3.1 to 3.3 of the paper, which look at no other scan.

First what the scan shows, then what is made of it: the judging of clusters costs next to nothing beside the
finding of them, so that what was found can be kept and judged again (see `pipeline.remapping`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.classification import depth_image, steepest_by_direction
from pipeline.config import Parameters
from pipeline.config.stages import Detection
from pipeline.detection.cluster_shape import describe_stems
from pipeline.detection.clustering import cluster
from pipeline.detection.external_stems import take_stems
from pipeline.detection.free_space import clear_range
from pipeline.detection.obstacles import find_clearance
from pipeline.detection.truncation import is_cut
from pipeline.detection.verdicts import detections, judge
from pipeline.geometry.poses import Float, Pose3
from pipeline.geometry.quantisation import GROUND, POINT, rounded
from pipeline.ground import scan_ground
from pipeline.ground.terrain import NO_GROUND, Terrain, height_above, heights_of_places, shows_ground
from pipeline.preprocessing import filters
from pipeline.preprocessing.acquisition import acquire, acquire_near, driven_with
from pipeline.stage_timer import Watch, no_watch
from pipeline.types.clearance import Clearance
from pipeline.types.records import Clusters, Detections, Float32, Int32, Sensor, Stems, Step, UInt16
from pipeline.update_schedule import is_fused, is_gathered


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """What is gathered of a scan.

    Attributes:
        points: Of the box, float32, shape (N, 3) [m]; height: above the ground, float32, shape (N,) [m];
            both, and the terrain, as fine as `pipeline.geometry.quantisation` tells.
        steepest: Tangent of the steepest elevation seen by direction (see `steepest_by_direction`).
        depth: How far away the nearest return lies by direction and elevation (see `depth_image`).
        terrain: The ground under it, as `Terrain.height`.
    """

    points: Float32
    height: Float32
    steepest: Float
    depth: UInt16
    terrain: Float


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What one scan shows before any of it is judged; see Frame for what is not named here.

    Attributes:
        clusters: Without verdicts.
        heights: Mean height of each cluster above the ground, shape (K,) [m]; None without ground.
        free: How far the view is free by direction (see visibility).
        overview: Of a scan that is gathered (see turns), where there is a ground, else None.
        terrain: Of a scan whose ground goes into the height map, likewise.
        clearance: Of the way that the robot drives; None where nobody looks for obstacles.
    """

    raw: Float32
    filtered: Float32
    labels: Int32
    clusters: Clusters
    heights: Float | None
    free: Float
    sensor_offset: Float
    overview: Overview | None
    terrain: Terrain | None
    warnings: tuple[str, ...]
    counts: dict[str, int]
    clearance: Clearance | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What one scan shows, before it is known where it was taken.

    Attributes:
        looked: What it was made of.
        clusters: With their verdicts.
        detections: Those that are trees.
        heights: Mean height above the ground of what each detection is of, shape (D,) [m]; None where the
            scan shows no ground.
    """

    looked: Looked
    clusters: Clusters
    detections: Detections
    heights: Float | None


def perceive(
    step: Step, sensor: Sensor, T_base_lidar: Pose3, parameters: Parameters, watch: Watch = no_watch
) -> Seen:
    """What a scan shows.

    Args:
        step: Points of a LiDAR, or stems that another program found.
        sensor: The LiDAR; T_base_lidar: where it stands on the robot.
        parameters: Of all stages.
        watch: Is entered around each stage with its name.
    """
    return decide(look(step, sensor, T_base_lidar, parameters, watch), parameters.detection, watch)


def look(
    step: Step, sensor: Sensor, T_base_lidar: Pose3, parameters: Parameters, watch: Watch = no_watch
) -> Looked:
    """The clusters of a scan, and what is gathered of it; see `perceive`."""
    if step.scan.stems is not None:
        return _at_stems(step, step.scan.stems, T_base_lidar, parameters, watch)
    return _at_points(step, sensor, T_base_lidar, parameters, watch)


def decide(looked: Looked, parameters: Detection, watch: Watch = no_watch) -> Seen:
    """What the clusters of a scan are."""
    with watch("detection"):
        judged = judge(looked.clusters, parameters)
        found = detections(judged, looked.sensor_offset, parameters)
        heights = None if looked.heights is None else looked.heights[found.cluster]
    return Seen(looked, judged, found, heights)


def _at_points(step: Step, sensor: Sensor, T_base_lidar: Pose3, p: Parameters, watch: Watch) -> Looked:
    with watch("acquisition"):
        raw, sensor_offset = acquire(step, T_base_lidar, p.acquisition)

    with watch("pass-through"):
        boxed = filters.pass_through(raw, p.filters)

    with watch("ground"):
        terrain = None if p.ground.method == "none" else scan_ground.find_terrain(raw, p.ground)
        height = height_above(boxed, terrain) if terrain else None
        band = boxed if height is None else scan_ground.in_band(boxed, height, p.ground)

    with watch("voxel grid"):
        filtered = filters.voxel_grid(band, p.filters)

    with watch("clustering"):
        labels = cluster(filtered, sensor, p.clustering)

    with watch("shape"):
        labels, described = describe_stems(filtered, labels, sensor, p.shape)
        cut = is_cut(filtered, labels, raw, sensor, p.filters, p.acquisition)
        described = replace(described, cut=cut)

    with watch("free view"):
        free = clear_range(raw, filtered, sensor_offset)

    grounded = terrain is not None and shows_ground(terrain)
    with watch("obstacles"):
        near = acquire_near(step, T_base_lidar, p.acquisition)
        twist = driven_with(step, p.acquisition)
        seen = terrain if grounded else None
        clearance = find_clearance(raw, near, seen, sensor_offset, twist, p.obstacles)

    return Looked(
        raw=raw,
        filtered=filtered,
        labels=labels.label,
        clusters=described,
        heights=heights_of_places(described.centroid, terrain.height)
        if terrain is not None and grounded
        else None,
        free=free,
        sensor_offset=sensor_offset,
        overview=_overview(raw, boxed, height, terrain, sensor_offset, sensor)
        if p.classification.method == "columns" and is_gathered(step.index, p.classification.every)
        else None,
        terrain=replace(terrain, height=rounded(terrain.height, GROUND))
        if terrain is not None and is_fused(step.index, p.classification.every)
        else None,
        warnings=(NO_GROUND,) if terrain is not None and len(raw) and not grounded else (),
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


def _overview(
    raw: Float32,
    boxed: Float32,
    height: Float32 | None,
    terrain: Terrain | None,
    sensor_offset: Float,
    sensor: Sensor,
) -> Overview | None:
    if height is None or terrain is None:
        return None
    steepest = steepest_by_direction(raw, sensor_offset, sensor.rings > 0)
    return Overview(
        rounded(boxed, POINT),
        rounded(height, POINT),
        steepest,
        depth_image(raw),
        rounded(terrain.height, GROUND),
    )


def _returns(step: Step, raw: Float32) -> dict[str, int]:
    """What became of the returns before the first filter."""
    returns = len(step.scan.points)
    return {
        "returns": returns,
        "without a value": step.scan.dropped,
        "out of range": returns - len(raw),
    }


def _at_stems(step: Step, stems: Stems, T_base_lidar: Pose3, p: Parameters, watch: Watch) -> Looked:
    with watch("acquisition"):
        places, sensor_offset, clusters = take_stems(step, stems, T_base_lidar, p.acquisition)

    with watch("free view"):
        free = clear_range(places, places, sensor_offset)

    return Looked(
        raw=places,
        filtered=places,
        labels=np.arange(len(places), dtype=np.int32),
        clusters=clusters,
        heights=None,
        free=free,
        sensor_offset=sensor_offset,
        overview=None,
        terrain=None,
        warnings=(),
        counts={**_returns(step, places), "clustered": len(places)},
    )
