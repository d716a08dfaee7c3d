"""A robot on plain DDS: an independent peer of Fast DDS (slow), and CycloneDDS's own writer."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.robot.address import DdsAddress, parse_address
from app.robot.dds_discovery import DdsGraph, Offer
from app.robot.ros_graph import Publisher
from app.robot.source import LiveSource, open_live
from pipeline.errors import SourceError
from pipeline.records import Odometry, Record, Scan
from pipeline.sources.container import Message
from pipeline.sources.mcap_file import open_mcap
from pipeline.sources.rostypes import ODOMETRY, POINT_CLOUD, READ_TYPES, ROS1_TRANSFORMS, TRANSFORMS
from tests.robot.conftest import POINTS, SCANS, until

#: A domain of this test process: others on the machine must not be heard.
DOMAIN = 100 + os.getpid() % 100
PEER = Path(__file__).parent / "fastdds" / "peer.cpp"


# --- without a network ---------------------------------------------------------------------------


def test_an_address_has_a_domain_and_stays_on_this_machine_unless_told():
    assert parse_address("dds:") == DdsAddress("dds:")
    uri = "dds:?domain=7&interface=192.168.1.10&peer=192.168.1.5,robot1&robot=/red/&scan=/red/points"
    assert parse_address(uri) == DdsAddress(
        uri, 7, "192.168.1.10", ("192.168.1.5", "robot1"), "red", {"scan": "/red/points"}
    )


@pytest.mark.parametrize(
    "uri",
    [
        "dds:robot",
        "dds:?domain=233",
        "dds:?interface=eth0%22/%3E",
        "dds:?peer=%3CPeer%3E",
        "dds:?colour=red",
    ],
)
def test_what_is_no_address_is_refused(uri: str):
    with pytest.raises(SourceError):
        parse_address(uri)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("app.robot.address.find_spec", {}.get)
    with pytest.raises(SourceError, match="uv sync --extra dds"):
        parse_address("dds:")


def test_topics_of_ros_are_told_from_others():
    kind = "sensor_msgs::msg::dds_::PointCloud2_"
    offer = Offer.of("rt/red/points", kind, reliable=True, latched=False)
    assert offer == Offer("/red/points", POINT_CLOUD, reliable=True, latched=False)
    for topic, type_name in [("red/points", kind), ("rr/red/reply", kind), ("rt/a b", kind), ("rt/a", "Foo")]:
        assert Offer.of(topic, type_name, reliable=True, latched=False) is None


def test_a_reader_asks_for_no_more_than_all_writers_offer():
    graph, losses = DdsGraph("red"), dict[str, int]()
    one = Offer("/red/points", POINT_CLOUD, reliable=True, latched=True)
    assert graph.add("a", one, losses)
    assert not graph.add("a", one, losses)
    assert graph.common("/red/points", POINT_CLOUD) == one
    graph.add("b", Offer("/red/points", POINT_CLOUD, reliable=False, latched=False), losses)
    assert graph.common("/red/points", POINT_CLOUD) == Offer(
        "/red/points", POINT_CLOUD, reliable=False, latched=False
    )
    graph.add("c", Offer("/tf", TRANSFORMS, reliable=True, latched=False), losses)
    assert graph.publishers() == [
        Publisher("", "/tf", TRANSFORMS),
        Publisher("red", "/red/points", POINT_CLOUD),
    ]
    assert graph.remove("b")
    assert not graph.remove("b")
    assert graph.common("/red/points", ODOMETRY) is None


def test_the_types_are_those_that_recordings_are_written_with(drive: Path):
    idl = pytest.importorskip("cyclonedds.idl", reason="cyclonedds, an extra, is not installed")
    from app.robot.dds_types import idl_type

    for msgtype in set(READ_TYPES) - {ROS1_TRANSFORMS}:
        package, _, name = msgtype.split("/")
        assert idl_type(msgtype).__idl_typename__ == f"{package}.msg.dds_.{name}_"
        assert issubclass(idl_type(msgtype), idl.IdlStruct)
    for topic, msgtype, payload in _messages(drive, one_each=True):
        message: Any = idl_type(msgtype).deserialize(payload)
        assert message.serialize() == payload, topic


# --- with a peer ---------------------------------------------------------------------------------


def _messages(run: Path, *, one_each: bool = False) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of the messages of a recording."""
    with closing(open_mcap(run)) as container:
        channels = {c.number: c for c in container.channels}
        left = set(channels)
        message: Message
        for message in container.messages(list(channels), None, {}):
            if message.channel in left or not one_each:
                left.discard(message.channel)
                yield channels[message.channel].topic, channels[message.channel].msgtype, message.payload


def _taken(source: LiveSource, records: list[Record], enough: Callable[[list[Record]], bool]) -> None:
    def come() -> bool:
        records.extend(source.take())
        return enough(records)

    until(come, lambda: f"{source.scans_come} scans came, {source.losses}, {source.waiting_for()}")


def _scans(records: list[Record]) -> list[Scan]:
    return [record for record in records if isinstance(record, Scan)]


class Peer:
    """The publisher of Fast DDS: `tests/robot/fastdds/peer.cpp` says what its lines mean."""

    def __init__(self, program: Path, run: Path) -> None:
        self.messages = list(_messages(run))
        self._numbers = {topic: k for k, topic in enumerate(dict.fromkeys(m[0] for m in self.messages))}
        self._process = subprocess.Popen(
            [str(program), str(DOMAIN)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def announce(self, *, reliable: bool, topics: tuple[str, ...] = ()) -> None:
        """Make the writers of some topics, or of all."""
        for topic, number in self._numbers.items():
            msgtype = next(m[1] for m in self.messages if m[0] == topic)
            package, _, name = msgtype.split("/")
            latched = int(topic.endswith("tf_static"))
            sure = int(reliable or latched)
            if not topics or topic in topics:
                self._say(f"W {number} rt{topic} {package}::msg::dds_::{name}_ {sure} {latched}\n".encode())
        self.finish()

    def withdraw(self, topic: str) -> None:
        """Delete a writer."""
        self._say(f"D {self._numbers[topic]}\n".encode())
        self.finish()

    def send(self, pause_us: int = 0) -> None:
        """Send all messages."""
        for topic, msgtype, payload in self.messages:
            pause = pause_us if msgtype == POINT_CLOUD else 0
            self._say(f"M {self._numbers[topic]} {len(payload)} {pause}\n".encode() + payload)
        self.finish()

    def matched(self, topic: str) -> None:
        """Wait until somebody listens to a topic."""
        self._say(f"A {self._numbers[topic]}\n".encode())
        self.finish()

    def finish(self) -> None:
        """Wait until all that was said is done."""
        self._say(b"P\n")
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"done\n"

    def close(self) -> None:
        self._process.kill()
        self._process.wait(30)
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()

    def _say(self, line: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The peer, compiled against Debian's libfastrtps-dev."""
    compiler = shutil.which("c++")
    if compiler is None or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("no C++ compiler, or Debian's libfastrtps-dev is not installed")
    made = tmp_path_factory.mktemp("fastdds") / "peer"
    words = [compiler, "-std=c++17", str(PEER), "-o", str(made), "-lfastrtps", "-lfastcdr", "-lpthread"]
    subprocess.run(words, check=True)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("reliable", [True, False])
def test_a_robot_of_fast_dds_is_found_heard_lost_and_found_again(program: Path, drive: Path, reliable: bool):
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    with closing(Peer(program, drive)) as robot, closing(open_live(f"dds:?domain={DOMAIN}")) as source:
        until(lambda: not source.listen() and "no scans are announced" in source.waiting_for())
        robot.announce(reliable=reliable)
        until(lambda: source.listen() or "announced and silent" in source.waiting_for(), source.waiting_for)
        topic = next(m[0] for m in robot.messages if m[1] == POINT_CLOUD)
        robot.matched(topic)
        records: list[Record] = []
        robot.send(100_000)
        _taken(source, records, lambda records: len(_scans(records)) >= SCANS // 2)
        known = source.description
        assert (known.kind, known.has_odometry, known.sensor.rings) == ("ROS 2 over DDS", True, 16)
        np.testing.assert_allclose(known.T_base_lidar.t, [0.2, 0.0, 0.9])
        assert {len(scan.points) for scan in _scans(records)} == {POINTS}
        assert any(isinstance(record, Odometry) for record in records)
        if reliable:
            until(lambda: source.scans_come == SCANS, lambda: str(source.scans_come))
            assert source.losses == {}
        robot.withdraw(topic)
        until(lambda: not source.take() and "the robot is lost" in source.notices())
        robot.announce(reliable=not reliable, topics=(topic,))  # another quality of service than before
        until(lambda: not source.take() and "the robot is back" in source.notices())
        heard = len(_scans(records))
        robot.matched(topic)
        robot.send(100_000)
        _taken(source, records, lambda records: len(_scans(records)) >= heard + SCANS // 2)


def test_a_writer_in_cdr_is_heard(drive: Path):
    """Without a peer: CycloneDDS writes too, so that only the way from discovery to records is tested."""
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from app.robot.dds_types import idl_type

    with closing(open_live(f"dds:?domain={DOMAIN}")) as source:
        until(lambda: not source.listen() and "no scans are announced" in source.waiting_for())
        participant = DomainParticipant(DOMAIN)
        writers: dict[str, Any] = {}
        for topic, msgtype, _ in _messages(drive, one_each=True):
            held = [Policy.Durability.TransientLocal] if topic.endswith("tf_static") else []
            # A writer waits so long for a reader that is behind, and fails then.
            qos = Qos(Policy.Reliability.Reliable(60 * 10**9), Policy.History.KeepAll, *held)
            written: Any = Topic(participant, f"rt{topic}", idl_type(msgtype))
            writers[topic] = DataWriter(participant, written, qos)
        sent = [(topic, idl_type(kind).deserialize(cdr)) for topic, kind, cdr in _messages(drive)]
        # A writer that keeps no past writes for those only whom it has met.
        until(
            lambda: source.listen() or all(w.get_matched_subscriptions() for w in writers.values()),
            source.waiting_for,
        )
        records: list[Record] = []
        for topic, message in sent:
            writers[topic].write(message)
            records.extend(source.take())
        _taken(source, records, lambda records: len(_scans(records)) == SCANS)
        assert source.losses == {}
        assert {len(scan.points) for scan in _scans(records)} == {POINTS}
        np.testing.assert_allclose(source.description.T_base_lidar.t, [0.2, 0.0, 0.9])
        writers.clear()
        del participant


def test_the_web_of_an_absent_network_is_said(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    with closing(open_live(f"dds:?domain={DOMAIN}&interface=203.0.113.9")) as source:
        until(lambda: "cannot take part in DDS domain" in source.waiting_for(), source.waiting_for)
