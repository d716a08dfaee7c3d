"""Two people in one run: no edit is lost, and both pages see the same edits in one order."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest
from websockets.asyncio.client import ClientConnection, connect

from app.dashboard.dashboard import Dashboard
from app.web.auth import viewer_token
from app.worker.protocol import Shown
from tests.app.fakes import frame, opened, path
from tests.app.server_for_tests import BEARER, TOKEN, served

ANN = {"browser": "a" * 16, "who": "Ann"}
BOB = {"browser": "b" * 16, "who": "Bob"}
VIEWER = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
ROUNDS = 20


@contextlib.asynccontextmanager
async def shared() -> AsyncIterator[tuple[str, Dashboard, httpx.AsyncClient]]:
    """A server with a map, and a client of the owner."""
    async with served() as (host, dashboard):
        await dashboard.receive(opened(truth=None))
        await dashboard.receive(
            Shown(1, 0.2, frame(2, 5_200_000_000, x=1.0, n_trees=4), 0, path([0.0, 0.5, 1.0]))
        )
        async with httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as client:
            yield host, dashboard, client


async def edit(
    client: httpx.AsyncClient, method: str, where: str, who: dict[str, str], **body: Any
) -> httpx.Response:
    return await client.request(method, f"/api/annotations{where}", json={"run": 1, **who, **body})


async def row(client: httpx.AsyncClient) -> dict[str, Any]:
    (only,) = (await client.get("/api/annotations")).json()["trees"]
    return dict(only)


async def diameters(page: ClientConnection, last_cm: float) -> list[float]:
    """Return the diameters of the annotation that a page was told, in their order, until the last one."""
    told: list[float] = []
    async with asyncio.timeout(20):
        while not told or told[-1] != last_cm:
            message = json.loads(await page.recv())
            if message["type"] == "annotations" and message["trees"]:
                told.append(message["trees"][0]["dbh_cm"])
    return told


async def selection(page: ClientConnection, **wanted: Any) -> dict[str, Any]:
    """Return the next selection that a page was told with these values."""
    async with asyncio.timeout(20):
        while True:
            message: dict[str, Any] = json.loads(await page.recv())
            if message["type"] == "selection" and wanted.items() <= message.items():
                return message


@pytest.mark.slow
async def test_a_selection_names_its_page_and_what_the_open_pages_have_selected() -> None:
    ann, bob = "a" * 32, "b" * 32
    async with (
        shared() as (host, dashboard, _),
        connect(f"ws://{host}/api/live?page={ann}", additional_headers=BEARER, proxy=None) as one,
    ):
        await one.send('{"type":"select","tree":1}')
        assert (await selection(one, tree=1))["by"] == ann
        address = f"ws://{host}/api/live?page={bob}"
        async with connect(address, additional_headers=BEARER, proxy=None) as other:
            await other.send('{"type":"select","tree":2}')
            told = await selection(one, tree=2)
            assert (told["by"], told["pages"], told["run"]) == (bob, {ann: 1, bob: 2}, 1)
            await one.send('{"type":"select","tree":2}')  # the order tells who came to it first
            assert list((await selection(one, by=ann, tree=2))["pages"]) == [bob, ann]
            await one.send('{"type":"select","tree":1}')
            await selection(one, by=ann, tree=1)
            await other.send('{"type":"select","tree":2}')
            assert list((await selection(one, by=bob))["pages"]) == [bob, ann]
        assert (await selection(one, tree=2, pages={ann: 1}))["by"] == bob  # the other page was closed
        dashboard.selector.remove([2])
        assert (await selection(one, tree=None, pages={ann: 1}))["by"] == bob
        await dashboard.select_tree(3)  # a click in the scene
        assert (await selection(one, tree=3, pages={}))["by"] is None
        await one.send('{"type":"select","tree":1}')
        assert (await selection(one, tree=1))["pages"] == {ann: 1}
        await one.send('{"type":"select","tree":null}')
        assert (await selection(one, tree=None))["pages"] == {}


async def test_of_two_edits_of_a_tree_at_once_one_is_taken_and_the_other_is_told_to_look_again() -> None:
    async with (
        shared() as (host, _, client),
        connect(f"ws://{host}/api/live", additional_headers=BEARER, proxy=None) as one,
        connect(f"ws://{host}/api/live", additional_headers=BEARER, proxy=None) as other,
    ):
        number = (await edit(client, "POST", "", ANN, x=1.0, y=2.0, dbh_cm=1.0)).json()["id"]
        taken: list[float] = []
        for k in range(ROUNDS):
            version = (await row(client))["version"]
            offers = {10.0 + 2 * k: ANN, 11.0 + 2 * k: BOB}
            answers = await asyncio.gather(
                *(
                    edit(client, "PATCH", f"/{number}", who, version=version, x=1.0, y=2.0, dbh_cm=cm)
                    for cm, who in offers.items()
                )
            )
            assert sorted(answer.status_code for answer in answers) == [200, 409]
            winner = next(cm for cm, answer in zip(offers, answers, strict=True) if answer.status_code == 200)
            loser = next(cm for cm in offers if cm != winner)
            now = await row(client)
            assert (now["dbh_cm"], now["dbh_who"]) == (winner, offers[winner]["who"])
            # The second person looks again, and edits what is there now.
            again = await edit(
                client, "PATCH", f"/{number}", offers[loser],
                version=now["version"], x=1.0, y=2.0, dbh_cm=loser,
            )  # fmt: skip
            assert again.status_code == 200
            taken += [winner, loser]
        seen = [await diameters(page, taken[-1]) for page in (one, other)]
        order = {cm: place for place, cm in enumerate([1.0, *taken])}
        for told in seen:  # a slow page skips states, and never goes back to an earlier one
            assert [order[cm] for cm in told] == sorted(order[cm] for cm in told)
        steps = [
            (await client.get("/api/annotations", params={"browser": who["browser"]})).json()["undo"]["tree"]
            for who in (ANN, BOB)
        ]
        assert sum(steps) == 1 + len(taken)


async def test_of_two_answers_for_one_tree_at_once_one_is_taken_and_the_other_is_refused() -> None:
    async with shared() as (_, dashboard, client):
        assert dashboard.shown is not None
        trees = dashboard.shown.frame.trees
        places = trees.position[trees.confirmed].tolist()
        stored: list[dict[str, Any]] = []
        for k, (x, y) in enumerate(places):
            answers = [
                edit(client, "POST", "", who, x=x + 0.02 * (who is BOB), y=y, kind=kind)
                for who, kind in ((ANN, "tree"), (BOB, "pole"))
            ]
            taken = await asyncio.gather(*answers)
            assert sorted(answer.status_code for answer in taken) == [201, 409]
            refused = next(answer for answer in taken if answer.status_code == 409)
            assert "it was annotated by" in refused.json()["error"]["what"]
            stored = (await client.get("/api/annotations")).json()["trees"]
            assert len(stored) == k + 1
            assert stored[-1]["who"] in refused.text
        # Who agrees is not refused.
        agreed = await edit(
            client, "POST", "", BOB, x=places[-1][0], y=places[-1][1], kind=stored[-1]["kind"]
        )
        assert agreed.json()["id"] == stored[-1]["id"]
        # An answer replaces a skip, and a tree beside it is another object.
        x, y = places[0]
        (await edit(client, "DELETE", f"/{stored[0]['id']}", ANN, version=1)).raise_for_status()
        (await edit(client, "POST", "", BOB, x=x, y=y, kind="skipped")).raise_for_status()
        (await edit(client, "POST", "", ANN, x=x, y=y, kind="tree")).raise_for_status()
        (await edit(client, "POST", "", ANN, x=x + 0.3, y=y, kind="tree")).raise_for_status()


@pytest.mark.slow
async def test_a_viewer_who_floods_loses_no_edit_of_the_owner_and_changes_nothing() -> None:
    async with (
        shared() as (host, dashboard, client),
        connect(f"ws://{host}/api/live", additional_headers=VIEWER, proxy=None) as flooding,
        httpx.AsyncClient(base_url=f"http://{host}", headers=VIEWER) as viewer,
    ):
        chosen = dashboard.selector.selection
        is_over = asyncio.Event()
        refused = list[int]()

        async def select() -> None:
            while not is_over.is_set():
                await flooding.send('{"type":"select","tree":1}')
                await asyncio.sleep(0)

        async def write() -> None:
            while not is_over.is_set():
                refused.append((await edit(viewer, "POST", "", BOB, x=9.0, y=9.0)).status_code)

        flood = [asyncio.create_task(select()), asyncio.create_task(write()), asyncio.create_task(write())]
        for k in range(ROUNDS):
            async with asyncio.timeout(20):
                assert (await edit(client, "POST", "", ANN, x=float(k), y=0.0)).status_code == 201
        is_over.set()
        await asyncio.gather(*flood)
        assert refused
        assert set(refused) <= {403, 429}
        trees = (await client.get("/api/annotations")).json()["trees"]
        assert sorted(tree["x"] for tree in trees) == [float(k) for k in range(ROUNDS)]
        assert {tree["who"] for tree in trees} == {"Ann"}
        assert dashboard.selector.selection == chosen


async def test_an_owner_who_loses_the_link_in_an_undo_finds_it_done_or_not_and_nothing_else_changed() -> None:
    async with shared() as (host, _, client):
        for k in range(ROUNDS):
            await edit(client, "POST", "", ANN, x=float(k), y=0.0)
        left = ROUNDS
        for k in range(ROUNDS):
            async with httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as lost:
                asked = asyncio.create_task(edit(lost, "POST", "/undo", ANN))
                await asyncio.sleep(0.001 * k)  # the link ends at any moment of the request
                asked.cancel()
                await asyncio.gather(asked, return_exceptions=True)
            async with asyncio.timeout(20):  # a request that was received is carried out
                while True:
                    one = (await client.get("/api/annotations", params={"browser": ANN["browser"]})).json()
                    await asyncio.sleep(0.05)
                    two = (await client.get("/api/annotations", params={"browser": ANN["browser"]})).json()
                    if one == two:
                        break
            assert len(two["trees"]) in (left, left - 1)
            left = len(two["trees"])
            assert (two["undo"].get("tree", 0), two["redo"].get("tree", 0)) == (left, ROUNDS - left)
            assert sorted(tree["x"] for tree in two["trees"]) == [float(x) for x in range(left)]
        for _ in range(ROUNDS - left):
            assert (await edit(client, "POST", "/redo", ANN)).status_code == 200
        trees = (await client.get("/api/annotations")).json()["trees"]
        assert sorted(tree["x"] for tree in trees) == [float(x) for x in range(ROUNDS)]
