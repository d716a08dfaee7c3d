"""Stand figures on the command line."""

from __future__ import annotations

import csv
import json
import math
import warnings

import geopandas
import numpy as np
import pyproj
import pytest
import shapely

from tests.app.batch.finished_runs import grid_run, write_run
from tests.app.cli.test_commands import stemmap


@pytest.fixture
def run(tmp_path):
    """A finished run with 2,500 stems per hectare."""
    return grid_run(tmp_path / "run")


def table(file):
    """The rows of a CSV file by the first column."""
    with file.open(newline="") as text:
        return {row["plot"]: row for row in csv.DictReader(text)}


def test_the_whole_observed_area_is_a_plot_by_default(run, tmp_path, capsys):
    result = stemmap(capsys, "stand", run, "--out", tmp_path / "out")
    assert (result.code, result.err) == (0, "")
    assert "100 trees from 7 cm on 400 m2 observed, coordinates local" in result.out
    row = table(tmp_path / "out" / "stand.csv")["all"]
    assert float(row["n_ha"]) == pytest.approx(2500.0)
    assert float(row["g_ha"]) == pytest.approx(2500 * math.pi / 4 * 0.04)
    assert float(row["seen_m2"]) == float(row["area_m2"]) == 400.0
    assert float(row["nearest_neighbour_m"]) == pytest.approx(2.0)
    record = json.loads((tmp_path / "out" / "stand.json").read_text())
    assert record["plots"]["all"]["n_ha"][0] == pytest.approx(2500.0)
    assert record["detection_sigma_m"] is None
    with (tmp_path / "out" / "classes.csv").open(newline="") as text:
        assert sum(int(c["trees"]) for c in csv.DictReader(text)) == 100


def test_plots_have_rows_of_their_own_and_a_mean(run, tmp_path, capsys):
    words = ["--circle", "10,10,5.641896", "--rectangle", "10,10,9,9", "--along", "9", "--radius", "4"]
    result = stemmap(capsys, "stand", run, *words, "--out", tmp_path / "out")
    assert result.err == "warning: plots overlap: what they share counts in each of them\n"
    rows = table(tmp_path / "out" / "stand.csv")
    assert list(rows) == ["1", "2", "path 1", "path 2", "path 3", "mean"]
    assert float(rows["1"]["area_m2"]) == pytest.approx(100.0, abs=0.01)
    assert int(rows["2"]["trees"]) == 16
    assert rows["2"]["trees_without_dbh"] == "0"
    assert float(rows["mean"]["n_ha_se"]) > 0.0


def written(folder, name, shapes, names=("a", "b"), crs=None, columns=None):
    """A file of plots."""
    file = folder / name
    frame = geopandas.GeoDataFrame(
        {"name": list(names)[: len(shapes)], **(columns or {})}, geometry=shapes, crs=crs
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files without a reference system
        frame.to_file(file)
    return file


@pytest.mark.parametrize("name", ["plots.gpkg", "plots.shp"])
def test_plots_of_a_file_in_the_frame_of_the_map(run, tmp_path, capsys, name):
    file = written(tmp_path, name, [shapely.box(0, 0, 10, 10), shapely.box(10, 0, 20, 20)])
    result = stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local", "--out", tmp_path / "out")
    assert result.code == 0, result.err
    rows = table(tmp_path / "out" / "stand.csv")
    assert [rows[n]["trees"] for n in ("a", "b")] == ["25", "50"]


def test_points_with_a_radius_are_circles(run, tmp_path, capsys):
    file = written(tmp_path, "p.gpkg", [shapely.Point(10, 10)], columns={"radius_m": [5.0]})
    assert (
        stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local", "--out", tmp_path / "out").code
        == 0
    )
    assert float(table(tmp_path / "out" / "stand.csv")["a"]["area_m2"]) == pytest.approx(
        25 * math.pi, abs=0.01
    )


@pytest.mark.parametrize(
    ("point", "radius", "message"),
    [
        (shapely.Point(10, 10), math.nan, "plot a: the radius 'nan' is not a number"),
        (shapely.Point(), 5.0, "plot a is not an area"),
    ],
)
def test_points_without_a_place_or_a_radius_are_refused(run, tmp_path, capsys, point, radius, message):
    file = written(tmp_path, "p.gpkg", [point], columns={"radius_m": [radius]})
    stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local").refused(1, message)


def test_a_file_of_features_that_is_not_one_json_value_is_refused(run, tmp_path, capsys):
    feature = {
        "type": "Feature",
        "properties": {},
        "geometry": shapely.geometry.mapping(shapely.box(0, 0, 9, 9)),
    }
    (file := tmp_path / "p.geojson").write_text(2 * (json.dumps(feature) + "\n"))
    stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local").refused(1, "not JSON in UTF-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--circle", "500,500,5"], "outside of what the run observed"), (["--circle", "10,10,0"], "area of 0")],
)
def test_plots_that_cannot_be_used_are_refused(run, capsys, words, message):
    stemmap(capsys, "stand", run, *words).refused(1, message)


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--dbh-min", "7"], "--dbh-min 7"), (["--circle", "nan,10,2"], "is not X,Y,R")],
)
def test_parameters_out_of_bounds_are_refused(run, capsys, words, message):
    stemmap(capsys, "stand", run, *words).refused(2, message)


def test_plots_in_a_country_s_coordinates_need_a_georeference(run, tmp_path, capsys):
    shapes = [shapely.box(500000, 5.3e6, 500010, 5300010)]
    file = written(tmp_path, "p.gpkg", shapes, crs="EPSG:25832")
    stemmap(capsys, "stand", run, "--plots", file).refused(1, "but the map is local", "stemmap georeference")
    nowhere = written(tmp_path, "n.gpkg", shapes)
    stemmap(capsys, "stand", run, "--plots", nowhere).refused(1, "no coordinate reference", "--plots-crs")


@pytest.mark.parametrize("text", ["{", "\0" * 500])
@pytest.mark.parametrize("suffix", ["gpkg", "geojson"])
def test_damaged_files_of_plots_end_with_one_line(run, tmp_path, capsys, text, suffix):
    file = tmp_path / f"plots.{suffix}"
    file.write_text(text)
    result = stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local")
    assert result.code == 1
    assert result.err.startswith("stemmap: ")
    assert "Traceback" not in result.err


def test_few_trees_and_empty_plots_are_warnings(run, capsys):
    few = stemmap(capsys, "stand", run, "--circle", "10,10,2")
    assert few.code == 3
    assert "plot 1: only 4 trees" in few.err
    empty = stemmap(capsys, "stand", run, "--circle", "10,10,0.5", "--circle", "5,5,4")
    assert empty.code == 3
    assert "plot 1: the plot has no trees" in empty.err


def test_a_plot_that_was_not_observed_is_left_out_of_the_mean_and_named(run, tmp_path, capsys):
    alone = stemmap(capsys, "stand", run, "--circle", "10,10,5")
    words = ["--circle", "10,10,5", "--circle", "500,10,5", "--out", tmp_path / "b"]
    both = stemmap(capsys, "stand", run, *words)
    assert "plot 2: no part of the plot was observed: it has no figures and counts in no mean" in both.err
    assert both.out.startswith("1 plot: ")
    rows = table(tmp_path / "b" / "stand.csv")
    assert rows["mean"]["n_ha_plain"] == rows["1"]["n_ha_plain"]
    assert rows["2"]["n_ha_plain"] == ""
    stems = next(line for line in alone.out.splitlines() if line.startswith("Stems per hectare of the whole"))
    assert stems in both.out.splitlines()
    assert next(line for line in alone.out.splitlines() if line.startswith("Mean diameter")) in both.out


def test_what_is_not_known_of_detection_is_said_and_no_error_is_0(run, tmp_path, capsys):
    many = stemmap(capsys, "stand", run, "--count-error", "0").out
    assert "Stems per hectare: 2,500 1/ha, standard error not known" in many
    assert "detection: does not decrease with distance within reach" in many
    position = np.random.default_rng(2).uniform(1, 19, (12, 2))
    few_trees = write_run(tmp_path / "few", position, np.full(12, 0.2))
    few = stemmap(capsys, "stand", few_trees, "--count-error", "0", "--out", tmp_path)
    assert "detection: not estimated from fewer than 20 trees, every tree in view counts as found" in few.out
    record = json.loads((tmp_path / "stand.json").read_text())
    assert record["detection_not_estimated"] == "few_trees"
    assert record["plots"]["all"]["n_ha"][1] is None


def test_stems_of_a_plot_in_full_view_have_the_error_of_false_and_missed_trees(run, tmp_path, capsys):
    shown = stemmap(capsys, "stand", run).out
    assert "Stems per hectare: 2,500 +- 150 1/ha" in shown
    assert "6 % of the stems for false and missed trees, less for trees that people confirmed" in shown
    lines = (run / "trees.csv").read_text().splitlines()
    (run / "trees.csv").write_text(
        "\n".join([lines[0], *(each.replace("open", "confirmed") for each in lines[1:])])
    )
    assert "Stems per hectare: 2,500 +- 25.0 1/ha" in stemmap(capsys, "stand", run).out


def test_two_plots_of_one_name_are_refused(run, tmp_path, capsys):
    file = written(tmp_path, "p.gpkg", [shapely.box(0, 0, 9, 9)] * 2, names=["x", "x"])
    stemmap(capsys, "stand", run, "--plots", file, "--plots-crs", "local").refused(
        1, "two plots are called 'x'"
    )


def test_diameters_in_another_unit_are_noticed(tmp_path, capsys):
    position = np.random.default_rng(1).uniform(1, 19, (12, 2))
    thick = write_run(tmp_path / "thick", position, np.full(12, 20.0))
    assert "in centimetres?" in stemmap(capsys, "stand", thick).err
    thin = write_run(tmp_path / "thin", position, np.full(12, 0.002))
    assert "in metres?" in stemmap(capsys, "stand", thin).err


def test_a_run_without_a_record_of_the_observed_area_has_no_figures(tmp_path, capsys):
    run = grid_run(tmp_path / "old", seen=False)
    result = stemmap(capsys, "stand", run)
    assert result.code == 1
    assert "no record of what was observed" in result.err
    assert "Map it again" in result.err


def test_each_tree_of_the_map_is_counted_or_left_out_for_a_reason(tmp_path, capsys):
    position = np.random.default_rng(2).uniform(1, 19, (30, 2))
    position[:3] += 200.0  # not observed
    dbh = np.full(30, 0.2)
    dbh[3:5] = 0.03  # thin
    run = write_run(tmp_path / "run", position, dbh)
    result = stemmap(capsys, "stand", run, "--out", tmp_path / "out")
    assert "25 trees from 7 cm" in result.out
    assert "3 outside of observed area, 2 below minimum dbh" in result.out
    record = json.loads((tmp_path / "out" / "stand.json").read_text())
    assert record["trees_in_map"] == 30
    plots = tmp_path / "plots.geojson"
    shape = {"type": "Polygon", "coordinates": [[[1, 1], [10, 1], [10, 10], [1, 10], [1, 1]]]}
    features = [{"type": "Feature", "properties": {"name": "a"}, "geometry": shape}]
    plots.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    stemmap(capsys, "stand", run, "--plots", plots, "--plots-crs", "local", "--out", tmp_path / "of_plots")
    record = json.loads((tmp_path / "of_plots" / "stand.json").read_text())
    assert record["plots"]["a"]["trees"] + sum(record["trees_left_out"].values()) == 30


def test_trees_far_from_every_view_are_corrected_for_detection(tmp_path, capsys):
    random = np.random.default_rng(5)
    position = random.uniform(0, 20, (600, 2))
    distance = np.abs(position[:, 0] - position[:, 1]) / np.sqrt(2)
    found = random.random(600) < np.exp(-0.5 * (distance / 6.0) ** 2)
    run = write_run(tmp_path / "run", position[found], np.full(found.sum(), 0.2))
    assert stemmap(capsys, "stand", run, "--out", tmp_path / "out").code == 0
    row = table(tmp_path / "out" / "stand.csv")["all"]
    assert abs(float(row["n_ha_corrected"]) - 15000) < 2.5 * float(row["n_ha_corrected_se"])
    assert float(row["n_ha"]) < 12000
    none = stemmap(capsys, "stand", run, "--out", tmp_path / "none", "--correction", "none")
    assert none.code == 0
    assert "detection: not estimated, every tree in view counts as found" in none.out
    row = table(tmp_path / "none" / "stand.csv")["all"]
    assert row["n_ha"] == row["n_ha_corrected"]


def test_a_formula_of_the_user_gives_volumes(run, tmp_path, capsys):
    result = stemmap(capsys, "stand", run, "--volume", "0.001 * dbh_cm^2", "--out", tmp_path / "out")
    assert (result.code, result.err) == (0, "")
    assert "Stem volume: 1,000" in result.out
    row = table(tmp_path / "out" / "stand.csv")["all"]
    assert float(row["v_ha"]) == pytest.approx(1000.0)
    assert row["trees_with_volume"] == "100"
    # A drive sees no tree tops: without heights there is no volume, and the warning says so.
    result = stemmap(capsys, "stand", run, "--volume", "0.001 * dbh_cm^2 * height_m")
    assert result.code == 3
    assert "volume of 0 of 100 trees" in result.err
    result = stemmap(capsys, "stand", run, "--volume", "dbh + 1")
    assert (result.code, "--volume" in result.err, "'dbh'" in result.err) == (2, True, True)


def test_a_reference_system_in_wkt_is_reported_by_its_name(tmp_path, capsys):
    wkt = pyproj.CRS("EPSG:25832").to_wkt()
    run = grid_run(tmp_path / "run", cloud_crs=wkt)
    result = stemmap(capsys, "stand", run)
    assert "coordinates ETRS89 / UTM zone 32N\n" in result.out


def test_coordinates_may_be_negative(run, capsys):
    alone = stemmap(capsys, "stand", run, "--circle", "-1,2,6").out
    assert "1 plot" in alone
    assert alone == stemmap(capsys, "stand", run, "--circle=-1,2,6").out
    stemmap(capsys, "stand", "--", "-5,3.run").refused(1, "-5,3.run")


def test_a_plot_may_be_called_all(run, tmp_path, capsys):
    file = tmp_path / "plots.geojson"
    ring = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"name": "all"}, "geometry": shape}
    file.write_text(json.dumps({"type": "FeatureCollection", "coordinateFrame": {}, "features": [feature]}))
    result = stemmap(capsys, "stand", run, "--plots", file)
    assert result.out.startswith("1 plot: ")
    assert "plot all: " in result.err
