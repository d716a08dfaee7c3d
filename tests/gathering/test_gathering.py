"""Gathering: what stands over many scans is told from what does not, and going back in time is exact."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.gathering import Gathering, View
from pipeline.gathering.gathering import FOLD, GONE_SCANS
from pipeline.geometry import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.parameters import preset
from pipeline.records import Columns, Float32, Scan, Sensor, Step, Verdict
from pipeline.terrain import SECTORS
from pipeline.tracking import Tracker
from pipeline.visibility import BINS
from tests.gathering.clouds import bush, trunk

FOREST = preset("forest")
NOWHERE_FREE = np.zeros(BINS)


def view(free=NOWHERE_FREE, pose=None):
    """From the origin, 1 m above flat ground, as steep as 45 degrees."""
    return View(pose or Pose2(), np.zeros(3), free, np.ones(BINS), np.full((SECTORS, 200), -1.0))


def gathered(*clouds: Float32, free=NOWHERE_FREE, scans=1):
    gathering = Gathering(FOREST.gathering, all_around=True)
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)
    for k in range(scans):
        gathering.add(points, points[:, 2].copy(), k, view(free))
    return gathering


def at(columns: Columns, x: float, y: float) -> int:
    return int(np.hypot(columns.axis[:, 0] - x, columns.axis[:, 1] - y).argmin())


def test_a_trunk_is_a_tree_and_a_bush_is_none():
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), bush(-5.0, 2.0, 0.7), scans=3).columns
    tree = at(columns, 5.0, 1.0)
    assert columns.verdict[tree] == Verdict.TREE
    assert columns.axis[tree, :2] == pytest.approx([5.0, 1.0], abs=0.03)
    in_bush = np.hypot(columns.axis[:, 0] + 5.0, columns.axis[:, 1] - 2.0) < 0.8
    assert (columns.verdict[in_bush] != Verdict.TREE).all()
    assert columns.share.sum(axis=1) == pytest.approx(1.0, abs=0.02)


def test_nothing_gathered_is_no_column():
    assert len(gathered().columns.verdict) == 0


def test_who_walked_on_is_moving():
    gathering = gathered(trunk(5.0, 1.0, 0.15, top=1.7), scans=2)
    nothing = np.zeros((0, 3), np.float32)
    for k in range(GONE_SCANS + 3):
        gathering.add(nothing, np.zeros(0, np.float32), 2 + k, view(np.full(BINS, np.inf)))
    columns = gathering.columns
    assert columns.verdict[at(columns, 5.0, 1.0)] == Verdict.MOVING
    assert columns.absent.max() == GONE_SCANS + 3


def test_how_high_a_scan_looked_is_told_from_the_ground():
    columns = gathered(trunk(3.0, 0.0, 0.15)).columns
    assert columns.viewed[at(columns, 3.0, 0.0)] == pytest.approx(
        4.0, abs=0.05
    )  # 3 m out at 45 degrees, plus 1 m


def test_going_back_gives_the_same_again():
    clouds = [trunk(4.0 + 0.001 * k, 1.0, 0.1, points=300, seed=k) for k in range(FOLD + 20)]
    gathering = Gathering(FOREST.gathering, all_around=True)
    states, seen = {}, {}
    for k, cloud in enumerate(clouds):
        if k in (0, 5, FOLD - 1, FOLD, FOLD + 7):
            states[k] = gathering.snapshot()
        gathering.add(cloud, cloud[:, 2].copy(), k, view())
        seen[k] = gathering.columns
    for k, state in reversed(states.items()):
        gathering.restore(state)
        for again in range(k, k + 3):
            gathering.add(clouds[again], clouds[again][:, 2].copy(), again, view())
            for name in ("axis", "figures", "share", "verdict", "present", "absent"):
                assert np.array_equal(getattr(gathering.columns, name), getattr(seen[again], name)), (
                    k,
                    again,
                    name,
                )


def test_a_tree_that_no_scan_showed_begins_a_track_and_keeps_its_number():
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), scans=3).columns
    tracker = Tracker(FOREST.tracking)
    for _ in range(3):
        tracker.judge(1, columns)
    trees = tracker.trees()
    assert trees.number.tolist() == [1]
    assert trees.confirmed.tolist() == [True]
    assert trees.observations.tolist() == [0]
    assert np.isnan(trees.dbh[0])
    assert trees.position[0] == pytest.approx([5.0, 1.0], abs=0.03)


def test_the_paper_gathers_nothing():
    frame = mapped("paper", trunk(5.0, 1.0, 0.15))
    assert frame.columns is None


def mapped(name, points, scans=3):
    sensor = Sensor("VLP-16", 16, float(np.radians(2.0)), 0.0035)
    mapper = Mapper(preset(name), sensor=sensor, T_base_lidar=Pose3.identity(), seed=0)
    frame = None
    for k in range(scans):
        frame = mapper.process(Step(k, Scan(k * 100_000_000, points.astype(np.float32)), Pose2()))
    assert frame is not None
    return frame


RNG = np.random.default_rng(0)
POOR = {
    "nothing": np.zeros((0, 3)),
    "ten identical points": np.repeat([[3.0, 1.0, 0.5]], 10, axis=0),
    "one plane": np.column_stack([RNG.uniform(-20, 20, (20000, 2)), np.full(20000, -1.0)]),
    "a wall": np.column_stack([np.full(20000, 5.0), RNG.uniform(-8, 8, 20000), RNG.uniform(-1, 3, 20000)]),
    "no ground": RNG.uniform(-20, 20, (20000, 3)),
}


@pytest.mark.parametrize("kind", POOR)
def test_a_poor_cloud_gives_a_frame_and_no_tree(kind):
    frame = mapped("forest", POOR[kind])
    assert not frame.trees.confirmed.any()
