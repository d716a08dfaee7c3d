"""Stems detected by another program: they pass through the mapper like own detections."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.config import preset
from pipeline.config.stages import Acquisition
from pipeline.front_end import external_clusters
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.types.records import Scan, Sensor, Stems, Step, Verdict

NAN = float("nan")
LEVEL = Acquisition(range_min=0.0)
tilts = st.floats(-0.4, 0.4)


def step_of(
    places: Any, *, axis: Any = None, dbh: Any = None, index: int = 0, **rest: Any
) -> tuple[Step, Stems]:
    """A step with stems at places of the sensor frame."""
    points = np.asarray(places, np.float32).reshape(-1, 3)
    stems = Stems(
        np.full((len(points), 3), NAN) if axis is None else np.asarray(axis, float),
        np.full(len(points), NAN) if dbh is None else np.asarray(dbh, float),
    )
    pose = rest.pop("pose", Pose2())
    return Step(index, Scan(500_000_000 * index, points, stems=stems), pose, **rest), stems


def stand(seed: int, count: int = 12) -> NDArray[np.float64]:
    """Stems 3 m below the sensor."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-12.0, 12.0, (count, 2)), np.full(count, -3.0)])


@given(tilts, tilts, st.integers(0, 100))
def test_stems_are_levelled_by_the_pose(roll: float, pitch: float, seed: int):
    tilt = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0)
    level = stand(seed)
    step, stems = step_of(tilt.inverse().apply(level), roll=roll, pitch=pitch, tilt_known=True)
    places, _, clusters = external_clusters(step, stems, Pose3.identity(), LEVEL)
    np.testing.assert_allclose(places, level, atol=1e-5)
    np.testing.assert_allclose(clusters.centre, level[:, :2], atol=1e-5)


@given(tilts, tilts, st.integers(0, 100))
def test_without_a_tilt_they_are_levelled_by_their_axes(roll: float, pitch: float, seed: int):
    tilt = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0)
    level = stand(seed)
    axis = np.tile(tilt.R.T @ [0.0, 0.0, 1.0], (len(level), 1))
    axis[:3] = NAN  # some are not known
    step, stems = step_of(tilt.inverse().apply(level), axis=axis)
    np.testing.assert_allclose(external_clusters(step, stems, Pose3.identity(), LEVEL)[0], level, atol=1e-5)


def test_few_axes_level_nothing_and_none_may_be_asked_for():
    level = stand(1)
    step, stems = step_of(level[:4], axis=np.tile([0.6, 0.0, 0.8], (4, 1)))
    np.testing.assert_allclose(
        external_clusters(step, stems, Pose3.identity(), LEVEL)[0], level[:4], atol=1e-6
    )
    step, stems = step_of(level, roll=0.3, tilt_known=True)
    places, _, _ = external_clusters(
        step, stems, Pose3.identity(), LEVEL.model_copy(update={"level": "none"})
    )
    np.testing.assert_allclose(places, level, atol=1e-6)


def test_the_real_axes_tell_the_tilt_of_the_real_poses(shared_data):
    evo = np.load(shared_data / "oxford_evo" / "Evo.npz")
    far = []
    for k in range(0, len(evo["trajectory"]), 100):
        rows = evo["frame"] == k
        row = evo["trajectory"][k]
        roll, pitch, _ = Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]).euler()
        known, stems = step_of(
            evo["xyz"][rows], axis=evo["axis_z"][rows], roll=roll, pitch=pitch, tilt_known=True
        )
        unknown, _ = step_of(evo["xyz"][rows], axis=evo["axis_z"][rows])
        by_pose, by_axes = (external_clusters(s, stems, Pose3.identity(), LEVEL)[0] for s in (known, unknown))
        far.append(np.median(np.linalg.norm(by_pose[:, :2] - by_axes[:, :2], axis=1)))
    assert np.median(far) < 0.2  # the untilted ones are 0.5 m off


def test_mounting_and_range():
    mount = Pose3.from_euler(np.array([0.5, 0.0, 1.0]), 0.0, 0.0, np.pi / 2)
    step, stems = step_of([[1.0, 0.0, 0.0], [30.0, 0.0, 0.0]], dbh=[0.3, 0.4])
    places, offset, clusters = external_clusters(
        step, stems, mount, LEVEL.model_copy(update={"range_max": 20.0})
    )
    np.testing.assert_allclose(places, [[0.0, 1.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(offset, [0.5, 0.0, 1.0])
    np.testing.assert_allclose(clusters.radius, [0.15])


def mapper(**changes: Any) -> Mapper:
    """For stems of another program."""
    chosen = preset("stems").replace(changes)
    return Mapper(chosen, sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=1)


def drive(m: Mapper, count: int = 12, seed: int = 3) -> tuple[Any, NDArray[np.float64]]:
    """Along x through a stand, with the odometry's steps 5 % too long; the last frame, and the stand."""
    level = stand(seed)
    dbh = np.where(np.arange(len(level)) % 2, 0.3, NAN)
    rng = np.random.default_rng(seed)
    frame = None
    for k in range(count):
        seen = level - [0.5 * k, 0.0, 0.0] + rng.normal(0.0, 0.02, level.shape)
        step, _ = step_of(seen, dbh=dbh, index=k, pose=Pose2(0.525 * k))
        frame = m.process(step)
    return frame, level


def test_the_map_has_the_stems_with_their_diameters():
    frame, level = drive(mapper(**{"acquisition.range_max": 40.0}))
    trees = frame.trees
    assert trees.confirmed.all()
    assert len(trees.number) == len(level)
    gap = np.linalg.norm(trees.position[:, None] - level[None, :, :2], axis=2)
    assert gap.min(axis=1).max() < 0.25
    with_dbh = np.isfinite(trees.dbh)
    assert with_dbh.sum() == len(level) // 2
    np.testing.assert_allclose(trees.dbh[with_dbh], 0.3, atol=1e-9)
    assert abs(frame.estimate.T_map_base.x - 5.5) < 0.1 < abs(0.525 * 11 - 5.5)
    assert len(frame.raw) == len(frame.labels) == len(frame.clusters.size) == len(level)
    assert frame.counts == {"returns": 12, "without a value": 0, "out of range": 0, "clustered": 12}


def test_a_diameter_that_no_tree_has_is_a_verdict():
    step, _ = step_of(stand(1)[:3], dbh=[0.3, 1.9, NAN])
    frame = mapper().process(step)
    assert frame.clusters.verdict.tolist() == [Verdict.TREE, Verdict.TOO_THICK, Verdict.TREE]
    assert frame.detections.cluster.tolist() == [0, 2]


@pytest.mark.parametrize("name", ["forest", "paper", "laser2d", "stems"])
def test_every_preset_takes_stems_even_none(name: str):
    m = Mapper(preset(name), sensor=Sensor(), T_base_lidar=Pose3.identity(), seed=1)
    assert len(m.process(step_of(stand(1))[0]).detections.cluster) == 12
    assert len(m.process(step_of(np.zeros((0, 3)), index=1)[0]).detections.cluster) == 0


def test_a_snapshot_goes_on_to_the_same_map():
    m = mapper()
    start = m.snapshot()
    first, _ = drive(m)
    m.restore(start)
    again, _ = drive(m)
    assert first.trees.position.tobytes() == again.trees.position.tobytes()
