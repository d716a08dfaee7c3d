"""What can be chosen of a source before it is opened, and that the choice arrives."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.common.child_process import ChildProcess
from app.common.settings import Settings
from app.dashboard import inspection_process
from app.robot.link import Inbox
from app.robot.source import open_any
from app.robot.topics import Publisher
from app.sources import opening
from app.sources.opening import ask, check_source
from app.sources.request import SourceRequest
from app.worker.protocol import Open
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import Source, SourceOptions
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.topics import IMAGE, NAV_SAT_FIX, POINT_CLOUD
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.types.records import Sensor
from tests.app.batch.finished_runs import grid_run
from tests.app.fakes import FakeSource, FakeWorker, make_mapper
from tests.app.robot.conftest import clouds
from tests.app.server_for_tests import BEARER, Running, running
from tests.pipeline.plots import write_las

MOUNT = (0.1, 0.2, 0.9, 5.0, -3.0, 90.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of a robot whose LiDAR stands askew."""
    path = tmp_path_factory.mktemp("inside") / "run.mcap"
    mounted = Pose3.from_euler(MOUNT[:3], *map(radians, MOUNT[3:]))
    write_recording(path, clouds(6, 200), sensor=Sensor("VLP-16", 16), T_base_lidar=mounted)
    return path


def by_name(told: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {topic["name"]: topic for topic in told["topics"]}


@pytest.mark.slow
async def test_a_recording_tells_its_topics_and_where_the_lidar_stands(both: Running, run: Path) -> None:
    client, _ = both
    told = (await client.post("/api/inside", json={"uri": str(run)})).json()
    cloud = by_name(told)["/velodyne_points"]
    assert (cloud["messages"], cloud["rate_hz"], cloud["read_as"]) == (6, 10.0, "scan")
    assert cloud["type"] == POINT_CLOUD
    np.testing.assert_allclose(told["mount"], MOUNT, atol=2e-3)
    missing = await client.post("/api/inside", json={"uri": "/no/such.mcap"})
    assert (missing.status_code, missing.json()["error"]["where"]) == (409, "/no/such.mcap")


@pytest.mark.parametrize("path", ["/no/such.mcap", "~nobody9/x.mcap", "a" * 4000, "x\0.mcap"])
async def test_a_path_that_does_not_exist_is_refused_without_a_process(
    both: Running, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ChildProcess, "start", lambda *_, **__: pytest.fail("a process was started"))
    reply = await both[0].post("/api/inside", json={"uri": path})
    assert reply.status_code == 409
    assert "no such file" in reply.json()["error"]["what"]


def test_what_has_no_topics_says_so():
    told = inspection_process.recorded("sim:paper?duration=1")
    assert (told["topics"], told["mount"]) == ([], None)


class Announced:
    """A robot whose topics come one after the other; it sends ten a second of what is listened to."""

    def __init__(self, inbox: Inbox, *topics: Publisher) -> None:
        self._inbox, self._topics, self._asked = inbox, list(topics), 0

    def publishers(self) -> list[Publisher]:
        self._asked += 1
        return self._topics[: self._asked]

    def subscribe(self, channels: Sequence[Channel]) -> None:
        for channel in channels:
            for k in range(0 if channel.msgtype == NAV_SAT_FIX else 21):
                message = Message(channel.number, k * 100_000_000, b"")
                if channel.msgtype != IMAGE:
                    self._inbox.put(message, is_scan=True)
                elif self._inbox.wants_picture(message.log_ns, 1 << 20):
                    self._inbox.put_picture(message)

    def close(self) -> None:
        """Nothing is open."""


def test_a_robot_tells_what_it_announces_and_how_often(monkeypatch: pytest.MonkeyPatch):
    names = [("points", POINT_CLOUD), ("fix", NAV_SAT_FIX), ("image", IMAGE), ("depth", "a/msg/Large")]
    topics = [Publisher("red", f"/red/{name}", kind) for name, kind in names]
    link = lambda _, inbox: Announced(inbox, *topics)  # noqa: E731
    monkeypatch.setattr(inspection_process, "link_for", lambda _address: link)
    monkeypatch.setattr(inspection_process, "SETTLE_S", 0.3)
    monkeypatch.setattr(inspection_process, "COUNT_S", 0.01)
    told = inspection_process.heard("zenoh:tcp/127.0.0.1:7447")
    found = {name: (t["fits"], t["messages"], t["rate_hz"]) for name, t in by_name(told).items()}
    assert found == {
        "/red/points": ("scan", 21, 10.0),
        "/red/fix": ("gnss", 0, None),
        "/red/image": ("camera", 21, 10.0),
        "/red/depth": ("", None, None),
    }
    assert "silent" in by_name(told)["/red/fix"]["why_not"]
    read = {name: t["read_as"] for name, t in by_name(told).items()}
    assert read == {"/red/points": "scan", "/red/fix": "gnss", "/red/image": "camera", "/red/depth": ""}
    assert (told["mount"], told["warnings"]) == (None, [])
    named = inspection_process.heard("zenoh:tcp/127.0.0.1:7447?camera=none&gnss=/red/points")
    assert {t["read_as"] for t in named["topics"]} == {""}
    assert "/red/points is of the type" in named["warnings"][0]
    bare = inspection_process.heard("zenoh:tcp/127.0.0.1:7447?camera=none&robot=red")
    assert [t["name"] for t in bare["topics"] if t["read_as"]] == ["/red/points", "/red/fix"]
    monkeypatch.setattr(inspection_process, "link_for", lambda _address: lambda _, inbox: Announced(inbox))
    monkeypatch.setattr(inspection_process, "LISTEN_S", 0.1)
    assert "no topic was announced" in inspection_process.heard("velodyne:127.0.0.1:2368")["warnings"][0]


@pytest.mark.slow
async def test_a_source_is_checked_up_to_its_first_scan(tmp_path: Path, run: Path) -> None:
    await opening.check_source(SourceRequest(str(run), mount=(0.0, 0.0, 2.0, 0.0, 0.0, 0.0)))
    notes, cut = tmp_path / "notes.txt", tmp_path / "cut.mcap"
    notes.write_text("birch, birch, oak")
    cut.write_bytes(run.read_bytes()[:60])
    for uri, reason in ((notes, "not a LiDAR recording.*Supported formats"), (cut, "cut.mcap")):
        with pytest.raises(SourceError, match=reason):
            await opening.check_source(SourceRequest(str(uri)))
    with pytest.raises(SourceError, match="no topic /other"):
        await opening.check_source(SourceRequest(str(run), topics={"scan": "/other"}))


@pytest.mark.parametrize("uri", ["sim:stand?seed=2", "velodyne:0.0.0.0:2368?from=192.168.1.201"])
async def test_of_simulated_and_live_sources_the_address_is_checked(
    uri: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(opening, "ask")  # no child process
    await opening.check_source(SourceRequest(uri))
    with pytest.raises(SourceError):
        await opening.check_source(SourceRequest(uri + "&nothing=5"))


async def test_the_choice_goes_to_the_worker(both: Running) -> None:
    client, dashboard = both
    body = {"uri": "run.mcap", "topics": {"scan": "/other", "imu": "/imu"}, "mount": MOUNT}
    assert (await client.post("/api/open", json=body)).status_code == 202
    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    wanted = worker.commands[-1]
    assert isinstance(wanted, Open)
    assert wanted.topics == {"scan": "/other", "imu": "/imu"}
    assert wanted.mount == (*MOUNT[:3], *map(radians, MOUNT[3:]))
    assert dashboard.source == wanted.request()  # a worker that is started again opens the same


@pytest.mark.parametrize(
    "chosen",
    [
        {"topics": {"lidar": "/points"}},
        {"topics": {"scan": "x" * 300}},
        {"mount": [0, 0, 1, 0, 0, 400]},
        {"mount": [0, 0, "NaN", 0, 0, 0]},
        {"mount": [500, 0, 0, 0, 0, 0]},
    ],
)
async def test_a_choice_that_is_none_is_refused(both: Running, chosen: dict[str, Any]) -> None:
    client, _ = both
    assert (await client.post("/api/open", json={"uri": "run.mcap", **chosen})).status_code == 422


async def test_from_afar_nobody_looks_into_the_disk(tmp_path: Path) -> None:
    async with running(Settings(host="0.0.0.0", recordings=tmp_path)) as (client, _):  # noqa: S104
        client.headers.update(BEARER)
        for uri in ("/etc/passwd", "zenoh:tcp/127.0.0.1:7447"):
            assert (await client.post("/api/inside", json={"uri": uri})).status_code == 403


def test_the_choice_decides_what_is_read(run: Path):
    mount = (0.0, 0.0, 2.0, 0.0, 0.0, radians(45.0))
    source = open_any(str(run), SourceRequest(str(run), mount=mount).options())
    np.testing.assert_allclose(source.description.T_base_lidar.t, mount[:3])
    assert source.description.T_base_lidar.euler()[2] == pytest.approx(mount[5])
    source.close()
    with pytest.raises(SourceError, match="no topic /other"):
        open_any(str(run), SourceRequest(str(run), topics={"scan": "/other"}).options())


def test_a_run_that_failed_is_opened_again_with_the_same_choice():
    asked: list[SourceOptions] = []

    def open_source(_uri: str, options: SourceOptions) -> Source:
        asked.append(options)
        return FakeSource(3)

    session = Session(
        open_source=open_source,
        make_mapper=make_mapper,
        parameters=Parameters(),
    )
    session.open(Open("fake:", "auto", 5, {"scan": "/other"}))
    session.fail("the file is cut")
    session.play()
    assert asked == [SourceOptions({"scan": "/other"}, None, 5)] * 2
    session.close()


@pytest.mark.slow
async def test_a_whole_cloud_is_checked_without_a_drive_through_it(tmp_path: Path) -> None:
    """A cube full of points has no path for a robot, but it is a cloud."""
    points = np.random.default_rng(3).uniform(0.0, 2.0, (5_000, 3))
    file = write_las(tmp_path / "full.laz", points)
    await check_source(SourceRequest(str(file)))
    assert (await ask({"ask": "recording", "path": str(file)}))["kind"].startswith("whole cloud, LAS 1.4")
    damaged = tmp_path / "damaged.laz"
    damaged.write_bytes(file.read_bytes()[:300])
    with pytest.raises(SourceError):
        await check_source(SourceRequest(str(damaged)))


@pytest.mark.parametrize(
    "changes",
    [{"scans": "many"}, {"scans": math.inf}, {"health": []}, {"health": {"scans": 3}}],
)
def test_a_damaged_record_of_a_run_is_named(tmp_path: Path, changes: dict[str, Any]) -> None:
    folder = grid_run(tmp_path / "run")
    file = folder / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(SourceError, match=r"run\.json is damaged"):
        inspection_process.finished({"path": str(folder)})
