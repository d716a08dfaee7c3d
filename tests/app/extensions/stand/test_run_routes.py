"""The report of a run, and two runs compared, through the API."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from app.cli import main
from app.common.settings import Settings
from app.dashboard.shown_run import ShownRun
from app.extensions.stand.heading import Heading
from app.extensions.stand.plot_files import plots_of_run
from app.extensions.stand.report import report_page
from app.worker.protocol import View
from tests.app.batch.finished_runs import write_run
from tests.app.batch.test_runs import play, runs, show
from tests.app.server_for_tests import BEARER, Running, running


@pytest.mark.slow
async def test_two_runs_of_one_recording_are_compared(both: Running) -> None:
    client, dashboard = both
    await play(dashboard, n_trees=4)
    await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.4}})
    await play(dashboard, n_trees=5, run=2)
    new, old = (row["key"] for row in await runs(client))
    told = (await client.get("/api/runs/compare", params={"a": old, "b": new})).json()
    assert told["how"] == "same recording"
    assert [(row["tree_a"], row["tree_b"], row["shift_m"]) for row in told["rows"]] == [
        (1, 1, 0),
        (2, 2, 0),
        (3, 3, 0),
        (None, 4, None),
    ]
    assert told["record"]["counts"]["same"] == 3
    assert told["parameters"] == [{"name": "clustering.eps", "a": 0.15, "b": 0.4}]


@pytest.mark.slow
async def test_two_visits_are_those_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two folders in frames of their own: a tree has grown, one is gone, one is new."""

    rng = np.random.default_rng(3)
    there = rng.uniform(1, 19, (24, 2))
    c, s = np.cos(0.7), np.sin(0.7)
    here = (there - [3.0, -2.0]) @ np.array([[c, -s], [s, c]])
    dbh = rng.uniform(0.15, 0.45, 24)
    grown = dbh.copy()
    grown[5] += 0.05
    folder = tmp_path / "recordings"
    write_run(folder / "first", there[1:], dbh[1:], dbh_sigma=0.004, numbers=range(2, 25))
    write_run(folder / "second", here[:-1], grown[:-1], dbh_sigma=0.004, side=20.0)
    paths = [str(folder / name) for name in ("first", "second")]
    assert await asyncio.to_thread(main, ["compare", *paths, "--out", str(tmp_path / "out")]) == 0
    async with running(Settings(folder=tmp_path)) as (client, _):
        client.headers.update(BEARER)
        query = {"a": "folder:first", "b": "folder:second"}
        run = folder / "second" / "run.json"
        run.write_text(run.read_text().replace('"sha256": "00"', '"sha256": "01"'))
        told = (await client.get("/api/runs/compare", params=query)).json()
    assert told["how"] == "aligned by 22 stems"
    np.testing.assert_allclose(told["pose"], [3.0, -2.0, 0.7], atol=0.02)
    assert told["csv"] == (tmp_path / "out" / "comparison.csv").read_text()
    assert [row["tree_a"] for row in told["rows"] if row["significant"]] == [6]
    assert (told["record"]["pairs"], told["record"]["significant"]) == (22, 1)
    np.testing.assert_allclose(told["places_b"]["6"], there[5], atol=0.02)


@pytest.mark.slow
async def test_maps_that_do_not_fit_are_compared_without_alignment(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    write_run(folder / "few", [[1.0, 1.0]], [0.2])
    write_run(folder / "none", np.zeros((0, 2)), [])
    write_run(folder / "other", [[1.3, 1.0], [9.0, 9.0]], [0.2, 0.3])
    for k, name in enumerate(("few", "none", "other")):
        run = folder / name / "run.json"
        run.write_text(run.read_text().replace('"sha256": "00"', f'"sha256": "{k}"'))
    async with running(Settings(folder=tmp_path)) as (client, _):
        client.headers.update(BEARER)
        for a, b, statuses in (("few", "other", ["same", "new"]), ("none", "few", ["new"])):
            query = {"a": f"folder:{a}", "b": f"folder:{b}"}
            told = (await client.get("/api/runs/compare", params=query)).json()
            assert told["how"].startswith("not aligned: the stems of the two maps do not agree")
            assert not told["aligned"]
            assert [row["status"] for row in told["rows"]] == statuses


@pytest.mark.parametrize("key", ["99", "folder:nothing"])
async def test_a_run_that_is_not_there_is_not_compared(both: Running, key: str) -> None:
    client, _ = both
    assert (await client.get("/api/runs/compare", params={"a": key, "b": key})).status_code == 404


async def test_the_report_of_a_run_is_that_of_the_command_line(both: Running, tmp_path: Path) -> None:
    """Of the open run, and of a run in the list, which keeps its result files."""
    client, dashboard = both
    assert (await client.get("/api/runs/open/report/html")).status_code == 409
    await play(dashboard)
    assert dashboard.path is not None
    for stamp in dashboard.path.stamp_ns.tolist():
        await dashboard.receive(View(1, stamp, np.full((2, 360), 8.0)))
    await show(dashboard, 3, 4)
    shape = {"kind": "circle", "x": 1.0, "y": 1.0, "radius": 3.0}
    run = (await client.get("/api/annotations")).json()["run"]
    body = {"run": run, "browser": "a" * 16, "who": "Ann", "plots": [{"name": "north", "shape": shape}]}
    assert (await client.post("/api/plots", json=body)).status_code == 201

    reply = await client.get("/api/runs/open/report/html?language=de&volume=0.001*dbh_cm^2")
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-disposition"] == 'attachment; filename="report.html"'
    page = reply.text
    assert "Bestandesbericht" in page
    assert "north" in page
    assert "Stammvolumen je Hektar" in page
    names = {"stand": "Hohe Warte", "client": "", "author": " Ann  Lee "}
    body = {"run": run, "browser": "a" * 16, "who": "Ann"}
    edits = []
    for words in ({"stand": "before"}, {}, {}):  # a repeated one is no edit
        stored = await client.put("/api/heading", json={**body, "names": {**names, **words}})
        assert stored.status_code == 200, stored.text
        edits.append(stored.json()["undo"]["other"])
    assert edits == [2, 3, 3]
    (kept,) = (await client.get("/api/annotations")).json()["others"]["heading"]
    assert (kept["stand"], kept["author"]) == ("Hohe Warte", "Ann Lee")
    for wrong in ("a\x07", "a" * 101):
        refused = await client.put("/api/heading", json={**body, "names": {**names, "stand": wrong}})
        assert refused.status_code == 422
    for browser, part in (
        ("b", {"client": "the town"}),
        ("a", {"stand": "Warte"}),
        ("a", {"client": ""}),
        ("a", {}),
    ):
        edit = {**body, "browser": browser * 16, "names": part}
        assert (await client.put("/api/heading", json=edit)).status_code == 200
        (kept,) = (await client.get("/api/annotations")).json()["others"]["heading"]
        assert kept["author"] == "Ann Lee", "only the fields of the request change"
        assert part.items() <= kept.items()
    assert kept["stand"] == "Warte"
    assert (await client.put("/api/heading", json={**body, "names": names})).status_code == 200

    english = (await client.get("/api/runs/open/report/html")).text
    assert "Ann Lee" in english
    assert "What was left out" not in english  # only `stemmap map` counts it
    with ShownRun.of(dashboard).folder() as folder:
        heading = Heading("Hohe Warte", "", "Ann Lee")
        assert english == report_page(folder, plots=plots_of_run(ShownRun.of(dashboard)), heading=heading)

    key = next(row["key"] for row in await runs(client))
    assert (await client.get(f"/api/runs/{key}/report/html")).text == english
    await play(dashboard, "other:", run=2)
    async with asyncio.timeout(20):  # the files are written in the background
        while (stored := await client.get(f"/api/runs/{key}/report/html")).status_code == 409:
            assert "without its result files" in stored.text
            await asyncio.sleep(0.05)
    assert (stored.status_code, stored.text == english) == (200, True)
    assert (await client.get("/api/runs/999/report/html")).status_code == 404
    assert (await client.get("/api/runs/folder:none/report/html")).status_code == 404
    assert (await client.get(f"/api/runs/{key}/report/html?language=xx")).status_code == 422
