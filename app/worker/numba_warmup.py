"""Compilation of the kernels of the mapper before the first scan.

The front end and the mapping of trees share few kernels, so that two processes compile one half each.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from app.common.compile_ahead import compile_ahead
from app.common.timers import Stopwatch
from app.training.learned_forests import kept_forests
from pipeline.config import Parameters

if TYPE_CHECKING:
    from pipeline.types.records import Step

_SCENE = "sim:stand?duration=1"


def warm_up(parameters: Parameters | None = None) -> None:
    """Map one second of a simulated stand; the first time on a machine this takes minutes."""
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    compile_ahead()
    source = open_source(_SCENE)
    known = source.description
    mapper = Mapper(
        parameters or Parameters(),
        sensor=known.sensor,
        T_base_lidar=known.T_base_lidar,
        seed=0,
        timer=Stopwatch(),
        forests=kept_forests(),
    )
    for step in steps(source.records()):
        mapper.process(step)


def warm_eyes() -> None:
    """Segment the scans of that second, cache them, and integrate them into columns and terrain at the poses
    of the odometry: all of the mapper but SLAM and the Kalman filters of the trees."""
    from contextlib import closing

    from pipeline.classification import Gathering, View
    from pipeline.front_end import detect, segment
    from pipeline.geometry.poses import Pose2
    from pipeline.ground.terrain_map import HeightMapper
    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping import ScanCaches
    from pipeline.tracking.track_classification import nearest_other

    source = open_source(_SCENE)
    known, parameters = source.description, Parameters()
    gathering = Gathering(
        parameters.classification, all_around=known.sensor.rings > 0, forests=kept_forests()
    )
    heights = HeightMapper()
    with closing(ScanCaches()) as caches:
        cache = caches.of(parameters)
        for step in steps(source.records()):
            cache.put(step, segment(step, known.sensor, known.T_base_lidar, parameters))
        for index in range(len(cache)):
            cached = cache.read(index)
            if cached is None:
                continue
            step, scan = cached
            detect(scan, parameters.detection)
            pose, given = step.T_odom_base or Pose2(), scan.column_input
            if given is not None:
                view = View(pose, scan.sensor_offset, scan.free, given.steepest, given.depth, given.terrain)
                gathering.add(given.points, given.height, step.index, view)
            if scan.terrain is not None:
                heights.add(scan.terrain, pose, scan.sensor_offset)
    gathering.snapshot().folded()  # as a step back does
    place = gathering.columns.axis[:, :2].copy()
    nearest_other(place, place, 1.0)  # as the preview does


def warm_map() -> None:
    """Map detected stems, and compute a preview: SLAM and the Kalman filters of the trees."""
    from pipeline.classification import no_columns
    from pipeline.config import preset
    from pipeline.geometry.poses import Pose3
    from pipeline.mapper import Mapper
    from pipeline.remapping import ClusterTable, KnownMap, preview_trees
    from pipeline.tracking import Tracker
    from pipeline.tracking.track_classification import tree_columns
    from pipeline.types.records import Sensor

    stems, clusters = preset("stems"), ClusterTable()
    mapper = Mapper(stems, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0)
    for step in _stems():
        clusters.record(mapper.process(step))
    known = KnownMap(stems, clusters, mapper.path, None)
    preview_trees(known, stems.replace({"tracking.hits_to_confirm": 4}))
    tree_columns(Tracker(stems.tracking).judge(0, no_columns(), stems.classification))


def _stems() -> Iterator[Step]:
    """Return the steps of a robot that drives 0.5 m per scan between trees at distances of 3 m."""
    from pipeline.geometry.poses import Pose2
    from pipeline.types.records import Scan, Stems, Step

    x, y = np.meshgrid(np.arange(-6.0, 12.0, 3.0), np.array([-4.0, -1.5, 1.5, 4.0]))
    for index in range(12):
        along = 0.5 * index
        places = np.column_stack([x.ravel() - along, y.ravel(), np.zeros(x.size)]).astype(np.float32)
        upright = np.tile([0.0, 0.0, 1.0], (x.size, 1))
        scan = Scan(100_000_000 * index, places, stems=Stems(upright, np.full(x.size, 0.3)))
        yield Step(index, scan, Pose2(along, 0.0, 0.0))
