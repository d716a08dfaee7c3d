"""Each robot has a name, an address and a recording that no other has."""

from __future__ import annotations

import asyncio

import pytest

from app.extensions.fleet.fleet import RobotWatch
from app.extensions.fleet.members import NAMELESS, address_of, recorded_apart
from app.robot.topics import Publisher, choose
from app.sources.live_address import ROOT, ZenohAddress, parse_address
from app.worker.protocol import Open
from pipeline.io.readers.topics import POINT_CLOUD
from tests.app.extensions.fleet.test_fleet import make
from tests.app.robot.conftest import free_port

ROUTER = parse_address("zenoh:tcp/127.0.0.1:9")


@pytest.mark.parametrize("robot", ["", "red", "team/blue"])
@pytest.mark.parametrize("uri", ["zenoh:tcp/h:7447", "zenoh:tcp/[::1]:7447?domain=7"])
def test_the_address_of_one_robot_is_that_of_its_router(uri: str, robot: str):
    router = parse_address(uri)
    assert isinstance(router, ZenohAddress)
    own = parse_address(address_of(router, robot))
    assert isinstance(own, ZenohAddress)
    assert (own.endpoint, own.domain, own.robot) == (router.endpoint, router.domain, robot or ROOT)


def test_the_robot_without_a_namespace_is_no_other():
    assert isinstance(ROUTER, ZenohAddress)
    own = parse_address(address_of(ROUTER, ""))
    assert isinstance(own, ZenohAddress)
    alpha, none = Publisher("alpha", "/alpha/points", POINT_CLOUD), Publisher("", "/filtered", POINT_CLOUD)
    assert choose([alpha], own.robot, {}, own.uri) is None
    chosen = choose([alpha, none], own.robot, {}, own.uri)
    assert chosen is not None
    assert (chosen.robot, chosen.channels[0].topic) == ("", "/filtered")
    first = choose([alpha, none], "", {}, own.uri)
    assert first is not None
    assert first.robot == "alpha"


async def test_robots_that_are_called_alike_are_all_shown_and_recorded_apart():
    assert isinstance(ROUTER, ZenohAddress)
    fleet = make(free_port())
    watching = RobotWatch(fleet, ROUTER, Open("", record="/nowhere/live.mcap"))
    robots = ["", "robot", "a/b", "a_b", "A_b", "a.b"]
    for _ in range(2):
        for robot in robots:
            watching.take(robot)
    assert list(fleet.members) == [robot or NAMELESS for robot in robots]
    assert len({member.source.uri for member in fleet.members.values()}) == len(robots)
    records = [member.source.record for member in fleet.members.values()]
    assert len({record.casefold() for record in records}) == len(robots)
    assert records[1:4] == [f"/nowhere/live-{end}.mcap" for end in ("robot", "a_b", "a_b-2")]
    await watching.close()
    await fleet.close()


async def test_a_robot_that_cannot_be_added_does_not_keep_others_out(monkeypatch: pytest.MonkeyPatch):
    assert isinstance(ROUTER, ZenohAddress)
    fleet = make(free_port())
    add = fleet.add

    def fails_for_red(name: str, source: Open) -> bool:
        if name == "red":
            raise RuntimeError("no memory")
        return add(name, source)

    monkeypatch.setattr(fleet, "add", fails_for_red)
    watching = RobotWatch(fleet, ROUTER, Open(""))
    monkeypatch.setattr(watching._link, "robots", lambda: ["red", "blue"])
    watching.start()
    async with asyncio.timeout(20):
        while not fleet.members:
            await asyncio.sleep(0.01)
    assert list(fleet.members) == ["blue"]
    assert fleet.notice == "red cannot be shown: no memory"
    assert watching._task is not None
    assert not watching._task.done()
    await watching.close()
    await fleet.close()


def test_a_recording_is_numbered_where_another_has_its_name():
    source = Open("fake:", record="/data/live.mcap")
    assert recorded_apart(source, "x.1", []).record == "/data/live-x_1.mcap"
    taken = ["/data/live-x_1.mcap", "/data/live-x_1-2.mcap"]
    assert recorded_apart(source, "x_1", taken).record == "/data/live-x_1-3.mcap"
    assert recorded_apart(Open("fake:"), "x_1", taken).record == ""
