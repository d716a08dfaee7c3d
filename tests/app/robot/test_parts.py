"""Addresses, tokens, choices and the queue: what a live run is made of."""

from __future__ import annotations

import socket
import threading
from collections.abc import Sequence
from contextlib import closing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.robot.link import MAX_BYTES, MAX_OTHERS, MAX_SCANS, SKIPPED, TOO_MANY, Inbox, Link
from app.robot.topics import Publisher, choose
from app.robot.velodyne import VelodyneLink
from app.robot.zenoh import ZenohLink, data_key, publisher_of
from app.sources.live_address import VelodyneAddress, ZenohAddress, is_live, parse_address
from pipeline.errors import SourceError
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.topics import IMU, LASER_SCAN, NAV_SAT_FIX, ODOMETRY, POINT_CLOUD, TRANSFORMS
from tests.app.robot.conftest import free_port, until

NAMES = st.from_regex(r"\A[a-z][a-z0-9_]{0,8}\Z")


def test_an_address_has_an_endpoint_and_options():
    found = parse_address("zenoh:tcp/10.0.0.5:7447?robot=/red/&domain=7&odometry=/wheels")
    assert isinstance(found, ZenohAddress)
    assert (found.endpoint, found.domain, found.robot) == ("tcp/10.0.0.5:7447", 7, "red")
    assert found.topics == {"odometry": "/wheels"}
    assert is_live(found.uri)
    assert not is_live("run.mcap")


def test_a_sensor_has_a_place_and_a_sender():
    found = parse_address("velodyne:0.0.0.0:2368?from=192.168.1.201")
    assert isinstance(found, VelodyneAddress)
    assert (found.host, found.port, found.sender) == ("0.0.0.0", 2368, "192.168.1.201")  # noqa: S104
    assert is_live(found.uri)
    assert parse_address("velodyne:127.0.0.1:2368").uri


@pytest.mark.parametrize(
    "uri",
    [
        "velodyne:0.0.0.0:2368",
        "velodyne:0.0.0.0:0?from=192.168.1.201",
        "velodyne:0.0.0.0:2368?from=lidar",
        "zenoh:",
        "zenoh:tcp/host:0",
        "zenoh:tcp/host:70000",
        "zenoh:udp/host:7447",
        'zenoh:tcp/h:7447",x',
        "zenoh:tcp/host:7447?colour=red",
        "zenoh:tcp/host:7447?domain=233",
    ],
)
def test_what_is_no_address_is_refused(uri: str):
    with pytest.raises(SourceError):
        parse_address(uri)


@given(NAMES, NAMES, NAMES, st.integers(0, 200))
def test_tokens_and_keys_are_those_of_another_library(robot: str, node: str, topic: str, domain: int):
    entity = pytest.importorskip("zenoh_ros2_sdk.entity", reason="zenoh-ros2-sdk is not installed")
    keyexpr = pytest.importorskip("zenoh_ros2_sdk.keyexpr")
    qos = pytest.importorskip("zenoh_ros2_sdk.qos")
    name, kind = f"/{robot}/{topic}", "sensor_msgs::msg::dds_::PointCloud2_"
    owner = entity.NodeEntity(domain, "abc", 1, node, f"/{robot}")
    form = {"type_hash": "RIHS01_00", "qos": qos.DEFAULT_QOS_PROFILE.encode()}
    endpoint = entity.EndpointEntity(owner, 2, entity.EntityKind.PUBLISHER, name, kind, **form)
    token = keyexpr.endpoint_liveliness_keyexpr(endpoint)
    assert publisher_of(token) == Publisher(robot, name, POINT_CLOUD)
    assert publisher_of(keyexpr.node_liveliness_keyexpr(owner)) is None
    assert data_key(domain, name, POINT_CLOUD, "RIHS01_00") == keyexpr.topic_keyexpr(
        domain, name, kind, "RIHS01_00"
    )


class IdleLink(Link):
    """A link that connects to nothing."""

    place = nothing = ""

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Nothing is received."""

    def receive(self) -> None:
        """Nothing is received."""

    def failure(self, error: Exception) -> str:
        return str(error)


@given(st.text(max_size=200))
def test_any_text_is_a_token_or_none(text: str):
    link = IdleLink(Inbox(), "idle")
    link.announce(text, publisher_of(text))
    link.announce(f"@ros2_lv/{text}", publisher_of(f"@ros2_lv/{text}"))
    link.withdraw(text)
    assert link.publishers() == []


def test_a_network_with_too_many_topics_is_told_of_and_room_comes_back(monkeypatch):
    monkeypatch.setattr("app.robot.link.MAX_ENDPOINTS", 2)
    token = "@ros2_lv/0/abc/0/{}/MP/%/%/driver/%topic{}/std_msgs::msg::dds_::Empty_/RIHS01_00/::,10:,:,:,,"
    first, second, third = (token.format(k, k) for k in range(3))
    link = IdleLink(Inbox(), "idle")
    for each in (first, second, first, "no token of a publisher"):
        link.announce(each, publisher_of(each))
    assert (len(link.publishers()), link.losses) == (2, {})
    link.announce(third, publisher_of(third))
    assert (len(link.publishers()), link.losses) == (2, {TOO_MANY: 1})
    link.withdraw(first)
    link.announce(third, publisher_of(third))
    assert [publisher.topic for publisher in link.publishers()] == ["/topic1", "/topic2"]


ODD = st.text(st.sampled_from("%ab0_*$#?~. -é"), min_size=1, max_size=12)


@given(ODD, ODD)
def test_what_is_read_from_a_token_can_be_listened_to(topic: str, namespace: str):
    zenoh = pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")
    kind = "sensor_msgs::msg::dds_::PointCloud2_"
    found = publisher_of(f"@ros2_lv/0/abc/0/1/MP/%/{namespace}/driver/{topic}/{kind}/RIHS01_00/::,10:,:,:,,")
    if found is not None:
        assert not set("*$#?") & set(found.topic + found.robot)
        zenoh.KeyExpr(data_key(0, found.topic, found.msgtype))
        zenoh.KeyExpr(data_key(0, f"/{found.robot}/stemmap/pose".replace("//", "/"), found.msgtype))


@pytest.mark.parametrize("topic", ["%a%", "%a%%b", "%*"])
def test_a_topic_that_is_no_name_is_passed_over(topic: str):
    kind = "sensor_msgs::msg::dds_::PointCloud2_"
    token = "@ros2_lv/0/abc/0/1/MP/%/%red/driver/{}/" + kind + "/RIHS01_00/q"
    assert publisher_of(token.format("%red%points")) == Publisher("red", "/red/points", POINT_CLOUD)
    assert publisher_of(token.format(topic)) is None


def test_a_session_that_opens_after_the_end_is_closed(monkeypatch: pytest.MonkeyPatch):
    zenoh = pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")
    closed, go_on = threading.Event(), threading.Event()

    class Session:
        def close(self) -> None:
            closed.set()

    def slow(_configuration: object) -> Session:
        assert go_on.wait(60)
        return Session()

    monkeypatch.setattr(zenoh, "open", slow)
    address = parse_address("zenoh:tcp/127.0.0.1:9")
    assert isinstance(address, ZenohAddress)
    link = ZenohLink(address, Inbox())
    link.closing.set()  # as `close` does, which does not wait for ever
    go_on.set()
    assert closed.wait(60)
    link.thread.join(60)
    assert link.session is None


def test_a_connection_that_fails_half_way_is_tried_again(monkeypatch: pytest.MonkeyPatch):
    zenoh = pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")
    sessions: list[FailingSession] = []

    class FailingSession:
        closed = False
        routers: list[str] = ["router"]  # noqa: RUF012

        @property
        def info(self) -> FailingSession:
            return self

        def routers_zid(self) -> list[str]:
            return self.routers

        def liveliness(self) -> FailingSession:
            return self

        def declare_subscriber(self, *_arguments: object, **_named: object) -> None:
            if len(sessions) == 1:
                raise RuntimeError("refused half way")

        def close(self) -> None:
            self.closed = True

    def opened(_configuration: object) -> FailingSession:
        sessions.append(FailingSession())
        return sessions[-1]

    monkeypatch.setattr("app.robot.link._RETRY_S", 0.05)
    monkeypatch.setattr(zenoh, "open", opened)
    address = parse_address("zenoh:tcp/127.0.0.1:9")
    assert isinstance(address, ZenohAddress)
    problems: list[str] = []
    monkeypatch.setattr(
        ZenohLink, "problem", property(lambda _: problems[-1], lambda _, p: problems.append(p)), raising=False
    )
    link = ZenohLink(address, Inbox())
    until(lambda: link.problem == "")
    assert "no connection to tcp/127.0.0.1:9: refused half way" in problems
    assert sessions[0].closed
    sessions[1].routers = []
    until(lambda: link.problem == "no connection to tcp/127.0.0.1:9")
    link.close()
    assert sessions[1].closed


def test_a_sensor_link_goes_on_after_an_error_of_any_kind(monkeypatch: pytest.MonkeyPatch):
    address = parse_address(f"velodyne:127.0.0.1:{free_port()}")
    assert isinstance(address, VelodyneAddress)
    failures = ["out of order"]

    def take(_link: VelodyneLink, packet: bytes, _sender: str) -> None:
        if failures:
            raise ValueError(failures.pop())
        taken.append(packet)

    taken: list[bytes] = []
    monkeypatch.setattr(VelodyneLink, "_take", take)
    monkeypatch.setattr("app.robot.link._RETRY_S", 0.05)
    link = VelodyneLink(address, Inbox())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, closing(link):

        def sent() -> bool:
            sender.sendto(b"packet", (address.host, address.port))
            return bool(taken)

        until(sent)
        until(lambda: link.problem == "")


def there(*topics: tuple[str, str, str]) -> list[Publisher]:
    return [Publisher(*each) for each in topics]


def test_a_robot_is_read_with_its_own_odometry():
    both = [
        Publisher(robot, f"/{robot}/{name}", kind)
        for robot in ("red", "blue")
        for name, kind in (
            ("camera/points", POINT_CLOUD),
            ("velodyne_points", POINT_CLOUD),
            ("gps/odom", ODOMETRY),
            ("odom", ODOMETRY),
            ("imu/data_raw", IMU),
            ("imu/data", IMU),
            ("tf_static", TRANSFORMS),
        )
    ] + there(("", "/tf", TRANSFORMS), ("red", "/stemmap/odom", ODOMETRY))
    found = choose(both, "red", {}, "here")
    assert found is not None
    assert [channel.topic for channel in found.channels] == [
        "/red/velodyne_points",
        "/red/odom",
        "/red/imu/data",
        "/red/tf_static",
        "/tf",
    ]
    assert [channel.number for channel in found.channels] == [1, 2, 3, 4, 5]
    assert any("/red/camera/points" in warning for warning in found.warnings)
    first = choose(both, "", {}, "here")
    assert first is not None
    assert first.robot == "blue"
    assert any("red" in warning for warning in first.warnings)
    assert choose(both, "green", {}, "here") is None


def test_a_planar_laser_is_read_where_there_is_no_lidar_and_fixes_beside():
    alone = there(("", "/bumper", LASER_SCAN), ("", "/gps/fix", NAV_SAT_FIX), ("", "/odom", ODOMETRY))
    found = choose(alone, "", {}, "here")
    assert found is not None
    assert [channel.topic for channel in found.channels] == ["/bumper", "/odom", "/gps/fix"]
    both = choose([*alone, *there(("", "/camera/points", POINT_CLOUD))], "", {}, "here")
    assert both is not None
    assert both.channels[0].topic == "/camera/points"


def test_a_topic_of_another_type_is_refused():
    with pytest.raises(SourceError, match="is of the type"):
        choose(there(("", "/odom", ODOMETRY)), "", {"scan": "/odom"}, "here")


def message(number: int, size: int = 10) -> Message:
    return Message(number, number, bytes(size))


def test_the_oldest_scans_fall_out_and_are_counted():
    inbox = Inbox()
    assert inbox.take() is None
    for k in range(MAX_SCANS + 7):
        inbox.put(message(k), is_scan=True)
        inbox.put(message(1000 + k), is_scan=False)
    assert inbox.losses == {SKIPPED: 7}
    taken = []
    while (found := inbox.take()) is not None:
        taken.append(found.channel)
    assert [k for k in taken if k < 1000] == list(range(7, MAX_SCANS + 7))
    assert [k for k in taken if k >= 1000] == [1000 + k for k in range(MAX_SCANS + 7)]


def test_fixed_transforms_outlast_a_long_wait():
    inbox = Inbox()
    inbox.begin(None, [7])
    inbox.put(message(7), is_scan=False)
    for _ in range(MAX_OTHERS + 1):
        inbox.put(message(1), is_scan=False)
    assert inbox.take() == message(7)


def test_messages_come_out_in_the_order_in_which_they_came():
    inbox = Inbox()
    kinds = [k % 3 == 0 for k in range(40)]
    for k, is_scan in enumerate(kinds):
        inbox.put(message(k), is_scan=is_scan)
    taken = []
    while (found := inbox.take()) is not None:
        taken.append(found.channel)
    assert taken == list(range(40))


def test_large_messages_do_not_fill_the_memory():
    inbox = Inbox()
    assert inbox.take() is None
    for k in range(5):
        inbox.put(message(k, MAX_BYTES // 3), is_scan=True)
    assert inbox.losses == {SKIPPED: 2}
    assert inbox.scans_waiting == 3
