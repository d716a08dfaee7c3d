"""Result files of a run: empty cells for unknown values, reproducible bytes, and atomic replacement."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.io.result_files import (
    DETECTION_COLUMNS,
    PATH_COLUMNS,
    TREE_COLUMNS,
    RunFiles,
    csv_text,
    detection_rows,
    geojson,
    number_text,
    path_rows,
    terrain_text,
    tree_rows,
)
from pipeline.mapper import Mapper
from pipeline.types.records import HeightMap, Path
from tests.pipeline.strategies import SENSOR, arc, step, trees

NAMES = {"trees.csv", "path.csv", "trees.geojson", "detections.csv", "run.json", "state.zip"}
START = 1_700_000_000_000_000_000


def a_path(n=3):
    """A path that begins at START."""
    k = np.arange(n)
    return Path(START + k * 100_000_000, k * 0.5, k * -0.0, k * 0.1, k * 0.01)


def a_frame():
    """A frame with a trunk, and a cluster too small for a circle."""
    from pipeline.geometry.poses import Pose3

    p = preset("laser2d").replace({"clustering.method": "dbscan", "clustering.eps": 0.3})
    m = Mapper(p, sensor=SENSOR, T_base_lidar=Pose3(np.eye(3), np.array([0.2, 0, 0.8])), seed=0)
    return m.process(step(4, np.concatenate([arc(0.15, 1.2), [[9.0, 3.0, 0.0]]]), Pose2()))


# --- numbers --------------------------------------------------------------------------------------


@given(st.floats(-1e9, 1e9), st.integers(0, 6))
def test_a_number_is_plain_and_as_near_as_its_digits(value, digits):
    text = number_text(value, digits)
    assert "e" not in text
    assert abs(float(text) - value) <= 0.5 * 10**-digits * (1 + 1e-9) + abs(value) * 1e-15
    assert not (float(text) == 0.0 and text.startswith("-"))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_empty(value):
    assert number_text(value, 3) == ""


def test_there_is_no_minus_zero():
    assert number_text(-0.0, 3) == "0.000"
    assert number_text(-0.0004, 3) == "0.000"
    assert number_text(-0.4, 0) == "0"


# --- rows -----------------------------------------------------------------------------------------


def test_a_tree_in_the_promised_units():
    t = replace(trees([[1.0, -2.0]], dbh=0.314), first_seen_ns=np.array([START + 10**9]))
    (row,) = tree_rows(replace(t, last_seen_ns=np.array([START + 5 * 10**9])), START)
    told = dict(zip(TREE_COLUMNS, row, strict=True))
    assert told == {
        "tree": "1",
        "x_m": "1.000",
        "y_m": "-2.000",
        "sigma_x_m": "0.010",
        "sigma_y_m": "0.010",
        "dbh_cm": "31.4",
        "sigma_dbh_cm": "1.0",
        "eccentricity": "5.000",
        "observations": "9",
        "coverage_deg": "115",
        "first_seen_s": "1.000",
        "last_seen_s": "5.000",
        "height_m": "",
        "sigma_height_m": "",
        "lean_deg": "",
        "sigma_assumed": "0",
        "review": "open",
    }


def test_the_columns_of_detections_are_documented():
    told = (FilePath(__file__).parents[3] / "docs" / "commands.md").read_text(encoding="utf-8")
    section = told.partition("## Detections")[2].partition("\n## ")[0]
    assert [name for name in DETECTION_COLUMNS if f"`{name}`" not in section] == []


def test_a_tree_that_no_scan_detected_is_marked():
    t = replace(trees([[1.0, 2.0]]), observations=np.zeros(1, np.int64))
    assert dict(zip(TREE_COLUMNS, tree_rows(t, 0)[0], strict=True))["sigma_assumed"] == "1"


def test_what_is_not_known_of_a_tree_is_empty_and_not_zero():
    nothing = np.array([np.nan])
    t = replace(
        trees([[1.0, 2.0]]), dbh=nothing, dbh_sigma=nothing, eccentricity=nothing, coverage=np.zeros(1)
    )
    told = dict(zip(TREE_COLUMNS, tree_rows(t, 0)[0], strict=True))
    assert told["dbh_cm"] == told["sigma_dbh_cm"] == told["eccentricity"] == told["coverage_deg"] == ""
    (feature,) = json.loads(geojson(t, 0))["features"]
    assert feature["properties"]["dbh_cm"] is None


def test_only_confirmed_trees_are_written():
    t = trees([[0, 0], [1, 1], [2, 2]])
    t.confirmed[1] = False
    assert [row[0] for row in tree_rows(t, 0)] == ["1", "3"]
    assert [f["id"] for f in json.loads(geojson(t, 0))["features"]] == [1, 3]


def test_the_path_has_a_row_a_scan_from_time_zero():
    rows = path_rows(a_path(), START)
    assert [row[0] for row in rows] == ["0.000", "0.100", "0.200"]
    assert all(len(row) == len(PATH_COLUMNS) for row in rows)
    assert rows[0] == ("0.000", "0.0000", "0.0000", "0.00000", "0.0000")


def test_every_cluster_is_a_row_with_its_verdict_in_the_frame_of_the_map():
    frame = a_frame()
    frame = replace(frame, estimate=replace(frame.estimate, T_map_base=Pose2(1.0, 2.0, 0.5 * np.pi)))
    rows = [dict(zip(DETECTION_COLUMNS, row, strict=True)) for row in detection_rows(frame, 0)]
    assert len(rows) == len(frame.clusters.size) == 2
    trunk = max(rows, key=lambda row: int(row["points"]))
    speck = min(rows, key=lambda row: int(row["points"]))
    assert trunk["verdict"] == "tree"
    # 0.2 m from the robot to its LiDAR; how near the fit is to the trunk is asked in test_stem_fit.
    x, y = frame.clusters.centre[int(np.argmax(frame.clusters.size))]
    assert (float(trunk["x_m"]), float(trunk["y_m"])) == pytest.approx((1.0 - y, 2.2 + x), abs=6e-4)
    assert trunk["scan"] == "4"
    assert speck["radius_m"] == speck["arc_deg"] == ""


def test_geojson_says_which_frame_it_is_in():
    told = json.loads(geojson(trees([[1.0, -2.0]]), 0))
    assert told["type"] == "FeatureCollection"
    assert told["coordinateFrame"]["type"] == "local"
    (feature,) = told["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [1.0, -2.0]}
    assert feature["properties"]["observations"] == 9


def test_csv_quotes_what_needs_it_and_ends_lines_alike():
    text = csv_text(("a", "b"), [["x,y", 'q"']])
    assert text == 'a,b\n"x,y","q"""\n'
    assert next(csv.reader(text.splitlines()[1:])) == ["x,y", 'q"']


# --- the folder -----------------------------------------------------------------------------------


def write(folder, t=None, run=None):
    """A whole small run."""
    files = RunFiles(folder)
    files.add(a_frame(), 0)
    files.finish(trees([[1.0, 2.0]]) if t is None else t, a_path(), START, run or {"seed": 0}, b"state")
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def test_the_same_run_gives_the_same_bytes_and_nothing_else_is_left(tmp_path):
    one = write(tmp_path / "a" / "b")
    assert set(one) == NAMES
    assert one == write(tmp_path / "c")
    assert one["path.csv"].count(b"\n") == 4
    assert b"\r" not in b"".join(one.values())


def test_an_empty_map_is_still_whole(tmp_path):
    told = write(tmp_path, trees([]))
    assert told["trees.csv"].decode() == ",".join(TREE_COLUMNS) + "\n"
    assert json.loads(told["trees.geojson"])["features"] == []


def test_another_run_replaces_the_first_and_leaves_strange_files_alone(tmp_path):
    write(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    told = write(tmp_path, trees([]))
    assert told["trees.csv"].count(b"\n") == 1
    assert told["notes.txt"] == b"mine"


def test_another_run_removes_what_people_measured_by_the_tree_numbers_of_the_first(tmp_path):
    write(tmp_path)
    (tmp_path / "by_people.csv").write_text("of_tree,x_m,y_m,dbh_tape_cm\n1,1,2,30\n")
    assert set(write(tmp_path)) == NAMES


def test_nothing_is_there_before_the_end(tmp_path):
    files = RunFiles(tmp_path / "new")
    files.add(a_frame(), 0)
    assert not any(name in NAMES for name in (f.name for f in (tmp_path / "new").iterdir()))
    files.abandon()
    assert not (tmp_path / "new").exists()


def test_giving_up_leaves_the_old_run_as_it_was(tmp_path):
    before = write(tmp_path)
    files = RunFiles(tmp_path)
    files.add(a_frame(), 0)
    files.abandon()
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_giving_up_leaves_a_folder_of_the_user_there(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    RunFiles(mine).abandon()
    assert mine.is_dir()


def test_a_run_that_cannot_be_written_down_leaves_the_old_one(tmp_path):
    before = write(tmp_path)
    files = RunFiles(tmp_path)
    with pytest.raises(ValueError, match="JSON"):
        files.finish(trees([]), a_path(), START, {"error": float("nan")}, b"state")
    files.abandon()
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_what_a_killed_run_left_does_not_stand_in_the_way(tmp_path):
    killed = RunFiles(tmp_path)
    killed.add(a_frame(), 0)
    killed._detections.close()
    assert set(write(tmp_path)) == NAMES


def test_a_file_in_the_place_of_the_folder_is_an_os_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="file"):
        RunFiles(tmp_path / "file")


def test_the_ground_is_a_table_of_its_known_cells():
    ground = HeightMap(
        cell=0.5,
        place=np.array([[1, -1], [-3, 4]], np.int32),
        height=np.array([0.25, -1.0], np.float32),
        sigma=np.array([0.04, 0.05], np.float32),
        views=np.array([3, 12], np.int32),
    )
    assert terrain_text(ground) == (
        "x_m,y_m,z_m,sigma_m,views\n-1.250,2.250,-1.000,0.050,12\n0.750,-0.250,0.250,0.040,3\n"
    )
