"""Learning from the page: it is done in a process of its own, and nothing changes before somebody says so."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.payload import doubts_of
from app.extensions.learning.page import Learning
from app.store.forests import Forests
from app.web.auth import viewer_token
from pipeline.classification import no_columns
from pipeline.classification.forest import ALL_AROUND, CLASSES, ONE_WAY
from tests.app.fakes import frame
from tests.app.server_for_tests import BEARER, TOKEN, running

LEAF = {"share": [0.9, 0.1, 0, 0, 0, 0]}
FOREST = {"classes": [c.label for c in CLASSES], ALL_AROUND: [LEAF], ONE_WAY: [LEAF]}
# Says what it is given as arguments, line by line; "wait" for ever.
SAYS = """
import sys, time
sys.stdin.readline()
for line in sys.argv[1:]:
    time.sleep(3600 if line == "wait" else 0)
    print("x" * (2 << 20) if line == "long" else line, flush=True)
"""


def says(*lines: dict[str, Any] | str) -> tuple[str, ...]:
    """The command of a process that says so."""
    return (
        sys.executable,
        "-c",
        SAYS,
        *(each if isinstance(each, str) else json.dumps(each) for each in lines),
    )


def learning_of(client: httpx.AsyncClient, *lines: dict[str, Any] | str) -> Learning:
    """That of the application, with such a process."""
    transport: Any = client._transport
    learning: Learning = transport.app.state.learning
    learning._command = says(*lines)
    return learning


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.02)


def force(dashboard: Dashboard) -> str:
    return dashboard.parameters.parameters.classification.forest


async def test_new_trees_are_used_when_somebody_says_so_and_not_before(tmp_path: Path) -> None:
    name = Forests(tmp_path).keep(FOREST)
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        assert (await client.post("/api/learning/use")).status_code >= 400
        learning = learning_of(client, {"progress": "Looking"}, {"learned": {"name": name}})
        assert (await client.post("/api/learning", json={})).status_code == 202
        await until(lambda: learning.state == "done")
        assert force(dashboard) == "package"
        assert (await client.post("/api/learning/use")).status_code == 200
        assert force(dashboard) == name
        await client.delete("/api/learning")
        assert (learning.state, force(dashboard)) == ("idle", name)
        answer = await client.post("/api/parameters/undo")
        assert answer.json()["values"]["classification.forest"] == "package"


async def test_a_file_that_was_damaged_meanwhile_is_refused_and_the_old_trees_stay(tmp_path: Path) -> None:
    name = Forests(tmp_path).keep(FOREST)
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        learning = learning_of(client, {"learned": {"name": name}})
        await client.post("/api/learning", json={})
        await until(lambda: learning.state == "done")
        (tmp_path / "forests" / f"{name}.json").write_text("{}")
        answer = await client.post("/api/learning/use")
        assert "decision trees" in answer.json()["error"]["what"]
        assert force(dashboard) == "package"


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        (['!["too little was annotated","",""]'], "too little was annotated"),
        ([], "ended without an answer"),
        (["long"], "ended without an answer"),
    ],
    ids=["error", "dies", "endless"],
)
async def test_what_goes_wrong_is_said_and_changes_nothing(
    tmp_path: Path, lines: list[dict[str, Any] | str], told: str
) -> None:
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        learning = learning_of(client, *lines)
        await client.post("/api/learning", json={})
        await until(lambda: learning.state == "failed")
        assert told in learning.words
        assert force(dashboard) == "package"


async def test_it_is_done_once_at_a_time_and_can_be_stopped(tmp_path: Path) -> None:
    async with running(Settings(folder=tmp_path)) as (client, _):
        client.headers.update(BEARER)
        learning = learning_of(client, {"progress": "Looking"}, "wait")
        await client.post("/api/learning", json={})
        await until(lambda: learning.words == "Looking")
        again = await client.post("/api/learning", json={})
        assert "already" in again.json()["error"]["what"]
        assert (await client.delete("/api/learning")).json()["state"] == "idle"


async def test_of_two_browsers_that_ask_at_once_one_is_refused(tmp_path: Path) -> None:
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        learning, parameters = learning_of(client, "wait"), dashboard.parameters.parameters
        told = await asyncio.gather(
            learning.begin(parameters), learning.begin(parameters), return_exceptions=True
        )
        assert sorted(str(each) for each in told) == ["None", "decision trees are being grown already"]
        await learning.forget()


async def test_who_may_only_look_starts_nothing(tmp_path: Path) -> None:
    async with running(Settings(folder=tmp_path)) as (client, _):
        client.headers["Authorization"] = f"Bearer {viewer_token(TOKEN)}"
        for method, where in (("POST", ""), ("DELETE", ""), ("POST", "/use")):
            assert (await client.request(method, f"/api/learning{where}")).status_code == 403
        assert (await client.get("/api/learning")).status_code == 200


def test_the_tree_whose_votes_are_nearest_to_the_limit_comes_first() -> None:
    shown = frame(2, 5_200_000_000, x=1.0, n_trees=4)
    place = shown.trees.position[shown.trees.confirmed]
    number = shown.trees.number[shown.trees.confirmed].tolist()
    n = len(place)
    share = np.zeros((n, len(CLASSES)))
    share[:, 0] = np.linspace(0.9, 0.45, n)
    share[:, 1] = 1.0 - share[:, 0]
    axis = np.column_stack([place, np.zeros((n, 3))])
    columns = replace(no_columns(), axis=axis, share=share)
    told = doubts_of(replace(shown, columns=columns), 0.4)
    assert [each["tree"] for each in told] == number[::-1]
    assert (told[0]["votes"], told[0]["next"], told[0]["next_votes"]) == (0.45, "pole", 0.55)
    away = replace(columns, axis=axis + 100.0)
    assert {each["votes"] for each in doubts_of(replace(shown, columns=away), 0.4)} == {None}
    assert len(doubts_of(replace(shown, columns=None), 0.4)) == n
