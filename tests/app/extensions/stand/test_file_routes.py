"""Files with plots and terrain through the API."""

from __future__ import annotations

import csv
import io
import zipfile
from pathlib import Path

import geopandas
import numpy as np
import pytest

from tests.app.extensions.stand.test_plot_routes import CIRCLE, act
from tests.app.server_for_tests import Running
from tests.app.web.test_routes import exported_twice, show


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("suffix", ["gpkg", "dxf", "xlsx"])
async def test_the_export_gives_the_bytes_of_the_command(both: Running, tmp_path: Path, suffix: str) -> None:
    reply, file = await exported_twice(both, tmp_path, suffix)
    assert reply.content == file.read_bytes()
    assert reply.headers["content-disposition"] == f'attachment; filename="trees.{suffix}"'


async def test_a_shapefile_is_an_archive_of_the_files_of_the_command(both: Running, tmp_path: Path) -> None:
    reply, file = await exported_twice(both, tmp_path, "shp")
    archive = zipfile.ZipFile(io.BytesIO(reply.content))
    there = {name: archive.read(name) for name in archive.namelist()}
    assert there == {part.name: part.read_bytes() for part in file.parent.iterdir()}


async def test_an_export_that_the_map_lacks_is_refused(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    terrain = await client.get("/api/export/tif")
    assert terrain.status_code == 422
    assert "no terrain" in terrain.text


async def test_what_people_measured_is_in_the_files_of_the_page(both: Running, tmp_path: Path) -> None:
    client, dashboard = both
    await show(dashboard)
    assert "dbh_tape_cm" not in (await client.get("/api/trees.csv")).text
    assert dashboard.shown is not None
    trees = dashboard.shown.frame.trees
    x, y = trees.position[trees.confirmed][0].tolist()
    run = (await client.get("/api/annotations")).json()["run"]
    for place in ((x, y, 23.4), (x + 50.0, y, None)):
        fields = dict(zip(("x", "y", "dbh_cm"), place, strict=True))
        body = {"run": run, "browser": "a" * 16, "who": "Ann", "kind": "tree", **fields}
        assert (await client.post("/api/annotations", json=body)).status_code == 201
    (first, *others) = csv.DictReader((await client.get("/api/trees.csv")).text.splitlines())
    assert (first["dbh_tape_cm"], first["review"]) == ("23.4", "confirmed")
    assert {row["dbh_tape_cm"] for row in others} <= {""}
    counted_columns = ("dbh_counted_cm", "sigma_dbh_counted_cm", "dbh_source")
    assert [first[name] for name in counted_columns] == ["23.4", "0.3", "tape"]
    assert all(row["sigma_dbh_counted_cm"] == row["sigma_dbh_cm"] for row in others)
    counted = [(row["dbh_counted_cm"], row["dbh_source"]) for row in others]
    assert counted == [(row["dbh_cm"], "map" if row["dbh_cm"] else "") for row in others]
    file = tmp_path / "trees.gpkg"
    file.write_bytes((await client.get("/api/export/gpkg")).content)
    layer = geopandas.read_file(file, layer="trees")
    assert layer["dbh_tape_cm"][0] == 23.4
    added = geopandas.read_file(file, layer="added")
    assert added.geometry.x.tolist() == pytest.approx([x + 50.0], abs=1e-3)


async def test_plots_are_a_layer_for_other_programs(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    assert (await client.get("/api/layers/plots.geojson")).json()["features"] == []
    await act(client, "POST", plots=[{**CIRCLE, "name": "north"}])
    (plot,) = (await client.get("/api/layers/plots.geojson")).json()["features"]
    assert plot["properties"] == {"name": "north"}
    ring = np.array(plot["geometry"]["coordinates"][0])
    shape = CIRCLE["shape"]
    gaps = np.hypot(ring[:, 0] - shape["x"], ring[:, 1] - shape["y"])
    np.testing.assert_allclose(gaps, shape["radius"], rtol=1e-3)
