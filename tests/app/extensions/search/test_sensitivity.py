"""Points come one by one; a newer question, another run and a dead process end what was asked before."""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import pytest_asyncio

from app.extensions.search.jobs import RunWithTruth
from app.extensions.search.page import Question, Sensitivity
from app.sources.request import SourceRequest
from app.store.records import Content
from app.web.auth import viewer_token
from pipeline.config import preset
from pipeline.errors import ParameterError, StemmapError
from pipeline.types.records import TruthTrees
from tests.app.extensions.search.jobs import job
from tests.app.fakes import opened, truth_trees
from tests.app.server_for_tests import BEARER, TOKEN, running

NAME = "clustering.eps"


class Heard:
    """What was told, and waiting for it."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []
        self._more = asyncio.Event()

    def __call__(self, told: dict[str, Any]) -> None:
        self.messages.append(told)
        self._more.set()

    async def until(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        async with asyncio.timeout(40):
            while not (self.messages and wanted(self.messages[-1])):
                self._more.clear()
                await self._more.wait()
        return self.messages[-1]


@pytest_asyncio.fixture
async def asked(tmp_path: Path) -> AsyncIterator[tuple[Sensitivity, Heard]]:
    """On a process that answers each job with its eps, see `fake_worker`."""
    heard = Heard()
    made = Sensitivity(
        heard, (sys.executable, "-m", "tests.app.extensions.search.fake_worker", str(tmp_path))
    )
    yield made, heard
    await made.leave()


def question(*values: float, seed: int = 0, name: str = NAME) -> Question:
    return Question(job(0.1, seed=seed).run, preset("forest"), name, values)


def is_whole(told: dict[str, Any]) -> bool:
    return len(told.get("points", ())) == told.get("of")


async def test_every_point_is_told_as_it_comes_and_values_that_cannot_be_say_why(asked):
    matters, heard = asked
    matters.ask(question(5.0, 0.01, 9.0, 1.0))
    told = await heard.until(is_whole)
    assert [len(message["points"]) for message in heard.messages] == [0, 1, 2, 3, 4]
    assert [point["value"] for point in told["points"]] == [5.0, 0.01, 9.0, 1.0]
    assert [point.get("f1") for point in told["points"]] == [5.0, 0.01, None, 1.0]
    assert "less than or equal to 5" in told["points"][2]["error"]
    assert told["asked_with"][NAME] == preset("forest").clustering.eps


async def test_a_newer_question_ends_the_one_before(asked):
    matters, heard = asked
    matters.ask(question(*(0.1 + 0.01 * k for k in range(60))))
    await heard.until(lambda told: len(told["points"]) >= 2)
    matters.ask(question(0.2, 0.3))
    told = await heard.until(lambda told: told["of"] == 2 and is_whole(told))
    assert [point["f1"] for point in told["points"]] == [0.2, 0.3]
    assert not any(is_whole(message) for message in heard.messages if message["of"] == 60)


async def test_a_process_that_dies_is_started_again_and_one_that_always_dies_is_told(asked):
    matters, heard = asked
    matters.ask(question(0.2, seed=13))
    assert (await heard.until(is_whole))["points"][0]["f1"] == 0.2
    matters.ask(question(0.3, seed=666))
    assert "processes were lost" in (await heard.until(lambda told: bool(told["error"])))["error"]


async def test_who_leaves_the_run_is_told_nothing_of_it_any_more(asked):
    matters, heard = asked
    matters.ask(question(*(0.1 + 0.01 * k for k in range(60))))
    await heard.until(lambda told: len(told["points"]) >= 1)
    await matters.leave()
    known = len(heard.messages)
    assert heard.messages[-1] == {}
    matters.ask(question(0.4))
    await heard.until(is_whole)
    assert all(message["of"] == 1 for message in heard.messages[known:])


async def test_of_many_questions_at_once_only_the_newest_is_worked_at(tmp_path):
    heard, done = Heard(), tmp_path / "done"
    answer = (sys.executable, "-m", "tests.app.extensions.search.fake_worker", str(tmp_path), str(done))
    matters = Sensitivity(heard, answer)
    (tmp_path / "wait").touch()
    matters.ask(question(0.2))
    while not done.exists() or not done.read_text().endswith("\n"):  # it is begun, and is not answered yet
        await asyncio.sleep(0.01)
    for k in range(1, 20):
        matters.ask(question(0.2 + 0.01 * k))
        await asyncio.sleep(0.02)  # long enough for some of them to get into the queue
    matters.ask(question(0.9, 1.0))
    (tmp_path / "wait").unlink()
    await heard.until(lambda told: told.get("of") == 2 and is_whole(told))
    await matters.leave()
    assert done.read_text().split() == ["0.2", "0.9", "1.0"]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (("/no/such/program",), "no process can be started"),
        ((sys.executable, "-c", "input(); print('x' * (17 << 20))"), "processes were lost"),
    ],
)
async def test_a_process_that_cannot_work_is_told_and_not_waited_for(command, says):
    heard = Heard()
    matters = Sensitivity(heard, command)
    matters.ask(question(0.1))
    assert says in (await heard.until(lambda told: bool(told["error"])))["error"]
    await matters.leave()


async def test_what_cannot_be_asked_is_refused(asked):
    matters, _ = asked
    for name, values in (("clustering.epz", (0.1,)), (NAME, ()), (NAME, tuple(range(100)))):
        with pytest.raises(ParameterError):
            matters.ask(question(*values, name=name))


TRUTH = TruthTrees(np.zeros(1), np.zeros(1), np.full(1, np.nan), ("tree",))


@pytest.mark.parametrize(
    ("digest", "uri", "truth", "says"),
    [
        ("", "sim:stand", TRUTH, "no run is open"),
        ("d", "zenoh:tcp/10.0.0.1:7447", TRUTH, "Open its recording"),
        ("d", "sim:stand", None, "tab Annotate"),
    ],
)
def test_a_run_that_cannot_be_scored_says_what_to_do(digest, uri, truth, says):
    with pytest.raises(StemmapError, match=says):
        RunWithTruth.shown(SourceRequest(uri), digest, truth)


def test_the_run_that_is_asked_of_is_the_one_that_is_shown():
    source = SourceRequest(
        "sim:stand", "static", 7, {"scan": "/other"}, (0.1, 0.2, 0.9, 0.0, 0.0, math.pi / 2)
    )
    made = RunWithTruth.shown(source, "d", TRUTH)
    assert (made.source, made.digest) == (source, "d")
    assert msgspec.json.decode(msgspec.json.encode(made.truth), type=list[Content]) == made.truth


async def test_the_address_takes_a_question_and_refuses_what_cannot_be():
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        body = {"name": NAME, "values": [0.1, 0.2]}
        refused = await client.post("/api/sensitivity", json=body)
        assert (refused.status_code // 100, refused.json()["error"]["what"]) == (4, "no run is open")
        await dashboard.receive(opened(truth=truth_trees()))
        for wrong in (
            {**body, "values": []},
            {**body, "values": [[1]]},
            {"name": NAME},
            {**body, "name": "no.such"},
        ):
            assert (await client.post("/api/sensitivity", json=wrong)).status_code // 100 == 4
        assert (await client.post("/api/sensitivity", json=body)).status_code == 202
        assert (await client.delete("/api/sensitivity")).status_code == 200
        viewer = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
        assert (await client.post("/api/sensitivity", json=body, headers=viewer)).status_code == 403
