"""The robots of a router, found by their liveliness, each get a place in the fleet."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from app.extensions.fleet.fleet import RobotWatch
from app.extensions.fleet.members import robots_at, watched_router
from app.sources.live_address import ZenohAddress, parse_address
from app.worker.protocol import Open
from tests.app.extensions.fleet.test_fleet import make
from tests.app.robot.conftest import Robot, free_port, until


def address_at(port: int, query: str = "") -> ZenohAddress:
    address = parse_address(f"zenoh:tcp/127.0.0.1:{port}{query}")
    assert isinstance(address, ZenohAddress)
    return address


async def come(fleet_names: Callable[[], list[str]], wanted: list[str]) -> None:
    async with asyncio.timeout(60):
        while fleet_names() != wanted:
            await asyncio.sleep(0.02)


async def test_robots_get_a_dashboard_as_they_come(router: int, robots: Callable[[str], Robot]):
    fleet = make(free_port())
    watching = RobotWatch(fleet, address_at(router), Open("", record="/nowhere/live.mcap", publish=True))
    watching.start()
    try:
        async with asyncio.timeout(60):
            while "no robot is announced" not in fleet.notice:
                await asyncio.sleep(0.02)
        started = []
        for name in ("red", "blue"):
            started.append(await asyncio.to_thread(robots, name))
            await come(lambda: list(fleet.members), ["red", "blue"][: len(started)])
        assert fleet.notice == ""
        for name, member in fleet.members.items():
            assert member.source.uri == f"zenoh:tcp/127.0.0.1:{router}?robot={name}"
            assert member.source.record == f"/nowhere/live-{name}.mcap"
            assert member.source.publish
        await asyncio.to_thread(started[0].kill)
        await asyncio.sleep(0.1)
        assert list(fleet.members) == ["red", "blue"], "who is lost keeps its map and its card"
    finally:
        await watching.close()
        await fleet.close()


@pytest.mark.slow
def test_a_router_with_several_robots_is_a_fleet(router: int, robots: Callable[[str], Robot]):
    one = Open(f"zenoh:tcp/127.0.0.1:{router}")
    robots("red")
    until(lambda: robots_at(address_at(router)) == ["red"])
    assert watched_router([one]) is None
    everyone = Open(f"{one.uri}?robot=*")
    watched = watched_router([everyone])
    assert watched is not None
    assert (watched[0].robot, watched[1]) == ("", everyone)
    robots("blue")
    until(lambda: robots_at(address_at(router)) == ["blue", "red"])
    assert watched_router([one]) is not None
    for uri in (f"{one.uri}?robot=red", "velodyne:127.0.0.1:2368", "sim:stand"):
        assert watched_router([Open(uri)]) is None
    assert watched_router([one, one]) is None


@pytest.mark.slow
def test_a_router_that_does_not_answer_is_no_fleet():
    assert robots_at(address_at(free_port())) == []
