"""Browsers are told states: the newest counts, a slow one skips, the path comes in pieces."""

from __future__ import annotations

import asyncio
import json
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.dashboard.broadcast import Broadcast
from app.dashboard.payload import clearance_payload, ellipses, obstacle_payload
from pipeline.geometry.columns import first_difference
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Clearance, Zone
from tests.app.fakes import frame


async def following(stream: Any, n: int) -> list[dict[str, Any]]:
    async with asyncio.timeout(10):
        return [json.loads(await anext(stream)) for _ in range(n)]


async def test_a_late_browser_is_told_all_states_once_in_order() -> None:
    live = Broadcast()
    live.publish("status", {"state": "playing"})
    live.publish("truth", None)
    live.publish("status", {"state": "paused"})
    with live.listener() as listener:
        messages = await following(listener.messages(), 2)
    assert messages == [{"type": "truth", "value": None}, {"type": "status", "state": "paused"}]


async def test_only_the_newest_map_is_sent_with_all_of_the_path() -> None:
    live = Broadcast()
    with live.listener() as listener:
        stream = listener.messages()
        xy = np.zeros((0, 2))
        live.show({"type": "map", "index": 0}, xy)
        assert (await following(stream, 1))[0]["path"] == {"start": 0, "points": []}
        for k in range(1, 6):
            xy = np.array([[float(i), 0.5] for i in range(k)])
            live.show({"type": "map", "index": k}, xy)
        (newest,) = await following(stream, 1)
        assert newest["index"] == 5
        assert newest["path"] == {"start": 0, "points": xy.tolist()}
        rewritten = np.vstack([xy[:3], [[9.0, 9.0]]])
        live.show({"type": "map", "index": 6}, rewritten)
        (cut,) = await following(stream, 1)
        assert cut["path"] == {"start": 3, "points": [[9.0, 9.0]]}


def test_a_long_path_is_encoded_in_parts() -> None:
    path = np.arange(400_000.0).reshape(-1, 4) / 7.0
    tracemalloc.start()
    try:
        text = Broadcast().path_json(1, path, 3)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert json.loads(text) == {"start": 3, "points": np.round(path[3:], 3).tolist()}
    assert peak < 15_000_000  # its text has 4 MB, the lists of all rows 18 MB


async def test_what_did_not_change_is_not_told_again() -> None:
    live = Broadcast()
    with live.listener() as listener:
        stream = listener.messages()
        live.publish("status", {"state": "paused"})
        await following(stream, 1)
        live.publish("status", {"state": "paused"})
        live.publish("selection", {"tree": 3})
        assert await following(stream, 1) == [{"type": "selection", "tree": 3}]


async def test_maps_wait_for_their_round_and_states_do_not() -> None:
    live = Broadcast()
    with live.listener() as listener:
        stream = listener.messages()
        live.show({"type": "map", "index": 0}, np.zeros((0, 2)))
        await following(stream, 1)
        live.show({"type": "map", "index": 1}, np.zeros((0, 2)))
        live.publish("status", {"state": "paused"})
        kinds = [message["type"] for message in await following(stream, 2)]
    assert kinds == ["status", "map"]
    assert not live._listeners


@given(st.lists(st.integers(0, 2), max_size=6), st.lists(st.integers(0, 2), max_size=6))
def test_a_path_is_cut_where_it_first_differs(old: list[int], new: list[int]) -> None:
    a = np.array([[x, 0.0] for x in old]).reshape(-1, 2)
    b = np.array([[x, 0.0] for x in new]).reshape(-1, 2)
    start = first_difference(a, b)
    assert old[:start] == new[:start]
    assert start == min(len(old), len(new)) or old[start] != new[start]


@given(st.floats(0.01, 3), st.floats(0.01, 3), st.floats(-3, 3))
def test_the_ellipse_gives_the_covariance_back(a: float, b: float, angle: float) -> None:
    major, minor = max(a, b), min(a, b)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = R @ np.diag([major**2, minor**2]) @ R.T
    ((big, small, direction),) = ellipses(covariance[None])
    R = np.array([[np.cos(direction), -np.sin(direction)], [np.sin(direction), np.cos(direction)]])
    np.testing.assert_allclose(R @ np.diag([big**2, small**2]) @ R.T, covariance, atol=2e-3)
    assert big >= small


def test_the_page_is_told_how_far_the_way_is_free() -> None:
    assert clearance_payload(None) is None
    told = clearance_payload(Clearance(Zone.SLOW, 1.23456, within=3.0))
    assert told == {"zone": "slow", "ahead_m": 1.235, "beside_m": None, "within_m": 3.0}


def test_the_page_is_told_where_the_obstacle_is_on_the_map() -> None:
    ahead = Clearance(Zone.STOP, 0.7, 0.0, x=1.2, y=0.1, curvature=0.0, within=3.0, begins=0.4)
    shot = frame(0, 0)
    turned = replace(shot.estimate, T_map_base=Pose2(10.0, 20.0, np.pi / 2))
    told = obstacle_payload(replace(shot, estimate=turned, clearance=ahead), 0.9)
    assert told is not None
    assert (told["x"], told["y"]) == (9.9, 21.2)
    # From the end of the robot to the end of the slow zone, as wide as the path.
    assert np.ptp(told["outline"], axis=0).tolist() == pytest.approx([0.9, 3.0])
    assert np.mean(told["outline"], axis=0).tolist() == pytest.approx([10.0, 21.9])
    for zone in (Zone.CLEAR, Zone.UNKNOWN):
        assert obstacle_payload(replace(shot, clearance=Clearance(zone)), 0.9) is None
