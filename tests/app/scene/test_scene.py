"""What reaches viser when a frame is shown."""

from __future__ import annotations

import contextlib
import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.scene import Scene
from app.scene import scene as scene_module
from app.scene.nodes import MOST_LABELS
from pipeline.geometry.poses import Pose2
from pipeline.types.records import TruthTrees
from tests.app.scene.frames import make_frame, make_trees, texts_of
from tests.app.scene.recorder import buffered

PATH = np.column_stack([0.05 * np.arange(1000), np.zeros(1000)] * 2)


def node(scene: Scene, name: str):
    handle = scene._server.scene.get_handle_by_name(name)
    assert handle is not None, name
    return handle


def test_the_first_frame_makes_the_nodes(scene: Scene):
    frame = make_frame(3)
    scene.show(frame, PATH[:4])
    raw = node(scene, "/world/robot/scan/raw")
    assert raw.points.shape == frame.raw.shape
    assert raw.points.dtype == np.float32
    assert node(scene, "/world/particles").points.dtype == np.float32
    assert len(node(scene, "/world/trees").batched_positions) == len(frame.trees.number)
    assert len(node(scene, "/world/robot/scan/fits").batched_positions) == len(frame.detections.cluster)


def test_everything_of_a_scan_is_content_in_the_frame_of_the_map(scene: Scene):
    """A browser draws a new pose of a node before new content, so only the world as a whole has a pose."""
    pose = Pose2(3.0, -2.0, 0.7)
    frame = dataclasses.replace(make_frame(1, pose=pose), base_z=0.4)
    scene.show(frame, PATH[:2])
    base = frame.raw + frame.sensor_offset
    wanted = np.column_stack([pose.apply(base[:, :2]), base[:, 2] + 0.4])
    np.testing.assert_allclose(node(scene, "/world/robot/scan/raw").points, wanted, atol=1e-5)
    rows = frame.detections.cluster
    centres = pose.apply(frame.clusters.centre[rows] + frame.sensor_offset[:2])
    fits = node(scene, "/world/robot/scan/fits").batched_positions
    np.testing.assert_allclose(fits[:, :2], centres, atol=1e-5)
    body = node(scene, "/world/robot/body").vertices
    np.testing.assert_allclose(body.mean(axis=0), [3.0, -2.0, 0.64], atol=1e-5)
    np.testing.assert_allclose(node(scene, "/world").position, [-pose.x, -pose.y, -0.4])
    moved = {name for name in buffered(scene) if name.startswith(("SetPosition", "SetOrientation"))}
    posed = {name.split(" ")[1] for name in moved}
    assert {name for name in posed if not name.startswith(("/world/labels", "/world/numbers"))} == {
        "",
        "/world",
    }


def test_a_later_frame_adds_no_node(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    scene.show(make_frame(1), PATH[:2])
    nodes = others_than_labels(scene)
    for index in range(2, 12):
        scene.show(make_frame(index), PATH[: index + 1])
    assert others_than_labels(scene) == nodes


def others_than_labels(scene: Scene) -> set[str]:
    """The nodes except the labels, of which a bounded number is added as they are needed."""
    return {name for name in scene._server.scene._handle_from_node_name if "/labels/" not in name}


def test_a_frame_costs_few_messages(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    before = scene.messages
    for index in range(1, 21):
        scene.show(make_frame(index), PATH[: index + 1])
    assert (scene.messages - before) / 20 < 30  # two million last for more than an hour and a half


def test_the_same_frame_twice_sends_nothing(scene: Scene):
    frame = make_frame(5)
    scene.show(frame, PATH[:6])
    before = scene.messages
    scene.show(frame, PATH[:6])
    assert scene.messages == before


def test_a_thousand_trees_are_one_mesh(scene: Scene):
    scene.show(make_frame(0, trees=1000), PATH[:1])
    trees = node(scene, "/world/trees")
    assert trees.batched_positions.shape == (1000, 3)
    assert trees.batched_colors.shape == (1000, 3)
    dbh = make_trees(1000).dbh
    known = np.isfinite(dbh)
    np.testing.assert_allclose(trees.batched_scales[known, 0], 0.5 * dbh[known], atol=0.001)
    labels = [
        name for name in scene._server.scene._handle_from_node_name if name.startswith("/world/numbers/")
    ]
    assert len(labels) <= MOST_LABELS


def test_trees_that_are_not_confirmed_are_not_shown(scene: Scene):
    trees = make_trees(9)
    frame = dataclasses.replace(
        make_frame(0), trees=dataclasses.replace(trees, confirmed=np.arange(9) % 3 == 0)
    )
    scene.show(frame, PATH[:1])
    assert len(node(scene, "/world/trees").batched_positions) == 3


def test_points_are_coloured_by_intensity_where_the_source_has_it(scene: Scene):
    frame = make_frame(2, clusters=5)
    bright = np.linspace(0.0, 255.0, len(frame.raw)).astype(np.uint8)
    scene.choose("colour_by", "intensity")
    scene.show(frame, PATH[:3], bright)
    found = node(scene, "/world/robot/scan/raw").colors.astype(int)
    assert found[0, 2] > found[-1, 2]  # from violet
    assert found[0, 0] < found[-1, 0]  # to yellow
    scene.show(frame, PATH[:3])
    assert len(np.unique(node(scene, "/world/robot/scan/raw").colors, axis=0)) == 1


def test_colours_are_as_many_as_points(scene: Scene):
    for name in ("verdict", "stage", "cluster", "height", "intensity", "eccentricity"):
        scene.choose("colour_by", name)
        scene.show(make_frame(2, clusters=5), PATH[:3])
        for cloud in ("raw", "filtered", "clusters"):
            handle = node(scene, f"/world/robot/scan/{cloud}")
            assert handle.colors.shape == handle.points.shape, (name, cloud)


def test_a_scan_without_points_or_clusters_is_shown(scene: Scene):
    full = make_frame(0)
    empty = dataclasses.replace(
        make_frame(1, clusters=0, trees=0),
        raw=np.zeros((0, 3), dtype=np.float32),
        filtered=np.zeros((0, 3), dtype=np.float32),
        labels=np.zeros(0, dtype=np.int32),
    )
    for frame in (empty, full, empty):
        scene.show(frame, PATH[:1])
    assert not node(scene, "/world/robot/scan/raw").visible
    assert not node(scene, "/world/trees").visible
    scene.show(full, PATH[:1])
    assert node(scene, "/world/robot/scan/raw").visible


def test_a_hidden_layer_sends_nothing_and_comes_back_with_the_newest_scan(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    scene.choose("raw", False)
    raw = node(scene, "/world/robot/scan/raw")
    old = raw.points.copy()
    frame = make_frame(1)
    scene.show(frame, PATH[:2])
    np.testing.assert_array_equal(raw.points, old)
    scene.choose("raw", True)
    assert len(raw.points) == len(frame.raw)
    assert not np.array_equal(raw.points, old)
    assert raw.visible


def test_the_picture_stays_where_it_is_when_following_ends(scene: Scene):
    scene.show(make_frame(0, pose=Pose2(4.0, 1.0, 0.0)), PATH[:1])
    scene.choose("follow", False)
    scene.show(make_frame(1, pose=Pose2(6.0, 1.0, 0.0)), PATH[:2])
    np.testing.assert_allclose(node(scene, "/world").position, [-4.0, -1.0, 0.0])


def test_selection_is_marked_and_named(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    place = scene.select(7)
    trees = make_frame(0).trees
    row = trees.number.tolist().index(7)
    foot = node(scene, "/world/trees").batched_positions[row, 2]
    assert place == pytest.approx([*trees.position[row], foot], abs=0.05 + 1e-6)
    assert scene.select(999) is None
    assert scene.select(7, (1.0, 2.0, 0.3)) == pytest.approx((1.0, 2.0, 0.0))
    scene.select(7)
    assert node(scene, "/world/selection").visible
    assert any(text.startswith("tree 7, DBH") for text in texts_of(scene._map._labels))
    scene.select(None)
    assert not node(scene, "/world/selection").visible
    assert not any(text.startswith("tree") for text in texts_of(scene._map._labels))


def test_a_click_or_a_look_around_sends_no_points(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    scene.show(make_frame(0), PATH[:1])
    touched: list[str] = []
    handle = type(node(scene, "/world/robot/scan/raw"))
    queue = handle._queue_update

    def remember(self: Any, name: str, value: Any) -> None:
        touched.append(name)
        queue(self, name, value)

    monkeypatch.setattr(handle, "_queue_update", remember)
    scene.choose("follow", False)
    scene.select(7)
    assert touched == []
    scene.choose("colour_by", "height")
    assert "points" not in touched
    assert "colors" in touched


def test_truth_comes_and_goes(scene: Scene):
    truth = TruthTrees(
        x=np.array([1.0, 2.0]), y=np.zeros(2), dbh=np.array([0.3, np.nan]), kind=("tree", "pole")
    )
    scene.show_truth(truth)
    rings = node(scene, "/world/truth")
    assert rings.visible
    assert rings.points.shape == (64, 2, 3)
    reach = np.linalg.norm(rings.points[:32, 0, :2] - [1.0, 0.0], axis=1)
    np.testing.assert_allclose(reach, 0.15 + 0.12, atol=1e-6)
    scene.show_truth(None)
    assert not rings.visible


def test_clear_forgets_the_run_and_keeps_the_panel(scene: Scene):
    scene.show(make_frame(0), PATH[:1])
    widgets = len(scene._server.gui._gui_input_handle_from_uuid)
    scene.clear()
    assert not node(scene, "/world/trees").visible
    assert len(scene._server.gui._gui_input_handle_from_uuid) == widgets
    scene.show(make_frame(1), PATH[:1])
    assert node(scene, "/world/trees").visible


def test_a_run_that_never_moves_is_not_shown_in_the_last_runs_frame(scene: Scene):
    scene.show(make_frame(0, pose=Pose2(3.0, -2.0, 1.3)), PATH[:1])
    scene.clear()
    scene.show(make_frame(0, pose=Pose2()), PATH[:1])
    sent = buffered(scene)  # a browser that had the last run still has its poses: unsaid is not the origin
    np.testing.assert_allclose(sent["SetOrientationMessage /world"].wxyz, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(sent["SetPositionMessage /world"].position, 0.0, atol=1e-12)


def test_the_server_is_renewed_before_message_numbers_hurt(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    scene.show(make_frame(0), PATH[:1])
    scene.select(3)
    old = scene.port
    monkeypatch.setattr(scene_module, "RENEW_AFTER", 10)
    scene.show(make_frame(1), PATH[:2])
    assert scene.port != old
    assert node(scene, "/world/selection").visible
    assert len(node(scene, "/world/trees").batched_positions) == 25


def test_the_path_by_odometry_begins_with_the_path_in_its_direction(scene: Scene):
    scene.choose("odometry", True)
    drifted = np.column_stack([PATH[:, :2], 7.0 - PATH[:, 1], 3.0 + 1.1 * PATH[:, 0]])  # along y
    drifted[500:, 2:] = np.nan  # unknown
    for rows in (40, 600):
        scene.show(make_frame(rows), drifted[:rows])
        places = drifted[: min(rows, 500), :2] * [1.1, 1.0]
        chunks = range(len(places) // 200 + 1)
        segments = np.concatenate([node(scene, f"/world/odometry/{k}").points for k in chunks])
        np.testing.assert_allclose(segments[:, 1, :2], places[1:], atol=1e-5)


def test_a_long_path_by_odometry_is_thinned_before_it_is_moved(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    """The path of a day has 864,000 rows, and it is drawn ten times a second."""
    monkeypatch.setattr("app.scene.robot.MOST_POINTS", 100)
    moved: list[int] = []
    apply = Pose2.apply

    def counted(pose: Pose2, places: np.ndarray) -> np.ndarray:
        moved.append(len(places))
        return apply(pose, places)

    monkeypatch.setattr(Pose2, "apply", counted)
    scene.choose("odometry", True)
    scene.show(make_frame(999), PATH)
    assert 64 in moved
    assert len(PATH) not in moved
    np.testing.assert_allclose(node(scene, "/world/odometry/0").points[0, :, 0], PATH[[0, 16], 0], atol=1e-6)


def test_cameras_return_to_the_robot_after_a_large_cloud(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    camera = SimpleNamespace()
    client = SimpleNamespace(atomic=contextlib.nullcontext, camera=camera)
    monkeypatch.setattr(scene._server, "get_clients", lambda: {0: client})
    scene._follower.frame_plot(240.0)
    np.testing.assert_allclose(camera.position, 20.0 * np.array(scene_module.BEHIND))
    scene.clear()
    scene.show(make_frame(1), PATH[:2])
    np.testing.assert_allclose(camera.position, scene_module.BEHIND)
    np.testing.assert_allclose(scene._server.initial_camera.position, scene_module.BEHIND)
