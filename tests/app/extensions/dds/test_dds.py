"""A robot on plain DDS: an independent peer of Fast DDS (slow), and CycloneDDS's own writer."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.extensions.dds.address import DdsAddress
from app.extensions.dds.link import Offer, common_offer, offer_of
from app.robot.source import LiveSource
from app.sources.live_address import parse_address
from pipeline.errors import SourceError
from pipeline.io.readers.topics import ODOMETRY, POINT_CLOUD, READ_TYPES, ROS1_TRANSFORMS, TRANSFORMS
from pipeline.types.records import Odometry, Record, Scan
from tests.app.extensions.dds.fast_dds import Peer, messages_of
from tests.app.robot.conftest import POINTS, SCANS, listening, until

#: A domain of this test process: others on the machine must not be heard.
DOMAIN = 100 + os.getpid() % 100


# --- without a network ---------------------------------------------------------------------------


def test_an_address_has_a_domain_and_stays_on_this_machine_unless_told():
    assert parse_address("dds:") == DdsAddress(uri="dds:")
    uri = "dds:?domain=7&interface=192.168.1.10&peer=192.168.1.5,robot1&robot=/red/&scan=/red/points"
    assert parse_address(uri) == DdsAddress(
        uri=uri,
        domain=7,
        interface="192.168.1.10",
        peers=("192.168.1.5", "robot1"),
        robot="red",
        topics={"scan": "/red/points"},
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
    monkeypatch.setattr("app.extensions.dds.address.find_spec", {}.get)
    with pytest.raises(SourceError, match="uv sync --extra dds"):
        parse_address("dds:")


def test_topics_of_ros_are_told_from_others():
    kind = "sensor_msgs::msg::dds_::PointCloud2_"
    offer = offer_of("rt/red/points", kind, "red", reliable=True, latched=False)
    assert offer == Offer("red", "/red/points", POINT_CLOUD, reliable=True, latched=False)
    other = offer_of("rt/tf", "tf2_msgs::msg::dds_::TFMessage_", "red", reliable=True, latched=False)
    assert other == Offer("", "/tf", TRANSFORMS, reliable=True, latched=False)
    for topic, type_name in [("red/points", kind), ("rr/red/reply", kind), ("rt/a b", kind), ("rt/a", "Foo")]:
        assert offer_of(topic, type_name, "", reliable=True, latched=False) is None


def test_a_reader_asks_for_no_more_than_all_writers_offer():
    one = Offer("red", "/red/points", POINT_CLOUD, reliable=True, latched=True)
    assert common_offer([one], "/red/points", POINT_CLOUD) == one
    less = replace(one, reliable=False, latched=False)
    assert common_offer([one, less], "/red/points", POINT_CLOUD) == less
    assert common_offer([one], "/red/points", ODOMETRY) is None


def test_the_types_are_those_that_recordings_are_written_with(drive: Path):
    idl = pytest.importorskip("cyclonedds.idl", reason="cyclonedds, an extra, is not installed")
    from app.extensions.dds.link import idl_type

    for msgtype in set(READ_TYPES) - {ROS1_TRANSFORMS}:
        package, _, name = msgtype.split("/")
        assert idl_type(msgtype).__idl_typename__ == f"{package}.msg.dds_.{name}_"
        assert issubclass(idl_type(msgtype), idl.IdlStruct)
    for topic, msgtype, payload in messages_of(drive, one_each=True):
        message: Any = idl_type(msgtype).deserialize(payload)
        assert message.serialize() == payload, topic


# --- with a peer ---------------------------------------------------------------------------------


def _taken(source: LiveSource, records: list[Record], enough: Callable[[list[Record]], bool]) -> None:
    def come() -> bool:
        records.extend(source.take())
        return enough(records)

    until(come, lambda: f"{source._link.scans} scans came, {source.losses}, {source.waiting_for()}")


def _scans(records: list[Record]) -> list[Scan]:
    return [record for record in records if isinstance(record, Scan)]


@pytest.mark.slow
@pytest.mark.parametrize("reliable", [True, False])
def test_a_robot_of_fast_dds_is_found_heard_lost_and_found_again(fast_dds: Path, drive: Path, reliable: bool):
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    with (
        closing(Peer(fast_dds, DOMAIN, drive)) as robot,
        closing(listening(f"dds:?domain={DOMAIN}")) as source,
    ):
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
            until(lambda: source._link.scans == SCANS, lambda: str(source._link.scans))
            assert source.losses == {}
        robot.withdraw(topic)
        until(lambda: not source.take() and "the robot sends no scans any more" in source.notices())
        robot.announce(reliable=not reliable, topics=(topic,))  # another quality of service than before
        until(lambda: not source.take() and "the robot sends scans again" in source.notices())
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

    from app.extensions.dds.link import idl_type

    with closing(listening(f"dds:?domain={DOMAIN}")) as source:
        until(lambda: not source.listen() and "no scans are announced" in source.waiting_for())
        participant = DomainParticipant(DOMAIN)
        writers: dict[str, Any] = {}
        for topic, msgtype, _ in messages_of(drive, one_each=True):
            held = [Policy.Durability.TransientLocal] if topic.endswith("tf_static") else []
            # A writer waits so long for a reader that is behind, and fails then.
            qos = Qos(Policy.Reliability.Reliable(60 * 10**9), Policy.History.KeepAll, *held)
            written: Any = Topic(participant, f"rt{topic}", idl_type(msgtype))
            writers[topic] = DataWriter(participant, written, qos)
        sent = [(topic, idl_type(kind).deserialize(cdr)) for topic, kind, cdr in messages_of(drive)]
        # A writer that keeps no past writes for those only whom it has met.
        until(
            lambda: source.listen() or all(w.get_matched_subscriptions() for w in writers.values()),
            source.waiting_for,
        )
        # DDS keeps no order between topics, and all scans come at once: the mounting must be there before.
        for topic, message in sent:
            if topic.endswith("tf_static"):
                writers[topic].write(message)
        until(lambda: bool(source._inbox._fixed), source.waiting_for)
        records: list[Record] = []
        for topic, message in sent:
            if not topic.endswith("tf_static"):
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
    with closing(listening(f"dds:?domain={DOMAIN}&interface=203.0.113.9")) as source:
        until(lambda: "cannot take part in DDS domain" in source.waiting_for(), source.waiting_for)
