"""Plots of the open run: drawn, along the path, imported, renamed, undone, and their figures and files."""

from __future__ import annotations

import asyncio
import base64
import json
import math
import re
from dataclasses import replace
from typing import Any

import geopandas
import httpx
import numpy as np
import pytest
import shapely
from msgspec import structs

from app.dashboard.dashboard import Dashboard
from app.worker.protocol import View
from pipeline.detection.free_space import BINS
from tests.app.dashboard.test_annotations import BOB, both, edit, show

__all__ = ["both"]

CIRCLE: dict[str, Any] = {"name": "", "shape": {"kind": "circle", "x": 1.0, "y": 1.0, "radius": 5.641896}}


async def plots(client: httpx.AsyncClient) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = (await client.get("/api/annotations")).json()["others"].get("plot", [])
    return found


async def act(client: httpx.AsyncClient, method: str, where: str = "", **body: Any) -> httpx.Response:
    run = (await client.get("/api/annotations")).json()["run"]
    said = {"run": run, "browser": "a" * 16, "who": "Ann", **body}
    return await client.request(method, f"/api/plots{where}", json=said)


async def look(dashboard: Dashboard) -> None:
    """Views from all three scans of the path, 10 m far."""
    assert dashboard.path is not None
    for stamp in dashboard.path.stamp_ns.tolist():
        await dashboard.receive(View(1, stamp, np.full((2, BINS), 10.0)))


async def test_a_rejected_tree_is_marked_in_the_table_and_counts_in_no_figure(both) -> None:
    client, dashboard = both
    await look(dashboard)
    assert dashboard.shown is not None
    (x, y), *_ = dashboard.shown.frame.trees.position.tolist()
    before = (await client.get("/api/plots")).json()["all"]
    await edit(client, "POST", x=x + 0.1, y=y, kind="pole")
    after = (await client.get("/api/plots")).json()["all"]
    assert [figures["trees_left_out"]["rejected"] for figures in (before, after)] == [0, 1]
    assert after["plots"]["all"]["trees"] == before["plots"]["all"]["trees"] - 1
    header, *rows = (await client.get("/api/trees.csv")).text.splitlines()
    assert header.endswith(",review")
    assert [row.rsplit(",", 1)[1] for row in rows] == ["rejected", *["open"] * (len(rows) - 1)]
    features = (await client.get("/api/export/geojson")).json()["features"]
    assert len(features) == len(rows) - 1


@pytest.mark.slow
async def test_the_way_of_coverage_is_that_of_the_child_process(both, monkeypatch) -> None:
    client, dashboard = both
    await look(dashboard)
    shown = dashboard.shown
    assert shown is not None
    trees = shown.frame.trees
    lacking = replace(trees, dbh=np.full_like(trees.dbh, np.nan), sides=np.ones(len(trees.number), np.int64))
    dashboard.shown = structs.replace(shown, frame=replace(shown.frame, trees=lacking))
    way = (await client.get("/api/detour")).json()
    assert way["length_m"] > 0.0
    assert set(way["trees"]) <= set(trees.number.tolist())
    assert len(way["points"][0]) == 2
    dashboard.shown = structs.replace(shown, frame=replace(shown.frame, trees=replace(lacking, sides=None)))
    assert (await client.get("/api/detour")).json() == {}


async def test_the_radius_of_a_circle_is_changed_and_no_other_shape_has_one(both) -> None:
    client, _ = both
    rectangle = {"kind": "rectangle", "x": 0.0, "y": 0.0, "length": 4.0, "width": 2.0}
    added = await act(client, "POST", plots=[CIRCLE, {"name": "", "shape": rectangle}])
    circle, other = added.json()["ids"]
    assert (await act(client, "PATCH", f"/{circle}", version=1, radius=8.0)).status_code == 200
    refused = await act(client, "PATCH", f"/{other}", version=1, radius=8.0)
    assert (refused.status_code, refused.json()["error"]["what"]) == (422, "only a circle has a radius")
    assert [plot["shape"].get("radius") for plot in await plots(client)] == [8.0, None]


async def test_a_plot_is_added_renamed_deleted_and_all_of_it_undone(both) -> None:
    client, _ = both
    added = await act(client, "POST", plots=[CIRCLE, {**CIRCLE, "name": "north"}])
    assert (added.status_code, added.json()["undo"]) == (201, {"other": 1})
    first, second = await plots(client)
    assert (first["name"], second["name"], first["shape"]["radius"]) == ("1", "north", 5.641896)
    assert (await client.get("/api/annotations")).json()["trees"] == []

    renamed = await act(client, "PATCH", f"/{first['id']}", version=1, name=" south  edge ")
    assert renamed.status_code == 200
    assert [plot["name"] for plot in await plots(client)] == ["south edge", "north"]
    taken = await act(client, "PATCH", f"/{first['id']}", version=2, name="north")
    assert (taken.status_code, "another plot is called" in taken.text) == (422, True)
    stale = await act(client, "PATCH", f"/{first['id']}", version=1, name="east", **BOB)
    assert (stale.status_code, "was changed by Ann" in stale.text) == (409, True)
    assert (await act(client, "PATCH", "/999", version=1, name="x")).status_code == 404

    assert (await edit(client, "DELETE", f"/{second['id']}", version=1)).status_code == 200
    assert [plot["name"] for plot in await plots(client)] == ["south edge"]
    for wanted in (["south edge", "north"], ["1", "north"], []):
        assert (await edit(client, "POST", "/undo")).status_code == 200
        assert [plot["name"] for plot in await plots(client)] == wanted
    await edit(client, "POST", "/redo")
    assert [plot["name"] for plot in await plots(client)] == ["1", "north"]


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (
            {"kind": "circle", "x": 0.0, "y": 0.0, "radius": 0.0},
            '"what":"radius is 0.0, but must be above 0","where":"plot 1","remedy":"Correct this value"',
        ),
        ({"kind": "polygon", "polygons": [[[[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 2.0]]]]}, "not valid"),
    ],
)
async def test_what_is_no_area_is_refused(both, shape: dict[str, Any], words: str) -> None:
    client, _ = both
    refused = await act(client, "POST", plots=[{"name": "", "shape": shape}])
    assert (refused.status_code, words in refused.text) == (422, True), refused.text
    assert await plots(client) == []


async def test_circles_lie_along_the_path(both) -> None:
    client, _ = both
    added = await act(client, "POST", "/along", every=0.5, radius=2.0)
    assert added.status_code == 201
    assert [(p["name"], p["shape"]["x"], p["shape"]["radius"]) for p in await plots(client)] == [
        ("1", 0.25, 2.0),
        ("2", 0.75, 2.0),
    ]
    await edit(client, "POST", "/undo")  # one edit
    assert await plots(client) == []
    refused = await act(client, "POST", "/along", every=50.0, radius=2.0)
    assert (refused.status_code, "the path of 1.0 m" in refused.text) == (422, True)


async def test_figures_refer_to_what_was_observed(both) -> None:
    client, dashboard = both
    nothing = (await client.get("/api/plots")).json()
    assert nothing["all"] is None
    assert "no area was observed" in nothing["problem"]
    await look(dashboard)
    whole = (await client.get("/api/plots")).json()
    assert (whole["plots"], whole["problem"]) == (None, "")
    assert whole["all"]["plots"]["all"]["trees"] == 3
    assert any("only 3 trees" in text for text in whole["all"]["warnings"])

    await act(client, "POST", plots=[CIRCLE])
    found = (await client.get("/api/plots?volume=0.001*dbh_cm^2")).json()["plots"]
    figures = found["plots"]["1"]
    assert figures["area_m2"] == pytest.approx(100.0, abs=0.01)
    assert figures["n_ha"][0] == pytest.approx(100.0 * figures["trees"], rel=0.01)
    assert figures["v_ha"][0] > 0.0
    far = {"name": "far", "shape": {"kind": "circle", "x": 500.0, "y": 0.0, "radius": 5.0}}
    await act(client, "POST", plots=[far])
    found = (await client.get("/api/plots")).json()["plots"]
    assert any("plot far: no part of the plot was observed" in text for text in found["warnings"])
    assert found["mean"]["n_ha_plain"][0] == found["plots"]["1"]["n_ha_plain"][0]
    for _ in range(2):
        await edit(client, "POST", "/undo")
    await act(client, "POST", plots=[far])
    problem = (await client.get("/api/plots")).json()["problem"]
    assert "the plot is outside of what the run observed" in problem
    wrong = await client.get("/api/plots?volume=dbh")
    assert (wrong.status_code, "'dbh'" in wrong.text) == (422, True)


@pytest.mark.slow
async def test_the_layer_of_an_export_is_imported_again(both, tmp_path) -> None:
    client, dashboard = both
    await look(dashboard)
    rectangle = {"kind": "rectangle", "x": 2.0, "y": 1.0, "length": 4.0, "width": 3.0, "turn_deg": 30.0}
    await act(client, "POST", plots=[CIRCLE, {"name": "b", "shape": rectangle}])
    file = (await client.get("/api/export/gpkg")).content
    (tmp_path / "out.gpkg").write_bytes(file)
    layer = geopandas.read_file(tmp_path / "out.gpkg", layer="plots")
    assert layer["plot"].tolist() == ["1", "b"]
    assert layer.geometry.area.tolist() == pytest.approx([math.pi * 5.641896**2, 12.0], abs=0.01)

    content = {"layer.gpkg": base64.b64encode(file).decode()}
    added = await act(client, "POST", "/import", files=content)
    assert added.status_code == 201, added.text
    names = [plot["name"] for plot in await plots(client)]
    assert names == ["1", "b", "1 (2)", "b (2)"]
    (ring,) = (await plots(client))[3]["shape"]["polygons"][0]
    assert shapely.Polygon(ring).area == pytest.approx(12.0, abs=0.01)


async def test_a_long_name_of_a_file_that_is_taken_gets_a_number(both) -> None:
    client, _ = both
    name = "x" * 53
    await act(client, "POST", plots=[{**CIRCLE, "name": name}])
    square = [[[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]]
    feature = {
        "type": "Feature",
        "properties": {"name": f"{name} north"},
        "geometry": {"type": "Polygon", "coordinates": square},
    }
    layer = json.dumps({"type": "FeatureCollection", "coordinateFrame": {}, "features": [feature]})
    files = {"layer.geojson": base64.b64encode(layer.encode()).decode()}
    added = await act(client, "POST", "/import", files=files)
    assert added.status_code == 201, added.text
    assert [plot["name"] for plot in await plots(client)] == [name, f"{name} (2)"]


async def test_a_file_that_is_no_plots_is_refused_in_one_sentence(both) -> None:
    client, _ = both
    damaged = base64.b64encode(b"no such format").decode()
    for files, words in (
        ({"a.gpkg": damaged}, "cannot read the plots"),
        ({"a.txt": damaged}, "there is no file of plots"),
        ({"../a.gpkg": damaged}, "the request does not fit"),
        ({"a.gpkg": "%%%"}, "not transferred"),
    ):
        refused = await act(client, "POST", "/import", files=files)
        assert (refused.status_code, words in refused.text) == (422, True), refused.text
    assert await plots(client) == []


async def test_the_command_line_uses_the_plots_of_the_page(tmp_path, capsys, monkeypatch) -> None:
    from app.cli import main
    from app.common.settings import Settings
    from tests.app.batch.finished_runs import grid_run
    from tests.app.server_for_tests import BEARER, running

    folder = grid_run(tmp_path / "run")
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "data"))
    assert await asyncio.to_thread(main, ["stand", str(folder)]) == 0
    assert "whole observed area" in capsys.readouterr().out
    async with running(Settings(folder=tmp_path / "data")) as (client, dashboard):
        client.headers.update(BEARER)
        await show(dashboard)
        run = folder / "run.json"
        run.write_text(run.read_text().replace('"sha256": "00"', f'"sha256": "{dashboard.digest}"'))
        await act(client, "POST", plots=[{**CIRCLE, "shape": {**CIRCLE["shape"], "x": 10.0, "y": 10.0}}])
        number = (await client.get("/api/annotations")).json()["run"]
        names = {"stand": "Hohe Warte", "client": "the town", "author": "Ann"}
        body = {"run": number, "browser": "a" * 16, "who": "Ann", "names": names}
        assert (await client.put("/api/heading", json=body)).status_code == 200
    assert await asyncio.to_thread(main, ["stand", str(folder)]) == 0
    told = capsys.readouterr()
    assert "1 plot: 24 trees from 7 cm on 100 m2" in told.out
    assert "plots: 1 plot of the page" in told.err
    assert await asyncio.to_thread(main, ["stand", str(folder), "--plots", "none"]) == 0
    assert "whole observed area" in capsys.readouterr().out
    report = tmp_path / "report.html"
    words = ["report", str(folder), "--out", str(report), "--author", "Bo"]
    assert await asyncio.to_thread(main, words) == 0
    assert "heading of the page: Hohe Warte, the town\n" in capsys.readouterr().err
    assert re.findall(r">(Hohe Warte|the town|Ann|Bo)<", report.read_text()) == [
        "Hohe Warte",
        "the town",
        "Bo",
    ]
