"""From a scan to detections: sections 3.1 to 3.3 of the paper, which look at no other scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline import filters, ground
from pipeline.acquisition import acquire
from pipeline.clustering import cluster
from pipeline.detection import detections, judge
from pipeline.geometry import Float, Pose3
from pipeline.parameters import Parameters
from pipeline.records import Clusters, Detections, Float32, Int32, Sensor, Stems, Step
from pipeline.shape import describe
from pipeline.stems import take_stems
from pipeline.terrain import NO_GROUND, Terrain, height_above, heights_of_places, shows_ground
from pipeline.visibility import clear_range
from pipeline.watch import Watch, no_watch


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What one scan shows, before it is known where it was taken; see Frame.

    Attributes:
        free: How far the view is free by direction (see visibility).
        above: Points of the box, their heights above the ground, and the ground; None without a ground.
        heights: Mean height above the ground of what each detection is of, shape (D,) [m]; None where the
            scan shows no ground.
    """

    raw: Float32
    filtered: Float32
    labels: Int32
    clusters: Clusters
    detections: Detections
    free: Float
    sensor_offset: Float
    above: tuple[Float32, Float32, Terrain] | None
    heights: Float | None
    warnings: tuple[str, ...]
    counts: dict[str, int]


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
    if step.scan.stems is not None:
        return _of_stems(step, step.scan.stems, T_base_lidar, parameters, watch)
    return _of_points(step, sensor, T_base_lidar, parameters, watch)


def _of_points(step: Step, sensor: Sensor, T_base_lidar: Pose3, p: Parameters, watch: Watch) -> Seen:
    with watch("acquisition"):
        raw, sensor_offset = acquire(step, T_base_lidar, p.acquisition)

    with watch("pass-through"):
        boxed = filters.pass_through(raw, p.filters)

    with watch("ground"):
        terrain = None if p.ground.method == "none" else ground.find_terrain(raw, p.ground)
        height = height_above(boxed, terrain) if terrain else None
        band = boxed if height is None else ground.in_band(boxed, height, p.ground)

    with watch("voxel grid"):
        filtered = filters.voxel_grid(band, p.filters)

    with watch("clustering"):
        labels = cluster(filtered, sensor, p.clustering)

    with watch("shape"):
        described = describe(filtered, labels, sensor, p.shape)

    with watch("detection"):
        judged = judge(described, p.detection)
        found = detections(judged, sensor_offset, p.detection)
        free = clear_range(raw, filtered, sensor_offset)

    grounded = terrain is not None and shows_ground(terrain)
    return Seen(
        raw=raw,
        filtered=filtered,
        labels=labels.label,
        clusters=judged,
        detections=found,
        free=free,
        sensor_offset=sensor_offset,
        above=(boxed, height, terrain) if terrain and height is not None else None,
        heights=heights_of_places(judged.centroid[found.cluster], terrain.height)
        if terrain is not None and grounded
        else None,
        warnings=(NO_GROUND,) if terrain is not None and len(raw) and not grounded else (),
        counts={
            "out of the box": len(raw) - len(boxed),
            "ground or too high": len(boxed) - len(band),
            "averaged in voxels": len(band) - len(filtered),
            "clustered": int(np.count_nonzero(labels.label >= 0)),
            "noise": int(np.count_nonzero(labels.label < 0)),
        },
    )


def _of_stems(step: Step, stems: Stems, T_base_lidar: Pose3, p: Parameters, watch: Watch) -> Seen:
    with watch("acquisition"):
        places, sensor_offset, clusters = take_stems(step, stems, T_base_lidar, p.acquisition)

    with watch("detection"):
        judged = judge(clusters, p.detection)
        found = detections(judged, sensor_offset, p.detection)
        free = clear_range(places, places, sensor_offset)

    return Seen(
        raw=places,
        filtered=places,
        labels=np.arange(len(places), dtype=np.int32),
        clusters=judged,
        detections=found,
        free=free,
        sensor_offset=sensor_offset,
        above=None,
        heights=None,
        warnings=(),
        counts={"clustered": len(places)},
    )
