"""The coordinate reference system of the open map: found as on the command line, undone, and in all files."""

from __future__ import annotations

import asyncio
import csv
import json
import tempfile
from pathlib import Path
from typing import Any

import geopandas
import httpx
import numpy as np
import pytest

from app.cli import main
from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.shown_run import ShownRun
from pipeline.geometry.poses import Pose2
from pipeline.io.atomic_files import write_texts
from tests.app.dashboard.test_annotations import both, edit, show
from tests.app.extensions.stand.test_plot_routes import look
from tests.app.server_for_tests import BEARER, running

__all__ = ["both"]

TRUE = Pose2(500000.0, 5300000.0, 0.5)  # UTM zone 32
UTM = "EPSG:25832"


async def put(client: httpx.AsyncClient, crs: str = UTM, **by: Any) -> httpx.Response:
    run = (await client.get("/api/annotations")).json()["run"]
    edit = {"run": run, "browser": "a" * 16, "who": "Ann"}
    return await client.put("/api/georeference", json={**edit, "crs": crs, "by": by}, timeout=60.0)


async def read_table(client: httpx.AsyncClient, table: str) -> httpx.Response:
    return await client.post("/api/georeference/points", json={"crs": UTM, "table": table}, timeout=60.0)


async def stored(client: httpx.AsyncClient) -> dict[str, Any] | None:
    found: dict[str, Any] | None = (await client.get("/api/annotations")).json()["frame"]
    return found


def points_of(dashboard: Dashboard) -> list[dict[str, Any]]:
    """Two trees and a mark that is no tree."""
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    place = np.array([*trees.position[:2], [-3.0, 4.0]])
    known = TRUE.apply(place).round(3).tolist()
    marks = [{"tree": int(n)} for n in trees.number[:2]] + [{"name": "post", "x": -3.0, "y": 4.0}]
    return [{**mark, "east": e, "north": n} for mark, (e, n) in zip(marks, known, strict=True)]


@pytest.mark.slow
async def test_control_points_place_the_files_as_on_the_command_line(both, tmp_path: Path) -> None:
    client, dashboard = both
    await look(dashboard)
    points = points_of(dashboard)
    answer = await put(client, crs="25832", how="control", points=points)
    assert (answer.status_code, answer.json()["undo"]) == (200, {"other": 1}), answer.text
    found = await stored(client)
    assert found is not None
    assert (found["crs"], [point["name"] for point in found["points"]]) == (UTM, ["1", "2", "post"])
    assert np.abs([row[1:] for row in found["frame"]["residuals_m"]]).max() < 0.002
    assert (await client.get("/api/plots")).json()["all"]["crs"] == UTM

    assert dashboard.shown is not None
    expected = TRUE.apply(dashboard.shown.frame.trees.position[:1])[0]
    (first, *_) = csv.DictReader((await client.get("/api/trees.csv")).text.splitlines())
    east_north = [float(first[name]) for name in ("easting_m", "northing_m")]
    assert east_north == pytest.approx(expected.tolist(), abs=0.003)

    run = tmp_path / "run"
    write_texts(run, ShownRun.of(dashboard).texts())
    table = ["name,tree,x_m,y_m,easting,northing"]
    for p in points:
        cells = (p.get(name, "") for name in ("name", "tree", "x", "y", "east", "north"))
        table.append(",".join(map(str, cells)))
    file = tmp_path / "points.csv"
    file.write_text("\n".join(table))
    assert (
        await asyncio.to_thread(main, ["georeference", str(run), "--control", str(file), "--crs", UTM]) == 0
    )
    for suffix in ("gpkg", "dxf", "xlsx"):
        out = tmp_path / f"trees.{suffix}"
        words = ["export", str(run), "--to", str(out), "--plots", "none"]
        assert await asyncio.to_thread(main, words) == 0
        assert (await client.get(f"/api/export/{suffix}")).content == out.read_bytes(), suffix
    layer = geopandas.read_file(tmp_path / "trees.gpkg", layer="trees")
    assert layer.crs == UTM
    assert layer.geometry[0].x == pytest.approx(expected[0], abs=0.003)
    assert "EPSG:25832" in (await client.get("/api/runs/open/report/html", timeout=60.0)).text

    # The same points as a table give the same frame; so does the page's frame on the command line.
    read = (await read_table(client, file.read_text())).json()
    assert read["faults"] == []
    assert (await put(client, how="control", points=read["points"])).status_code == 200
    again = await stored(client)
    assert again is not None
    assert (again["frame"], again["points"]) == (found["frame"], found["points"])


async def test_rows_of_a_table_are_kept_where_others_are_wrong(both) -> None:
    client, _ = both
    table = (
        "name,tree,x_m,y_m,lon,lat\nA,1,,,9.0,48.0\nB,2,,,9.O,48.0\nC,,,,9.0,48.0\n,1.5,,,9,48\n,,1,2,9,95\n"
    )
    read = (await read_table(client, table)).json()
    assert [text for _, text in read["faults"]] == [
        "line 3: lon = '9.O' is not a number",
        "line 4: it has no tree and no x_m and y_m",
        "line 5: the map has no tree 1.5",
        "line 6: the reference system has no place for its lon and lat. Check both, and the EPSG code",
    ]
    assert [row for row, _ in read["faults"]] == [1, 2, 3, 4]
    a, b, c, _, e = read["points"]
    assert (a["tree"], a["east"], a["north"]) == (1, pytest.approx(5e5), pytest.approx(5316300.0, abs=1000.0))
    assert (b["name"], b["tree"], b["east"], b["north"]) == ("B", 2, None, None)
    assert (c["name"], c["tree"], c["x"], c["east"]) == ("C", None, None, a["east"])
    assert (e["x"], e["y"], e["east"]) == (1.0, 2.0, None)
    assert await stored(client) is None


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            "x_m,y_m,easting,northing\n" + "".join(f"{k},0,{500000 + k},5300000\n" for k in range(201)),
            "at most 200 control points",
        )
    ],
)
async def test_a_table_without_points_that_could_be_kept_is_refused(both, table: str, words: str) -> None:
    client, _ = both
    refused = await read_table(client, table)
    assert (refused.status_code, words in refused.text) == (422, True), refused.text
    assert tempfile.gettempdir() not in refused.text


async def test_it_is_changed_removed_and_undone(both) -> None:
    client, _ = both
    assert await stored(client) is None
    for east in (500000.0, 500001.0):
        assert (await put(client, how="hand", east=east, north=5300000.0, turn_deg=30.0)).status_code == 200
    found = await stored(client)
    assert found is not None
    assert found["frame"]["east_m"] == 500001.0
    assert (await client.get("/api/annotations")).json()["trees"] == []
    await edit(client, "DELETE", f"/{found['id']}", version=found["version"])
    assert await stored(client) is None
    for east in (500001.0, 500000.0):
        await edit(client, "POST", "/undo")
        found = await stored(client)
        assert found is not None
        assert found["frame"]["east_m"] == east
    await edit(client, "POST", "/undo")
    assert await stored(client) is None


async def test_a_tree_that_is_annotated_as_a_pole_is_a_control_point(both) -> None:
    client, dashboard = both
    points = points_of(dashboard)
    assert dashboard.shown is not None
    x, y = dashboard.shown.frame.trees.position[0].tolist()
    await edit(client, "POST", x=x, y=y, kind="pole")
    answer = await put(client, how="control", points=points)
    assert answer.status_code == 200, answer.text


async def test_a_system_without_a_code_can_be_applied_again(both) -> None:
    client, _ = both
    crs = "+proj=tmerc +lon_0=9.5 +x_0=500000 +ellps=GRS80 +type=crs"
    for _ in range(2):
        answer = await put(client, crs, how="hand", east=500000.0, north=5300000.0)
        assert answer.status_code == 200, answer.text
        found = await stored(client)
        assert found is not None
        assert found["crs"] == crs
        assert found["frame"]["crs"].startswith("PROJCRS")


@pytest.mark.parametrize(
    ("crs", "by", "words"),
    [
        (UTM, {"how": "hand", "east": 50.0, "north": 5.0}, "do not fit"),
        (
            UTM,
            {"how": "control", "points": [{"tree": 99, "east": 5e5, "north": 53e5}]},
            "point 99: the map has no tree 99",
        ),
    ],
)
async def test_what_does_not_fit_is_refused_and_nothing_is_stored(
    both, crs: str, by: dict[str, Any], words: str
) -> None:
    client, _ = both
    refused = await put(client, crs, **by)
    assert (refused.status_code, words in refused.text) == (422, True), refused.text
    assert tempfile.gettempdir() not in refused.text
    assert await stored(client) is None


async def test_the_command_line_takes_the_frame_of_the_page(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "data"))
    run = tmp_path / "run"
    words = ["georeference", str(run), "--from-page"]
    async with running(Settings(folder=tmp_path / "data")) as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        write_texts(run, ShownRun.of(dashboard).texts())
        assert await asyncio.to_thread(main, words) == 1
        assert "got no reference system on the page" in capsys.readouterr().err
        assert (await put(client, how="hand", east=500000.0, north=5300000.0)).status_code == 200
    assert await asyncio.to_thread(main, words) == 0
    assert "EPSG:25832: origin at 500000.000, 5300000.000 m" in capsys.readouterr().out
    assert json.loads((run / "georeference.json").read_text())["crs"] == UTM
