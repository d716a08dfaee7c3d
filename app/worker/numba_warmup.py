"""Has the mapper's compiled code ready before it is needed: a robot's first scan would not wait for it.

What looks at a scan and what makes a map of trees share hardly a kernel: two processes compile a half each.
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
    """Map a second of a simulated stand; the first time on a machine this takes minutes."""
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
    """Look at the scans of that second, keep what they show, and gather it where odometry says that they were
    taken: all of the mapper but SLAM and the trees' tracks."""
    from contextlib import closing

    from pipeline.classification import Gathering, View
    from pipeline.front_end import detect, segment
    from pipeline.geometry.poses import Pose2
    from pipeline.ground.terrain_map import HeightMapper
    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping import KeptScans, look_key
    from pipeline.tracking.track_classification import nearest_other

    source = open_source(_SCENE)
    known, parameters = source.description, Parameters()
    gathering = Gathering(
        parameters.classification, all_around=known.sensor.rings > 0, forests=kept_forests()
    )
    heights = HeightMapper()
    with closing(KeptScans()) as kept:
        for step in steps(source.records()):
            looked = segment(step, known.sensor, known.T_base_lidar, parameters)
            detect(looked, parameters.detection)
            kept.put(step, looked, look_key(parameters))
        for index in range(len(kept)):
            step, looked = kept.scan(index)
            detect(looked, parameters.detection)
            pose, over = step.T_odom_base or Pose2(), looked.column_input
            if over is not None:
                view = View(pose, looked.sensor_offset, looked.free, over.steepest, over.depth, over.terrain)
                gathering.add(over.points, over.height, step.index, view)
            if looked.terrain is not None:
                heights.add(looked.terrain, pose, looked.sensor_offset)
    gathering.snapshot().folded()  # as a step back does
    place = gathering.columns.axis[:, :2].copy()
    nearest_other(place, place, 1.0)  # as a rough answer asks


def warm_map() -> None:
    """Map stems that nobody had to look for, and again with another parameter: SLAM, the trees' tracks, and
    what is kept of a run."""
    from contextlib import closing

    from pipeline.classification import no_columns
    from pipeline.config import preset
    from pipeline.geometry.poses import Pose3
    from pipeline.mapper import Mapper
    from pipeline.remapping import Basis, Journal, KeptScans, Rerun, look_key, rough_trees
    from pipeline.tracking import Tracker
    from pipeline.tracking.track_classification import tree_columns
    from pipeline.types.records import Sensor

    stems, journal = preset("stems"), Journal()
    mapper, again = (
        Mapper(p, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0)
        for p in (stems, stems.replace({"tracking.hits_to_confirm": 4}))
    )
    mapper.note = lambda noted: journal.note(noted, stems.slam)
    states = {0: mapper.snapshot()}
    with closing(KeptScans()) as kept:
        for step in _stems():
            looked = mapper.segment(step)
            kept.put(step, looked, look_key(stems))
            mapper.process(step, looked)
        scans = len(journal)
        states[scans] = mapper.snapshot()
        basis = Basis.of(stems, journal.first(scans), states, mapper.path, mapper.motion)
        rough_trees(basis, kept.clusters, again.parameters)
        for _ in Rerun(again, kept, None, basis).frames(scans):
            pass
    tree_columns(Tracker(stems.tracking).judge(0, no_columns(), stems.classification))


def _stems() -> Iterator[Step]:
    """A robot that drives half a metre a scan between trees three metres apart."""
    from pipeline.geometry.poses import Pose2
    from pipeline.types.records import Scan, Stems, Step

    x, y = np.meshgrid(np.arange(-6.0, 12.0, 3.0), np.array([-4.0, -1.5, 1.5, 4.0]))
    for index in range(12):
        along = 0.5 * index
        places = np.column_stack([x.ravel() - along, y.ravel(), np.zeros(x.size)]).astype(np.float32)
        upright = np.tile([0.0, 0.0, 1.0], (x.size, 1))
        scan = Scan(100_000_000 * index, places, stems=Stems(upright, np.full(x.size, 0.3)))
        yield Step(index, scan, Pose2(along, 0.0, 0.0))
