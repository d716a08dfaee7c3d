"""A run of a robot is mapped again, over what came so far, while more comes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from app.robot.source import LiveSource
from app.sources.live_address import parse_address
from app.worker.process import new_session
from app.worker.protocol import Open
from pipeline.config import Parameters
from pipeline.io.readers import open_source
from pipeline.io.readers.container import Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD
from pipeline.io.recording.mcap_writer import write_recording
from pipeline.types.records import Frame
from tests.app.robot.conftest import until
from tests.app.robot.test_live_session import URI, FakeLink, announce
from tests.app.worker.test_remap import BASE, FEWER, JUDGED, LATER, WIDER, content_of

SCANS, ASKED = 40, 18  # no more wait for a mapper than are sent at once
SEED = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the robot sends, as a recording."""
    path = tmp_path_factory.mktemp("live") / "run.mcap"
    with closing(open_source(f"sim:paper?duration={0.1 * SCANS:g}&odometry=poor")) as source:
        known = source.description
        write_recording(path, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    return path


class Robot:
    """A robot that is heard by a session on the real pipeline, and sends when a test says so."""

    def __init__(self, path: Path, parameters: Parameters) -> None:
        self._parameters = parameters
        with closing(McapFile(path)) as container:
            self.topics = list(container.channels)
            kinds = {channel.number: channel for channel in self.topics}
            self._messages = [
                (kinds[message.channel], message) for message in container.messages(list(kinds), None, {})
            ]
        self._sent = 0
        self.frames: list[object] = []
        links: list[FakeLink] = []

        def link(address: Any, inbox: Any) -> FakeLink:
            links.append(FakeLink(address, inbox))
            return links[-1]

        self.session = new_session()
        self.session._open_source = lambda uri, options: LiveSource(parse_address(uri), options, link)
        self.session.open(Open(URI, "auto", SEED))
        (self._link,) = links
        announce(self._link, self)
        self._opened = False

    def send(self, scans: int) -> None:
        """Send so many scans with what lies before the next one, and map what came."""
        numbers: dict[str, int] = {}
        if not self._opened:
            until(lambda: self.session.listen() is not None or self._link.channels)
        numbers = {channel.topic: channel.number for channel in self._link.channels}
        while self._sent < len(self._messages):
            channel, message = self._messages[self._sent]
            is_scan = channel.msgtype == POINT_CLOUD
            if is_scan and scans == 0:
                break
            scans -= is_scan
            self._sent += 1
            if channel.topic in numbers:
                put = Message(numbers[channel.topic], message.log_ns, message.payload)
                self._link.inbox.put(put, is_scan=is_scan)
        self._link.silence_s = 0.0
        if not self._opened:
            until(lambda: self.session.listen() is not None)
            self.session.set_parameters(self._parameters, 0)
            self.session.play()
            self._opened = True
        while self.session.next_ns() is not None:
            self.frames.append(content_of(self.session.work()))


@pytest.fixture
def robot(run: Path) -> Iterator[Callable[..., Robot]]:
    robots: list[Robot] = []

    def make(parameters: Parameters = BASE) -> Robot:
        robots.append(Robot(run, parameters))
        return robots[-1]

    yield make
    for each in robots:
        each.session.close()


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [FEWER, LATER, JUDGED])
def test_what_came_so_far_is_mapped_again_while_more_comes(robot, parameters):
    here, other, wanted = robot(), robot(), robot(parameters)  # the last has them from its first scan on
    for each in (here, other, wanted):
        each.send(ASKED)
    here.session.set_parameters(parameters, 1, whole=True)
    other.session.set_parameters(parameters, 1)
    assert len(here.frames) == len(other.frames)
    begun = len(here.frames)
    done: tuple[Frame, Any] | None = None
    while done is None:
        assert here.session.is_remapping
        for each in (here, other, wanted):
            each.send(1)
        for _ in range(4):
            done = done or here.session.remap()
    assert len(here.frames) > begun
    assert here.frames == other.frames, "the rerun disturbs nothing that comes meanwhile"
    frame = done[0]
    assert frame.index == len(here.frames) - 1 >= begun
    assert content_of(frame) == wanted.frames[-1]
    for each in (here, wanted):
        each.send(SCANS)
    assert here.frames[frame.index + 1 :] == wanted.frames[frame.index + 1 :]
    assert frame.index + 2 < len(here.frames) == len(wanted.frames)


def test_a_rerun_that_is_given_up_leaves_the_live_run_as_it_is(robot):
    here, other = robot(), robot()
    for each in (here, other):
        each.send(ASKED)
    here.session.set_parameters(LATER, 1, whole=True)
    here.session.remap()
    for each in (here, other):
        each.session.set_parameters(FEWER, 2)
        each.send(SCANS)
    assert not here.session.is_remapping
    assert here.frames == other.frames


def test_a_change_that_needs_points_and_its_undo_apply_from_now_on(robot):
    here = robot()
    here.send(ASKED)
    for revision, parameters in enumerate((WIDER, BASE), 1):
        here.session.set_parameters(parameters, revision, whole=True)
        assert not here.session.is_remapping, "it could not be completed"
        here.send(2)
    (warning,) = [text for text in here.session.status().warnings if "not mapped again" in text]
    assert "Open the recording of the run" in warning
