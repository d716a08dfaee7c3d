"""The layers that are made while people want to see them: voxels, the accumulated map, errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from app.scene import Scene
from app.scene.map import BLOCK, SIDE, STEP, Accumulated, errors
from pipeline.config import preset
from pipeline.config.stages import Evaluation
from pipeline.errors import ParameterError
from pipeline.geometry.poses import Pose2
from pipeline.types.records import HIDDEN, TruthTrees
from tests.app.scene.frames import make_frame, make_trees

PATH = np.column_stack([0.05 * np.arange(50), np.zeros(50)] * 2)


def node(scene: Scene, name: str):
    handle = scene._server.scene.get_handle_by_name(name)
    assert handle is not None, name
    return handle


def frames(poses: list[tuple[float, float]]):
    return [make_frame(k, pose=Pose2(x, 0.0, yaw)) for k, (x, yaw) in enumerate(poses)]


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-3, 3)), min_size=1, max_size=6))
def test_each_cell_has_one_point_and_going_back_forgets_what_came_later(poses: list[tuple[float, float]]):
    run = frames(poses)
    gathered = Accumulated()
    after = []
    for frame in run:
        gathered.take(frame)
        after.append(gathered.points.copy())
    cells = np.unique(np.floor(gathered.points.astype(np.float64) / SIDE), axis=0)
    assert len(cells) >= 0.98 * len(gathered.points)  # float32 may round a point over a border
    for index in reversed(range(len(run))):
        gathered.take(run[index])
        np.testing.assert_array_equal(gathered.points, after[index])


def test_a_robot_that_stands_gathers_nothing_new():
    gathered = Accumulated()
    assert gathered.take(make_frame(0, pose=Pose2(0.0, 0.0, 0.0)))
    count = len(gathered.points)
    assert not gathered.take(make_frame(1, pose=Pose2(0.5 * STEP, 0.0, 0.0)))
    assert len(gathered.points) == count
    assert gathered.take(make_frame(2, pose=Pose2(0.5 * STEP, 0.0, 0.5)))


def test_a_long_drive_stores_40_bytes_for_a_scan_and_20_for_a_point():
    gathered = Accumulated()
    scans = 300
    for frame in frames([(1.0 * k, 0.0) for k in range(scans)]):
        gathered.take(frame)
    assert len(gathered.points) > scans  # each scan added points
    size = sum(column.nbytes for rows in (gathered._rows, gathered._scans) for column in rows._columns)
    assert size <= 2 * (40 * scans + 20 * len(gathered.points))  # the capacity doubles


def test_the_cells_grow_where_a_drive_has_more_points_than_the_scene_shows(monkeypatch: pytest.MonkeyPatch):
    """All parts of the drive stay in the scene, and a step back leaves the points of the scans before it."""
    run = frames([(5.0 * k, 0.0) for k in range(12)])
    fine, coarse, expected, after = Accumulated(), Accumulated(), [], []
    for frame in run:
        fine.take(frame)
        expected.append(fine.points)
    monkeypatch.setattr("app.scene.map.MOST_POINTS", len(fine.points) // 4)
    for frame in run:
        coarse.take(frame)
        after.append(len(coarse.points))
        assert after[-1] <= len(fine.points) // 4
    cells = np.unique(np.floor(coarse.points.astype(np.float64) / coarse._side), axis=0)
    assert len(cells) >= 0.98 * len(coarse.points)  # float32 may round a point over a border
    distance, _ = cKDTree(coarse.points).query(fine.points)
    assert distance.max() <= np.sqrt(3.0) * coarse._side
    coarse.take(run[9])
    assert len(coarse.points) < after[-1]
    distance, _ = cKDTree(coarse.points).query(expected[9])
    assert distance.max() <= np.sqrt(3.0) * coarse._side


def test_a_time_window_has_the_points_of_the_last_seconds_also_after_a_step_back():
    second = 1_000_000_000
    run = [replace(make_frame(k, pose=Pose2(6.0 * k, 0.0, 0.0)), stamp_ns=k * second) for k in range(6)]
    gathered = Accumulated()
    shown = []
    for frame in run:
        gathered.take(frame)
        shown.append(gathered.points_of("last 3 s"))
    alone = Accumulated()
    for frame in run[2:]:
        alone.take(frame)
    np.testing.assert_array_equal(shown[5], alone.points)
    assert len(shown[5]) < len(gathered.points) == len(gathered.points_of("whole run"))
    gathered.take(run[4])
    np.testing.assert_array_equal(gathered.points_of("last 3 s"), shown[4])


def test_the_oldest_scans_leave_the_window_when_there_is_no_room(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.scene.map.MOST_RECENT", 1)
    gathered = Accumulated()
    for frame in frames([(0.0, 0.0), (9.0, 0.0)]):
        gathered.take(replace(frame, stamp_ns=frame.index * 500_000_000))
    assert 0 < len(gathered.points_of("last 10 s")) < len(gathered.points)


async def test_a_window_is_chosen_in_the_scene(scene: Scene):
    for index in range(4):
        frame = make_frame(index, pose=Pose2(6.0 * index, 0.0, 0.0))
        scene.show(replace(frame, stamp_ns=2_000_000_000 * index), PATH[: index + 1])
    scene.choose("gathered", True)
    whole = scene.counts["gathered"]
    scene.choose("accumulated", "last 1 s")
    assert 0 < scene.counts["gathered"] < whole
    assert len(node(scene, "/world/gathered/0").points) == scene.counts["gathered"]
    with pytest.raises(ParameterError):
        scene.choose("accumulated", "last 5 years")


async def test_the_accumulated_map_is_shown_when_it_is_asked_for(scene: Scene):
    scene.show(make_frame(0, pose=Pose2(0.0, 0.0, 0.0)), PATH[:1])
    assert scene.counts["gathered"] > 0
    assert scene._server.scene.get_handle_by_name("/world/gathered/0") is None
    scene.choose("gathered", True)
    block = node(scene, "/world/gathered/0")
    assert block.visible
    assert len(block.points) == scene.counts["gathered"] < BLOCK
    scene.show(make_frame(1, pose=Pose2(3.0, 0.0, 0.0)), PATH[:2])
    assert len(block.points) == scene.counts["gathered"]
    scene._renew()  # a scene that is built anew has what the old one had
    assert len(node(scene, "/world/gathered/0").points) == scene.counts["gathered"]
    scene.clear()
    assert scene.counts["gathered"] == 0


async def test_voxels_are_as_large_as_the_filter_has_them(scene: Scene):
    frame = make_frame(0)
    scene.show(frame, PATH[:1])
    assert scene.counts["voxels"] == 0
    scene.show_parameters(preset("forest").replace({"filters.voxel_size": 0.2}), "forest")
    scene.choose("voxels", True)
    boxes = node(scene, "/world/robot/scan/voxels")
    wanted = np.unique(np.floor(frame.filtered.astype(np.float64) / 0.2), axis=0)
    assert scene.counts["voxels"] == len(wanted)
    # The pose of the frame is the origin of the map.
    np.testing.assert_allclose(boxes.batched_positions, 0.2 * wanted + frame.sensor_offset, atol=1e-5)
    np.testing.assert_allclose(boxes.batched_scales, 0.2, atol=1e-6)
    scene.show_parameters(preset("forest").replace({"filters.voxel_size": 0.0}), "forest")
    scene.show(frame, PATH[:1])
    assert (scene.counts["voxels"], boxes.visible) == (0, False)


def truth_of(x: list[float], y: list[float], kind: tuple[str, ...]) -> TruthTrees:
    return TruthTrees(np.array(x), np.array(y), np.full(len(x), np.nan), kind)


def test_errors_are_offsets_missed_and_false_trees():
    trees = make_trees(4)
    trees = replace(trees, position=np.array([[0.0, 0.1], [5.0, 5.0], [3.0, 0.0], [90.0, 0.0]]))
    truth = truth_of([0.0, 2.0, 3.05, 200.0], [0.0, 7.0, 0.0, 0.0], ("tree", "tree", "pole", "tree"))
    offsets, missed, false = errors(trees, truth, PATH[:, :2], Evaluation(match_distance=0.5, reach=20.0))
    np.testing.assert_allclose(offsets, [[[0.0, 0.0], [0.0, 0.1]]])
    np.testing.assert_allclose(missed, [[2.0, 7.0]])  # the farthest is out of reach
    np.testing.assert_allclose(false, [[5.0, 5.0], [3.0, 0.0]])  # a pole that was taken for a tree is one too


def test_a_tree_that_the_ground_truth_calls_hidden_is_no_error():
    trees = make_trees(2)
    trees = replace(trees, position=np.array([[0.0, 0.1], [4.0, 0.0]]))
    truth = truth_of([0.0, 2.0], [0.0, 0.0], (HIDDEN, HIDDEN))
    offsets, missed, false = errors(trees, truth, PATH[:, :2], Evaluation(match_distance=0.5, reach=20.0))
    assert (len(offsets), len(missed)) == (0, 0)
    np.testing.assert_allclose(false, [[4.0, 0.0]])


async def test_errors_are_drawn_while_they_are_wanted(scene: Scene):
    frame = make_frame(0)
    scene.show_truth(truth_of([1.0], [1.0], ("tree",)))
    scene.show(frame, PATH)
    assert scene.counts["errors"] == 0
    scene.choose("errors", True)
    lines = node(scene, "/world/errors")
    assert lines.visible
    assert scene.counts["errors"] > 0
    assert lines.points.shape == lines.colors.shape
    scene.show_truth(None)
    scene.show(frame, PATH)
    assert (lines.visible, scene.counts["errors"]) == (False, 0)
