"""A session on a robot: waits, maps what comes, says when nothing comes; with a link of our own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.robot.link import Inbox, Link
from app.robot.source import LATE, LiveSource
from app.robot.topics import Publisher
from app.sources.live_address import ZenohAddress, parse_address
from app.worker.loop import WorkerLoop
from app.worker.protocol import (
    Advance,
    Begin,
    BeginRecording,
    EndRecording,
    EndRun,
    FromWorker,
    Open,
    Opened,
    Pause,
    Play,
    Report,
    Seek,
    SetParameters,
    Shown,
    ToWorker,
)
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD
from tests.app.fakes import make_mapper
from tests.app.robot.conftest import SCANS, until

URI = "zenoh:tcp/robot:7447"


class FakeLink(Link):
    """Gives what the test puts into the inbox."""

    silence_s: float | None = None
    place, nothing = "connected to a test", "no scans of a robot are announced"

    def __init__(self, _address: ZenohAddress, inbox: Inbox) -> None:
        super().__init__(inbox, "fake")
        self.problem, self.losses = "", {"scans lost on the way": 2}
        self.there: list[Publisher] = []
        self.channels: Sequence[Channel] = ()
        self.closed = False

    def receive(self) -> None:
        raise NotImplementedError

    def failure(self, error: Exception) -> str:
        return str(error)

    def publishers(self) -> list[Publisher]:
        return self.there

    def subscribe(self, channels: Sequence[Channel]) -> None:
        self.channels = channels

    def close(self) -> None:
        self.closed = True


class Stage:
    """A driver in a thread, its session's robot, and what it says."""

    def __init__(self) -> None:
        self.said: list[FromWorker] = []
        self.commands: queue.Queue[ToWorker | None] = queue.Queue()
        self.links: list[FakeLink] = []
        self.compiled = threading.Event()
        self.compiled.set()
        self.session = Session(
            open_source=lambda uri, _options: LiveSource(parse_address(uri), SourceOptions(), self._link),
            make_mapper=make_mapper,
            parameters=Parameters(),
            warm_up=self.warm_up,
        )

    def warm_up(self) -> None:
        """Wait as for the compiler, if the test says so."""
        assert self.compiled.wait(60)

    def _link(self, address: ZenohAddress, inbox: Inbox) -> FakeLink:
        self.links.append(FakeLink(address, inbox))
        return self.links[-1]

    @property
    def status(self) -> Any:
        reports = [m.status for m in list(self.said) if isinstance(m, Report)]
        return reports[-1] if reports else None

    @property
    def shown(self) -> list[int]:
        return [message.frame.index for message in list(self.said) if isinstance(message, Shown)]

    def opened(self) -> list[Opened]:
        return [message for message in list(self.said) if isinstance(message, Opened)]


@contextmanager
def stage() -> Iterator[Stage]:
    made = Stage()
    thread = threading.Thread(target=WorkerLoop(made.session, made.commands, made.said.append).run)
    thread.start()
    try:
        yield made
    finally:
        made.compiled.set()
        made.commands.put(None)
        thread.join(30)
        assert not thread.is_alive()


@pytest.fixture
def sending(drive: Path) -> Callable[[FakeLink, int, int], None]:
    """Puts the messages of some scans, and what lies between them, into a link's inbox."""
    with closing(McapFile(drive)) as container:
        topics = {c.number: c for c in container.channels}
        messages = list(container.messages(list(topics), None, {}))

    def send(link: FakeLink, first: int, last: int) -> None:
        numbers = {channel.topic: channel.number for channel in link.channels}
        scan = -1
        for message in messages:
            channel = topics[message.channel]
            is_scan = channel.msgtype == POINT_CLOUD
            scan += is_scan
            if first <= max(scan, 0) < last and channel.topic in numbers:
                put = Message(numbers[channel.topic], message.log_ns, message.payload)
                link.inbox.put(put, is_scan=is_scan)
        link.silence_s = 0.0

    send.topics = list(topics.values())  # type: ignore[attr-defined]
    return send


def announce(link: FakeLink, sending: Any) -> None:
    link.there = [Publisher("robot1", c.topic, c.msgtype) for c in sending.topics]
    link.version += 1


def test_a_topic_that_is_not_announced_is_named_with_those_that_are(sending):
    with stage() as on:
        on.commands.put(Open(f"{URI}?scan=/nope"))
        until(lambda: on.status and on.status.detail.endswith(
            "the topic /nope is not announced; no scans of a robot are announced"))  # fmt: skip
        announce(on.links[0], sending)
        (scans,) = (topic.topic for topic in sending.topics if topic.msgtype == POINT_CLOUD)
        told = f"the topic /nope is not announced; scans are announced as {scans}"
        until(lambda: on.status.detail.endswith(told), lambda: on.status.detail)


def test_a_robot_is_waited_for_mapped_lost_and_back(sending):
    with stage() as on:
        on.commands.put(Open(URI))
        until(lambda: on.status and "no scans of a robot" in on.status.detail)
        assert on.status.state == "waiting"
        assert on.status.live
        link = on.links[0]
        announce(link, sending)
        until(lambda: link.channels)
        sending(link, 0, 11)
        until(on.opened)
        (opened,) = on.opened()
        assert (opened.kind, opened.scans, opened.end_s) == ("ROS 2 over Zenoh", None, None)
        on.commands.put(Begin(opened.run, Parameters().model_dump(), 3, True))
        until(lambda: on.shown and on.shown[-1] == 10)
        until(lambda: on.status.state == "playing")
        assert (on.status.robot, on.status.robots, on.status.scans) == ("robot1", ["robot1"], None)
        assert "scans lost on the way (2)" in on.status.warnings
        link.silence_s, link.there, link.version = 7.0, [], 5
        until(lambda: on.status.state == "waiting")
        until(lambda: on.status.detail.startswith("Nothing heard for 7 s: robot robot1 is gone"))
        assert on.status.health == "no data for 7 s", "the quality of the last pose says nothing of now"
        until(lambda: "robot robot1 sends no scans any more" in on.status.warnings)
        announce(link, sending)
        until(lambda: not any("sends" in warning for warning in on.status.warnings))
        sending(link, 10, 11)  # once more
        sending(link, 11, SCANS)
        until(lambda: on.shown[-1] == SCANS - 1 and on.status.state == "playing")
        counts = [message.counts for message in on.said if isinstance(message, Shown)][-1]
        assert counts is not None
        assert counts.losses["scans lost on the way"] == 2
        assert counts.losses["scans that were not later than the one before"] == 1
        assert {"robot robot1 sends no scans any more", "robot robot1 sends scans again"} < set(
            counts.warnings
        )
        assert on.shown == sorted(set(on.shown)), "each scan is shown once"


def test_fixed_transforms_that_come_late_are_told_on_the_page_and_in_the_card_of_the_run(sending):
    fixed = [topic for topic in sending.topics if topic.topic.endswith("tf_static")]
    with stage() as on:
        on.commands.put(Open(URI))
        until(lambda: on.links)
        link = on.links[0]
        announce(link, sending)
        link.there = [p for p in link.there if p.topic not in [topic.topic for topic in fixed]]
        until(lambda: link.channels)
        sending(link, 0, 11)
        until(on.opened)
        on.commands.put(Begin(1, Parameters().model_dump(), 3, True))
        until(lambda: on.shown and on.shown[-1] == 10)
        announce(link, sending)
        until(lambda: any(LATE in warning for warning in on.status.warnings))
        sending(link, 11, SCANS)
        until(lambda: on.shown[-1] == SCANS - 1)
        counts = [message.counts for message in on.said if isinstance(message, Shown)][-1]
        assert counts is not None
        assert sum(LATE in warning for warning in counts.warnings) == 1


@pytest.mark.parametrize(
    ("problem", "told"),
    [
        ("no router answers. Is it running?", "no router answers. Is it running? It is"),
        ("cannot listen on 0.0.0.0:80: Permission denied", "0.0.0.0:80: Permission denied. It is"),
    ],
)
def test_a_problem_of_the_link_ends_its_sentence(problem, told):
    source = LiveSource(parse_address(URI), SourceOptions(), FakeLink)
    source._link.problem = problem
    assert f"{told} tried again every second" in source.waiting_for()
    source.close()


def mapped_link(on, sending, record: str = ""):
    """Map eleven scans of a live robot, with a file to record them, and return its link."""
    on.commands.put(Open(URI, record=record))
    until(lambda: on.links)
    link = on.links[0]
    announce(link, sending)
    until(lambda: link.channels)
    sending(link, 0, 11)
    until(on.opened)
    on.commands.put(Begin(1, Parameters().model_dump(), 3, True))
    until(lambda: on.shown and on.shown[-1] == 10)
    return link


def test_a_live_run_can_be_paused_and_not_stepped(sending):
    with stage() as on:
        link = mapped_link(on, sending)
        for command in (Pause(), Seek(0.0), Advance(1)):
            on.commands.put(command)
        until(lambda: on.status.state == "paused")
        until(lambda: any("open its recording" in warning for warning in on.status.warnings))
        sending(link, 11, SCANS)
        assert on.shown[-1] == 10


def test_an_ended_run_has_its_recording_and_keeps_its_map(sending, tmp_path: Path):
    with stage() as on:
        link = mapped_link(on, sending, record=str(tmp_path / "run.mcap"))
        on.commands.put(EndRun())
        until(lambda: on.status.state == "finished")
        assert on.status.live
        assert not on.status.recording.startswith("recording")
        assert recorded_scans(tmp_path / "run.mcap") == 11
        sending(link, 11, SCANS)
        on.commands.put(Play())  # an ended run stays ended
        on.commands.put(Pause())
        until(on.commands.empty)
        until(lambda: on.status.state == "finished")
        assert on.shown[-1] == 10
    assert recorded_scans(tmp_path / "run.mcap") == 11


def test_a_run_is_recorded_from_a_press_on_and_again_to_a_second_file(sending, drive: Path, tmp_path: Path):
    path = tmp_path / "run.mcap"
    tuned = Parameters().replace({"clustering.min_points": 6})
    with stage() as on:
        link = mapped_link(on, sending)
        link.times.now_ns = lambda: link.inbox._arrived_fixed[0].log_ns + 1
        on.commands.put(BeginRecording(str(path)))
        until(lambda: on.status.recording.startswith("recording run.mcap"))
        sending(link, 11, SCANS)
        until(lambda: on.shown[-1] == SCANS - 1)
        on.commands.put(SetParameters(tuned.model_dump(), 4))
        until(lambda: on.status.revision == 4)
        on.commands.put(EndRecording())
        until(lambda: on.status.recording.startswith("recorded run.mcap"))
        assert on.status.recorded_file == str(path)
        assert on.status.state == "playing"
        on.commands.put(BeginRecording(str(path)))
        until(lambda: on.status.recording.startswith("recording run-2.mcap"))
    with closing(open_source(str(path))) as recording, closing(open_source(str(drive))) as whole:
        known = recording.description
        assert known.scans == SCANS - 11
        mounted = whole.description.T_base_lidar  # the fixed transforms came before
        np.testing.assert_array_equal(known.T_base_lidar.t, mounted.t)
        assert mounted.t[2] == 0.9
        first, then = known.revisions
        assert (first.from_scan, then.from_scan) == (0, SCANS - 11)
        assert then.values["clustering"]["min_points"] == 6
    assert recorded_scans(tmp_path / "run-2.mcap") == 0


def test_what_waits_to_be_mapped_is_in_a_recording_that_begins_later(sending, tmp_path: Path):
    with stage() as on:
        link = mapped_link(on, sending)
        on.commands.put(Pause())
        until(lambda: on.status.state == "paused")
        sending(link, 11, SCANS)
        on.commands.put(BeginRecording(str(tmp_path / "run.mcap")))
        until(lambda: on.status.recording.startswith("recording"))
    assert recorded_scans(tmp_path / "run.mcap") == SCANS - 11


def test_a_file_that_cannot_be_created_is_told_and_the_run_goes_on(sending, tmp_path: Path):
    (tmp_path / "file").write_text("")
    with stage() as on:
        link = mapped_link(on, sending)
        on.commands.put(BeginRecording(str(tmp_path / "file" / "run.mcap")))
        until(lambda: on.status.recording.startswith("not recording: cannot record"))
        sending(link, 11, SCANS)
        until(lambda: on.shown[-1] == SCANS - 1)


def recorded_scans(path: Path) -> int:
    try:
        with closing(McapFile(path)) as container:
            return sum(channel.count for channel in container.channels if channel.msgtype == POINT_CLOUD)
    except SourceError:  # nothing is written yet
        return 0


def test_a_paused_run_is_recorded(sending, tmp_path: Path):
    with stage() as on:
        link = mapped_link(on, sending, record=str(tmp_path / "run.mcap"))
        on.commands.put(Pause())
        until(lambda: on.status.state == "paused")
        for _ in range(3):
            sending(link, 11, SCANS)
        until(lambda: recorded_scans(tmp_path / "run.mcap") == 11 + 3 * (SCANS - 11))  # while it is paused
        assert on.shown[-1] == 10
    assert recorded_scans(tmp_path / "run.mcap") == 11 + 3 * (SCANS - 11)


def test_the_status_of_a_paused_run_follows_its_robot(sending):
    with stage() as on:
        link = mapped_link(on, sending)
        on.commands.put(Pause())
        until(lambda: on.status.state == "paused")
        link.silence_s = 7.0
        until(lambda: on.status.health == "no data for 7 s")
        age_s = on.status.map_age_s
        sending(link, 11, SCANS)
        until(lambda: on.status.health != "no data for 7 s")
        assert (on.status.state, on.status.detail) == ("paused", "")
        assert on.status.map_age_s > age_s, "the map grows older although scans arrive"


def test_what_arrives_while_kernels_compile_is_recorded_and_reported(sending, tmp_path: Path):
    with stage() as on:
        on.compiled.clear()
        on.commands.put(Open(URI, record=str(tmp_path / "run.mcap")))
        until(lambda: on.links)
        link = on.links[0]
        announce(link, sending)
        until(lambda: link.channels)
        for _ in range(2):
            sending(link, 0, SCANS)
        until(lambda: recorded_scans(tmp_path / "run.mcap") == 2 * SCANS)
        on.compiled.set()
        until(on.opened)
        on.commands.put(Begin(1, Parameters().model_dump(), 3, True))
        until(lambda: any("10 scans arrived before mapping was ready" in w for w in on.status.warnings))
        assert not any("skipped" in reason for reason in on.status.warnings)


def test_another_run_leaves_a_robot_that_was_never_heard():
    with stage() as on:
        on.commands.put(Open(URI))
        on.commands.put(Open(URI + "?robot=red"))
        until(lambda: len(on.links) == 2 and on.links[0].closed)
        until(lambda: on.status.source.endswith("robot=red") and on.status.state == "waiting")
    assert on.links[1].closed
