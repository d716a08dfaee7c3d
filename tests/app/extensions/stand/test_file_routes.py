"""Files with plots and terrain through the API."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.app.extensions.stand.test_plot_routes import CIRCLE, act
from tests.app.server_for_tests import Running
from tests.app.web.test_routes import exported_twice, show


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
