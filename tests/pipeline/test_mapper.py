"""The mapper: reproducible bytes, snapshots and their restoration, and counts of points that sum to the
scan."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

from pipeline.config import PRESETS, preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Frame, Odometry, Scan, Sensor, Stems, Step, Verdict
from tests.pipeline.strategies import SENSOR, arc, scan

URI = "sim:paper?duration=3"


@cache
def run():
    """The steps of a short simulated run, and its source's description."""
    source = open_source(URI)
    return list(steps(source.records())), source.description


def mapper(name="forest", seed=0, **changes: Any):
    """A mapper for the simulated run."""
    d = run()[1]
    return Mapper(preset(name).replace(changes), sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=seed)


def as_bytes(record):
    """Everything that a record holds, bit by bit."""
    if is_dataclass(record):
        return tuple(as_bytes(getattr(record, f.name)) for f in fields(record))
    if isinstance(record, np.ndarray):
        return (record.dtype.str, record.shape, record.tobytes())
    return repr(record)


def fed(m, parts):
    """Map steps and return the frames as bytes."""
    return [as_bytes(m.process(step)) for step in parts]


@pytest.mark.parametrize("name", ["forest", "paper"])
def test_the_same_run_gives_the_same_bytes(name):
    parts, _ = run()
    assert fed(mapper(name), parts) == fed(mapper(name), parts)
    assert fed(mapper(name), parts) != fed(mapper(name, seed=1), parts)


def test_from_a_snapshot_it_goes_on_to_the_same_bytes():
    parts, _ = run()
    m = mapper()
    fed(m, parts[:12])
    state = m.snapshot()
    once = fed(m, parts[12:])
    path_once = as_bytes(m.path)
    for _ in range(2):
        m.restore(state)
        assert len(m.path.stamp_ns) == 12
        assert fed(m, parts[12:]) == once
        assert as_bytes(m.path) == path_once


def test_what_happens_later_does_not_change_a_snapshot_or_an_old_frame():
    parts, _ = run()
    m = mapper()
    frame = m.process(parts[0])
    state = m.snapshot()
    before = as_bytes(frame), as_bytes(state)
    fed(m, parts[1:])
    m.restore(state)
    fed(m, parts[1:])
    assert (as_bytes(frame), as_bytes(state)) == before


def test_the_scan_itself_is_left_alone():
    parts, _ = run()
    before = as_bytes(parts[3])
    fed(mapper(), parts[:5])
    assert as_bytes(parts[3]) == before


@pytest.mark.parametrize("name", PRESETS)
def test_every_point_is_counted_once(name):
    m = mapper(name)
    for step in run()[0][:8]:
        counts = dict(m.process(step).counts)
        assert counts.pop("without a value") == step.scan.dropped
        assert sum(counts.values()) == 2 * counts["returns"] > 0
        assert all(n >= 0 for n in counts.values())


def test_the_parts_of_a_frame_fit_one_another():
    m = mapper()
    told = [m.process(step) for step in run()[0]]
    for frame in told:
        k = len(frame.clusters.size)
        assert len(frame.labels) == len(frame.filtered)
        np.testing.assert_array_equal(
            np.bincount(frame.labels[frame.labels >= 0], minlength=k), frame.clusters.size
        )
        np.testing.assert_array_equal(
            frame.detections.cluster, np.flatnonzero(frame.clusters.verdict == Verdict.TREE)
        )
        assert frame.estimate.weights.sum() == pytest.approx(1.0)
    assert np.count_nonzero(told[-1].trees.confirmed) >= 1
    assert len(m.path.stamp_ns) == len(run()[0])
    assert m.path.stamp_ns[-1] == told[-1].stamp_ns


def test_the_stages_are_watched_in_order():
    entered = []

    class Watch:
        def __init__(self, stage: str) -> None:
            entered.append(stage)

        def __enter__(self) -> None:
            """The stage begins."""

        def __exit__(self, *_: object) -> None:
            """The stage ends."""

    d = run()[1]
    m = Mapper(preset("forest"), sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=0, timer=Watch)
    m.process(run()[0][0])
    assert entered[0] == "acquisition"
    assert entered[-4:] == ["slam", "tracking", "gathering", "height map"]
    assert len(entered) == len(set(entered))


def test_new_parameters_act_from_the_next_scan_on():
    m = mapper()
    first = m.process(run()[0][0])
    m.parameters = m.parameters.replace({"slam.particles": 7, "filters.x_max": 0.5, "filters.x_min": 0.0})
    frame = m.process(run()[0][1])
    assert len(first.estimate.particles) == 100
    assert len(frame.estimate.particles) == 7
    assert frame.filtered[:, 0].max(initial=0.0) <= 0.5
    assert m.parameters.slam.particles == 7


# --- motion ---------------------------------------------------------------------------------------


def test_a_graph_without_solution_changes_nothing(monkeypatch):
    parts = run()[0][:10]
    expected = fed(mapper(), parts)
    smoothed = mapper()
    monkeypatch.setattr(type(smoothed._slam), "is_smoothing_due", True)
    monkeypatch.setattr(smoothed._slam, "smooth", lambda _index: None)
    assert fed(smoothed, parts) == expected


def _still(m, poses):
    return [m.process(Step(k, scan(1 + k * 10**8), pose)).estimate.T_map_base for k, pose in enumerate(poses)]


def test_the_map_begins_where_the_robot_does():
    m = mapper(**{"slam.noise_distance": 0.0, "slam.noise_turn": 0.0, "slam.noise_turn_distance": 0.0})
    told = _still(m, [Pose2(100.0, 50.0, np.pi / 2), Pose2(100.0, 52.0, np.pi / 2)])
    assert (told[0].x, told[0].y) == pytest.approx((0.0, 0.0))
    assert (told[1].x, told[1].y) == pytest.approx((2.0, 0.0), abs=1e-9)


def test_odometry_that_begins_late_is_no_drive():
    told = _still(mapper(), [None, None, Pose2(100.0, 50.0, 1.0), Pose2(100.0, 50.0, 1.0)])
    assert all(np.hypot(pose.x, pose.y) < 1e-9 for pose in told)


def test_odometry_that_pauses_is_made_up_for():
    m = mapper(**{"slam.noise_distance": 0.0, "slam.noise_turn_distance": 0.0})
    told = _still(m, [Pose2(5.0), None, None, Pose2(8.0)])
    assert [pose.x for pose in told] == pytest.approx([0.0, 0.0, 0.0, 3.0])


# --- scans that are none --------------------------------------------------------------------------

RNG = np.random.default_rng(0)
POOR = {
    "empty": np.zeros((0, 3)),
    "without numbers": np.full((50, 3), np.nan),
    "infinite": np.full((50, 3), np.inf),
    "all at the sensor": np.zeros((50, 3)),
    "one point": np.array([[3.0, 1.0, 0.0]]),
    "ten times the same point": np.tile([3.0, 1.0, 0.2], (10, 1)),
    "a level plane": np.column_stack([RNG.uniform(-20, 20, (5000, 2)), np.full(5000, -0.8)]),
    "a wall": np.column_stack([np.full(3000, 4.0), RNG.uniform([-5, -1], [5, 2], (3000, 2))]),
    "no ground": arc(0.2, 1.2, distance=5.0),
    "noise": RNG.normal(0, 10, (4000, 3)),
    "far beyond": np.full((20, 3), 3e38),
}


@pytest.mark.parametrize("poor", POOR)
def test_a_poor_scan_is_mapped_without_a_word(poor):
    points = POOR[poor].astype(np.float32)
    mappers = [
        Mapper(preset(name), sensor=sensor, T_base_lidar=Pose3.identity(), seed=0)
        for name in PRESETS
        for sensor in (SENSOR, Sensor())
    ]
    for m, k in product(mappers, range(3)):
        frame = m.process(Step(k, Scan(1 + k, points), None))
        assert isinstance(frame, Frame)
        counts = dict(frame.counts)
        counts.pop("without a value")
        assert sum(counts.values()) == 2 * counts["returns"]
        assert np.isfinite(frame.estimate.T_map_base.as_array()).all()
        assert np.isfinite(frame.trees.position).all()


def test_a_level_plane_alone_has_no_tree():
    m = Mapper(preset("forest"), sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=0)
    level = POOR["a level plane"].astype(np.float32)
    told = [m.process(Step(k, Scan(1 + k, level), None)) for k in range(6)]
    assert len(told[-1].trees.number) == 0


def test_a_robot_that_stands_uses_its_first_scans_and_then_one_of_each_interval():
    tree, upright = np.array([[5.0, 1.0, 0.0]], np.float32), np.array([[0.0, 0.0, 1.0]])
    stems = Stems(upright, np.array([0.3]))
    for interval, used in ((1.0, 10 + 2), (0.0, 1)):
        parameters = preset("stems").replace({"slam.update_interval": interval})
        m = Mapper(parameters, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0)
        for k in range(30):
            shown, t_ns = Scan(k * 100_000_000, tree, stems=stems), k * 100_000_000
            m.process(Step(k, shown, Pose2(), elapsed_ns=t_ns, period_ns=100_000_000))
        assert m.snapshot().slam.detections == used


def observed(hz):
    """Observations of the trees of a drive of 4 m at 1 m/s between stems, seen at a rate."""
    x, y = np.meshgrid(np.arange(-6.0, 12.0, 3.0), np.array([-4.0, -1.5, 1.5, 4.0]))
    records: list[Any] = []
    for t_ns in range(0, 4_000_000_001, 10_000_000):
        along = t_ns * 1e-9
        if t_ns % 20_000_000 == 0:
            records.append(Odometry(t_ns, Pose3(np.eye(3), np.array([along, 0.0, 0.0]))))
        if t_ns % (1_000_000_000 // hz) == 0:
            places = np.column_stack([x.ravel() - along, y.ravel(), np.zeros(x.size)]).astype(np.float32)
            upright = np.tile([0.0, 0.0, 1.0], (x.size, 1))
            records.append(Scan(t_ns, places, stems=Stems(upright, np.full(x.size, 0.3))))
    m = Mapper(preset("stems"), sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=0)
    return [m.process(step) for step in steps(records)][-1].trees.observations


def test_a_faster_sensor_is_no_more_evidence():
    assert observed(20).tolist() == observed(10).tolist()
    assert len(observed(5)) == len(observed(10)) == 24
