"""Coordinates of the country for a mapped run."""

from __future__ import annotations

import csv
import json
import re
from types import SimpleNamespace

import geopandas
import numpy as np
import pyproj
import pytest
import shapely

from app.batch.export import LOCAL_WKT
from app.batch.map_frame import read_map_frame
from app.batch.run_folder import read_run
from app.extensions.stand.georeference import check_area, projected
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.readers.ros import RosSource
from tests.app.batch.finished_runs import grid_run, write_run
from tests.app.cli.test_commands import stemmap

TRUE = Pose2(500000.0, 5300000.0, 0.5)  # UTM zone 32


@pytest.fixture
def run(tmp_path):
    """A finished run in local coordinates."""
    return grid_run(tmp_path / "run")


def control(file, run, numbers, columns=("tree", "easting", "northing"), off=0.0, z=None):
    """A table of control points at trees of the run."""
    finished = read_run(run)
    rows = []
    for number in numbers:
        east, north = TRUE.apply(finished.trees.position[[number - 1]])[0] + off
        if columns[1] == "lon":
            east, north = pyproj.Transformer.from_crs(25832, 4326, always_xy=True).transform(east, north)
        rows.append([number, f"{east:.9f}", f"{north:.9f}", *([] if z is None else [z])])
    with file.open("w", newline="") as text:
        csv.writer(text).writerows([[*columns, *([] if z is None else ["elevation_m"])], *rows])
    return file


@pytest.mark.parametrize("columns", [("tree", "easting", "northing"), ("tree", "lon", "lat")])
def test_control_points_at_trees_place_the_map(run, tmp_path, capsys, columns):
    file = control(tmp_path / "points.csv", run, (1, 10, 91, 100), columns)
    result = stemmap(capsys, "georeference", run, "--control", file, "--crs", "EPSG:25832")
    assert result.code == 0, result.err
    assert "EPSG:25832: origin at 500000.000, 5300000.000 m" in result.out
    assert result.out.count("residual") == 4
    frame = read_map_frame(run)
    point = np.array([[3.0, 4.0]])
    assert np.abs(frame.to_crs(point) - TRUE.apply(point)).max() < 1e-3
    assert np.abs(frame.to_map(frame.to_crs(point)) - point).max() < 1e-6
    again = stemmap(capsys, "georeference", run)
    assert again.out == result.out


def test_heights_of_control_points_give_the_height_of_the_map(run, tmp_path, capsys):
    file = tmp_path / "points.csv"
    lines = ["x_m;y_m;easting;northing;elevation_m", "0,25;5;500000,25;5300005;300,025"]
    file.write_text("\n".join([*lines, "10,25;5;500010,25;5300005;301,025"]))
    assert stemmap(capsys, "georeference", run, "--control", file, "--crs", "25832").code == 0
    assert read_map_frame(run).z == pytest.approx(300.0, abs=0.03)


def test_plots_of_the_country_are_moved_into_the_map(run, tmp_path, capsys):
    stemmap(capsys, "georeference", run, "--by-hand", "500000,5300000,28.64789", "--crs", "EPSG:25832")
    local = shapely.box(0, 0, 10, 10)
    shape = shapely.transform(local, lambda points: TRUE.apply(points))
    for crs, name in ((25832, "utm.gpkg"), (4326, "wgs84.geojson")):
        file = tmp_path / name
        geopandas.GeoDataFrame({"name": ["p"]}, geometry=[shape], crs=25832).to_crs(crs).to_file(file)
        out = tmp_path / name.replace(".", "_")
        assert stemmap(capsys, "stand", run, "--plots", file, "--out", out).code == 0
        with (out / "stand.csv").open(newline="") as text:
            row = next(csv.DictReader(text))
        assert row["trees"] == "25"
        assert float(row["area_m2"]) == pytest.approx(100.0, abs=0.1)
    stemmap(capsys, "stand", run, "--circle", "500000,5300000,5").refused(
        1, "EPSG:25832", "x 499991 to 500017 m"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header"),
        ("tree,easting\n1,2\n", "it has tree, easting"),
        ("tree,easting,northing\n", "no control points"),
        ("tree,easting,northing\n1,a,2\n", "line 2: easting = 'a'"),
        ("tree,easting,northing\n999,500000,5300000\n", "no tree 999"),
        ("tree,easting,northing\n1,500000,5300000\n2,500009,5300000\n", "contradict|times"),
        ("tree,easting,northing\n1,5300000,500000\n2,5300002,500000\n", "no place|longitude"),
        ("tree,easting,northing\n1,nan,5300000\n", "not a number"),
        (f"name,tree,easting,northing\n{'n' * 61},1,500000,5300000\n", "more than 60 characters"),
    ],
)
def test_tables_that_cannot_be_used_are_refused(run, tmp_path, capsys, text, message):
    file = tmp_path / "points.csv"
    file.write_text(text)
    result = stemmap(capsys, "georeference", run, "--control", file, "--crs", "EPSG:25832")
    result.refused(1)
    assert any(word in result.err for word in message.split("|")), result.err
    assert not (run / "georeference.json").exists()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--by-hand", "500000,5300000,0"], 2, "--crs is missing"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:1"], 1, "not a coordinate reference system"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:4326"], 1, "degrees"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:4807"], 1, "the unit grad"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:4978"], 1, "is geocentric"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:5773"], 1, "has only heights"),
        (["--by-hand", "500000,5300000,0", "--crs", LOCAL_WKT], 1, "of the kind Engineering CRS"),
        (["--by-hand", "500000,5300000,0", "--crs", "EPSG:2263"], 1, "foot"),
        (["--by-hand", "50,5,0", "--crs", "EPSG:25832"], 1, "do not fit"),
        (["--gnss", "--crs", "EPSG:25832"], 1, "no GNSS fixes"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(run, capsys, words, code, message):
    result = stemmap(capsys, "georeference", run, *words)
    result.refused(code, message)


def test_a_map_that_is_already_in_the_country_gets_its_system_in_one_step(tmp_path, capsys):
    run = write_run(
        tmp_path / "run", np.array([[470628.0, 3650000.0], [470640.0, 3650010.0]]), np.full(2, 0.2)
    )
    zeros = stemmap(capsys, "georeference", run, "--by-hand", "0,0,0", "--crs", "EPSG:26912")
    assert zeros.code == 0, zeros.err
    again = stemmap(capsys, "georeference", run, "--in-file", "--crs", "EPSG:26912")
    assert again.out == zeros.out
    frame = read_map_frame(run)
    assert (frame.crs, frame.pose, frame.z) == ("EPSG:26912", Pose2(0.0, 0.0, 0.0), 0.0)
    stemmap(capsys, "georeference", run, "--in-file").refused(2, "--crs is missing")


def test_coordinates_of_a_local_map_are_in_no_system(run, capsys):
    stemmap(capsys, "georeference", run, "--in-file", "--crs", "EPSG:26912").refused(1, "do not fit")


def test_the_confirmation_shows_where_the_map_is(run, capsys):
    words = ("georeference", run, "--by-hand", "391000,5819000,0", "--crs")
    for code, place in ((25833, "33N: 13.39° E, 52.51° N"), (25830, "30N: 4.61° W")):
        told = stemmap(capsys, *words, f"EPSG:{code}").out
        assert f"EPSG:{code}, " in told
        assert place in told
        assert "area of use: Europe between" in told
        assert ", by hand" in told


def test_an_unknown_method_is_refused(run, capsys):
    stemmap(capsys, "georeference", run, "--by-hand", "391000,5819000,0", "--crs", "EPSG:25833")
    file = run / "georeference.json"
    for changes in ({"method": "guess"}, {"method": "gnss"}, {"method": "control", "numbers": {"points": 2}}):
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))
        stemmap(capsys, "georeference", run).refused(1, "georeference.json is damaged")


def test_removing_makes_the_map_local(run, capsys):
    stemmap(capsys, "georeference", run, "--by-hand", "500000,5300000,0", "--crs", "EPSG:25832")
    assert "the map is local" in stemmap(capsys, "georeference", run, "--remove").out
    assert stemmap(capsys, "georeference", run).out.startswith("local coordinates")
    (run / "georeference.json").write_text('{"crs": 3}')
    stemmap(capsys, "georeference", run).refused(1, "georeference.json is damaged")


def test_an_unknown_reference_system_is_named(run, tmp_path, capsys):
    stemmap(capsys, "georeference", run, "--by-hand", "500000,5300000,0", "--crs", "EPSG:25832")
    file = run / "georeference.json"
    file.write_text(file.read_text().replace("EPSG:25832", "EPSG:1"))
    for suffix in ("gpkg", "geojson", "laz"):
        result = stemmap(capsys, "export", run, "--to", tmp_path / f"trees.{suffix}")
        result.refused(1, "does not know the reference system of georeference.json")


def test_a_projected_system_with_heights_is_projected():
    assert projected("EPSG:5555") == "EPSG:5555"


def test_axes_are_east_and_north_as_in_pyproj_for_every_kind_of_system():
    for code, lon, lat in ((25832, 9.5, 48.0), (31467, 9.5, 48.0), (2193, 174.0, -41.0), (3067, 27.0, 62.0)):
        crs = projected(f"EPSG:{code}")
        point = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(lon, lat)
        check_area(crs, np.array([point]))
        with pytest.raises(StemmapError, match="do not fit"):
            check_area(crs, np.array([point[::-1]]))


def test_fixes_of_the_recording_place_the_map_in_spite_of_outliers(run, capsys, monkeypatch):
    random = np.random.default_rng(3)
    path = read_run(run).path
    start_ns = 1_700_000_000_000_000_000
    places = TRUE.apply(np.stack([path.x, path.y], axis=1)) + random.normal(0, 0.3, (len(path.x), 2))
    places[::10] += 40.0  # reflections
    lon, lat = pyproj.Transformer.from_crs(25832, 4326, always_xy=True).transform(*places.T)
    fixes = [
        SimpleNamespace(stamp_ns=start_ns + int(t), latitude=a, longitude=o, sigma=0.5)
        for t, a, o in zip(path.stamp_ns, lat, lon, strict=True)
    ]
    source = object.__new__(RosSource)
    monkeypatch.setattr(RosSource, "readings", lambda _source, _role: fixes)
    monkeypatch.setattr(RosSource, "close", lambda _source: None)
    monkeypatch.setattr("app.sources.opening.open_source", lambda _uri: source)
    saved = SimpleNamespace(start_ns=start_ns)
    monkeypatch.setattr("app.batch.saved_run.read_saved_run", lambda _folder: saved)
    result = stemmap(capsys, "georeference", run, "--gnss", "--crs", "EPSG:25832")
    assert result.code == 0, result.err
    used = re.search(r"by (\d+) of 41 GNSS fixes", result.out)
    assert used is not None
    assert 30 <= int(used[1]) <= 36  # five are reflections
    frame = read_map_frame(run)
    centre = np.array([[10.0, 10.0]])
    assert np.abs(frame.to_crs(centre) - TRUE.apply(centre)).max() < 0.2
    assert frame.pose.yaw == pytest.approx(TRUE.yaw, abs=0.03)
    assert 0.0 < frame.sigma < 1.0


def test_a_system_whose_metres_are_not_those_of_the_ground_is_refused():
    with pytest.raises(StemmapError, match=r"a metre on the ground is 1\.37 m in WGS 84 / Pseudo-Mercator"):
        check_area("EPSG:3857", np.array([[500_000.0, 5_300_000.0]]))
    check_area("EPSG:25832", np.array([[300_000.0, 5_300_000.0]]))  # beyond the border of its zone
