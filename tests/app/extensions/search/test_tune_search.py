"""A search that was asked for on the page: its process, what is told of it, what it may be asked."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import httpx
import msgspec
import pytest
import pytest_asyncio

from app.extensions.search.page import TuneSearch, _why_gone
from app.extensions.search.plan import Plan, PlannedRun, Trial, axes_of
from app.extensions.search.result import Result, SearchMessage
from app.sources.request import SourceRequest
from app.worker.protocol import Open
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.app.batch.test_runs import play
from tests.app.extensions.search.jobs import counted
from tests.app.extensions.search.provenance import provenance_in
from tests.app.fakes import opened, truth_trees
from tests.app.server_for_tests import BEARER, Running, running

PLAN = Plan(
    runs=(PlannedRun(SourceRequest("sim:stand?duration=1")),),
    axes=axes_of(["classification.tree_share=0.1..0.9"]),
    start=preset("forest").model_dump(),
    trials=3,
)
POOR, GOOD = (counted(ta, 10 - ta, 0, 0, 0, 0.1, 1.0) for ta in (5, 9))
START = Trial(-1, {"classification.tree_share": 0.4}, 1 / 3, (POOR,))
BEST = Trial(1, {"classification.tree_share": 0.7}, 1 / 19, (GOOD,))
RESULT = Result(
    START, BEST, True, 2, 0, {"classification.tree_share": 1.0}, (("sim:stand?duration=1", "ab", False),)
)
SAID = (
    SearchMessage(start=START),
    SearchMessage(trials=(msgspec.structs.replace(START, number=0), BEST)),
    SearchMessage(result=RESULT),
)


def says(*lines: SearchMessage, then: str = "", hears: Path = Path(os.devnull)) -> list[str]:
    """A process that says some lines when it was told a plan, which it writes to a file."""
    texts = [_line(line) for line in lines]
    code = (
        f"import sys, time, os\nopen({str(hears)!r}, 'w').write(sys.stdin.readline())\n"
        f"for t in {texts!r}: print(t, flush=True)\n{then}"
    )
    return [sys.executable, "-c", code]


def _line(said: SearchMessage) -> str:
    return msgspec.json.encode(said).decode()


async def until(holds: Callable[[], bool]) -> None:
    """Wait until something holds."""
    while not holds():
        await asyncio.sleep(0.01)


async def test_what_a_search_says_is_told_and_its_set_is_a_file_with_its_provenance():
    told: list[dict[str, Any]] = []
    search = TuneSearch(told.append, says(*SAID))
    await search.start(PLAN)
    await until(lambda: not search.is_under_way)
    assert told[0]["state"] == "looking"
    last = told[-1]
    assert (last["state"], last["better"], last["made"]) == ("done", True, 2)
    assert last["start"]["shown"] == "F1 0.667"
    assert last["best"]["number"] == 1
    assert last["points"] == [(0, pytest.approx(2 / 3)), (1, pytest.approx(18 / 19))]
    assert last["changes"] == [["classification.tree_share", 0.4, 0.7]]
    name, values, text = search.found()
    assert (name, values) == ("forest", preset("forest").replace({"classification.tree_share": 0.7}))
    assert provenance_in(text)["run"][0]["sha256"] == "ab"
    await search.leave()
    assert told[-1] == {"state": "none"}
    with pytest.raises(StemmapError, match="no better set"):
        search.found()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            says(then="""print('!["the run is empty","run.mcap","Take another"]')"""),
            "the run is empty (run.mcap). Take",
        ),
        (says(SAID[0]), "ended unexpectedly"),
        (says(then="print('no JSON')"), "protocol error"),
    ],
)
async def test_a_search_that_fails_says_why_and_another_can_begin(command, words):
    told: list[dict[str, Any]] = []
    search = TuneSearch(told.append, command)
    for _ in range(2):
        await search.start(PLAN)
        await until(lambda: not search.is_under_way)
        assert told[-1]["state"] == "failed"
        assert words in told[-1]["error"]


async def test_the_search_before_stays_if_no_process_can_be_started():
    states: list[dict[str, Any]] = []
    search = TuneSearch(states.append, says(*SAID))
    await search.start(PLAN)
    await until(lambda: not search.is_under_way)
    search._command = ["/no/such/program"]
    with pytest.raises(StemmapError):
        await search.start(PLAN)
    assert search.as_plain() == states[-1]
    assert search.result == RESULT


@pytest.mark.parametrize("scheme", ["", "file:", "file://"])
def test_a_recording_that_is_gone_cannot_be_opened_again(tmp_path: Path, scheme: str):
    assert _why_gone(f"{scheme}{tmp_path}") == ""
    assert "does not exist any more" in _why_gone(f"{scheme}{tmp_path}/gone.mcap")


@pytest.mark.slow
async def test_one_search_at_a_time_and_leaving_the_run_ends_its_process():
    search = TuneSearch(lambda _told: None, says(SAID[0], then="time.sleep(600)"))
    await search.start(PLAN)
    with pytest.raises(StemmapError, match="under way"):
        await search.start(PLAN)
    await until(lambda: search.as_plain()["state"] == "searching")
    process = search._process
    assert process is not None
    await search.leave()
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
    assert search.as_plain() == {"state": "none"}


@pytest.fixture
def made(monkeypatch) -> list[asyncio.subprocess.Process]:
    """All processes that are started."""
    processes, start = [], asyncio.create_subprocess_exec

    async def noted(*words: Any, **options: Any) -> asyncio.subprocess.Process:
        processes.append(await start(*words, **options))
        return processes[-1]

    monkeypatch.setattr(asyncio, "create_subprocess_exec", noted)
    return processes


async def test_of_two_browsers_that_start_at_once_one_is_refused(made):
    search = TuneSearch(lambda _: None, says(then="sys.stdin.read()"))
    told = await asyncio.gather(search.start(PLAN), search.start(PLAN), return_exceptions=True)
    assert [type(each) for each in told] == [type(None), StemmapError]
    await search.leave()
    assert [process.returncode is None for process in made] == [False]


async def test_a_run_that_is_left_while_its_search_is_being_started_has_none(made):
    search = TuneSearch(lambda _: None, says(then="sys.stdin.read()"))
    starting = asyncio.create_task(search.start(PLAN))
    await asyncio.sleep(0)  # it waits for its process
    await search.leave()
    await starting
    assert search.as_plain() == {"state": "none"}
    assert [process.returncode is None for process in made] == [False]


async def test_a_stopped_search_can_go_on_and_its_process_is_told_its_plan(tmp_path):
    heard = tmp_path / "heard"
    ended = SearchMessage(result=msgspec.structs.replace(RESULT, better=False, best=START, made=1))
    then = f"sys.stdin.readline()\nprint({_line(ended)!r}, flush=True)"
    search = TuneSearch(lambda _told: None, says(*SAID[:2], then=then, hears=heard))
    await search.start(PLAN)
    await until(lambda: search.as_plain()["made"] == 2)
    assert not search.can_go_on
    await search.stop()
    await until(lambda: not search.is_under_way)
    assert (search.as_plain()["state"], search.can_go_on) == ("done", True)
    assert msgspec.json.decode(heard.read_bytes(), type=Plan) == PLAN


@pytest.mark.slow
async def test_a_real_search_is_stopped_and_keeps_what_it_found():
    search = TuneSearch(lambda _told: None)
    await search.start(msgspec.structs.replace(PLAN, trials=100_000))
    await until(lambda: search.as_plain().get("made", 0) >= 3 or not search.is_under_way)
    process = search._process
    assert process is not None
    if hasattr(os, "getpriority"):
        assert os.getpriority(os.PRIO_PROCESS, process.pid) > os.getpriority(os.PRIO_PROCESS, 0)
    await search.stop()
    await until(lambda: not search.is_under_way)
    told = search.as_plain()
    assert (told["state"], told["error"]) == ("done", "")
    assert told["made"] >= 3
    assert search.result is not None
    assert search.result.made >= told["made"]


# --- the routes -----------------------------------------------------------------------------------


def search_of(client: httpx.AsyncClient) -> TuneSearch:
    """The search of the application."""
    transport: Any = client._transport
    search: TuneSearch = transport.app.state.search
    return search


BODY = {"over": ["classification.tree_share=0.1..0.9"], "trials": 3}


@pytest_asyncio.fixture
async def both() -> AsyncIterator[Running]:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await dashboard.receive(msgspec.structs.replace(opened(), truth=truth_trees()))
        search_of(client)._command = says(*SAID)
        yield client, dashboard


async def test_the_set_that_was_found_is_used_undone_and_saved(both: Running):
    client, dashboard = both
    assert (await client.get("/api/search")).json()["state"] == "none"
    assert (await client.post("/api/search", json=BODY)).status_code == 202
    await until(lambda: not search_of(client).is_under_way)
    assert (await client.post("/api/search/use", json={})).status_code == 200
    assert dashboard.parameters.parameters.classification.tree_share == 0.7
    await client.post("/api/parameters/undo", json={})
    assert dashboard.parameters.parameters.classification.tree_share == 0.4
    saved = await client.post("/api/search/save", json={"name": "found", "who": "Ann"})
    assert [row["name"] for row in saved.json()["sets"]] == ["found"]
    text = (await client.get("/api/sets/found.toml")).text
    assert provenance_in(text)["tuned"]["goal"] == "f1"
    await client.post("/api/sets/use", json={"name": "found"})
    assert dashboard.parameters.parameters.classification.tree_share == 0.7


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"over": ["classification.tree_share=0.9..0.1"]}, "must be less"),
        ({**BODY, "trials": 10**9}, "but must be at most"),
        ({**BODY, "storage": "/etc/passwd"}, "does not fit"),
    ],
)
async def test_what_cannot_be_searched_for_is_refused(both: Running, body, words):
    client, _ = both
    answer = await client.post("/api/search", json=body)
    assert answer.status_code == 422
    assert words in answer.json()["error"]["what"]
    assert not search_of(client).is_under_way


async def test_without_truth_or_a_result_there_is_nothing_to_do(both: Running):
    client, dashboard = both
    assert (await client.post("/api/search/use", json={})).status_code == 409
    dashboard.annotation_editor.truth = None
    answer = await client.post("/api/search", json=BODY)
    assert (answer.status_code, answer.json()["error"]["what"]) == (
        409,
        "no true trees are known of this run",
    )


async def test_runs_of_the_list_are_searched_over_or_held_out_where_they_can_be_judged(both: Running):
    client, dashboard = both
    for k, (uri, known) in enumerate(
        (("sim:a", True), ("sim:b", True), ("sim:none", False), ("/no/such/run.mcap", True)), 1
    ):
        await play(dashboard, uri, run=k, truth=truth_trees() if known else None)
        if known:
            await until(lambda: dashboard.scores.latest is not None)
    await dashboard.open(Open("fake:"))
    await dashboard.run_recorder.close()
    await dashboard.receive(msgspec.structs.replace(opened(run=9), truth=truth_trees()))
    listed = {run["name"]: run for run in (await client.get("/api/search")).json()["runs"]}
    assert {name: run["why_not"] for name, run in listed.items()} == {
        "sim:a": "",
        "sim:b": "",
        "sim:none": "no true trees are known of it",
        "run.mcap": "its recording does not exist any more",
    }
    a, b, none, gone = (listed[name]["record"] for name in ("sim:a", "sim:b", "sim:none", "run.mcap"))
    for wanted, words in (
        ({"also": [none]}, "no true trees are known of it"),
        ({"held_out": [gone]}, "does not exist any more"),
        ({"also": [a], "held_out": [a]}, "named twice"),
        ({"also": [999]}, "no such run in the list"),
    ):
        answer = await client.post("/api/search", json={**BODY, **wanted})
        assert (answer.status_code, words in answer.json()["error"]["what"]) == (409, True)
    best = msgspec.structs.replace(BEST, held_out=(POOR,))
    start = msgspec.structs.replace(START, held_out=(GOOD,))
    sources = tuple((name, "ab", name == "b") for name in ("fake:", "a", "b"))
    result = msgspec.structs.replace(RESULT, start=start, best=best, sources=sources)
    search_of(client)._command = says(
        SearchMessage(start=start), SearchMessage(trials=(best,)), SearchMessage(result=result)
    )
    await client.post("/api/search", json={**BODY, "also": [a], "held_out": [b]})
    await until(lambda: not search_of(client).is_under_way)
    plan = search_of(client).plan
    assert plan is not None
    assert [(run.source.uri, run.held_out) for run in plan.runs[1:]] == [
        ("sim:a", False),
        ("sim:b", True),
    ]
    told = search_of(client).as_plain()
    assert [(row["held_out"], row["runs"]) for row in told["scores"]] == [(False, 2), (True, 1)]
    assert told["held_out"] == [(1, pytest.approx(2 / 3))]
    assert "on held-out runs F1 fell" in told["warning"]
    assert (await client.post("/api/search/go-on", json={})).status_code == 202
    await until(lambda: not search_of(client).is_under_way)
    again = search_of(client).plan
    assert again is not None
    assert len(again.runs) == 3
