"""The camera's picture of a scan: the one of its time, with trees and clusters where they stand in it."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app.dashboard.camera_view import drawn_tree, marks_of
from app.dashboard.dashboard import Dashboard
from app.worker.process import new_session
from app.worker.protocol import (
    Answer,
    AskCamera,
    AskTreePicture,
    CameraPicture,
    Open,
    Shown,
    ToWorker,
    from_worker,
)
from app.worker.session import camera_picture, has_camera, tree_picture
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import open_source
from pipeline.io.readers.camera import SHOWN_NS
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.io.recording.rendering import CAMERA, rendered, with_pictures
from pipeline.types.camera import Picture
from pipeline.types.records import Frame, Truth, TruthTrees
from tests.app.batch.test_tree_pictures import bomb, trees_at
from tests.app.fakes import FakeWorker, frame, opened, path
from tests.app.server_for_tests import Running


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosSource]:
    """Two seconds of a simulated robot with two pictures a second."""
    run = open_source("sim:stand?duration=2")
    assert isinstance(run, SimulatedSource)
    known, place = run.description, tmp_path_factory.mktemp("camera") / "run.mcap"
    records = with_pictures(run.records(), run.run.scene.truth, run.run.true_path())
    write_recording(
        place, records, sensor=known.sensor, T_base_lidar=known.T_base_lidar, truth=Truth(), camera=CAMERA
    )
    opened_again = open_source(str(place))
    assert isinstance(opened_again, RosSource)
    yield opened_again
    opened_again.close()


def current(*trees: tuple[float, float]) -> Frame:
    """A scan at (2, 1) of the map, looking along x, with a cluster 4 m ahead and trees in the base frame."""
    seen = frame(3, 5_200_000_000)
    pose = replace(seen.estimate, T_map_base=Pose2(2.0, 1.0, 0.0))
    places = [(2.0 + x, 1.0 + y) for x, y in trees]
    points = np.array([[4.0, 0.1, 0.2], [4.0, -0.1, 0.9], [9.0, 3.0, 0.0]], np.float32)
    return replace(
        seen, estimate=pose, trees=trees_at(*places), filtered=points,
        labels=np.array([0, 0, -1], np.int32), sensor_offset=np.array([0.0, 0.0, 0.5]),
    )  # fmt: skip


def test_marks_stand_where_the_things_are():
    marks = marks_of(current((5.0, 0.0), (8.0, 1.0), (-5.0, 0.0), (5.0, 40.0)), CAMERA, Pose2())
    cluster, far, near = marks  # trees lie on top, the nearest last
    assert [(mark["kind"], mark["number"]) for mark in marks] == [("cluster", 0), ("tree", 2), ("tree", 1)]
    assert near["left"] + near["width"] / 2 == pytest.approx(0.5, abs=1e-3)
    assert near["width"] == pytest.approx(2.0 * far["width"], rel=0.6)
    assert far["left"] < near["left"], "what stands on the left is seen on the left"
    told, _ = CAMERA.project(np.array([[4.0, 0.1, 0.7], [4.0, -0.1, 1.4]]))
    assert cluster["left"] == pytest.approx(told[0, 0] / CAMERA.width, abs=1e-3)
    assert cluster["top"] == pytest.approx(told[1, 1] / CAMERA.height, abs=1e-3)
    assert cluster["width"] * CAMERA.width == pytest.approx(told[1, 0] - told[0, 0], abs=0.2)
    for mark in marks:
        assert mark["left"] >= 0.0
        assert mark["left"] + mark["width"] <= 1.0 + 1e-4


def test_the_box_of_a_tree_is_on_the_stem_that_was_rendered():
    truth = TruthTrees(np.array([5.0]), np.array([0.4]), np.array([0.3]), ("tree",))
    picture = np.asarray(Image.open(io.BytesIO(rendered(truth, (0.0, 0.0, 0.0)))).convert("RGB")).astype(int)
    brown = np.flatnonzero(np.abs(picture[150] - [104, 78, 52]).sum(axis=1) < 60)
    mark = next(m for m in marks_of(current((5.0, 0.4)), CAMERA, Pose2()) if m["kind"] == "tree")
    assert abs(brown[0] - mark["left"] * CAMERA.width) < 4
    assert abs(brown[-1] - (mark["left"] + mark["width"]) * CAMERA.width) < 4


def test_marks_stand_as_seen_from_where_the_robot_was_when_the_picture_was_taken():
    moved = Pose2(-0.5, 0.1, 0.2)
    there = current((5.0, 0.0), (8.0, 1.0))
    # The same trees and points, told from the place of the picture.
    pose = there.estimate.T_map_base @ moved
    points = there.filtered.astype(np.float64) + there.sensor_offset
    points[:, :2] = moved.inverse().apply(points[:, :2])
    here = replace(
        there, estimate=replace(there.estimate, T_map_base=pose),
        filtered=(points - there.sensor_offset).astype(np.float32),
    )  # fmt: skip
    seen, wanted = marks_of(there, CAMERA, moved), marks_of(here, CAMERA, Pose2())
    assert [mark["number"] for mark in seen] == [mark["number"] for mark in wanted] == [0, 2, 1]
    for mark, same in zip(seen, wanted, strict=True):
        for side in ("left", "top", "width", "height", "distance_m"):
            assert mark[side] == pytest.approx(same[side], abs=2e-4)


def test_the_picture_nearest_to_a_scan_is_found_within_a_second(source: RosSource):
    assert has_camera(source.description)
    stamps = source.picture_stamps()
    for stamp_ns in stamps:
        for off_ns in (-240_000_000, -100_000_000, 0, 100_000_000, 240_000_000):
            found = camera_picture(source, stamp_ns + off_ns)
            assert found.picture.stamp_ns == stamp_ns
            assert found.camera is not None
    assert source.picture_near(stamps[0] + 240_000_000) is None, "of no other place where trees get pictures"
    for edge_ns, beyond_ns in ((stamps[0] - SHOWN_NS, -1), (stamps[-1] + SHOWN_NS, 1)):
        assert camera_picture(source, edge_ns).picture.stamp_ns in (stamps[0], stamps[-1])
        with pytest.raises(StemmapError, match="no picture was taken within 1 s"):
            camera_picture(source, edge_ns + beyond_ns)
    with pytest.raises(StemmapError, match="no camera"):
        camera_picture(None, stamps[0])
    with pytest.raises(StemmapError, match="no camera"):
        camera_picture(open_source("sim:stand?duration=1"), stamps[0])


def test_looking_at_pictures_does_not_disturb_the_reading(source: RosSource):
    plain = [record.stamp_ns for record in source.records()]
    mixed = []
    for record in source.records():
        mixed.append(record.stamp_ns)
        source.picture_near(record.stamp_ns)
    assert mixed == plain


def test_a_picture_travels_between_the_processes(source: RosSource):
    answer = Answer(7, camera=camera_picture(source, source.picture_stamps()[0]))
    channel = from_worker()
    back = channel.decode(channel.encode(answer)[4:])
    assert isinstance(back, Answer)
    assert back.camera is not None
    assert answer.camera is not None
    assert back.camera.picture == answer.camera.picture or (
        back.camera.picture.data == answer.camera.picture.data
    )
    assert back.camera.camera is not None
    np.testing.assert_array_equal(back.camera.camera.K, CAMERA.K)


@pytest.mark.slow
def test_the_best_picture_of_a_tree_is_one_that_shows_it(source: RosSource):
    session = new_session()
    session.open(Open(source.description.uri, "auto", 3))
    session.play()
    while session.pace == "replay":
        session.work()
    run, frame_ = session.run, session.shown.frame
    assert run is not None
    assert frame_ is not None
    shown = 0
    for row in np.flatnonzero(frame_.trees.confirmed):
        number = int(frame_.trees.number[row])
        try:
            found = tree_picture(run, number)
        except StemmapError:
            continue
        shown += 1
        content = drawn_tree(found, number, frame_.trees, run.path)
        assert content is not None
        picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
        assert picture.shape[1] < CAMERA.width  # a part of it
        yellow = np.flatnonzero((np.abs(picture - [255, 208, 0]).sum(axis=2) < 120).sum(axis=0) > 20)
        brown = np.abs(picture - [104, 78, 52]).sum(axis=2) < 60
        inside = brown[:, yellow[0] : yellow[-1]].mean()
        assert inside > 0.2, f"tree {number} is not in its frame"
    assert shown > 3
    with pytest.raises(StemmapError, match="no picture shows tree 999"):
        tree_picture(run, 999)
    session.close()
    with pytest.raises(StemmapError, match="nothing is mapped"):
        tree_picture(None, 1)


async def test_the_page_asks_for_the_picture_of_a_tree(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/camera/tree/1.jpg")).status_code == 409
    await dashboard.receive(opened())
    await dashboard.receive(Shown(1, 0.2, current((5.0, 0.0)), 0, path([0.0, 0.5, 1.0])))
    stamp_ns = dashboard.path.stamp_ns[-1] if dashboard.path is not None else 0
    raw = Picture(int(stamp_ns), "rgb8", CAMERA.width, CAMERA.height, CAMERA.width * 3, bytes(3 * 640 * 480))
    answering(dashboard, CameraPicture(raw, CAMERA, ""), "no picture shows tree 2")
    jpeg = await client.get("/api/camera/tree/1.jpg")
    assert jpeg.headers["content-type"] == "image/jpeg"
    width, height = Image.open(io.BytesIO(jpeg.content)).size
    assert 0 < width < CAMERA.width
    assert 0 < height <= CAMERA.height
    missing = await client.get("/api/camera/tree/2.jpg")
    assert (missing.status_code, missing.content) == (204, b"")


def answering(dashboard: Dashboard, *pictures: CameraPicture | str) -> list[int]:
    """The worker answers with these, one after the other; gives what it was asked for."""
    worker, left, asked = dashboard.worker, list(pictures), list[int]()
    assert isinstance(worker, FakeWorker)
    send = worker.send

    async def answer(command: ToWorker, /) -> None:
        await send(command)
        if isinstance(command, AskCamera | AskTreePicture):
            asked.append(command.stamp_ns if isinstance(command, AskCamera) else command.tree)
            told = left.pop(0)
            told_of: dict[str, Any] = {"missing": told} if isinstance(told, str) else {"camera": told}
            await dashboard.receive(Answer(command.ticket, **told_of))

    worker.send = answer  # type: ignore[method-assign, assignment]
    return asked


async def test_the_page_asks_for_the_picture_and_its_marks(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/camera")).status_code == 409
    await dashboard.receive(opened())
    await dashboard.receive(Shown(1, 0.2, current((5.0, 0.0)), 0, path([0.0, 0.5, 1.0])))
    raw = Picture(5_250_000_000, "rgb8", 1920, 1080, 1920 * 3, bytes(1920 * 1080 * 3))
    damaged = Picture(5_260_000_000, "", 0, 0, 0, bomb())
    lost = CameraPicture(replace(raw, stamp_ns=5_270_000_000), None, "no CameraInfo")
    asked = answering(
        dashboard,
        CameraPicture(raw, CAMERA, ""),
        CameraPicture(damaged, CAMERA, ""),
        lost,
        "no picture",
        lost,
        lost,
    )
    seen = (await client.get("/api/camera")).json()
    assert asked == [5_200_000_000]
    assert (seen["index"], seen["stamp_ns"], seen["later_ms"], seen["why"]) == (3, "5250000000", 50, "")
    assert {mark["kind"] for mark in seen["marks"]} == {"tree", "cluster"}
    jpeg = await client.get("/api/camera/5250000000.jpg")
    assert jpeg.headers["content-type"] == "image/jpeg"
    assert Image.open(io.BytesIO(jpeg.content)).size == (960, 540)
    bad = await client.get("/api/camera")
    assert bad.status_code == 404
    assert "cannot be decoded" in bad.text
    assert (await client.get("/api/camera/5260000000.jpg")).status_code == 404
    unplaced = (await client.get("/api/camera")).json()
    assert (unplaced["marks"], unplaced["why"]) == ([], "no CameraInfo")
    assert "no picture" in (await client.get("/api/camera")).text
    dashboard.camera.forget()
    assert (await client.get("/api/camera/5250000000.jpg")).status_code == 404
    # Another run may have a picture of the same time.
    assert (await client.get("/api/camera")).json()["of"] != unplaced["of"]
    camera = dashboard.worker_client.camera

    async def left_meanwhile(stamp_ns: int) -> CameraPicture:
        found = await camera(stamp_ns)
        dashboard.camera.forget()
        return found

    dashboard.worker_client.camera = left_meanwhile  # type: ignore[method-assign]
    assert "another run was opened" in (await client.get("/api/camera")).text
    assert (await client.get("/api/camera/5270000000.jpg")).status_code == 404
