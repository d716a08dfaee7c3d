"""Who only looks takes no place of a person who works, and little of the mapping's time."""

from __future__ import annotations

import asyncio
import itertools
from contextlib import ExitStack

import pytest
from starlette.exceptions import WebSocketException
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from app.common.timers import RequestQueue
from app.web.auth import Role, viewer_token
from app.web.routes import access
from app.web.routes.access import ConnectionLimit
from tests.app.server_for_tests import BEARER, TOKEN, served

VIEWER = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    most: dict[Role, int] = {"owner": 1, "viewer": 2}
    monkeypatch.setattr(access, "MOST", most)


@pytest.mark.usefixtures("few")
def test_places_are_given_by_role_and_given_back() -> None:
    room = ConnectionLimit()
    with ExitStack() as stack:
        stack.enter_context(room.place("viewer"))
        stack.enter_context(room.place("viewer"))
        with pytest.raises(WebSocketException), room.place("viewer"):
            pass
        with room.place("owner"), pytest.raises(WebSocketException), room.place("owner"):
            pass
        assert room._taken.total() == 2
    assert room._taken.total() == 0


@pytest.mark.usefixtures("few")
async def test_viewers_keep_nobody_out_who_works() -> None:
    async with served() as (host, _):
        address = f"ws://{host}/api/live"
        async with connect(address, additional_headers=VIEWER), connect(address, additional_headers=VIEWER):
            with pytest.raises(InvalidStatus):
                await connect(address, additional_headers=VIEWER)
            async with connect(address, additional_headers=BEARER) as worker:
                assert await worker.recv()


async def test_turns_come_one_after_the_other_with_a_pause() -> None:
    turns, inside, times = RequestQueue(0.02), 0, []
    loop = asyncio.get_running_loop()

    async def work() -> None:
        nonlocal inside
        async with turns.turn():
            inside += 1
            assert inside == 1
            times.append(loop.time())
            await asyncio.sleep(0)
            inside -= 1

    await asyncio.gather(*(work() for _ in range(4)))
    assert all(later - earlier >= 0.02 for earlier, later in itertools.pairwise(times))
    assert len(times) == 4
