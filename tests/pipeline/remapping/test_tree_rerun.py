"""Trees that are made again from the log are those of the main loop."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from itertools import islice

import numpy as np
import pytest

from pipeline.config import Parameters, preset
from pipeline.front_end import SegmentedScan
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper, MapperState
from pipeline.odometry.synchroniser import steps
from pipeline.remapping.tree_rerun import TreeRerun
from pipeline.slam import FastSlam, Loop
from pipeline.tree_log import TreeLog, TreesDifferError, are_same, differ_in_trees_only
from pipeline.types.records import Frame, Step

URI, SCANS = "sim:stand?duration=8", 70
FOREST = preset("forest")
CHANGES = (
    {"classification.tree_share": 0.3},
    {"tracking.proximity_radius": 0.3, "tracking.hits_to_confirm": 2},
    {"tracking.dbh_arc_min": 40.0, "classification.tree_share": 0.8},
)


def told(record: object) -> object:
    """Everything that a record holds, bit by bit."""
    if is_dataclass(record):
        return tuple(told(getattr(record, f.name)) for f in fields(record))
    if isinstance(record, tuple):
        return tuple(map(told, record))
    return (
        (record.dtype.str, record.shape, record.tobytes()) if isinstance(record, np.ndarray) else repr(record)
    )


def lean(frame: Frame) -> Frame:
    """The frame without its points, as it is stored."""
    nothing = np.zeros((0, 3), np.float32)
    return replace(frame, raw=nothing, filtered=nothing, labels=frame.labels[:0])


class MappedRun:
    """A run that the main loop maps from its first scan."""

    scans: list[tuple[Step, SegmentedScan]] | None = None

    def __init__(self, parameters: Parameters) -> None:
        self.mapper = mapper(parameters)
        self.mapper.log = TreeLog()
        self.frames: list[Frame] = []
        self.states: list[MapperState] = [self.mapper.snapshot()]
        if MappedRun.scans is None:
            run = islice(steps(open_source(URI).records()), SCANS)
            MappedRun.scans = [(step, self.mapper.segment(step)) for step in run]
        for step, scan in MappedRun.scans:
            self.frames.append(lean(self.mapper.process(step, scan)))
            self.states.append(self.mapper.snapshot())


def mapper(parameters: Parameters) -> Mapper:
    known = open_source(URI).description
    return Mapper(parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=1)


@pytest.fixture
def often_smoothed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The graph is solved at every keyframe, so that there are corrections."""
    monkeypatch.setattr(FastSlam, "is_smoothing_due", FastSlam.is_keyframe)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("changes", CHANGES)
def test_each_scan_and_each_state_are_those_of_the_main_loop(changes, often_smoothed):
    known, wanted = MappedRun(FOREST), FOREST.replace(changes)
    expected = MappedRun(wanted)
    assert known.mapper.log is not None
    again = mapper(wanted)
    again.log = TreeLog()
    rerun = TreeRerun(again, known.mapper.log)
    for k in range(SCANS):
        assert told(rerun.map_next()) == told((expected.frames[k].stamp_ns, expected.frames[k].trees))
        assert told(rerun.with_trees()(known.states[k + 1])) == told(expected.states[k + 1])
    assert sum(len(known.mapper.log.at(k).corrections) for k in range(SCANS)) > 1
    finished = rerun.finish(known.states[-1], known.mapper.path, known.mapper.motion)
    assert told(finished) == told(expected.states[-1])
    assert told(again.motion) == told(expected.mapper.motion)
    assert told(again.path) == told(expected.mapper.path)
    for k in (3, 4, 60, 59, 66, 0):  # in turn, forwards and backwards
        frame = expected.frames[k]
        assert frame.columns is not None
        assert told(rerun.by_scan.at(k)) == told((frame.trees, frame.columns.verdict))
    back = TreeRerun(mapper(FOREST), again.log)  # by the log of the rerun
    assert [told(back.map_next()[1]) for _ in range(SCANS)] == [told(frame.trees) for frame in known.frames]


def test_trees_that_close_another_loop_are_not_made_from_the_log(monkeypatch):
    known = MappedRun(FOREST)
    assert known.mapper.log is not None
    other = Loop(0, 0, Pose2(), np.eye(3))
    monkeypatch.setattr("pipeline.loop_closure.detection.find_displaced", lambda *_: other)
    rerun = TreeRerun(mapper(FOREST), known.mapper.log)
    first = next(k for k in range(SCANS) if known.mapper.log.at(k).search is not None)
    for _ in range(first):
        rerun.map_next()
    with pytest.raises(TreesDifferError):
        rerun.map_next()


def test_scans_that_are_not_known_are_told():
    log = TreeLog()
    log.put(0, None)
    assert log.has_all(0)
    assert not log.has_all(1)
    for index in (0, 1):
        with pytest.raises(TreesDifferError):
            log.at(index)


def test_a_log_that_grows_too_large_is_empty():
    known = MappedRun(FOREST).mapper.log
    assert known is not None
    assert known.has_all(SCANS)
    log = TreeLog(100_000)
    for k in range(SCANS):
        log.put(k, known.at(k))
    assert not log.has_all(1)
    assert log.nbytes == 0


def test_only_parameters_of_the_trees_may_differ():
    for changes in CHANGES:
        assert differ_in_trees_only(FOREST, FOREST.replace(changes))
    for name, value in (
        ("tracking.breast_height", 1.0),
        ("classification.range_max", 9.0),
        ("slam.particles", 50),
        ("detection.e_max", 9.0),
    ):
        assert not differ_in_trees_only(FOREST, FOREST.replace({name: value}))


def test_loops_are_compared_bit_by_bit():
    loop = Loop(5, 3, Pose2(1.0, 2.0, 0.5), np.eye(3))
    assert are_same(loop, replace(loop, covariance=np.eye(3)))
    assert are_same(None, None)
    assert not are_same(loop, None)
    for changed in (
        {"first": 4},
        {"T_map_base": Pose2(1.0, 2.0, 0.5000001)},
        {"covariance": 2.0 * np.eye(3)},
    ):
        assert not are_same(loop, replace(loop, **changed))
