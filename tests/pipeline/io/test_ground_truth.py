"""Ground truth from tables of other programs; errors name line and column."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.io.ground_truth import KINDS, read_truth_trees


def read(tmp_path, text, **rest: Any):
    """Read a table from its text."""
    path = tmp_path / "trees.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_truth_trees(path, **rest)


def test_our_own_header(tmp_path):
    told = read(tmp_path, "x_m,y_m,dbh_cm,class\n1.5,-2,30,tree\n3,4,,pole\n")
    np.testing.assert_allclose(told.x, [1.5, 3])
    np.testing.assert_allclose(told.y, [-2, 4])
    np.testing.assert_allclose(told.dbh, [0.3, np.nan])
    assert told.kind == ("tree", "pole")


@pytest.mark.parametrize(
    "header",
    [
        "X,Y",
        "x,y",
        "TreeLocationX,TreeLocationY",
        "Easting,Northing",
        " x_m , y_m ",
        "\ufeffx_m,y_m",
        "id,x_m,y_m,notes",
    ],
)
def test_headers_of_other_tools(tmp_path, header):
    columns = len(header.split(","))
    row = "1,2" if columns == 2 else "7,1,2,tall"
    told = read(tmp_path, f"{header}\n{row}\n")
    assert (told.x[0], told.y[0]) == (1.0, 2.0)
    assert told.kind == ("tree",)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_delimiters_and_line_ends(tmp_path, delimiter, ending):
    rows = [["x", "y", "dbh_mm"], ["1", "2", "250"]]
    told = read(tmp_path, ending.join(delimiter.join(row) for row in rows) + ending)
    assert told.dbh[0] == pytest.approx(0.25)


def test_a_spreadsheet_with_decimal_commas(tmp_path):
    told = read(tmp_path, "x_m;y_m;dbh_cm\r\n1,5;-2;30,5\r\n-0,25;4,5;\r\n")
    np.testing.assert_allclose(told.x, [1.5, -0.25])
    np.testing.assert_allclose(told.y, [-2, 4.5])
    np.testing.assert_allclose(told.dbh, [0.305, np.nan])


@pytest.mark.parametrize(
    ("azimuth", "x", "y"), [(0, 0, 2), (90, 2, 0), (180, 0, -2), (270, -2, 0), (45, 2**0.5, 2**0.5)]
)
def test_azimuths_run_clockwise_from_north(tmp_path, azimuth, x, y):
    told = read(tmp_path, f"azimuth_deg,distance_m\n{azimuth},2\n")
    np.testing.assert_allclose([told.x[0], told.y[0]], [x, y], atol=1e-12)


@pytest.mark.parametrize(("unit", "dbh"), [("m", "0.25"), ("cm", "25"), ("mm", "250")])
@pytest.mark.parametrize("name", ["DBH", "BHD"])
def test_a_diameter_without_a_unit_is_asked_for(tmp_path, name, unit, dbh):
    text = f"x,y,{name}\n0,0,{dbh}\n"
    with pytest.raises(SourceError, match="--dbh-unit"):
        read(tmp_path, text)
    assert read(tmp_path, text, dbh_unit=unit).dbh[0] == pytest.approx(0.25)
    assert read(tmp_path, text.replace(name, f"{name}_{unit}")).dbh[0] == pytest.approx(0.25)


@pytest.mark.parametrize(("name", "dbh"), [("dbh_m", 25), ("dbh_cm", 0.25), ("dbh_cm", 2500)])
def test_diameters_in_another_unit_than_the_column_states_are_refused(tmp_path, name, dbh):
    with pytest.raises(SourceError, match="median diameter") as caught:
        read(tmp_path, f"x,y,{name}\n0,0,{dbh}\n1,1,{dbh}\n")
    assert name in caught.value.remedy


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_the_encodings_of_spreadsheets(tmp_path, encoding):
    told = read(tmp_path, "x_m;y_m;Höhe;bhd_cm\r\n1,5;2;größer;30\r\n".encode(encoding))
    assert (told.x[0], told.y[0], told.dbh[0]) == (1.5, 2.0, pytest.approx(0.3))


def test_a_column_that_says_its_unit_is_not_overruled(tmp_path):
    assert read(tmp_path, "x,y,dbh_cm\n0,0,25\n", dbh_unit="m").dbh[0] == pytest.approx(0.25)


@pytest.mark.parametrize("unknown", ["", "nan", "NA", "0", "0.000", "-3"])
def test_a_diameter_that_was_not_measured_is_not_a_number(tmp_path, unknown):
    """Some tools write 0.000 for "not measured", one gives -3 cm."""
    assert np.isnan(read(tmp_path, f"x,y,dbh_cm\n0,0,{unknown}\n").dbh[0])


@pytest.mark.parametrize("kind", KINDS)
def test_every_class_is_known_in_any_case(tmp_path, kind):
    assert read(tmp_path, f"x,y,class\n0,0,{kind.upper()}\n").kind == (kind,)


def test_a_header_alone_is_a_table_of_nothing(tmp_path):
    told = read(tmp_path, "x_m,y_m\n")
    assert len(told.x) == len(told.dbh) == len(told.kind) == 0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no position"),
        ("a,b\n1,2\n", "no position"),
        ("a,b\n1,2\n", "easting and northing"),
        ("x_m;y_m\n1,5;2\n1.200,5;2\n", "line 3: x_m = '1.200,5'"),
        ("x_m;y_m\n1,5;2\n1.200;2\n", "no sign between thousands"),
        ("x_m;y_m\n1,200,5;2\n", "line 2: x_m = '1,200,5'"),
        ("x_m\n1\n", "no position"),
        ("x_m,y_m\n1,2\n3,abc\n", "line 3: y_m = 'abc'"),
        ("x_m,y_m\n1\n", "line 2: y_m = ''"),
        ("x_m,y_m\nnan,2\n", "line 2: x_m = 'nan'"),
        ("x_m,y_m\n1,inf\n", "line 2: y_m = 'inf'"),
        ("x_m,y_m,dbh_cm\n1,2,thick\n", "line 2: dbh_cm = 'thick'"),
        ("x_m,y_m,class\n1,2,tree\n1,2,cow\n", "line 3: class 'cow'"),
        ("x_m,y_m\n1,2\n\n\n3,abc\n", "line 5: y_m = 'abc'"),
        ("x_m,y_m,class\n\n1,2,cow\n", "line 3: class 'cow'"),
        (b"x_m,y_m\n\xff\xfe,2\n", "line 2: x_m"),
        (b"x_m,y_m\n\x81,2\n", "not text"),
        (b"x_m,y_m\n\x00,2\n", "not text"),
    ],
    ids=lambda v: repr(v)[:40],
)
def test_what_does_not_fit_is_said_with_line_and_column(tmp_path, text, says):
    with pytest.raises(SourceError) as caught:
        read(tmp_path, text)
    assert says in str(caught.value)
    assert "trees.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_all_faults_are_named_in_the_order_of_the_lines(tmp_path):
    with pytest.raises(SourceError) as caught:
        read(tmp_path, "x_m,y_m,class\n1,2,cow\nup,2,tree\n" + "1,,\n" * 11)
    assert caught.value.what.startswith("line 2: class 'cow' is not one of tree, pole")
    assert "; line 3: x_m = 'up' is not a number; line 4: y_m = '' is" in caught.value.what
    assert caught.value.what.endswith("line 11: y_m = '' is not a number; and 3 more")


def test_a_table_that_would_take_gigabytes_is_refused(tmp_path):
    with pytest.raises(SourceError, match="larger than 8 MB"):
        read(tmp_path, "x_m,y_m\n" + "1,1\n" * (3 << 20))


def test_a_missing_file_and_a_folder(tmp_path):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(SourceError, match="cannot read"):
            read_truth_trees(path)


# --- real tables ----------------------------------------------------------------------------------


def test_the_field_survey_reads_by_map_grid_and_by_polar_alike(shared_data, tmp_path):
    path = shared_data / "stem_maps" / "prf025_field.csv"
    grid = read_truth_trees(path)
    assert len(grid.x) == 62
    assert 0.05 < np.nanmedian(grid.dbh) < 0.5
    lines = path.read_text().splitlines()
    keep = [k for k, name in enumerate(lines[0].split(",")) if name not in ("easting", "northing")]
    polar = read(tmp_path, "\n".join(",".join(line.split(",")[k] for k in keep) for line in lines))
    centre = np.array([np.median(grid.x - polar.x), np.median(grid.y - polar.y)])
    apart = np.hypot(grid.x - polar.x - centre[0], grid.y - polar.y - centre[1])
    assert np.median(apart) < 0.5


def test_diameters_in_metres_are_not_taken_for_centimetres(shared_data):
    told = read_truth_trees(shared_data / "stem_maps" / "prf025_lidar.csv")
    assert len(told.x) == 93
    assert 0.02 < np.nanmedian(told.dbh) < 0.5


def test_the_stems_of_the_pine_plot(shared_data):
    told = read_truth_trees(shared_data / "forest" / "pine_plot_stems.csv")
    assert len(told.x) == 16
    assert 0.1 < np.nanmedian(told.dbh) < 0.4


@pytest.mark.parametrize("header", ["x_m,y_m", "azimuth_deg,distance_m"])
@pytest.mark.parametrize("number", ["1e200", "-1e8", "inf"])
def test_coordinates_out_of_range_are_refused_in_one_line(tmp_path, header, number):
    with pytest.raises(SourceError, match=r"line 3: .* is (out of range|not a number)"):
        read(tmp_path, f"{header}\n1,2\n1,{number}\n")
