"""Pictures of a live robot: beside the scan, bounded, put aside for trees, recorded; no part of the map."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.batch.tree_pictures import keep_pictures
from app.robot.link import (
    LARGEST_PICTURE,
    MAX_PICTURE_BYTES,
    MAX_PICTURES,
    PICTURE_PAUSE_NS,
    PICTURES_SKIPPED,
    PICTURES_TOO_LARGE,
    Inbox,
)
from app.robot.recorder import Recorder
from app.robot.source import LiveSource, PictureStore
from app.robot.topics import PICTURE_TYPES, Publisher, choose
from app.sources.live_address import parse_address
from app.worker.session import camera_picture, has_camera
from pipeline.errors import StemmapError
from pipeline.geometry.file_arrays import SPARE_BYTES
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.camera import SHOWN_NS
from pipeline.io.readers.container import Message
from pipeline.io.readers.live import LiveRecording
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.ros import RosSource
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.io.readers.topics import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.io.recording.rendering import CAMERA, with_pictures
from pipeline.types.camera import Picture
from pipeline.types.records import Path as Way
from pipeline.types.records import Record, Scan, Truth
from tests.app.batch.test_tree_pictures import trees_at
from tests.app.robot.conftest import Robot, listening, until
from tests.app.robot.test_live_session import FakeLink

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of a robot with a camera, two pictures a second."""
    place = tmp_path_factory.mktemp("camera") / "run.mcap"
    with closing(open_source("sim:stand?duration=3&seed=5")) as source:
        assert isinstance(source, SimulatedSource)
        known = source.description
        records = with_pictures(source.records(), source.run.scene.truth, source.run.true_path())
        write_recording(
            place, records, sensor=known.sensor, T_base_lidar=known.T_base_lidar, truth=Truth(), camera=CAMERA
        )
    return place


class Heard:
    """A live source that gets the messages of a file, and what became of them."""

    def __init__(self, run: Path, recording: Recorder | None = None, address: str = "") -> None:
        uri = f"zenoh:tcp/robot:7447{address}"
        self.source = LiveSource(parse_address(uri), SourceOptions(), self._link)
        self.source.start(recording)
        self.records: list[Record] = []
        with closing(McapFile(run)) as container:
            topics = {c.number: c for c in container.channels}
            self.link.there = [Publisher("", c.topic, c.msgtype) for c in topics.values()]
            until(lambda: self.source.listen() or self.link.channels)
            numbers = {channel.topic: channel.number for channel in self.link.channels}
            for message in container.messages(list(topics), None, {}):
                channel = topics[message.channel]
                if channel.topic in numbers:
                    sent = Message(numbers[channel.topic], message.log_ns, message.payload)
                    self._send(sent, channel.msgtype)
        self.source.stop()
        self.records.extend(self.source.records())

    def _link(self, address: Any, inbox: Inbox) -> FakeLink:
        self.link = FakeLink(address, inbox)
        self.link.losses = {}
        return self.link

    def _send(self, message: Message, msgtype: str) -> None:
        if msgtype not in PICTURE_TYPES:
            self.link.inbox.put(message, is_scan=msgtype == POINT_CLOUD)
        elif self.link.inbox.wants_picture(message.log_ns, len(message.payload)):
            self.link.inbox.put_picture(message)
        self.records.extend(self.source.take())


def told(records: list[Record]) -> list[tuple[str, int]]:
    return [(type(record).__name__, record.stamp_ns) for record in records]


def test_the_picture_beside_a_live_scan_is_that_of_its_recordings(run: Path, tmp_path: Path):
    recording = Recorder(tmp_path / "live.mcap")
    with closing(Heard(run, recording).source) as live, closing(open_source(str(run))) as plain:
        assert has_camera(live.description)
        assert isinstance(plain, RosSource)
        stamps = plain.picture_stamps()
        assert len(stamps) > 4
        for stamp_ns in stamps:
            found = camera_picture(live, stamp_ns + 40_000_000)
            wanted = plain.picture_near(stamp_ns)
            assert wanted is not None
            assert found.camera is not None
            assert (found.picture.stamp_ns, found.picture.data) == (stamp_ns, wanted.data)
            np.testing.assert_allclose(found.camera.K, CAMERA.K)
            np.testing.assert_allclose(found.camera.T_base_camera.t, CAMERA.T_base_camera.t)
            assert found.received.startswith(f"of {len(stamps)} pictures {len(stamps)} were taken in")
        with pytest.raises(StemmapError, match="no picture was taken"):
            camera_picture(live, stamps[-1] + SHOWN_NS + 1)
        assert camera_picture(live, stamps[-1] + SHOWN_NS).picture.stamp_ns == stamps[-1]
        assert live.picture_near(stamps[-1] + SHOWN_NS) is None
    with closing(open_source(str(recording.path))) as replay:
        assert isinstance(replay, LiveRecording)
        assert has_camera(replay.description)
        assert replay.picture_stamps() == stamps
        again = camera_picture(replay, stamps[1])
        assert again.camera is not None
        assert again.picture.data == next(replay.pictures({stamps[1]})).data
        assert again.received == ""


def test_the_map_is_made_of_the_same_with_pictures_and_without(run: Path):
    with_camera, without = Heard(run), Heard(run, address="?camera=none")
    assert told(with_camera.records) == told(without.records)
    assert sum(isinstance(record, Scan) for record in without.records) == 30
    assert not has_camera(without.source.description)
    assert without.source.camera() == (None, "")
    for each in (with_camera, without):
        each.source.close()


class RunFigures:
    """What `mapped` needs of a frame."""

    def __init__(self, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns


def way(stamps: list[int]) -> Way:
    """Half a metre along x between two times."""
    n = len(stamps)
    x = np.arange(n, dtype=np.float64) / 2.0
    return Way(np.array(stamps, np.int64), x, np.zeros(n), np.zeros(n), np.full(n, 0.01))


def test_each_tree_gets_a_picture_of_those_that_were_put_aside(run: Path, tmp_path: Path):
    heard = Heard(run)
    with closing(heard.source) as live, closing(open_source(str(run))) as plain:
        assert isinstance(plain, RosSource)
        stamps = plain.picture_stamps()
        assert keep_pictures(live, trees_at((5.0, 0.0)), way(stamps), tmp_path) == (0, "")
        live.keep_pictures()
        for k in range(1, len(stamps) + 1):
            frame: Any = RunFigures(stamps[k - 1])
            live.mapped(frame, way(stamps[:k]))
        assert live.picture_stamps() == stamps[::2], "one a metre"
        kept, problem = keep_pictures(live, trees_at((5.0, 0.0), (-9.0, 0.0)), way(stamps), tmp_path)
        assert (kept, problem) == (1, "")
        assert (tmp_path / "pictures" / "tree_0001.jpg").read_bytes().startswith(b"\xff\xd8")


def test_what_is_put_aside_is_bounded_and_counted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.robot.source.MOST_BYTES", 2500)
    data = [np.random.default_rng(k).bytes(1000) for k in range(5)]
    with closing(PictureStore()) as kept:
        for k in range(1, 5):
            assert kept.is_due(way(list(range(1, 3 * k))))
            kept.add(Picture(k, "", 0, 0, 0, data[k]), way(list(range(1, 3 * k))))
        assert kept.stamps() == [1, 2]
        ((reason, number),) = kept.losses.items()
        assert ("the limit of" in reason, number) == (True, 2)
        assert [picture.data for picture in kept.at({2, 3})] == [data[2]]


def test_the_disk_keeps_its_reserve(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pipeline.io.block_file.free_space", lambda _: SPARE_BYTES - 1)
    with closing(PictureStore()) as kept:
        kept.add(Picture(1, "", 0, 0, 0, bytes(10)), way([1]))
        assert kept.stamps() == []
        assert list(kept.losses) == [
            "pictures not stored for trees: less than 2 GB of the disk would be left"
        ]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk here that is always full")
def test_a_full_disk_costs_pictures_and_nothing_else(monkeypatch: pytest.MonkeyPatch):
    def full(**_how: Any) -> Any:
        return Path("/dev/full").open("w+b", buffering=0)

    monkeypatch.setattr("pipeline.geometry.file_arrays.TemporaryFile", full)
    with closing(PictureStore()) as kept:
        kept.add(Picture(1, "", 0, 0, 0, bytes(10)), way([1]))
        assert list(kept.losses) == ["pictures not stored for trees: No space left on device"]
        assert list(kept.at(kept.stamps())) == []


def message(size: int, log_ns: int = 0) -> Message:
    return Message(9, log_ns, bytes(size))


def test_pictures_take_no_room_of_scans_and_are_counted():
    inbox = Inbox()
    inbox.put(message(10), is_scan=True)
    at_30_hz = [inbox.wants_picture(k * SECOND // 30, 100) for k in range(90)]
    assert sum(at_30_hz) == pytest.approx(3 * SECOND / PICTURE_PAUSE_NS, abs=2)
    assert not inbox.wants_picture(9 * SECOND, LARGEST_PICTURE + 1)
    assert (inbox.pictures_arrived, inbox.pictures_accepted) == (91, sum(at_30_hz))
    for k in range(MAX_PICTURES + 3):
        inbox.put_picture(message(100, k))
    assert inbox.losses == {PICTURES_TOO_LARGE: 1, PICTURES_SKIPPED: 3}
    for _ in range(5):
        inbox.put_picture(message(MAX_PICTURE_BYTES // 4))
    taken = []
    while (found := inbox.take()) is not None:
        taken.append(len(found.payload))
    assert taken == [10] + [MAX_PICTURE_BYTES // 4] * 4


@pytest.mark.parametrize(
    ("topics", "wanted"),
    [
        ({}, ["/red/camera/color/image/compressed", "/red/camera/color/camera_info"]),
        ({"camera": "/red/camera/depth/image"}, ["/red/camera/depth/image", "/red/camera/depth/camera_info"]),
        ({"camera": "none"}, []),
    ],
)
def test_the_camera_is_the_one_that_shows_the_scene(topics: dict[str, str], wanted: list[str]):
    kinds = {
        "points": POINT_CLOUD,
        "camera/depth/image": IMAGE,
        "camera/depth/camera_info": CAMERA_INFO,
        "camera/color/image": IMAGE,
        "camera/color/image/compressed": COMPRESSED_IMAGE,
        "camera/color/image/compressedDepth": COMPRESSED_IMAGE,
        "camera/color/camera_info": CAMERA_INFO,
    }
    found = choose([Publisher("red", f"/red/{name}", kind) for name, kind in kinds.items()], "", topics, "")
    assert found is not None
    assert [channel.topic for channel in found.camera] == wanted
    assert [channel.number for channel in (*found.channels, *found.camera)] == list(range(1, 2 + len(wanted)))


@pytest.mark.slow
def test_the_pictures_of_an_independent_robot_are_seen(router: int, run: Path):
    pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk, the independent robot, is not installed")
    robot = Robot(router, run, "red")
    try:
        with closing(listening(f"zenoh:tcp/127.0.0.1:{router}")) as source:
            until(lambda: source.listen() or "announced and silent" in source.waiting_for())
            robot.send()
            scans: list[Scan] = []

            def seen() -> bool:
                scans.extend(record for record in source.take() if isinstance(record, Scan))
                return any(_has_picture(source, scan) for scan in scans[-3:])

            until(seen, source.waiting_for)
            assert has_camera(source.description)
            camera, why = source.camera()
            assert why == ""
            assert camera is not None
            np.testing.assert_allclose(camera.K, CAMERA.K)
    finally:
        robot.kill()


def _has_picture(source: LiveSource, scan: Scan) -> bool:
    found = source.picture_near(scan.stamp_ns)
    return found is not None and found.data.startswith(b"\xff\xd8")
