"""Repairs of the map through the API: the worker gets them in their order, and they are undone, saved and
imported."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import httpx
import msgspec
import numpy as np
import pytest

from app.dashboard.shown_run import ShownRun
from app.worker.protocol import SetRepairs, WorkerBusyError
from pipeline.geometry.columns import rows_of
from pipeline.repairs.record import Repair, repairs_text
from pipeline.repairs.trees import repaired_trees
from tests.app.dashboard.test_annotations import ANN, edit, show, until
from tests.app.fakes import FakeWorker
from tests.app.server_for_tests import BEARER, running


async def repair(client: httpx.AsyncClient, where: str = "", **body: Any) -> httpx.Response:
    run = (await client.get("/api/annotations")).json()["run"]
    return await client.post(f"/api/repairs{where}", json={"run": run, **ANN, **body})


def sent(worker: Any) -> tuple[Any, ...]:
    assert isinstance(worker, FakeWorker)
    found = [command.repairs for command in worker.commands if isinstance(command, SetRepairs)]
    return found[-1] if found else ()


async def test_repairs_are_stored_sent_in_their_order_and_undone() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        x, y = dashboard.shown.frame.trees.position[0].tolist()  # type: ignore[union-attr]
        assert (await repair(client, kind="move", places=[[x, y], [x + 1.0, y]])).status_code == 201
        assert (await repair(client, kind="class", places=[[x + 1.0, y]], value="pole")).status_code == 201
        await until(lambda: len(sent(dashboard.worker)) == 2)
        assert [each.kind for each in sent(dashboard.worker)] == ["move", "class"]
        assert (await edit(client, "POST", "/undo")).status_code == 200
        await until(lambda: len(sent(dashboard.worker)) == 1)
        assert (await edit(client, "POST", "/redo")).status_code == 200
        await until(lambda: len(sent(dashboard.worker)) == 2)
        rows = (await client.get("/api/annotations")).json()["others"]["repair"]
        assert [row["kind"] for row in rows] == ["move", "class"]
        await edit(client, "DELETE", f"/{rows[0]['id']}", version=1)
        await until(lambda: [each.kind for each in sent(dashboard.worker)] == ["class"])


async def test_the_annotation_of_a_moved_tree_moves_with_it_and_back() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        (x, y), (other, _) = dashboard.shown.frame.trees.position[:2].tolist()  # type: ignore[union-attr]
        for at, kind in ((x + 0.1, "tree"), (other, "skipped")):
            await edit(client, "POST", x=at, y=y if kind == "tree" else _, kind=kind, dbh_cm=30.0)

        async def trees() -> list[tuple[float, float | None]]:
            rows = (await client.get("/api/annotations")).json()["trees"]
            return [(round(row["x"] - x, 3), row["dbh_cm"]) for row in rows]

        assert (await repair(client, kind="move", places=[[x, y], [x + 2.5, y]])).status_code == 201
        assert await trees() == [(2.6, 30.0)]
        await edit(client, "POST", "/undo")
        assert await trees() == [(0.1, 30.0)]
        await edit(client, "POST", "/redo")
        assert await trees() == [(2.6, 30.0)]
        assert len((await client.get("/api/annotations")).json()["skipped"]) == 1


async def test_an_annotation_follows_its_tree_through_two_moves() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        x, y = dashboard.shown.frame.trees.position[0].tolist()  # type: ignore[union-attr]
        await edit(client, "POST", x=x, y=y, kind="tree")
        ways = (((x, y), (x, y + 30.0)), ((x, y + 30.0), (x, y + 60.0)))
        text = repairs_text([Repair("move", places=way) for way in ways])
        assert (await repair(client, "/import", text=text)).json()["added"] == 2
        (row,) = (await client.get("/api/annotations")).json()["trees"]
        assert (round(row["x"] - x, 3), round(row["y"] - y, 3)) == (0.0, 60.0)


async def test_a_repair_that_is_removed_before_the_map_has_it_gives_the_annotation_back() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        x, y = dashboard.shown.frame.trees.position[0].tolist()  # type: ignore[union-attr]
        await edit(client, "POST", x=x + 0.1, y=y, kind="tree", dbh_cm=30.0)
        way = ((x, y), (x + 2.5, y))
        assert (await repair(client, kind="move", places=way)).status_code == 201
        # A second move, of the tree where the first one puts it, and a class that is set meanwhile.
        assert (await repair(client, kind="move", places=[way[1], [x + 4.0, y]])).status_code == 201
        (row,) = await trees_of(client)
        assert (round(row["x"] - x, 3), row["version"]) == (4.1, 3)
        fields = {"x": row["x"], "y": row["y"], "kind": "pole", "dbh_cm": 30.0}
        await edit(client, "PATCH", f"/{row['id']}", version=row["version"], **fields)
        for left in (2.6, 0.1):
            newest = (await client.get("/api/annotations")).json()["others"]["repair"][-1]
            assert (await edit(client, "DELETE", f"/{newest['id']}", version=1)).status_code == 200
            (row,) = await trees_of(client)
            assert (round(row["x"] - x, 3), row["kind"], row["dbh_cm"]) == (left, "pole", 30.0)
        await edit(client, "POST", "/undo")
        assert [round(row["x"] - x, 3) for row in await trees_of(client)] == [2.6]


async def trees_of(client: httpx.AsyncClient) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = (await client.get("/api/annotations")).json()["trees"]
    return rows


async def test_merged_trees_keep_one_annotation_which_is_removed_with_the_merge() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        a, b = dashboard.shown.frame.trees.position[:2].tolist()  # type: ignore[union-attr]
        for at, who, dbh in ((a, "Bob", None), (b, "Eve", 30.0)):
            await edit(client, "POST", x=at[0], y=at[1], kind="tree", dbh_cm=dbh, who=who)
        facts = ("x", "y", "dbh_cm", "who", "dbh_who")
        before = [[row[each] for each in facts] for row in await trees_of(client)]
        shown = dashboard.shown
        merge = Repair("merge", places=(tuple(a), tuple(b)))
        merged, _ = repaired_trees(shown.frame.trees, merge)  # type: ignore[union-attr]
        assert (await repair(client, kind="merge", places=[a, b])).status_code == 201
        (row,) = await trees_of(client)
        assert (row["x"], row["y"]) == pytest.approx(tuple(merged.position[0]), abs=1e-3)
        assert [row[each] for each in facts[2:]] == [30.0, "Bob", "Eve"]
        for way in ("undo", "redo", "undo", "redo"):
            await edit(client, "POST", f"/{way}")
        (of_merge,) = (await client.get("/api/annotations")).json()["others"]["repair"]
        version = of_merge["version"]
        assert (await edit(client, "DELETE", f"/{of_merge['id']}", version=version)).status_code == 200
        assert [[row[each] for each in facts] for row in await trees_of(client)] == before
        await edit(client, "POST", "/undo")
        assert len(await trees_of(client)) == 1


async def test_annotations_follow_the_trees_that_a_repair_of_the_path_moves_and_merges() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        shown = dashboard.shown
        assert shown is not None
        trees, north = shown.frame.trees, np.array([0.0, 2.0])
        for k, dbh in ((0, None), (1, 30.0), (2, 40.0)):
            x, y = trees.position[k].tolist()
            await edit(client, "POST", x=x + 0.1, y=y, kind="tree", dbh_cm=dbh)
        before = [(row["x"], row["y"], row["dbh_cm"]) for row in await trees_of(client)]
        places = [trees.position[k].tolist() for k in (0, 1)]
        assert (await repair(client, kind="tie", places=places)).status_code == 201
        await until(lambda: len(sent(dashboard.worker)) == 1)
        assert [(row["x"], row["y"], row["dbh_cm"]) for row in await trees_of(client)] == before

        # The map with the repair: the second tree came to the first one and was merged with it.
        tied = rows_of(replace(trees, position=trees.position + north), np.array([0, 2, 3]))
        tied.position[0] = trees.position[0]
        frame = replace(shown.frame, trees=tied)
        answer = msgspec.structs.replace(
            shown, frame=frame, path_start=len(shown.path.x), path=rows_of(shown.path, []),
            odometry_xy=np.zeros((0, 2)), repairs=sent(dashboard.worker), problems=("",),
        )  # fmt: skip
        await dashboard.receive(answer)
        found = [(round(row["x"], 3), round(row["y"], 3), row["dbh_cm"]) for row in await trees_of(client)]
        east = np.array([0.1, 0.0])
        first, third = np.round([trees.position[0] + east, trees.position[2] + north + east], 3).tolist()
        assert found == [(*first, 30.0), (*third, 40.0)]
        await dashboard.receive(answer)  # once only
        assert len(await trees_of(client)) == 2
        for way, number in (("undo", 3), ("redo", 2), ("undo", 3), ("redo", 2)):
            await edit(client, "POST", f"/{way}")
            assert len(await trees_of(client)) == number
        (tie,) = (await client.get("/api/annotations")).json()["others"]["repair"]
        await edit(client, "DELETE", f"/{tie['id']}", version=tie["version"])
        back = [(row["x"], row["y"], row["dbh_cm"]) for row in await trees_of(client)]
        assert np.array(back, float) == pytest.approx(np.array(before, float), nan_ok=True)


@pytest.mark.parametrize(
    ("of_a", "of_b", "kept"),
    [
        ("tree", "skipped", "tree"),
        ("skipped", "tree", "tree"),
        ("pole", "tree", "pole"),
        ("", "bush", "bush"),
    ],
)
async def test_the_annotation_that_states_a_class_stays_with_merged_trees(
    of_a: str, of_b: str, kept: str
) -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        a, b = dashboard.shown.frame.trees.position[:2].tolist()  # type: ignore[union-attr]
        for at, kind in ((a, of_a), (b, of_b)):
            if kind:
                await edit(client, "POST", x=at[0], y=at[1], kind=kind)
        assert (await repair(client, kind="merge", places=[a, b])).status_code == 201
        answer = (await client.get("/api/annotations")).json()
        assert [row["kind"] for row in answer["trees"]] == [kept]
        assert answer["skipped"] == []


async def test_annotations_stay_with_the_stems_of_a_split_tree() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        x, y = dashboard.shown.frame.trees.position[0].tolist()  # type: ignore[union-attr]
        for away in (0.0, 0.4):
            await edit(client, "POST", x=x + away, y=y, kind="tree")
        split = Repair("split", places=((x, y), (x + 0.5, y)))
        move = Repair("move", places=((x + 0.5, y), (x + 2.5, y)))
        assert (await repair(client, "/import", text=repairs_text([split, move]))).json()["added"] == 2
        assert [round(row["x"] - x, 3) for row in await trees_of(client)] == [0.0, 2.4]


async def test_a_tie_stores_the_times_at_which_its_trees_were_seen() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        trees = dashboard.shown.frame.trees  # type: ignore[union-attr]
        a, b = trees.position[:2].tolist()
        assert (await repair(client, kind="tie", places=[a, b])).status_code == 201
        await until(lambda: len(sent(dashboard.worker)) == 1)
        (tie,) = sent(dashboard.worker)
        assert set(tie.stamps_ns) <= set(dashboard.path.stamp_ns.tolist())  # type: ignore[union-attr]
        nowhere = await repair(client, kind="tie", places=[a, [500.0, 0.0]])
        assert nowhere.status_code == 422
        assert "no tree" in nowhere.json()["error"]["what"]


async def test_repairs_that_are_not_valid_are_refused() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        for body in (
            {"kind": "delete", "places": []},
            {"kind": "merge", "places": [[0.0, 0.0]]},
            {"kind": "class", "places": [[0.0, 0.0]]},
            {"kind": "delete", "places": [[0.0, 0.0]], "value": "pole"},
            {"kind": "forbid", "scans": [0]},
            {"kind": "forbid", "scans": [0, 99]},
            {"kind": "burn", "places": [[0.0, 0.0]]},
        ):
            assert (await repair(client, **body)).status_code == 422, body


async def test_more_repairs_than_a_run_can_have_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.web.routes.repairs.MOST", 1)
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        assert (await repair(client, kind="delete", places=[[1.0, 2.0]])).status_code == 201
        refused = await repair(client, kind="delete", places=[[3.0, 2.0]])
        assert refused.status_code == 422
        assert "at most 1 repairs" in refused.json()["error"]["what"]


async def test_repairs_that_a_busy_worker_did_not_take_are_sent_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        await repair(client, kind="delete", places=[[1.0, 2.0]])
        await until(lambda: len(sent(dashboard.worker)) == 1)
        take = dashboard.worker.send

        async def busy(command: Any) -> None:
            if isinstance(command, SetRepairs):
                raise WorkerBusyError("the mapping process is busy")
            await take(command)

        monkeypatch.setattr(dashboard.worker, "send", busy)
        dashboard._repairs_sent = ()
        with pytest.raises(WorkerBusyError):
            await dashboard._send_repairs()
        monkeypatch.undo()
        assert isinstance(dashboard.worker, FakeWorker)
        dashboard.worker.commands.clear()
        await dashboard._send_repairs()
        assert len(sent(dashboard.worker)) == 1


async def test_a_saved_run_records_the_repairs_that_its_map_has() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        assert dashboard.shown is not None
        of_map = (Repair("delete", ((1.0, 2.0),)),)
        dashboard.shown = msgspec.structs.replace(dashboard.shown, repairs=of_map, problems=("",))
        await repair(client, kind="move", places=[[1.0, 2.0], [2.0, 2.0]])
        record = json.loads(ShownRun.of(dashboard).texts()["run.json"])
        assert record["repairs"] == {"applied": {"delete": 1}, "not_applied": []}


async def test_saved_repairs_are_imported_once() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        await repair(client, kind="delete", places=[[1.0, 2.0]])
        await repair(client, kind="forbid", scans=[0, 2])
        text = (await client.get("/api/repairs.json")).text
        assert [each["kind"] for each in json.loads(text)["repairs"]] == ["delete", "forbid"]
        assert (await repair(client, "/import", text=text)).json()["added"] == 0
        for _ in range(2):
            await edit(client, "POST", "/undo")
        assert (await repair(client, "/import", text=text)).json()["added"] == 2
        assert (await client.get("/api/repairs.json")).text == text
        wrong = await repair(client, "/import", text='{"repairs": [{"kind": "delete"}]}')
        assert wrong.status_code == 422
        assert "repair 1: delete needs 1 positions" in wrong.json()["error"]["what"]
