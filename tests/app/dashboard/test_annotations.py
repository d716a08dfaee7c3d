"""Annotating through the API: what it does, whom it tells, what it refuses, what the scores make of it."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import pytest_asyncio
from websockets.asyncio.client import connect
from websockets.typing import Origin

from app.batch.run_edits import SAME_THING
from app.common.settings import Settings
from app.dashboard.annotations import (
    AnnotationEditor,
    _successors,
    carried_by,
    counted,
    import_plan,
    is_doubtful_dbh,
    laid_over,
    truth_of,
    usual_dbh,
)
from app.dashboard.dashboard import Dashboard
from app.store.async_store import LARGEST_QUEUE, AsyncStore, StoreBusyError
from app.store.records import Annotation, Content, contents_of
from app.web.auth import session_value
from app.web.responses import BadRequestError
from app.web.routes.annotations import _imported, _ImportTable
from app.worker.protocol import Shown
from pipeline.geometry.columns import rows_of
from pipeline.io.ground_truth import read_truth_trees
from pipeline.repairs.record import Repair
from pipeline.types.records import TruthTrees
from tests.app.fakes import frame, opened, path, truth_trees
from tests.app.server_for_tests import BEARER, ENDS, TOKEN, Running, running, served
from tests.pipeline.strategies import trees

ANN = {"browser": "a" * 16, "who": "Ann"}
BOB = {"browser": "b" * 16, "who": "Bob"}
EVE = {"browser": "e" * 16, "who": "Eve"}


@pytest_asyncio.fixture
async def both() -> AsyncIterator[Running]:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        yield client, dashboard


async def show(dashboard: Dashboard, truth: bool = False) -> None:
    await dashboard.receive(opened(truth=truth_trees() if truth else None))
    await dashboard.receive(
        Shown(1, 0.2, frame(2, 5_200_000_000, x=1.0, n_trees=4), 0, path([0.0, 0.5, 1.0]))
    )


async def edit(client: httpx.AsyncClient, method: str, where: str = "", **body: Any) -> httpx.Response:
    run = (await client.get("/api/annotations")).json()["run"]
    said = {"run": run, **ANN, **body}
    return await client.request(method, f"/api/annotations{where}", json=said)


async def rows(client: httpx.AsyncClient) -> list[dict[str, Any]]:
    answer: list[dict[str, Any]] = (await client.get("/api/annotations")).json()["trees"]
    return answer


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.02)


async def test_a_tree_is_added_changed_deleted_and_all_is_undone(both: Running) -> None:
    client, _ = both
    added = await edit(client, "POST", x=1.25, y=-2.0, dbh_cm=31.5)
    assert added.status_code == 201
    assert (added.json()["undo"], added.json()["redo"]) == ({"tree": 1}, {})
    (row,) = await rows(client)
    assert (row["x"], row["y"], row["kind"], row["dbh_cm"], row["who"], row["version"]) == (
        1.25,
        -2.0,
        "tree",
        31.5,
        "Ann",
        1,
    )
    where = f"/{row['id']}"
    assert (await edit(client, "PATCH", where, version=1, x=1.0, y=-2.0, kind="pole")).status_code == 200
    assert [(r["x"], r["kind"], r["dbh_cm"], r["version"]) for r in await rows(client)] == [
        (1.0, "pole", None, 2)
    ]
    assert (await edit(client, "DELETE", where, version=2)).status_code == 200
    assert await rows(client) == []
    for expected in ([("pole", 1.0)], [("tree", 1.25)], []):
        await edit(client, "POST", "/undo")
        assert [(r["kind"], r["x"]) for r in await rows(client)] == expected
    nothing = await edit(client, "POST", "/undo")
    assert nothing.status_code == 409
    assert "nothing to undo" in nothing.json()["error"]["what"]
    assert (await edit(client, "POST", "/redo")).json()["redo"] == {"tree": 2}
    assert [r["kind"] for r in await rows(client)] == ["tree"]


async def test_a_skipped_tree_is_stored_and_undone_but_is_no_ground_truth(tmp_path: Path) -> None:
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        edited: list[tuple[str, int]] = []
        dashboard.annotation_editor.edited = lambda who, number: edited.append((who, number))
        await show(dashboard)
        number = (await edit(client, "POST", x=1.0, y=2.0, kind="skipped")).json()["id"]
        answer = (await client.get("/api/annotations")).json()
        assert (answer["trees"], answer["used"]) == ([], "none")
        assert [(row["id"], row["x"], row["kind"]) for row in answer["skipped"]] == [(number, 1.0, "skipped")]
        assert dashboard.annotation_editor.truth is None
        assert edited == []
        assert len((await client.get("/api/annotations.csv")).text.splitlines()) == 1
        assert await dashboard.store.ask(lambda store: store.annotated_sources()) == []

        # Deciding later replaces the skip; one undo brings it back, the next one removes it.
        await edit(client, "PATCH", f"/{number}", version=1, x=1.0, y=2.0, kind="tree")
        assert [row["kind"] for row in await rows(client)] == ["tree"]
        assert edited == [("Ann", 1)]
        for expected in (["skipped"], []):
            await edit(client, "POST", "/undo")
            answer = (await client.get("/api/annotations")).json()
            assert [row["kind"] for row in answer["skipped"]] == expected
            assert answer["trees"] == []
        await edit(client, "POST", "/redo")
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        assert [row["who"] for row in (await client.get("/api/annotations")).json()["skipped"]] == ["Ann"]
        await dashboard.receive(opened(uri="other.mcap"))
        assert (await client.get("/api/annotations")).json()["skipped"] == []


async def test_a_stale_edit_is_refused_and_says_who_changed_it_when(both: Running) -> None:
    client, _ = both
    number = (await edit(client, "POST", x=0.0, y=0.0)).json()["id"]
    await edit(client, "PATCH", f"/{number}", version=1, x=0.5, y=0.0, **BOB)
    for method, body in (("PATCH", {"x": 9.0, "y": 9.0}), ("DELETE", {})):
        refused = await edit(client, method, f"/{number}", version=1, **body)
        assert refused.status_code == 409
        assert "(tree) at 0.50, 0.00 was changed by Bob at 20" in refused.json()["error"]["what"]
    assert [r["x"] for r in await rows(client)] == [0.5]
    # Ann's own step is no longer hers alone.
    assert (await edit(client, "POST", "/undo")).status_code == 409
    await edit(client, "DELETE", f"/{number}", version=2, **BOB)
    gone = await edit(client, "PATCH", f"/{number}", version=2, x=1.0, y=1.0)
    assert gone.status_code == 409
    assert "deleted by Bob" in gone.json()["error"]["what"]


async def test_an_edit_for_a_run_that_was_left_does_not_land_in_the_next(both: Running) -> None:
    client, dashboard = both
    run = dashboard.annotation_editor.run
    await dashboard.receive(opened("other:", run=2))
    refused = await client.post("/api/annotations", json={"run": run, **ANN, "x": 0.0, "y": 0.0})
    assert refused.status_code == 409
    assert "another run" in refused.json()["error"]["what"]
    await dashboard.receive(opened(run=3))
    assert dashboard.annotation_editor.run == run, "the same source is the same run"


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ({"x": "1", "y": 0.0}, "x"),
        ({"x": True, "y": 0.0}, "x"),
        ({"x": 1e9, "y": 0.0}, "x"),
        ({"y": 0.0}, "x"),
        ({"x": 0.0, "y": 0.0, "kind": "shrub"}, "kind"),
        ({"x": 0.0, "y": 0.0, "dbh_cm": 0.0}, "dbh_cm"),
        ({"x": 0.0, "y": 0.0, "dbh_cm": 1001.0}, "dbh_cm"),
        ({"x": 0.0, "y": 0.0, "more": 1}, "more"),
        ({"x": 0.0, "y": 0.0, "who": "=cmd()"}, "who"),
        ({"x": 0.0, "y": 0.0, "who": ""}, "who"),
        ({"x": 0.0, "y": 0.0, "who": "Ann\n"}, "who"),
        ({"x": 0.0, "y": 0.0, "who": "A" * 41}, "who"),
        ({"x": 0.0, "y": 0.0, "browser": "Z" * 16}, "browser"),
    ],
)
async def test_what_is_no_annotation_is_refused(both: Running, body: dict[str, Any], word: str) -> None:
    client, _ = both
    answer = await edit(client, "POST", **body)
    assert answer.status_code == 422
    assert word in answer.json()["error"]["what"]
    assert await rows(client) == []


async def test_what_is_not_there_is_said(both: Running) -> None:
    client, _ = both
    assert (await edit(client, "PATCH", "/77", version=1, x=0.0, y=0.0)).status_code == 404
    assert (await edit(client, "DELETE", f"/{2**31 - 1}", version=1)).status_code == 404
    assert (await edit(client, "DELETE", f"/{10**30}", version=1)).status_code == 422
    await edit(client, "POST", x=0.0, y=0.0)
    assert len(await rows(client)) == 1


async def test_a_table_goes_in_and_comes_out(both: Running, tmp_path: Path) -> None:
    client, _ = both
    table = "Easting,Northing,DBH,class\n1.5,2.5,0.31,tree\n3.0,4.0,,pole\n"
    unsaid = await edit(client, "POST", "/import", table=table)
    assert unsaid.status_code == 422
    assert "unit" in unsaid.json()["error"]["what"]
    answer = (await edit(client, "POST", "/import", table=table, dbh_unit="m")).json()
    assert (answer["added"], answer["left_out"], answer["undo"]) == (2, 0, {"tree": 1})
    again = (await edit(client, "POST", "/import", table=table, dbh_unit="m")).json()
    assert (again["added"], again["left_out"], again["undo"]) == (0, 2, {"tree": 1})
    twice = table + "9.0,9.0,0.2,tree\n" * 2
    mixed = (await edit(client, "POST", "/import", table=twice, dbh_unit="m")).json()
    assert (mixed["added"], mixed["left_out"]) == (1, 3)
    await edit(client, "POST", "/undo")
    out = await client.get("/api/annotations.csv")
    assert 'filename="truth.csv"' in out.headers["content-disposition"]
    (tmp_path / "truth.csv").write_text(out.text)
    read = contents_of(read_truth_trees(tmp_path / "truth.csv"))
    assert read == [Content(1.5, 2.5, "tree", 0.31), Content(3.0, 4.0, "pole", None)]
    assert out.text.splitlines()[0] == "x_m,y_m,dbh_cm,class,who,dbh_who,edited,tree"
    told = json.loads((await client.get("/api/annotations.geojson")).text)
    assert told["coordinateFrame"]["type"] == "local"
    assert [f["geometry"]["coordinates"] for f in told["features"]] == [[1.5, 2.5], [3.0, 4.0]]
    assert told["features"][0]["properties"]["dbh_cm"] == 31.0
    await edit(client, "POST", "/undo")
    assert await rows(client) == []


async def test_a_row_that_contradicts_an_annotation_is_left_out_and_named(both: Running) -> None:
    client, dashboard = both
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    k = int(np.flatnonzero(trees.confirmed)[0])
    number, (x, y) = int(trees.number[k]), trees.position[k].tolist()
    await edit(client, "POST", x=x, y=y, kind="tree")
    await edit(client, "POST", x=50.0004, y=6.00045, kind="tree", dbh_cm=30.5)
    before = await rows(client)
    table = (await client.get("/api/annotations.csv")).text
    kinds = (await edit(client, "POST", "/import", table=table.replace(",tree,", ",pole,"))).json()
    assert (kinds["added"], kinds["filled"], kinds["left_out"], kinds["differing"]) == (0, 0, 0, 2)
    assert kinds["differences"] == [
        f"tree {number} is tree here, pole in the file",
        "the annotation at 50.00, 6.00 is tree here, pole in the file",
    ]
    dbh = (await edit(client, "POST", "/import", table=table.replace("30.50", "31.5"))).json()
    assert (dbh["added"], dbh["left_out"], dbh["differing"]) == (0, 1, 1)
    assert dbh["differences"] == ["the annotation at 50.00, 6.00 has DBH 30.5 cm here, 31.5 cm in the file"]
    assert await rows(client) == before
    assert dbh["undo"] == {"tree": 2}
    # Rows of one table that contradict each other; a few are named.
    many = "x_m,y_m,class\n" + "".join(f"{90 + n},0,tree\n{90 + n},0,pole\n" for n in range(5))
    within = (await edit(client, "POST", "/import", table=many)).json()
    assert (within["added"], within["differing"], len(within["differences"])) == (5, 5, 5)


async def test_an_imported_dbh_fills_the_annotation_and_is_undone_with_the_import(both: Running) -> None:
    client, _ = both
    await edit(client, "POST", x=1.0, y=2.0)
    await edit(client, "POST", x=3.0, y=2.0, kind="pole")
    table = "x_m,y_m,dbh_cm,class\n1,2,26.4,tree\n3,2,,pole\n7,8,31,tree\n"
    answer = (await edit(client, "POST", "/import", table=table)).json()
    assert (answer["added"], answer["filled"], answer["left_out"], answer["differing"]) == (1, 1, 1, 0)
    assert [row["dbh_cm"] for row in await rows(client)] == [26.4, None, 31.0]
    assert answer["undo"] == {"tree": 3}
    await edit(client, "POST", "/undo")
    assert [row["dbh_cm"] for row in await rows(client)] == [None, None]


async def test_a_row_beside_an_annotation_is_about_the_same_object(both: Running) -> None:
    client, _ = both
    await edit(client, "POST", x=0.0, y=0.0)
    await edit(client, "POST", x=5.0, y=0.0, dbh_cm=30.0)
    await edit(client, "POST", x=9.0, y=0.0, kind="pole")
    table = "x_m,y_m,dbh_cm,class\n0.1,0,26,tree\n5.02,0,31,tree\n9,0.4,,tree\n12,0,,tree\n12.51,0,,tree\n"
    answer = (await edit(client, "POST", "/import", table=table)).json()
    assert (answer["added"], answer["filled"], answer["left_out"], answer["differing"]) == (2, 1, 0, 2)
    assert (answer["beside"], answer["beside_m"]) == (3, [0.02, 0.4])
    assert answer["differences"] == [
        "the annotation at 5.00, 0.00 has DBH 30 cm here, 31 cm in the file",
        "the annotation at 9.00, 0.00 is pole here, tree in the file",
    ]
    assert [(row["x"], row["dbh_cm"]) for row in await rows(client)][:2] == [(0.0, 26.0), (5.0, 30.0)]


async def test_two_stems_of_a_table_stay_two(both: Running) -> None:
    client, _ = both
    await edit(client, "POST", x=0.1, y=0.0)
    twins = "x_m,y_m,dbh_cm\n0.3,0,20\n0,0,30\n"  # the second one is nearer to the annotation
    for added, left_out, beside in ((1, 0, 1), (0, 2, 1)):
        answer = (await edit(client, "POST", "/import", table=twins)).json()
        assert (answer["added"], answer["left_out"], answer["beside"]) == (added, left_out, beside)
    known = [(row["x"], row["dbh_cm"]) for row in await rows(client)]
    assert known == [(0.1, 30.0), (0.3, 20.0)]
    more = (await edit(client, "POST", "/import", table="x_m,y_m,dbh_cm\n50,0,20\n50.3,0,30\n")).json()
    assert more["added"] == 2


async def test_a_saved_table_names_the_trees_of_the_map() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        trees = dashboard.shown.frame.trees  # type: ignore[union-attr]
        row = int(np.flatnonzero(trees.confirmed)[0])
        x, y = trees.position[row].tolist()
        for place in ((x + 0.3, y), (x + 500.0, y)):
            await edit(client, "POST", x=place[0], y=place[1])
        table = (await client.get("/api/annotations.csv")).text.splitlines()
        assert [line.split(",")[-1] for line in table] == ["tree", str(trees.number[row]), ""]
        features = json.loads((await client.get("/api/annotations.geojson")).text)["features"]
        assert [each["properties"]["tree"] for each in features] == [trees.number[row], None]


@pytest.mark.parametrize("metres", [1.0, 0.3048])
def test_a_table_for_a_cloud_in_feet_may_be_in_feet_or_metres(metres: float) -> None:
    foot = 0.3048
    x, y = 2_491_010.0 * foot / metres, 6_973_020.0 * foot / metres
    body = _ImportTable.model_validate({"run": 1, **ANN, "table": f"x,y,dbh_cm\n{x},{y},31\n"})
    [content], _ = _imported(body, (2_491_000.0 * foot, 6_973_000.0 * foot), (foot, foot))
    assert (content.x, content.y) == pytest.approx((10.0 * foot, 20.0 * foot), abs=1e-6)
    assert content.dbh == pytest.approx(0.31)


def test_only_the_wrong_row_of_a_table_in_feet_is_a_fault() -> None:
    foot = 0.3048
    table = "x,y\n1640000,18040000\nup,18040000\n"
    body = _ImportTable.model_validate({"run": 1, **ANN, "table": table})
    with pytest.raises(BadRequestError) as refused:
        _imported(body, (1_640_000.0 * foot, 18_040_000.0 * foot), (foot, foot))
    assert refused.value.what == "line 3: x = 'up' is not a number"


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ("", "position"),
        ("a,b\n1,2\n", "position"),
        ("x_m,y_m\n1,up\n", "line 2"),
        ("x_m,y_m\n1,nan\n", "line 2"),
        ("x_m,y_m\n1e9,0\n", "line 2"),
        ("x_m,y_m\n2e7,0\n", "line 2"),
        ("x_m,y_m,dbh_m\n1,0,31\n", "median diameter"),
        ("x_m,y_m,class\n1,0,shrub\n", "shrub"),
        ("x_m,y_m\n" + "".join(f"{k},0\n" for k in range(5001)), "5000"),
    ],
)
async def test_a_table_that_cannot_be_used_adds_nothing(both: Running, table: str, word: str) -> None:
    client, _ = both
    answer = await edit(client, "POST", "/import", table=table)
    assert answer.status_code == 422
    assert word in answer.json()["error"]["what"]
    assert await rows(client) == []


async def test_all_faults_of_a_table_are_named(both: Running) -> None:
    client, _ = both
    faulty = "x_m,y_m,dbh_cm,class,who\nup,0,30,shrub,Ann\n\n2e7,0,2000,,=cmd()\n1,2,30,,\n"
    refused = (await edit(client, "POST", "/import", table=faulty)).json()["error"]
    assert refused["what"] == (
        "line 2: x_m = 'up' is not a number; line 2: class 'shrub' is not one of tree, pole, person, bush, "
        "other, hidden; line 4: it is farther than 10,000,000 m from the origin; line 4: the DBH is 20.0 m; "
        "line 4: who = '=cmd()' is not a name"
    )
    assert refused["remedy"] == "Check the unit of the diameter"
    many = "x_m,y_m\n" + "2e7,0\n" * 13
    refused = (await edit(client, "POST", "/import", table=many)).json()["error"]
    assert refused["what"].count("line ") == 10
    assert refused["what"].endswith("; and 3 more")


async def test_a_cell_that_states_nothing_neither_confirms_nor_removes(both: Running) -> None:
    client, _ = both
    await edit(client, "POST", x=1.0, y=2.0, kind="pole")
    await edit(client, "POST", x=3.0, y=2.0, dbh_cm=26.4)
    before = await rows(client)
    for table, fault in (
        ("1,2,,\n3,2,26.4,tree\n", "line 2: no class"),
        ("3,2,0,tree\n", "dbh_cm 0 is no DBH"),
        ("3,2,-3,tree\n", "dbh_cm -3 is no DBH"),
    ):
        text = f"x_m,y_m,dbh_cm,class\n{table}"
        answer = await edit(client, "POST", "/import", table=text, replaces=True)
        assert fault in answer.json()["error"]["what"]
    assert await rows(client) == before


async def test_two_rows_about_one_annotation_do_not_replace_each_other(both: Running) -> None:
    client, _ = both
    await edit(client, "POST", x=1.0, y=2.0, dbh_cm=28.3)
    table = "x_m,y_m,dbh_cm\n1,2,28.3\n1,2,26\n5,5,\n"
    answer = (await edit(client, "POST", "/import", table=table, replaces=True)).json()
    assert (answer["replaced"], answer["left_out"], answer["differing"]) == (0, 1, 1)
    assert answer["differences"] == ["the annotation at 1.00, 2.00 has DBH 28.3 cm here, 26 cm in the file"]
    assert answer["additions"] == ["the annotation at 5.00, 5.00: tree"]
    answer = (await edit(client, "POST", "/import", table="x_m,y_m,dbh_cm\n5,5,31\n")).json()
    assert answer["fillings"] == ["the annotation at 5.00, 5.00: 31 cm"]


async def test_an_import_names_what_it_replaces_and_which_diameters_are_doubtful(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    at, numbers = trees.position[trees.confirmed], trees.number[trees.confirmed]
    trees.dbh[:], trees.dbh_sigma[:] = 0.222, 0.01
    trees.dbh[np.flatnonzero(trees.confirmed)[1]] = np.nan
    table = "x_m,y_m,dbh_cm,class\n" + "".join(
        f"{x},{y},{dbh},tree\n" for (x, y), dbh in zip(at.tolist(), (222.0, 0.34, 23.0), strict=False)
    )
    answer = (await edit(client, "POST", "/import", table=table)).json()
    assert answer["doubtful"] == 2
    assert answer["doubts"] == [
        f"tree {numbers[0]} has 222 cm, 22.2 cm in the map",
        f"tree {numbers[1]} has 0.34 cm, none in the map; usual are 3 to 150 cm",
    ]
    right = table.replace("222.0", "22.2").replace("0.34,tree", ",pole")
    answer = (await edit(client, "POST", "/import", table=right, replaces=True)).json()
    assert (answer["replaced"], answer["doubtful"]) == (2, 0)
    assert answer["replacements"] == [
        f"tree {numbers[0]}: 222 cm -> 22.2 cm", f"tree {numbers[1]}: tree -> pole",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("mapped", "dbh", "doubtful"),
    [
        ([0.2, 0.4], 1.2, False), ([0.2, 0.4], 0.02, True),  # too few to tell the range of the stand
        (np.linspace(0.1, 0.4, 9), 0.98, True), (np.linspace(0.1, 0.4, 9), 0.098, True),
        ([*np.linspace(0.1, 0.4, 9), np.nan], 0.39, False),
    ],
)  # fmt: skip
def test_a_dbh_beyond_those_of_the_stand_is_doubtful_where_the_map_has_none(mapped, dbh, doubtful) -> None:
    usual = usual_dbh(np.array(mapped))
    assert is_doubtful_dbh(dbh, np.nan, np.nan, usual) == doubtful
    assert not is_doubtful_dbh(dbh, dbh, 0.01, usual)


async def test_class_and_dbh_have_the_authors_of_the_table_else_the_name_of_the_file(both: Running) -> None:
    client, _ = both

    async def authors() -> list[tuple[str, str]]:
        return [(row["who"], row["dbh_who"]) for row in await rows(client)]

    await edit(client, "POST", x=1.0, y=2.0)
    await edit(client, "POST", x=3.0, y=2.0)
    table = "x_m,y_m,dbh_cm,class,who\n1,2,26.4,tree,Ann\n3,2,30,tree,Eve\n7,8,31,tree,Eve\n9,8,31,tree,\n"
    await edit(client, "POST", "/import", table=table, file="plot (2).csv")
    imported = "import of plot _2_.csv"
    # Ann has seen both of her trees, but has not measured them here.
    filled = [("Ann", imported), ("Ann", "Eve")]
    added = [("Eve", "Eve"), (imported, imported)]
    assert await authors() == filled + added
    number = (await rows(client))[2]["id"]
    await edit(client, "PATCH", f"/{number}", version=1, x=7.0, y=8.0, kind="pole")
    corrected = [("Ann", ""), (imported, imported)]
    assert await authors() == filled + corrected
    alone = [("Ann", ""), ("Ann", "")]
    for where, expected in (
        ("undo", filled + added), ("undo", alone), ("redo", filled + added), ("redo", filled + corrected),
    ):  # fmt: skip
        await edit(client, "POST", f"/{where}")
        assert await authors() == expected
    out = (await client.get("/api/annotations.csv")).text.splitlines()
    assert [tuple(line.split(",")[4:6]) for line in out[1:]] == filled + corrected
    await edit(client, "POST", "/import", table="x_m,y_m\n50,50\n", file="")
    assert (await authors())[-1] == ("import", "")
    # A saved table that was corrected elsewhere: its authors are those of what was there before.
    table = "\n".join(out).replace("26.40", "27.40") + "\n"
    await edit(client, "POST", "/import", table=table, file="mended.csv", replaces=True)
    assert (await authors())[:4] == [("Ann", "import of mended.csv"), *filled[1:], *corrected]


def test_an_import_keeps_the_authors_that_its_rows_do_not_replace() -> None:
    twice = [Content(1.0, 1.0, who="Ann"), Content(1.0, 1.0, "tree", 0.3, who="Bob")]
    (added,) = import_plan([], twice).added
    assert (added.who, added.dbh_who) == ("Ann", "Bob")
    known = Annotation(1, Content(1.0, 1.0, "tree", 0.3), "Ann", "Bob", "Bob", 0, 2)
    for who, dbh_who, expected in (
        ("Eve", "Bob", ("Eve", "import")), ("Bob", "", ("import", "import")), ("Eve", "", ("Eve", "Eve")),
    ):  # fmt: skip
        row = Content(1.0, 1.0, "pole", 0.4, who=who, dbh_who=dbh_who)
        ((_, _, changed),) = import_plan([known], [row], replaces=True).replaced
        assert changed is not None
        assert (changed.who, changed.dbh_who) == expected


async def test_the_dbh_keeps_its_author_where_another_person_changes_the_class(both: Running) -> None:
    client, _ = both
    number = (await edit(client, "POST", x=1.0, y=2.0)).json()["id"]
    place = {"x": 1.0, "y": 2.0}
    assert (await edit(client, "PATCH", f"/{number}", version=1, **place, dbh_cm=31.234, **BOB)).is_success
    [row] = await rows(client)
    assert (row["who"], row["dbh_who"], row["dbh_cm"]) == ("Ann", "Bob", 31.23)
    await edit(client, "PATCH", f"/{number}", version=2, **place, dbh_cm=31.23, kind="pole", **EVE)
    [row] = await rows(client)
    assert (row["who"], row["dbh_who"], row["kind"]) == ("Eve", "Bob", "pole")
    late = await edit(client, "PATCH", f"/{number}", version=1, **place, dbh_cm=9.0)
    assert late.status_code == 409
    assert "changed by Eve" in late.text
    await edit(client, "PATCH", f"/{number}", version=3, **place, kind="pole", **BOB)
    [row] = await rows(client)
    assert (row["who"], row["dbh_who"], row["by"], row["dbh_cm"]) == ("Eve", "", "Bob", None)
    late = await edit(client, "PATCH", f"/{number}", version=1, **place, dbh_cm=9.0)
    assert late.status_code == 409
    assert "changed by Bob" in late.text


async def test_a_body_that_is_too_large_is_refused(both: Running) -> None:
    client, _ = both
    assert (await edit(client, "POST", "/import", table="x" * 1_000_001)).status_code == 413


async def test_the_scores_follow_each_edit(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/evaluation")).json() is None
    number = (await edit(client, "POST", x=0.1, y=0.0)).json()["id"]
    await until(lambda: dashboard.scores.latest is not None)
    score = dashboard.scores.latest
    assert score is not None
    # Trees are found at 0, 2 and 4 m; one of them is judged, two are taken for wrong until they are.
    assert (score["TA"], score["spurious"]) == ({"count": 1, "of": 1, "rate": 1.0}, 2)
    await edit(client, "PATCH", f"/{number}", version=1, x=0.1, y=0.0, kind="pole")
    await until(lambda: (dashboard.scores.latest or {}).get("FA", {}).get("count") == 1)
    await edit(client, "POST", "/undo")
    await until(lambda: (dashboard.scores.latest or {}).get("TA", {}).get("count") == 1)
    await edit(client, "POST", "/undo")
    await until(lambda: dashboard.scores.latest is None)


async def test_annotations_lie_over_the_truth_of_the_source() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard, truth=True)
        assert dashboard.annotation_editor.as_plain()["used"] == "source"
        # The source has trees at 0.05 and 2 m and a pole at 9 m.
        await edit(client, "POST", x=2.2, y=0.1, kind="pole")
        assert dashboard.truth is not None
        assert dashboard.truth.x.tolist() == [0.05, 9.0, 2.2]
        assert dashboard.truth.kind == ("tree", "pole", "pole")
        assert dashboard.annotation_editor.as_plain()["used"] == "both"
        # The truth says itself what is annotated: the message with the annotations comes later.
        messages = [json.loads(each) for _, each in dashboard.live.messages_after(0)]
        truth = next(each for each in messages if each["type"] == "truth")
        assert [each.get("annotated", False) for each in truth["trees"]] == [False, False, True]
        assert not truth["trees"][2]["taped"]
        await edit(client, "POST", "/undo")
        assert dashboard.truth.x.tolist() == [0.05, 2.0, 9.0]


async def test_what_agrees_leaves_the_truth_of_the_source_exact_and_a_person_chooses_what_counts() -> None:
    async with running() as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard, truth=True)
        exact = dashboard.truth
        assert exact is not None

        async def choose(against: str) -> dict[str, Any]:
            answer = await client.put("/api/annotations/against", json={"against": against})
            assert answer.status_code == 200
            told: dict[str, Any] = answer.json()
            return told

        await edit(client, "POST", x=2.2, y=0.1)  # the tree that was found there is one
        assert dashboard.truth is not None
        assert sorted(dashboard.truth.x.tolist()) == sorted(exact.x.tolist())
        assert dashboard.annotation_editor.as_plain()["contradicting"] == []
        wrong = (await edit(client, "POST", x=0.1, y=0.0, kind="pole")).json()["id"]
        await edit(client, "POST", x=30.0, y=0.0, kind="pole")  # nobody knew of it
        assert (await client.get("/api/annotations")).json()["contradicting"] == [wrong]
        await edit(client, "POST", "/undo")
        told = await choose("own")
        assert (told["used"], told["own"]) == ("source", len(exact.x))
        assert dashboard.truth is exact
        assert (await choose("annotations"))["used"] == "annotations"
        assert sorted(dashboard.truth.x.tolist()) == [0.1, 2.2]
        await edit(client, "POST", "/undo")
        assert dashboard.truth.x.tolist() == [2.2]
        await edit(client, "POST", "/undo")
        # Who asked for annotations alone is not told the source's truth.
        assert dashboard.annotation_editor.as_plain()["used"] == "none"
        assert dashboard.annotation_editor.truth is None
        assert (await choose("both"))["used"] == "source"
        assert dashboard.truth is exact
        refused = await client.put("/api/annotations/against", json={"against": "nothing"})
        assert refused.status_code == 422


def test_without_annotations_the_truth_is_that_of_the_source() -> None:
    assert laid_over(None, []) is None
    own = truth_trees()
    assert laid_over(own, []) is own
    alone = laid_over(None, [Content(1.0, 2.0, "tree", 0.3)])
    assert alone is not None
    assert (alone.x.tolist(), alone.dbh.tolist()) == ([1.0], [0.3])


def test_who_confirms_one_stem_of_two_says_nothing_of_the_other() -> None:
    own = TruthTrees(np.array([0.0, 0.4]), np.zeros(2), np.array([0.2, 0.3]), ("tree", "bush"))
    one = Content(0.05, 0.0, "tree", None)
    laid = laid_over(own, [one])
    assert laid is not None
    assert (laid.x.tolist(), laid.kind) == ([0.4, 0.0], ("bush", "tree"))
    # The second is of what the first, which is nearer, leaves.
    both = laid_over(own, [Content(0.15, 0.0, "bush", None), one])
    assert both is not None
    assert (both.x.tolist(), both.kind) == ([0.4, 0.0], ("bush", "tree"))


async def test_every_browser_is_told() -> None:
    async with served() as (host, dashboard):
        await show(dashboard)
        port = int(host.rpartition(":")[2])
        cookie = {"Cookie": f"stemmap_{port}={session_value(TOKEN, port, ENDS)}"}
        listen = partial(
            connect,
            f"ws://{host}/api/live",
            additional_headers=cookie,
            origin=Origin(f"http://{host}"),
        )
        async with (
            listen() as one,
            listen() as other,
            httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as client,
        ):
            number = (await edit(client, "POST", x=1.0, y=2.0)).json()["id"]
            for browser in (one, other):
                async with asyncio.timeout(20):
                    while True:
                        message = json.loads(await browser.recv())
                        if message["type"] == "annotations" and message["trees"]:
                            break
                assert [(t["id"], t["who"]) for t in message["trees"]] == [(number, "Ann")]


async def test_what_was_annotated_is_there_after_a_restart(tmp_path: Path) -> None:
    for expected in ([], [1.0]):
        async with running(Settings(folder=tmp_path)) as (client, dashboard):
            client.headers.update(BEARER)
            await show(dashboard)
            assert [row["x"] for row in await rows(client)] == expected
            if not expected:
                await edit(client, "POST", x=1.0, y=0.0)


async def test_a_store_that_cannot_be_used_is_said_and_the_map_goes_on(tmp_path: Path, caplog: Any) -> None:
    (tmp_path / "annotations.sqlite").write_bytes(b"no database" * 500)
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard, truth=True)
        told = (await client.get("/api/annotations")).json()
        assert "annotations.sqlite" in told["problem"]
        assert len(caplog.records) == 1
        refused = await client.post("/api/annotations", json={"run": 1, **ANN, "x": 0.0, "y": 0.0})
        assert refused.status_code == 409
        assert "annotations.sqlite" in refused.json()["error"]["what"]
        assert dashboard.truth is not None
        assert len((await client.get("/api/trees")).json()["trees"]) == 3


async def test_the_store_works_beside_the_event_loop() -> None:
    import threading

    store = AsyncStore(None)
    annotation_editor = AnnotationEditor(store)
    await annotation_editor.begin("d", "u", None)
    assert annotation_editor.run is not None
    name = await annotation_editor.edit(annotation_editor.run, lambda _: threading.current_thread().name)
    assert name.startswith("store")
    assert threading.current_thread().name != name
    await store.close()


@pytest.mark.parametrize("is_open", [True, False])
async def test_a_store_with_a_full_queue_finishes_its_requests_and_closes(is_open: bool) -> None:
    store, held = AsyncStore(None), threading.Event()
    if is_open:
        await store.ask(lambda _: None)
    requests = [asyncio.ensure_future(store.ask(lambda _: held.wait(20.0))) for _ in range(LARGEST_QUEUE)]
    await asyncio.sleep(0)
    with pytest.raises(StoreBusyError):
        await store.ask(lambda _: None)
    closing = asyncio.ensure_future(store.close())
    await asyncio.sleep(0)
    held.set()
    await closing
    assert all(await asyncio.gather(*requests))


def test_who_asks_for_one_of_two_truths_is_not_told_the_other() -> None:
    rows = [Annotation(1, Content(1.0, 2.0, "tree", 0.3), "Ann", "", "Ann", 0, 1)]
    assert truth_of(None, rows, "own") is None
    assert truth_of(truth_trees(), [], "annotations") is None
    assert (counted(None, rows, "both"), counted(None, rows, "annotations")) == ("annotations",) * 2


def test_merged_trees_of_a_repaired_path_are_found_by_those_that_were_seen_with_them() -> None:
    """Three trees of the second round came to those of the first one; a fourth has no other."""
    first = np.array([[0.0, 0.0], [6.0, 0.0], [12.0, 0.0]])
    before = trees(np.concatenate([first, first + np.array([1.5, 3.0]), [[19.5, 3.0]]]))
    before = replace(before, first_seen_ns=np.array([0, 1, 2, 10, 11, 12, 13]) * 10**9)
    after = rows_of(before, np.array([0, 1, 2, 6]))
    after.position[3] = (18.0, 0.0)
    assert _successors(before, after, (2, 5)) == {1: 1, 2: 2, 3: 3, 7: 7, 5: 2, 4: 1, 6: 3}


def test_a_rejection_of_a_vanished_tree_neither_follows_nor_decides_a_merge() -> None:
    there = trees(np.array([[0.3, 0.0], [0.9, 0.0]]))
    gone = Annotation(1, Content(0.0, 0.0, "pole", reach=0.15), "Ann", "", "Ann", 0, 1)
    confirmed = Annotation(2, Content(0.9, 0.0, "tree", 0.31), "Ben", "Ben", "Ben", 0, 1)
    places = ((0.3, 0.0), (0.9, 0.0))
    changes = carried_by(there, [gone, confirmed], [Repair("merge", places)])
    assert [(id_, content is None) for id_, _, content in changes] == [(2, False)]


@pytest.mark.parametrize("replaces", [False, True])
def test_a_table_changes_only_what_its_rows_are_about(replaces: bool) -> None:
    rejected = Annotation(1, Content(0.0, 0.0, "pole", reach=0.15), "Ann", "", "Ann", 0, 1)
    plan = import_plan([rejected], [Content(0.3, 0.0, "tree", 0.31)], replaces=replaces)
    assert (len(plan.added), plan.replaced, plan.conflicts) == (1, [], [])
    open_ = Annotation(2, Content(5.0, 0.0), "Ann", "", "Ann", 0, 1)
    twice = [Content(5.0, 0.0, "tree", 0.3), Content(5.0, 0.0, "tree", 0.5)]
    plan = import_plan([open_], twice, replaces=replaces)
    assert [content and content.dbh for *_, content in plan.filled] == [0.3]
    assert (plan.replaced, len(plan.conflicts)) == ([], 1)


@pytest.mark.parametrize(("replaces", "has_diameters", "left"), [
    (True, True, [None]), (True, False, []), (False, True, []),
])  # fmt: skip
def test_an_emptied_diameter_is_a_difference(
    replaces: bool, has_diameters: bool, left: list[float | None]
) -> None:
    measured = Annotation(1, Content(0.0, 0.0, "tree", 0.31), "Ann", "", "Ann", 0, 1)
    emptied = [Content(0.0, 0.0, "tree", None)]
    plan = import_plan([measured], emptied, replaces=replaces, has_diameters=has_diameters)
    assert [content and content.dbh for *_, content in plan.replaced] == left
    assert (plan.filled, plan.conflicts, plan.repeated) == ([], [], 1 - len(left))


async def test_the_reach_is_that_of_the_map_in_which_an_answer_was_given(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    assert dashboard.shown is not None
    (x, y), (other_x, other_y), *_ = dashboard.shown.frame.trees.position.tolist()
    gap = float(np.hypot(other_x - x, other_y - y))
    number = (await edit(client, "POST", x=x, y=y, kind="pole")).json()["id"]
    stored = dashboard.annotation_editor.rows[0]
    assert stored.content.reach == (pytest.approx(gap / 2.0) if gap < 2.0 * SAME_THING else None)
    # The trees move away: the answer is about none, so that a nudge gives it no other one.
    dashboard.annotation_editor.rows[0] = replace(stored, content=replace(stored.content, reach=0.1))
    dashboard.shown.frame.trees.position[0] += 0.3
    said = {"x": x + 0.01, "y": y, "kind": "pole", "version": stored.version}
    assert (await edit(client, "PATCH", f"/{number}", **said)).status_code == 200
    assert dashboard.annotation_editor.rows[0].content.reach == 0.1


async def test_a_table_whose_diameters_have_another_unit_than_those_of_the_map_is_refused(
    both: Running,
) -> None:
    client, dashboard = both
    await show(dashboard)
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    trees.dbh[:] = 0.3
    places = trees.position[trees.confirmed].tolist()
    assert len(places) >= 3
    for factor, code in ((1.0, 200), (2.0, 200), (10.0, 422), (0.1, 422)):
        rows_ = "".join(f"{x},{y},{30.0 * factor:.3f}\n" for x, y in places)
        answer = await edit(client, "POST", "/import", table=f"x_m,y_m,dbh_cm\n{rows_}", replaces=True)
        assert answer.status_code == code, factor
        if code == 422:
            assert "times those of the map" in answer.json()["error"]["what"]
