"""Calls come not too often, the newest arguments win, the last are not lost."""

from __future__ import annotations

import asyncio

import pytest

from app.common.timers import Throttle


async def test_the_first_call_is_at_once_and_of_many_the_last_follows() -> None:
    seen: list[int] = []
    done = asyncio.Event()

    def show(number: int) -> None:
        seen.append(number)
        if number == 9:
            done.set()

    throttle = Throttle(show, pause_s=0.05)
    for k in range(10):
        throttle(k)
    assert seen == [0]
    async with asyncio.timeout(10):
        await done.wait()
    assert seen == [0, 9]


async def test_calls_are_apart_and_take_only_their_share() -> None:
    loop = asyncio.get_running_loop()
    now = loop.time()
    times: list[float] = []
    throttle = Throttle(lambda: times.append(loop.time()), pause_s=0.02)
    while len(times) < 5:
        throttle()
        await asyncio.sleep(0)
    assert times[-1] - now >= 4 * 0.02


async def test_what_waits_can_be_forgotten() -> None:
    seen: list[int] = []
    throttle = Throttle(seen.append, pause_s=0.01)
    throttle(1)
    throttle(2)
    throttle.cancel()
    throttle(3)
    while len(seen) < 2:
        await asyncio.sleep(0)
    assert seen == [1, 3]


async def test_a_call_that_fails_does_not_end_those_after_it() -> None:
    seen: list[int] = []

    def show(number: int) -> None:
        if number == 0:
            raise ValueError("a fault on purpose")
        seen.append(number)

    throttle = Throttle(show, pause_s=0.0)
    with pytest.raises(ValueError, match="on purpose"):
        throttle(0)
    while not seen:
        throttle(1)
        await asyncio.sleep(0)
    assert seen[0] == 1
