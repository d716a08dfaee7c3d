"""Exported files, opened by readers that did not write them."""

from __future__ import annotations

import csv
import json
import math
import os
import sqlite3
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import fiona
import numpy as np
import openpyxl
import pyproj
import pytest
import rasterio

from app.batch.map_frame import read_map_frame
from app.batch.run_folder import read_run
from app.extensions.stand.gis_files import LAYER_FIELDS
from pipeline.geometry.poses import Pose2
from tests.app.batch.finished_runs import grid_run, write_run
from tests.app.cli.test_commands import stemmap

TRUE = Pose2(500000.0, 5300000.0, math.radians(30.0))
PLOTS = ("--circle", "10,10,5", "--rectangle", "5,5,8,8")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A local run and one in UTM zone 32, with two trees without a diameter."""
    from app.cli import main

    folder = tmp_path_factory.mktemp("runs")
    axis = np.arange(1.0, 20.0, 2.0)
    position = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    dbh = np.linspace(0.1, 0.5, 100)
    dbh[[3, 50]] = math.nan
    made = {}
    for name in ("local", "utm"):
        made[name] = write_run(folder / name, position, dbh)
    words = ["--by-hand", "500000,5300000,30,400", "--crs", "EPSG:25832"]
    assert main(["georeference", str(made["utm"]), *words]) == 0
    return made


def exported(capsys, run, file):
    """Export a run with plots; the file."""
    result = stemmap(capsys, "export", run, "--to", file, *PLOTS)
    assert result.code == 0, result.err
    assert "100 trees in" in result.out
    return file


def expected_places(runs, name):
    """Positions of the trees in the files."""
    position = read_run(runs[name]).trees.position
    return position if name == "local" else TRUE.apply(position)


@pytest.mark.parametrize("name", ["local", "utm"])
@pytest.mark.parametrize("suffix", ["gpkg", "shp"])
def test_layers_have_their_fields_places_and_reference_system(runs, tmp_path, capsys, name, suffix):
    file = exported(capsys, runs[name], tmp_path / f"trees.{suffix}")
    short = {field.name: field.short for field in LAYER_FIELDS["plots"]}
    layers = ("trees", "path", "plots", "contours")
    if suffix == "gpkg":
        assert fiona.listlayers(file) == [*layers, "layer_styles"] or set(fiona.listlayers(file)) >= set(
            layers
        )
    for layer in layers:
        part = file if suffix == "gpkg" or layer == "trees" else tmp_path / f"trees_{layer}.shp"
        with fiona.open(part, layer=layer if suffix == "gpkg" else None) as table:
            rows = list(table)
            if name == "utm":
                assert pyproj.CRS.from_wkt(table.crs_wkt).to_epsg() == 25832
            else:
                assert not table.crs_wkt or "local frame of the map" in table.crs_wkt
            names = set(table.schema["properties"])
        assert names == {f.name if suffix == "gpkg" else f.short for f in LAYER_FIELDS[layer]}
        assert all(len(n) <= 10 for n in names) or suffix == "gpkg"
        if layer == "trees":
            places = np.array([row.geometry.coordinates[:2] for row in rows])
            np.testing.assert_allclose(places, expected_places(runs, name), atol=2e-3)
            dbh = [row.properties["dbh_cm"] for row in rows]
            assert [k for k, value in enumerate(dbh) if value is None] == [3, 50]
            assert dbh[-1] == pytest.approx(50.0)
            z = rows[0].properties["z_m"]
            assert z == pytest.approx((400.0 if name == "utm" else 0.0) + 0.1, abs=0.05)
        elif layer == "path":
            assert rows[0].properties["length_m"] == pytest.approx(20 * math.sqrt(2), abs=0.01)
        elif layer == "plots":
            key = "n_ha" if suffix == "gpkg" else short["n_ha"]
            assert len(rows) == 2
            assert rows[1].properties["trees"] == 25
            assert rows[1].properties[key] == pytest.approx(25 / 64e-4)
            error = rows[1].properties["g_ha_se"]
            assert 0.0 < error < 0.1 * rows[1].properties["g_ha"]
            assert rows[1].properties[f"{short['dg_cm']}_se" if suffix == "shp" else "dg_cm_se"] > 0.0
        else:
            heights = sorted({row.properties["z_m"] for row in rows})
            low = 400.0 if name == "utm" else 0.0
            np.testing.assert_allclose(heights, low + np.array([0.5, 1.0, 1.5]), atol=1e-9)


@pytest.mark.parametrize("suffix", ["gpkg", "shp"])
def test_plots_have_the_numbers_of_trees_with_each_value(tmp_path, capsys, suffix):
    run = grid_run(tmp_path / "run")
    trees = run / "trees.csv"
    header, *rows = (line.split(",") for line in trees.read_text().splitlines())
    rows[0][header.index("dbh_cm")] = rows[0][header.index("sigma_dbh_cm")] = ""
    for row in rows[:2]:
        row[header.index("height_m")] = "20.00"
    trees.write_text("\n".join(",".join(row) for row in (header, *rows)) + "\n")
    names = ["trees", "trees_with_dbh", "trees_with_height", "trees_with_volume"]
    if suffix == "shp":
        names = ["trees", "trees_dbh", "trees_h", "trees_v"]
    for words, volumes in (([], None), (["--volume", "0.001 * dbh_cm * height_m"], 1)):
        file = tmp_path / f"{len(words)}.{suffix}"
        told = stemmap(
            capsys, "export", run, "--to", file, "--circle", "10,10,9", "--circle", "2,2,2", *words
        )
        assert told.code == 0, told.err
        part, layer = (file, "plots") if suffix == "gpkg" else (tmp_path / f"{len(words)}_plots.shp", None)
        with fiona.open(part, layer=layer) as table:
            plot = list(table)[1].properties
        assert [plot[name] for name in names] == [4, 3, 2, volumes]


def test_a_table_of_measured_trees_in_the_folder_is_no_file_of_the_run(tmp_path, capsys):
    run = grid_run(tmp_path / "run")
    (run / "measured.csv").write_text("x_m,y_m,dbh_cm\n9.0,1.0,23.4\n")  # for `evaluate --truth`
    assert stemmap(capsys, "export", run, "--to", tmp_path / "trees.geojson").code == 0
    assert stemmap(capsys, "report", run, "--out", tmp_path / "report.html").code == 0


def test_what_people_measured_is_in_every_format(tmp_path, capsys):
    run = grid_run(tmp_path / "run")
    stemmap(capsys, "georeference", run, "--by-hand", "500000,5300000,0", "--crs", "EPSG:25832")
    (run / "by_people.csv").write_text(
        "of_tree,x_m,y_m,dbh_tape_cm\n5,9.000,1.000,23.4\n,2.000,2.000,31.0\n,4,2,\n"
    )
    files = {suffix: tmp_path / f"trees.{suffix}" for suffix in ("gpkg", "shp", "xlsx", "dxf", "geojson")}
    for file in files.values():
        assert stemmap(capsys, "export", run, "--to", file).code == 0
    for part, layer, *names in (
        (
            files["gpkg"],
            "added",
            "name",
            "g_m2",
            "dbh_tape_cm",
            "dbh_counted_cm",
            "sigma_dbh_counted_cm",
            "dbh_source",
        ),
        (
            tmp_path / "trees_added.shp",
            None,
            "name",
            "g_m2",
            "dbh_tape",
            "dbh_count",
            "sdbh_count",
            "dbh_source",
        ),
    ):
        with fiona.open(part, layer=layer) as table:
            rows = [[row.geometry.coordinates[0], *(row.properties[name] for name in names)] for row in table]
        assert rows[0] == [pytest.approx(500002.0), "A1", 0.0755, 31.0, 31.0, 0.3, "tape"]
        assert rows[1][:6] == [pytest.approx(500004.0), "A2", None, None, None, None]
        assert not rows[1][6]
    with fiona.open(files["gpkg"], layer="trees") as table:
        tape = {row.properties["tree"]: row.properties["dbh_tape_cm"] for row in table}
    assert {number: dbh for number, dbh in tape.items() if dbh is not None} == {5: 23.4}
    book = openpyxl.load_workbook(files["xlsx"])
    assert list(book["added"].values)[:2] == [
        (
            "name",
            "east_m",
            "north_m",
            "g_m2",
            "dbh_tape_cm",
            "dbh_counted_cm",
            "sigma_dbh_counted_cm",
            "dbh_source",
        ),
        ("A1", 500002, 5300002, 0.0755, 31, 31, 0.3, "tape"),
    ]
    header, *rows = book["trees"].values
    counted = [dict(zip(header, row, strict=True)) for row in rows]
    assert {(of["dbh_counted_cm"], of["dbh_source"]) for of in counted if of["tree"] == 5} == {(23.4, "tape")}
    assert {of["dbh_source"] for of in counted if of["tree"] != 5} == {"map"}
    sigmas = [
        {of["sigma_dbh_counted_cm"] for of in counted if (of["tree"] == 5) == taped}
        for taped in (True, False)
    ]
    assert sigmas == [{0.3}, {of["sigma_dbh_cm"] for of in counted}]
    drawing = files["dxf"].read_text()
    assert all(text in drawing for text in ("ADDED", "\nA1 31\n", "\nA2\n"))
    features = json.loads(files["geojson"].read_text())["features"]
    assert len(features) == 102
    assert [feature["properties"]["name"] for feature in features[-2:]] == ["A1", "A2"]
    figures = stemmap(capsys, "stand", run).out
    assert "102 trees from 7 cm" in figures
    assert "by people: 2 diameters by tape, 2 trees added" in figures


def test_qgis_finds_a_style_for_each_layer_and_the_file_is_sound(runs, tmp_path, capsys):
    file = exported(capsys, runs["utm"], tmp_path / "trees.gpkg")
    database = sqlite3.connect(file)
    try:
        styles = dict(database.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute(
            "SELECT count(*) FROM gpkg_contents WHERE data_type='features'"
        ).fetchone() == (4,)
    finally:
        database.close()
    assert set(styles) == {"trees", "path", "plots", "contours"}
    assert "MapUnit" in styles["trees"]
    for style in styles.values():
        assert ElementTree.fromstring(style.partition(">")[2]).tag == "qgis"  # noqa: S314 - our own


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "geojson", "dxf", "xlsx", "tif"])
def test_the_same_run_gives_the_same_bytes(runs, tmp_path, capsys, suffix):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        exported(capsys, runs["utm"], tmp_path / folder / f"x.{suffix}")
    first = {file.name: file.read_bytes() for file in (tmp_path / "a").iterdir()}
    assert first == {file.name: file.read_bytes() for file in (tmp_path / "b").iterdir()}
    assert f"x.{suffix}" in first


@pytest.mark.slow
@pytest.mark.parametrize("hash_seed", ["0", "4"])  # two orders of the set of types of ezdxf
def test_a_drawing_lists_its_types_in_one_order(runs, tmp_path, hash_seed):
    program = "import sys; from app.cli import main; sys.exit(main(sys.argv[1:]))"
    file = tmp_path / "trees.dxf"
    words = [sys.executable, "-c", program, "export", runs["local"], "--to", file, *PLOTS]
    subprocess.run(words, env={**os.environ, "PYTHONHASHSEED": hash_seed}, check=True, capture_output=True)
    text = file.read_text(encoding="utf-8")
    assert 0 < text.index("ACDBPLACEHOLDER") < text.index("AcDbLayout")


def test_geojson_is_wgs84_with_a_georeference_and_else_local(runs, tmp_path, capsys):
    with fiona.open(exported(capsys, runs["utm"], tmp_path / "utm.geojson")) as table:
        places = np.array([row.geometry.coordinates[:2] for row in table])
    to_utm = pyproj.Transformer.from_crs(4326, 25832, always_xy=True)
    back = np.stack(to_utm.transform(*places.T), axis=1)
    np.testing.assert_allclose(back, expected_places(runs, "utm"), atol=5e-3)
    local = json.loads(exported(capsys, runs["local"], tmp_path / "local.geojson").read_text())
    assert local["coordinateFrame"]["type"] == "local"
    assert len(local["features"]) == 100


@pytest.mark.parametrize("name", ["local", "utm"])
def test_the_drawing_has_circles_of_the_diameters(runs, tmp_path, capsys, name):
    file = exported(capsys, runs[name], tmp_path / "trees.dxf")
    with fiona.open(file) as table:
        rows = list(table)
    layers = {
        layer: [r for r in rows if r.properties["Layer"] == layer] for layer in ("TREES", "PATH", "CONTOURS")
    }
    points = [r for r in layers["TREES"] if r.geometry.type == "Point"]
    circles = [r for r in layers["TREES"] if r.geometry.type != "Point"]
    assert (len(points), len(circles), len(layers["PATH"])) == (100, 98, 1)
    places = np.array([r.geometry.coordinates[:2] for r in points])
    np.testing.assert_allclose(places, expected_places(runs, name), atol=1e-6)
    ring = np.array(circles[-1].geometry.coordinates)[..., :2].reshape(-1, 2)
    assert np.ptp(ring[:, 0]) == pytest.approx(0.5, abs=0.01)
    assert len({r.properties["Layer"] for r in rows}) == 5
    assert f"{'EPSG:25832' if name == 'utm' else 'local'}" in file.read_text(encoding="utf-8")


def test_the_workbook_names_fields_and_units_and_leaves_the_unknown_empty(runs, tmp_path, capsys):
    file = exported(capsys, runs["utm"], tmp_path / "trees.xlsx")
    assert zipfile.ZipFile(file).testzip() is None
    book = openpyxl.load_workbook(file)
    assert book.sheetnames == ["trees", "plots", "fields", "about"]
    header, *rows = book["trees"].values
    column = {name: k for k, name in enumerate(header)}
    assert len(rows) == 100
    assert rows[3][column["dbh_cm"]] is None
    assert rows[-1][column["dbh_cm"]] == pytest.approx(50.0)
    east = [row[column["east_m"]] for row in rows]
    np.testing.assert_allclose(east, expected_places(runs, "utm")[:, 0], atol=2e-3)
    fields = {row[0]: row[1] for row in book["fields"].values}
    assert set(header) <= set(fields)
    assert fields["dbh_cm"] == "cm"
    assert ("coordinates", "EPSG:25832") in list(book["about"].values)
    rows = [row[:4] for row in list(book["fields"].values)[1:]]
    for layer, layer_fields in LAYER_FIELDS.items():
        told = {row[0] for row in rows if row[3] == layer}
        assert {field.name for field in layer_fields} <= told, layer
    assert "added" not in book.sheetnames
    assert set(next(book["plots"].values)) == {row[0] for row in rows if row[3] == "plots"}
    assert all(row[2] for row in rows)
    assert ("area_m2", "m2", "area of the plot", "plots") in rows


@pytest.mark.parametrize("name", ["local", "utm"])
def test_the_terrain_is_a_raster_in_its_place(runs, tmp_path, capsys, name):
    file = exported(capsys, runs[name], tmp_path / "terrain.tif")
    x = np.array([5.25, 12.25, 17.75])
    points = np.stack([x, np.full(3, 9.25)], axis=1)
    places = points if name == "local" else TRUE.apply(points)
    with rasterio.open(file) as raster:
        assert (raster.crs.to_epsg() if name == "utm" else raster.crs and raster.crs.to_epsg()) == (
            25832 if name == "utm" else None
        )
        assert raster.res == (0.5, 0.5)
        assert math.isnan(raster.nodata)
        values = np.array([v[0] for v in raster.sample(places.tolist())])
        band = raster.read(1)
    base = 400.0 if name == "utm" else 0.0
    np.testing.assert_allclose(values, base + 0.1 * x, atol=0.001 if name == "local" else 0.05)
    assert np.isfinite(band).sum() == pytest.approx(1600, rel=0.03)


@pytest.mark.parametrize(
    ("to", "code", "message"),
    [
        ("trees.kml", 1, ".gpkg, .shp"),
        ("missing/trees.gpkg", 1, "cannot read or write"),
    ],
)
def test_what_cannot_be_written_is_refused(runs, capsys, tmp_path, monkeypatch, to, code, message):
    monkeypatch.chdir(tmp_path)
    stemmap(capsys, "export", runs["local"], "--to", to).refused(code, message)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("suffix", "package"), [("xlsx", "xlsxwriter")])
def test_a_missing_package_is_named_with_its_extra(runs, capsys, tmp_path, monkeypatch, suffix, package):
    monkeypatch.setitem(sys.modules, package, None)
    result = stemmap(capsys, "export", runs["local"], "--to", tmp_path / f"x.{suffix}")
    result.refused(1, package, "stemmap[gis]")


def test_a_cloud_with_a_reference_system_keeps_it(tmp_path, capsys):
    run = grid_run(tmp_path / "cloud", cloud_crs="EPSG:25832")
    result = stemmap(capsys, "export", run, "--to", tmp_path / "x.gpkg")
    assert "100 trees in EPSG:25832" in result.out
    with fiona.open(tmp_path / "x.gpkg", layer="trees") as table:
        assert pyproj.CRS.from_wkt(table.crs_wkt).to_epsg() == 25832
        assert len(table) == 100
    assert Path(run / "trees.csv").is_file()
    with (run / "trees.csv").open(newline="") as text:
        assert len(list(csv.reader(text))) == 101


@pytest.mark.parametrize("crs", ["no system"])
def test_a_cloud_whose_reference_system_is_unknown_is_local(tmp_path, capsys, crs):
    run = grid_run(tmp_path / "cloud", cloud_crs=crs)
    assert read_map_frame(run).crs == ""
    for suffix in ("gpkg", "geojson"):
        result = stemmap(capsys, "export", run, "--to", tmp_path / f"x.{suffix}")
        assert result.code == 0, result.err
        assert "100 trees in local coordinates" in result.out
