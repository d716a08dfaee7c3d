"""Pictures of trees: where they stand in a picture, which is chosen, and that damaged ones do no harm."""

from __future__ import annotations

import io
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from app.batch.tree_pictures import best_views, keep_pictures
from app.common.draw_picture import Drawing, draw, draw_safely
from pipeline.io.readers import open_source
from pipeline.io.readers.camera import nearest
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.io.recording.rendering import CAMERA, rendered, with_pictures
from pipeline.types.records import Path as Way
from pipeline.types.records import Trees, Truth, TruthTrees


def drawing(data: bytes, encoding: str = "", width: int = 0, height: int = 0, step: int = 0) -> Drawing:
    """A picture with a box."""
    return Drawing(encoding, width, height, step, data, (10.0, 10.0, 50.0, 90.0), "tree 7")


def trees_at(*places: tuple[float, float]) -> Trees:
    """Confirmed trees of 30 cm."""
    n = len(places)
    many = np.ones(n, np.int64)
    return Trees(
        np.arange(1, n + 1), np.array(places, np.float64).reshape(n, 2), np.tile(0.01 * np.eye(2), (n, 1, 1)),
        np.full(n, 0.3), np.full(n, 0.02), np.ones(n), many, np.ones(n), many, many,
        np.ones(n, np.bool_),
    )  # fmt: skip


def drive(metres: int) -> Way:
    """Along x, a metre a second."""
    n = metres + 1
    return Way(np.arange(n) * 10**9, np.arange(n, dtype=float), np.zeros(n), np.zeros(n), np.full(n, 0.01))


def test_a_tree_ahead_stands_in_the_middle_and_one_on_the_left_left_of_it():
    pixels, depth = CAMERA.project(
        np.array([[5.3, 0.0, 0.9], [5.3, 1.0, 0.9], [5.3, 0.0, 1.9], [-1.0, 0.0, 0.0]])
    )
    np.testing.assert_allclose(pixels[0], [CAMERA.width / 2, CAMERA.height / 2])
    assert pixels[1, 0] == pytest.approx(CAMERA.width / 2 - CAMERA.K[0, 0] / 5.0)
    assert pixels[2, 1] < pixels[0, 1]
    assert depth[3] < 0.0


def test_the_best_view_is_near_and_in_the_picture():
    views = best_views(CAMERA, trees_at((20.0, 1.0), (-5.0, 0.0)), drive(30), np.arange(31) * 10**9)
    assert [view.tree for view in views] == [1]  # the other was never ahead
    assert 13 <= views[0].stamp_ns // 10**9 <= 17
    left, top, right, bottom = views[0].box
    assert 0 < left < right < CAMERA.width / 2 + 1
    assert top < bottom


def test_the_box_is_drawn_around_the_stem_that_was_rendered(tmp_path: Path):
    truth = TruthTrees(np.array([5.0]), np.array([0.4]), np.array([0.3]), ("tree",))
    picture = np.asarray(Image.open(io.BytesIO(rendered(truth, (0.0, 0.0, 0.0)))).convert("RGB")).astype(int)
    brown = np.flatnonzero(np.abs(picture[150] - [104, 78, 52]).sum(axis=1) < 60)
    way = Way(np.zeros(1, np.int64), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1))
    left, _, right, _ = best_views(CAMERA, trees_at((5.0, 0.4)), way, np.zeros(1, np.int64))[0].box
    assert abs(brown[0] - left) < 4
    assert abs(brown[-1] - right) < 4


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a simulated robot with a camera."""
    source = open_source("sim:stand?duration=2")
    assert isinstance(source, SimulatedSource)
    known, path = source.description, tmp_path_factory.mktemp("camera") / "run.mcap"
    records = with_pictures(source.records(), source.run.scene.truth, source.run.true_path())
    write_recording(
        path, records, sensor=known.sensor, T_base_lidar=known.T_base_lidar, truth=Truth(), camera=CAMERA
    )
    return path


def test_a_recording_gives_a_picture_of_each_tree_that_was_in_view(recording: Path, tmp_path: Path):
    source = open_source(str(recording))
    assert isinstance(source, RosSource)
    found, why = source.camera()
    assert found is not None, why
    np.testing.assert_allclose(found.K, CAMERA.K)
    np.testing.assert_allclose(found.T_base_camera.t, CAMERA.T_base_camera.t, atol=1e-9)
    assert {topic.read_as for topic in source.description.topics if "camera" in topic.name} == {"camera"}
    start_ns = source.description.start_ns
    assert start_ns is not None
    way = Way(np.array([start_ns]), np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1))
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "tree_0099.jpg").touch()  # of an earlier run
    kept, told = keep_pictures(source, trees_at((4.0, 0.0), (6.0, 1.0), (-9.0, 0.0)), way, tmp_path)
    assert (kept, told) == (2, "")
    names = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    assert names == ["tree_0001.jpg", "tree_0002.jpg"]
    with Image.open(tmp_path / "pictures" / "tree_0001.jpg") as picture:
        assert picture.size == (CAMERA.width, CAMERA.height)
    source.close()


def test_the_nearest_pictures_are_taken_and_none_of_another_place():
    taken, there = nearest(np.array([0, 10**9, 2 * 10**9]), np.array([10**9 + 10**7, 5 * 10**9, 10**8]))
    assert taken.tolist() == [10**9, 2 * 10**9, 0]
    assert there.tolist() == [True, False, True]
    only_the_second = best_views(CAMERA, trees_at((20.0, 1.0)), drive(30), np.array([10 * 10**9]))
    assert [view.stamp_ns for view in only_the_second] == [10 * 10**9]
    assert best_views(CAMERA, trees_at((20.0, 1.0)), drive(30), np.zeros(0, np.int64)) == []


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "rgba8", "bgra8"])
def test_raw_pictures_of_usual_encodings_are_drawn(encoding: str):
    depth = {"mono8": 1, "rgba8": 4, "bgra8": 4}.get(encoding, 3)
    step = 64 * depth + 8
    drawn = draw(drawing(bytes(step * 48), encoding, 64, 48, step))
    assert Image.open(io.BytesIO(drawn)).size == (64, 48)


def bomb() -> bytes:
    """A PNG of a few bytes that claims 60,000 x 60,000 pixels."""
    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )


@pytest.mark.parametrize(
    "picture",
    [
        drawing(b"\xff\xd8\xff\xe0 no picture"),
        drawing(bomb()),
        drawing(bytes(32), "16UC1", 4, 4, 8),
        drawing(bytes(32), "rgb8", 4000, 4000, 12000),
    ],
)
def test_what_is_no_picture_is_refused(picture: Drawing):
    with pytest.raises(Exception, match=r".+"):
        draw(picture)


def test_the_reason_why_a_picture_cannot_be_drawn_is_printed(capfd):
    assert draw_safely(drawing(b"no picture")) is None
    assert "UnidentifiedImageError" in capfd.readouterr().err


def test_a_picture_for_which_there_is_too_little_memory_is_none(monkeypatch: pytest.MonkeyPatch):
    failure = """print('!["this needs more memory than this machine has","",""]')"""
    monkeypatch.setattr("app.common.draw_picture._COMMAND", (sys.executable, "-c", failure))
    assert draw_safely(drawing(b"")) is None
