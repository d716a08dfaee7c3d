"""A live run is recorded as it goes; its replay gives the same map, and a cut file is mended."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from app.batch.map_run import OfflineRun, map_run
from app.cli import main
from app.robot import recorder as recorder_module
from app.robot.link import SKIPPED
from app.robot.recorder import NOT_RECORDED, RawFile, Recorder
from app.robot.source import LiveSource
from app.sources.live_address import parse_address
from app.worker.run import recorded_parameters
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.base import Source
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD
from pipeline.io.recording.mcap_writer import LiveWriter, repair, write_recording
from pipeline.types.records import Scan
from tests.app.robot.conftest import Child, until
from tests.app.robot.test_live_session import FakeLink, announce

MAP_FILES = ("trees.csv", "path.csv", "detections.csv", "trees.geojson", "terrain.csv")
TUNED = Parameters().replace({"clustering.min_points": 6})


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a simulated stand."""
    path = tmp_path_factory.mktemp("stand") / "stand.mcap"
    with closing(open_source("sim:stand?duration=2&seed=5")) as source:
        known = source.description
        write_recording(path, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    return path


class Heard:
    """A live source that gets the messages of a file, some of them in another order or late."""

    def __init__(self, run: Path, recording: Recorder | None, take_every: int = 1) -> None:
        self._take_every = take_every
        with closing(McapFile(run)) as container:
            self.topics: list[Channel] = container.channels
            kinds = {c.number: c for c in self.topics}
            self._messages = list(container.messages(list(kinds), None, {}))
        self._kinds = kinds
        self.links: list[FakeLink] = []
        self.source = LiveSource(parse_address("zenoh:tcp/robot:7447"), SourceOptions(), self._link)
        self.source.start(recording)

    def _link(self, address: Any, inbox: Any) -> FakeLink:
        self.links.append(FakeLink(address, inbox))
        self.links[0].losses = {}
        return self.links[0]

    def records(self) -> Iterator[Any]:
        """All records, as the loop of a live run takes them."""
        link = self.links[0]
        announce(link, self)
        while not link.channels:
            self.source.listen()
        numbers = {channel.topic: channel.number for channel in link.channels}
        rng = np.random.default_rng(3)
        order = np.argsort(np.arange(len(self._messages)) + rng.uniform(0.0, 3.0, len(self._messages)))
        for arrival, k in enumerate(order.tolist()):
            message = self._messages[k]
            channel = self._kinds[message.channel]
            stamp_ns = self._messages[arrival].log_ns + arrival
            link.inbox.put(
                Message(numbers[channel.topic], stamp_ns, message.payload),
                is_scan=channel.msgtype == POINT_CLOUD,
            )
            if arrival % self._take_every == 0:
                yield from self.source.take()
        yield from self.source._reader.finish() if self.source._reader else ()


class Played:
    """What `map` needs of a live source: its records, and its description once they begin."""

    def __init__(self, heard: Heard) -> None:
        self._live, self._records = heard.source, heard.records()
        self._first = next(self._records)
        self.losses: dict[str, int] = {}
        self.description = heard.source.description

    def records(self) -> Iterator[Any]:
        yield self._first
        yield from self._records

    def truth(self) -> None:
        return None

    def close(self) -> None:
        self._live.close()


def map_files(source: Source, out: Path, **plan: Any) -> dict[str, bytes]:
    run = OfflineRun(
        source=source, preset="forest", seed=0, odometry="auto", **{"parameters": Parameters(), **plan}
    )
    map_run(run, out)
    return {name: (out / name).read_bytes() for name in MAP_FILES}


def test_the_replay_gives_the_map_of_the_live_run_byte_for_byte(
    stand: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    recording = Recorder(tmp_path / "live.mcap")
    heard = Heard(stand, recording)
    played = Played(heard)
    heard.source.use_parameters(0, 0, TUNED)
    live = map_files(
        played,
        tmp_path / "a",
        parameters=TUNED,
        on_frame=lambda frame, mapper: heard.source.mapped(frame, mapper.path),
    )
    played.close()
    assert recording.problem == ""
    with closing(open_source(str(recording.path))) as replay:
        known = replay.description
        assert (known.scans, known.has_odometry, known.has_imu) == (20, True, True)
        ((first, parameters),) = recorded_parameters(known)
        assert (first, parameters) == (0, TUNED)
        again = map_files(replay, tmp_path / "b", parameters=parameters)
        assert again == live
        assert map_files(replay, tmp_path / "c") != live, "with other parameters it is another map"
    code = main(["map", str(recording.path), "--out", str(tmp_path / "d")])
    told = capfd.readouterr().err
    assert code == 3, told  # what came late was left out, and is counted
    assert "left out: IMU readings that were not later than the one before" in told
    assert {name: (tmp_path / "d" / name).read_bytes() for name in MAP_FILES} == live


def test_other_programs_read_the_recording(stand: Path, tmp_path: Path):
    recording = Recorder(tmp_path / "live.mcap")
    heard = Heard(stand, recording)
    played = Played(heard)
    map_files(played, tmp_path / "a", on_frame=lambda frame, mapper: heard.source.mapped(frame, mapper.path))
    played.close()
    with recording.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {index.compression for index in summary.chunk_indexes} == {"lz4"}
        assert summary.statistics is not None
        topics = {
            c.topic: summary.statistics.channel_message_counts.get(n, 0) for n, c in summary.channels.items()
        }
    assert (
        topics["/velodyne_points"]
        == topics["/robot1/stemmap/pose"]
        == topics["/robot1/stemmap/odometry"]
        == 20
    )
    assert topics["/robot1/stemmap/trees"] >= 1


def count_messages(path: Path) -> dict[str, int]:
    with closing(McapFile(path)) as container:
        return {channel.topic: channel.count for channel in container.channels}


@pytest.mark.slow
def test_a_mapper_five_times_slower_than_the_robot_loses_nothing_in_the_recording(
    stand: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("app.robot.link.MAX_SCANS", 3)
    recording = Recorder(tmp_path / "live.mcap")
    heard = Heard(stand, recording, take_every=5)
    played = Played(heard)
    heard.source.use_parameters(0, 0, TUNED)
    live = map_files(
        played,
        tmp_path / "a",
        parameters=TUNED,
        on_frame=lambda frame, mapper: heard.source.mapped(frame, mapper.path),
    )
    losses = heard.source.losses
    played.close()
    sent, kept = count_messages(stand), count_messages(recording.path)
    assert {topic: kept[topic] for topic in sent} == sent
    assert 5 < losses[SKIPPED] < 20
    with closing(open_source(str(recording.path), SourceOptions(as_live=True))) as replay:
        ((_, parameters),) = recorded_parameters(replay.description)
        assert map_files(replay, tmp_path / "b", parameters=parameters) == live
        assert replay.description.scans == 20 - losses[SKIPPED] - heard.source.scans_waiting
    with closing(open_source(str(recording.path))) as whole:
        assert sum(isinstance(record, Scan) for record in whole.records()) == 20
        assert any("--as-live" in warning for warning in whole.description.warnings)
    main(["map", str(recording.path), "--as-live", "--out", str(tmp_path / "c")])
    assert {name: (tmp_path / "c" / name).read_bytes() for name in MAP_FILES} == live
    assert '"as_live": true' in (tmp_path / "c" / "run.json").read_text()
    main(["map", str(recording.path), "--out", str(tmp_path / "d")])
    assert "of the 20 recorded scans" in capfd.readouterr().err
    assert (tmp_path / "d" / "path.csv").read_text().count("\n") == 21


def write_live(path: Path, run: Path, topics: list[str], spoil: Callable[[LiveWriter], None]) -> None:
    """A recording of the messages of a file, with settings that name some topics, and with what `spoil` adds
    at its end."""
    with closing(McapFile(run)) as container, path.open("wb") as stream:
        header = {"uri": "zenoh:tcp/robot:7447", "topics": topics, "camera": ["/camera"]}
        writer = LiveWriter(stream, container.channels, header, "")
        for message in container.messages([c.number for c in container.channels], None, {}):
            writer.add(message)
        spoil(writer)
        writer.finish()


def test_settings_without_a_topic_of_scans_are_refused(stand: Path, tmp_path: Path):
    write_live(tmp_path / "live.mcap", stand, [], lambda _: None)
    with pytest.raises(SourceError, match="no topic of scans"):
        open_source(str(tmp_path / "live.mcap"))


def test_damaged_notes_are_counted_in_every_reading(stand: Path, tmp_path: Path):
    damaged: Any = {"/velodyne_points": ["late"]}

    def spoil(writer: LiveWriter) -> None:
        writer.add_parameters(0, -1, {"clustering": []})
        writer.add_skipped(damaged)

    write_live(tmp_path / "live.mcap", stand, ["/velodyne_points"], spoil)
    with closing(open_source(str(tmp_path / "live.mcap"))) as source:
        assert source.description.revisions == ()
        assert any("cut or damaged" in warning for warning in source.description.warnings)
        for _ in range(2):
            assert sum(isinstance(record, Scan) for record in source.records()) == 20
            assert source.losses == {"notes of the recorder that cannot be read": 2}


def test_a_queue_that_is_full_is_counted_and_reported(stand: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 100)
    recording = Recorder(tmp_path / "live.mcap")
    heard = Heard(stand, recording)
    assert sum(isinstance(record, Scan) for record in heard.records()) == 20
    assert heard.source.losses[NOT_RECORDED] >= 20
    assert "messages missing because the disk is too slow" in heard.source.recording
    heard.source.close()
    assert count_messages(recording.path)["/velodyne_points"] == 0


class FullDisk(RawFile):
    """Has room for so many bytes."""

    room = 700_000

    def write(self, data: bytes) -> int:
        if self.tell() + len(data) > self.room:
            super().write(data[: max(0, self.room - self.tell())])
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def test_a_full_disk_ends_the_recording_and_not_the_map(stand: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(recorder_module, "RawFile", FullDisk)
    recording = Recorder(tmp_path / "live.mcap")
    heard = Heard(stand, recording)
    assert sum(isinstance(record, Scan) for record in heard.records()) == 20
    until(lambda: heard.source.recording.startswith("not recording"))
    assert "No space left on device" in heard.source.recording
    heard.source.close()
    found = repair(recording.path, tmp_path / "mended.mcap")
    assert found.losses
    with closing(open_source(str(tmp_path / "mended.mcap"))) as mended:
        assert 0 < sum(isinstance(record, Scan) for record in mended.records()) < 20


def test_a_recording_never_overwrites_another(tmp_path: Path):
    (tmp_path / "live.mcap").write_bytes(b"precious")
    recording = Recorder(tmp_path / "live.mcap")
    assert recording.path == tmp_path / "live-2.mcap"
    recording.close()
    assert not recording.path.exists(), "nothing was heard, so nothing is left"
    assert (tmp_path / "live.mcap").read_bytes() == b"precious"
    with pytest.raises(SourceError, match="cannot record"):
        Recorder(tmp_path / "live.mcap" / "below.mcap")


def messages_of(path: Path) -> list[tuple[int, bytes]]:
    with closing(McapFile(path)) as container:
        numbers = [channel.number for channel in container.channels]
        return [(m.log_ns, m.payload) for m in container.messages(numbers, None, {})]


def test_a_whole_recording_is_mended_to_the_same_messages(drive: Path, tmp_path: Path, capsys):
    assert main(["recover", str(drive), "--out", str(tmp_path / "m.mcap")]) == 0
    assert messages_of(tmp_path / "m.mcap") == messages_of(drive)
    assert capsys.readouterr().err == ""


def test_exit_codes_of_mending(drive: Path, tmp_path: Path, capsys):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(drive.read_bytes()[: drive.stat().st_size * 2 // 3])
    assert main(["recover", str(cut), "--out", str(tmp_path / "m.mcap")]) == 3
    assert "lost:" in capsys.readouterr().err
    kept = messages_of(tmp_path / "m.mcap")
    assert kept == messages_of(drive)[: len(kept)]
    assert 0.3 < len(kept) / len(messages_of(drive)) < 0.7
    cut.write_bytes(drive.read_bytes()[:60])
    assert main(["recover", str(cut), "--out", str(tmp_path / "n.mcap")]) == 1
    assert not (tmp_path / "n.mcap").exists()
    assert main(["recover", str(drive), "--out", str(drive)]) == 1
    capsys.readouterr()
    assert main(["recover", str(drive), "--out", str(tmp_path / "m.mcap")]) == 1
    assert "--force" in capsys.readouterr().err
    assert messages_of(tmp_path / "m.mcap") == kept
    assert main(["recover", str(drive), "--out", str(tmp_path / "m.mcap"), "--force"]) == 0


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a few kilobytes."""
    from tests.app.robot.conftest import clouds

    path = tmp_path_factory.mktemp("small") / "small.mcap"
    known = open_source("sim:stand?duration=1").description
    write_recording(path, clouds(3, 20), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    return path


@given(data=st.data())
def test_damage_never_harms_the_mender(small: Path, tmp_path_factory, data):
    content = bytearray(small.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(8, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(9, len(content))) :]
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "d.mcap").write_bytes(content)
    try:
        found = repair(folder / "d.mcap", folder / "m.mcap")
    except SourceError:
        assert not (folder / "m.mcap").exists()
        return
    assert found.messages == len(messages_of(folder / "m.mcap")) > 0


@pytest.mark.slow
@pytest.mark.parametrize("attempt", range(20))
def test_a_killed_recorder_loses_at_most_its_last_second(drive: Path, tmp_path: Path, attempt: int):
    out = tmp_path / "killed.mcap"
    child = Child("-m", "tests.app.robot.recorder", str(drive), str(out))
    told = [child.hear().split() for _ in range(60 + 13 * attempt)]
    child.kill()
    times = {int(number): float(at) for number, at in told}
    found = repair(out, tmp_path / "mended.mcap")
    kept = [log_ns for log_ns, _ in messages_of(tmp_path / "mended.mcap")]
    assert found.messages == len(kept)
    assert kept == list(range(1, len(kept) + 1)), "nothing is missing before the end"
    newest = times[max(times)]
    assert all(number in kept for number, at in times.items() if at < newest - 1.0)
    with closing(open_source(str(tmp_path / "mended.mcap"))) as mended:
        assert any(isinstance(record, Scan) for record in mended.records())
