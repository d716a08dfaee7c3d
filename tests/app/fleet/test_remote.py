"""Robots that are heard by a process of its own: what their cards say when it ends, or never begins."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.fleet import server as module
from app.fleet.server import RemoteRobots
from tests.app.fleet.test_fleet import make

RED = {
    "silence_s": 0.5,
    "rate_hz": 10.0,
    "distance_m": 4.0,
    "clearance": None,
    "unreadable": 0,
    "map": {"trees": [], "path": [[1.0, 2.0]], "pose": [1.0, 2.0, 0.0]},
    "alive": True,
}
NOTHING_YET = {**RED, "silence_s": None, "map": {"trees": [], "path": [], "pose": [0.0, 0.0, 0.0]}}


def said(**robots: dict[str, Any]) -> str:
    return json.dumps({"problem": "", "place": "connected", "robots": robots})


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.01)


async def test_nothing_is_live_while_nobody_hears_and_the_last_picture_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "_RETRY_S", 0.1)
    begun, go_on = tmp_path / "begun", tmp_path / "go on"
    # The first says a line and ends; the second has heard of nothing yet until it is let go on.
    code = f"""
import pathlib, sys, time
begun, go_on = pathlib.Path({str(begun)!r}), pathlib.Path({str(go_on)!r})
if not begun.exists():
    print({said(red=RED, blue={**RED, "silence_s": 5.0})!r}, flush=True)
    begun.touch()
    sys.exit()
while not go_on.exists():
    time.sleep(0.01)
print({said(red=NOTHING_YET)!r}, flush=True)
sys.stdin.read()
"""
    fleet = make(40000)
    far = RemoteRobots(fleet, "zenoh:tcp/127.0.0.1:9", [sys.executable, "-c", code])
    far.start()
    try:
        await until(lambda: "ended" in fleet.notice)
        card, _ = fleet.remote["red"]
        assert card["state"] == "waiting"
        assert card["detail"].startswith("Nothing heard for ")
        assert "the process that receives the maps ended" in card["detail"]
        go_on.touch()
        await until(lambda: fleet.notice == "")
        assert list(fleet.remote) == ["red", "blue"]
        assert fleet.remote["red"][1] == fleet.remote["blue"][1] == RED["map"]
        assert "its mapping is gone" in fleet.remote["blue"][0]["detail"]
    finally:
        await far.close()


async def test_a_process_that_cannot_be_started_is_said_and_the_fleet_still_ends(tmp_path: Path):
    fleet = make(40000)
    far = RemoteRobots(fleet, "zenoh:tcp/127.0.0.1:9", [str(tmp_path / "nowhere")])
    far.start()
    await until(lambda: "no process can be started: No such file" in fleet.notice)
    await far.close()
