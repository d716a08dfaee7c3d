"""Kidnapped robot: it is reported as lost, located again, and leaves no false tree."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.io.readers import open_source
from pipeline.loop_closure.correction import LoopClosure, RelocalisedPose
from pipeline.loop_closure.kidnapped_robot import Relocaliser, RelocaliserState, local_seed
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.slam import Loop, Motion, SlamState
from pipeline.slam.particle_ancestry import draws
from pipeline.tracking import Tracker
from pipeline.types.records import PoseMeasurement
from tests.pipeline.strategies import NOTHING_SEEN, detections
from tests.pipeline.test_mapper import as_bytes

URI = "sim:stand?duration=22&seed=3"
JUMP, BACK, AFTER = 160, 40, 50  # scan of the jump, the one where it lands, and how many are driven then


@cache
def drive():
    """The steps of a drive through a stand, its true path, and what is known of its source."""
    source = open_source(URI)
    truth = source.truth()
    assert truth is not None
    return list(steps(source.records())), truth.path, source.description


def kidnapped(landing=BACK):
    """The drive up to JUMP, and from `landing` on once more without a word of the wheels about it."""
    whole, _, _ = drive()
    before, last = whole[:JUMP], whole[JUMP - 1]
    T = last.T_odom_base @ whole[landing].T_odom_base.inverse()
    after = [
        replace(
            step,
            index=JUMP + k,
            T_odom_base=T @ step.T_odom_base,
            scan=replace(step.scan, stamp_ns=last.scan.stamp_ns + (k + 1) * 10**8),
        )
        for k, step in enumerate(whole[landing : landing + AFTER])
    ]
    return before, after


def mapper(**changes: Any):
    """A mapper for the drive."""
    d = drive()[2]
    return Mapper(preset("forest").replace(changes), sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=1)


def confirmed(frame):
    """Numbers of the trees on the map."""
    return set(frame.trees.number[frame.trees.confirmed].tolist())


@cache
def mapped_before():
    """A mapper that mapped the drive up to the jump, its snapshot and its frames."""
    m = mapper()
    frames = [m.process(step) for step in kidnapped()[0]]
    return m, m.snapshot(), frames


def at_the_jump():
    """The mapper, restored to the scan of the jump."""
    m, state, _ = mapped_before()
    m.restore(state)
    return m


@cache
def mapped():
    """The frames before and after the jump."""
    m = at_the_jump()
    return mapped_before()[2], [m.process(step) for step in kidnapped()[1]]


@pytest.mark.slow
def test_a_drive_without_a_jump_is_never_lost():
    assert {frame.health.state for frame in mapped()[0]} <= {"good", "weak"}


def test_a_kidnapped_robot_says_so_and_is_good_again_within_fifty_scans():
    states = [frame.health.state for frame in mapped()[1]]
    assert "lost" in states[:5]
    assert states[-1] == "good"
    assert states.count("lost") < 20
    told = [word for frame in mapped()[1] for word in frame.warnings]
    assert any("is lost" in word for word in told)
    assert any("robot located" in word for word in told)
    assert not any("drifted" in word for word in told), "who was carried did not drift"


def test_no_loop_bends_what_was_driven_before_it_was_put_in_place():
    m, (_, after) = at_the_jump(), kidnapped()
    state = m.snapshot()
    assert state.placed == 0
    told = iter(m.process(step).warnings for step in after)
    assert any("robot located" in word for words in told for word in words)
    assert m.snapshot().placed == len(m.path.x) == len(m.motion) > JUMP
    m.restore(state)
    assert m.snapshot().placed == 0


def test_it_stands_where_it_was_put():
    _, truth, _ = drive()
    stamp = drive()[0][BACK + AFTER - 1].scan.stamp_ns
    k = int(np.searchsorted(truth.stamp_ns, stamp))
    pose = mapped()[1][-1].estimate.T_map_base
    assert np.hypot(pose.x - truth.x[k], pose.y - truth.y[k]) < 0.15


def test_a_jump_leaves_at_most_one_false_tree():
    before, after = mapped()
    known, now = confirmed(before[-1]), confirmed(after[-1])
    place = after[-1].trees.position[after[-1].trees.confirmed]
    old = before[-1].trees.position[before[-1].trees.confirmed]
    far = np.hypot(*(place[:, None] - old[None]).transpose(2, 0, 1)).min(axis=1) > 1.0
    known_truth = open_source(URI).truth()
    assert known_truth is not None
    assert known_truth.trees is not None
    true = np.stack([known_truth.trees.x, known_truth.trees.y], axis=1)
    false = np.hypot(*(place[far][:, None] - true[None]).transpose(2, 0, 1)).min(axis=1, initial=9.0) > 0.5
    assert np.count_nonzero(false) <= 1
    assert len(known - now) <= 2


def test_without_relocalisation_it_maps_on():
    m = mapper(**{"relocalisation.method": "none"})
    before, after = kidnapped()
    for step in before:
        m.process(step)
    words = [word for step in after[:10] for word in m.process(step).warnings]
    assert not any("lost" in word for word in words)


def test_a_snapshot_taken_while_lost_goes_on_to_the_same_bytes():
    m, (_, after) = at_the_jump(), kidnapped()
    lost = [m.process(step) for step in after[:5]]
    assert lost[-1].health.state == "lost"
    state = m.snapshot()
    once = [as_bytes(m.process(step)) for step in after[5:15]]
    m.restore(state)
    assert [as_bytes(m.process(step)) for step in after[5:15]] == once


@pytest.mark.parametrize("landing", [0, 90])
def test_wherever_it_lands(landing):
    m, (_, after) = at_the_jump(), kidnapped(landing)
    states = [m.process(step).health.state for step in after]
    assert states[-1] != "lost"


def test_a_map_saved_while_lost_goes_on_to_the_same_bytes():
    m, (_, after) = at_the_jump(), kidnapped()
    for step in after[:5]:
        m.process(step)
    saved = SavedMap.of(m)
    assert saved.search is not None
    other, state = mapper(), saved.state()
    other.load(state, saved.stamp_ns, saved.sigma_xy, saved.motion)
    once = [as_bytes(m.process(step)) for step in after[5:15]]
    assert [as_bytes(other.process(step)) for step in after[5:15]] == once
    with pytest.raises(ValueError, match="search"):
        replace(saved, search=replace(saved.search, since=10**6)).state()


def test_a_map_saved_while_lost_goes_on_where_the_robot_is_put():
    m, (_, after) = at_the_jump(), kidnapped()
    for step in after[:5]:
        m.process(step)
    saved = SavedMap.of(m)
    other = mapper()
    other.load(saved.state(), saved.stamp_ns, saved.sigma_xy, saved.motion)
    _, truth, _ = drive()
    k = int(np.searchsorted(truth.stamp_ns, drive()[0][BACK + 5].scan.stamp_ns))
    pose = Pose2(truth.x[k], truth.y[k], truth.yaw[k])
    other.place(len(saved.stamp_ns), pose, np.diag([0.1, 0.1, 0.02]) ** 2)
    assert other.snapshot().recovery.local is None
    assert {other.process(step).health.state for step in after[5:15]} <= {"good", "weak"}


def test_measured_poses_are_of_the_map_and_not_of_the_small_one_of_a_search():
    recovery: Relocaliser[Any] = Relocaliser(0)
    recovery.state = RelocaliserState(local=SlamState.at_origin(20))
    far = PoseMeasurement(1, Pose2(100.0, 50.0, 1.0), np.eye(3) * 1e-4)
    seen = detections([[3.0, 1.0], [4.0, -2.0]])
    run: Any = SimpleNamespace(trees=Tracker(preset("forest").tracking).trees())  # none, so none is found
    for index in (1, 2, 4):
        motion = Motion(Pose2(0.3), measured=far)
        assert recovery.search(index, motion, seen, NOTHING_SEEN, preset("forest"), run) is None
    assert recovery.state.local is not None
    np.testing.assert_allclose(recovery.state.local.pose.mean(axis=0), [0.9, 0.0, 0.0], atol=0.1)


def test_the_local_map_shares_no_random_numbers_with_runs_of_near_seeds():
    local, _ = draws(local_seed(4), 7, 10)
    for seed in range(10):
        run, _ = draws(seed, 7, 10)
        assert not np.array_equal(local, run)


@pytest.mark.parametrize("stems", [None, 7])
def test_a_loop_that_the_graph_contradicts_is_not_reported(stems, monkeypatch):
    """It changes nothing; a lost robot is located by its trees all the same."""
    m, frame = at_the_jump(), mapped_before()[2][-1]
    monkeypatch.setattr(m._slam, "close", lambda *_: None)
    T_map_base, index = frame.estimate.T_map_base, frame.index
    loop = Loop(0, 0, Pose2(T_map_base.x + 1.0, T_map_base.y, T_map_base.yaw), 1e-4 * np.eye(3))
    estimate, applied = m._apply(index, LoopClosure(loop, stems), frame.estimate)
    if stems is None:
        assert applied is None
        assert estimate is frame.estimate
    else:
        assert isinstance(applied, RelocalisedPose)
        assert estimate.T_map_base.x == pytest.approx(loop.T_map_base.x, abs=0.05)


def test_the_map_returns_to_a_state_before_the_trees_contradicted_it():
    relocaliser: Relocaliser[str] = Relocaliser(0)
    for k in range(100):
        is_supported = k < 40  # no tree is where it should be from then on, in however many scans
        state = f"before {k}" if relocaliser.needs_state(k // 2, is_supported) else None
        relocaliser.remember(k, Motion(Pose2(0.1 * k)), k // 2, state)
    restart = relocaliser.begin(100, detections([[4.0, 1.0]]), NOTHING_SEEN, preset("forest"))
    assert restart.state == "before 20"
    assert [scan for scan, _ in restart.motions] == list(range(20, 100))
