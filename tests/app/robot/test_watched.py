"""A robot that maps by itself is watched from afar: its results are heard, its scans are not."""

from __future__ import annotations

import asyncio
import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.cli import serve
from app.fleet.hearing import TOPICS, UNREADABLE, Results, results_topic
from app.fleet.server import RemoteRobots
from app.robot.source import open_live
from app.worker.numba_warmup import warm_up
from app.worker.protocol import Open
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose2
from pipeline.io.recording import outputs
from pipeline.types.clearance import Clearance, Zone
from tests.app.fakes import START_NS, frame, path, trees
from tests.app.fleet.test_fleet import make
from tests.app.robot.conftest import ROOT, Child, Robot, free_port, listening
from tests.app.robot.conftest import until as patiently

_START = "from app.cli import command; command()"


def messages() -> dict[str, bytes]:
    """What a mapper publishes of a scan."""
    seen = replace(frame(3, START_NS), trees=trees(4), clearance=Clearance(Zone.STOP, 0.75, within=3.0))
    seen = replace(seen, estimate=replace(seen.estimate, T_map_base=Pose2(4.0, -2.0, 3.0)))
    return outputs.scan_messages(seen) | outputs.map_messages(seen, path([0.0, 1.0, 3.0]))


def test_what_was_published_is_what_is_shown():
    results = Results()
    for topic, payload in messages().items():
        if topic in TOPICS:
            results.take(topic, payload, 10.0)
    told = results.report(10.5, alive=True)
    known = trees(4)
    shown = told.map["trees"]
    assert [[tree["x"], tree["y"]] for tree in shown] == known.position[known.confirmed].tolist()
    assert [tree["dbh_cm"] for tree in shown] == [30.0, None, 30.0]
    np.testing.assert_allclose(told.map["pose"], [4.0, -2.0, 3.0], atol=1e-3)
    assert [x for x, _ in told.map["path"]] == [0.0, 1.0, 3.0]
    assert told.distance_m == pytest.approx(3.0 + math.hypot(1.0, 2.0), abs=0.1)
    assert told.clearance is not None
    assert (told.clearance["zone"], told.clearance["ahead_m"]) == ("stop", 0.75)
    assert (told.silence_s, results.losses) == (0.5, {})


@given(st.sampled_from(TOPICS), st.binary(max_size=200), st.integers(0, 400))
def test_damaged_messages_are_counted_and_harm_nothing(topic: str, extra: bytes, cut: int):
    results, whole = Results(), messages()
    for name in TOPICS:
        results.take(name, whole[name], 1.0)
    before = json.dumps(results.report(2.0, alive=True).map["trees"])
    results.take(topic, whole[topic][:cut] + extra, 1.5)
    results.report(2.0, alive=True)
    if results.losses.get(UNREADABLE) or topic != outputs.DETECTIONS:
        assert json.dumps(results.report(2.0, alive=True).map["trees"]) == before


def test_results_are_known_by_their_names():
    assert results_topic("/red/stemmap/path") == ("red", "path")
    assert results_topic("/team/blue/stemmap/zone") == ("team/blue", "zone")
    assert results_topic("/stemmap/detections") == ("", "detections")
    for other in ("/red/points", "/red/stemmap/trees", "/stemmap", "/red/notstemmap/path"):
        assert results_topic(other) is None


def test_such_an_address_is_watched_and_not_mapped():
    uri = "zenoh:tcp/127.0.0.1:9?mapped=robot"
    watched = serve._watched([Open(uri)])
    assert watched is not None
    assert watched[0].mapped_there
    with pytest.raises(SourceError, match="is shown and not mapped again"):
        open_live(uri)
    with pytest.raises(SourceError, match="only one robot"):
        open_live("zenoh:tcp/127.0.0.1:9?robot=*")
    with pytest.raises(SourceError, match="is unknown"):
        open_live("zenoh:tcp/127.0.0.1:9?mapped=moon")


async def test_a_robot_that_maps_is_watched_from_afar_until_it_ends(
    router: int, robots: Callable[[str], Robot], tmp_path: Path
):
    await asyncio.to_thread(warm_up)  # what a fresh checkout compiles is not waited for below
    fleet = make(free_port())
    far = RemoteRobots(fleet, f"zenoh:tcp/127.0.0.1:{router}?mapped=robot")
    far.start()
    robot = await asyncio.to_thread(robots, "red")
    words = ["map", f"zenoh:tcp/127.0.0.1:{router}?robot=red", "--publish", "--out", str(tmp_path / "out")]
    mapping = subprocess.Popen(
        [sys.executable, "-c", _START, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )

    async def until(condition: Callable[[dict[str, Any]], bool]) -> None:
        async with asyncio.timeout(240):
            while "red" not in fleet.remote or not condition(fleet.remote["red"][0]):
                await asyncio.sleep(0.05)

    try:
        async with asyncio.timeout(60):
            while "no robot publishes a map of its own" not in fleet.notice and "red" not in fleet.remote:
                await asyncio.sleep(0.05)
        await until(bool)
        robot.send()
        await until(lambda card: card["state"] == "playing" or "Nothing heard for" in card["detail"])
        assert fleet.notice == ""
        assert len(fleet.remote["red"][1]["path"]) >= 1
        fleet.send_cards()
        (_, told), *_ = [m for m in fleet.live.messages_after(0) if b'"fleet"' in m[1]]
        (card,) = json.loads(told)["members"]
        assert (card["name"], card["remote"]) == ("red", True)
        mapping.send_signal(signal.SIGINT)
        assert await asyncio.to_thread(mapping.wait, 120) in (0, 3)
        await until(lambda card: "its mapping is gone" in card["detail"])
        assert len(fleet.remote["red"][1]["path"]) >= 1, "the last picture stays"
    finally:
        mapping.kill()
        await asyncio.to_thread(mapping.wait)
        await far.close()
        await fleet.close()


def test_routers_that_are_connected_pass_a_robot_on(router: int, robots: Callable[[str], Robot]):
    far = free_port()
    other = Child("-m", "tests.app.robot.router", str(far), str(router))
    assert other.hear() == "ready"
    with closing(listening(f"zenoh:tcp/127.0.0.1:{far}?robot=red")) as source:
        robot = robots("red")
        patiently(
            lambda: source.listen() or "announced and silent" in source.waiting_for(), source.waiting_for
        )
        robot.send()
        patiently(source.listen, source.waiting_for)
        assert source.robots == ["red"]
    other.kill()
