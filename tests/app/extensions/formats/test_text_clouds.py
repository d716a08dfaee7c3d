"""Clouds as lines of text, as other programs export them; other tables are refused by what they are."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from app.cli import main
from app.sources.one_step import is_one_step as is_cloud
from pipeline.errors import SourceError
from pipeline.io.readers import open_source, recordings_in
from pipeline.io.readers.point_files import ScanFileError, open_table
from tests.app.extensions.formats.conftest import open_cloud
from tests.pipeline.plots import plot

POINTS = np.round(np.random.default_rng(3).uniform(-9.0, 9.0, (500, 3)), 3)
UTM = np.array([470_612.25, 6_810_203.5, 278.0])


def lines(points: np.ndarray, form: str, *, comma: bool = False) -> str:
    """Points as text; `form` has {x}, {y} and {z} for the coordinates."""
    text = "".join(
        form.format(x=f"{x:.3f}", y=f"{y:.3f}", z=f"{z:.3f}") + "\n" for x, y, z in points.tolist()
    )
    return text.replace(".", ",") if comma else text


@pytest.mark.slow_after(12)
@pytest.mark.parametrize(
    ("name", "head", "form"),
    [
        ("c.XYZ", "", "  {x}   {y}  {z} "),
        ("c.txt", "", "{x}\t{y}\t{z}\t30"),
        ("c.csv", "//X;Y;Z;Intensity\n", "{x};{y};{z};30"),
        ("c.csv", '"x", "y", "z", "R"\n', "{x}, {y}, {z}, 7"),
        ("c.asc", "# made by a scanner\n# x y z r g b\n", "{x} {y} {z} 12 200 8"),
        ("c.csv", "id,Classification,Z,Easting,Northing\n", "5,2,{z},{x},{y}"),
        ("c.txt", "X[m] Y[m] Z[m]\n", "{x} {y} {z}"),
        ("c.csv", "Rechtswert;Hochwert;H\u00f6he [m]\n", "{x};{y};{z}"),
        ("c.csv", "Points:0,Points:1,Points:2,kind\n", "{x},{y},{z},stem"),
        ("c.csv", "x,y,z,label,\n", "{x},{y},{z},,"),
        ("c.pts", "500\n", "{x} {y} {z} -1204 12 34 56"),
        ("cloud", "", "{x} {y} {z} 12 200 8"),
        ("c.dat", "", "{x},{y},{z}"),
        ("c.txt", "", "{x} | {y} | {z} | 12"),
        ("c.3d", "Export of plot 7, 2024-05-01\nx y z\n", "{x} {y} {z}"),
    ],
)
@pytest.mark.parametrize("form_of_text", ["unix", "windows", "old mac"])
def test_separator_header_and_columns_are_recognised(tmp_path: Path, name, head, form, form_of_text):
    text = head + lines(POINTS, form)
    content = {
        "unix": text.encode(),
        "windows": b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
        "old mac": text.replace("\n", "\r").encode(),
    }[form_of_text]
    (tmp_path / name).write_bytes(content)
    assert is_cloud(str(tmp_path / name))
    cloud = open_cloud(str(tmp_path / name))
    assert cloud.description.kind == "whole cloud, text"
    assert cloud.about.points == 500
    for _ in range(2):
        np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS, atol=1e-5)
    assert cloud.losses == {}


@pytest.mark.parametrize("first", [0, 1, 40_001])
def test_a_first_column_that_counts_the_rows_is_no_coordinate(tmp_path: Path, first):
    rows = lines(POINTS, "{x} {y} {z} 30").splitlines()
    text = "".join(f"{first + k} {row}\n" for k, row in enumerate(rows))
    (tmp_path / "c.txt").write_text(text)
    cloud = open_cloud(str(tmp_path / "c.txt"))
    np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS, atol=1e-5)


@pytest.mark.parametrize("form", ["{x};{y};{z}", "{x}\t{y}\t{z}", "{x} {y} {z} 3"])
def test_a_decimal_comma(tmp_path: Path, form):
    (tmp_path / "c.csv").write_text("X;Y;Z\n".replace(";", form[3]) + lines(POINTS, form, comma=True))
    cloud = open_cloud(str(tmp_path / "c.csv"))
    np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS, atol=1e-5)


def test_national_coordinates_keep_their_millimetres(tmp_path: Path):
    (tmp_path / "c.xyz").write_text(lines(POINTS + UTM, "{x} {y} {z}"))
    cloud = open_cloud(str(tmp_path / "c.xyz"))
    found = np.concatenate(list(cloud.points()))
    np.testing.assert_allclose(found, POINTS + UTM, atol=1e-3)
    assert cloud.about.up.startswith("z")


def test_bad_lines_are_counted_and_comments_are_not(tmp_path: Path):
    rows = lines(POINTS, "{x} {y} {z}").splitlines()
    rows[7], rows[100], rows[300], rows[301] = "1.0 2.0", "a b c", "", "# a remark"
    (tmp_path / "c.xyz").write_text("\n".join(rows))
    cloud = open_cloud(str(tmp_path / "c.xyz"))
    assert len(np.concatenate(list(cloud.points()))) == 496
    assert cloud.losses == {"lines that are no points": 2}


def test_a_cut_pts_file_tells_how_many_points_are_missing(tmp_path: Path):
    (tmp_path / "c.pts").write_text("800\n" + lines(POINTS, "{x} {y} {z} 5"))
    cloud = open_cloud(str(tmp_path / "c.pts"))
    assert len(np.concatenate(list(cloud.points()))) == 500
    assert cloud.losses == {"points that the files promise but do not hold": 300}


def test_pts_of_several_stations(tmp_path: Path):
    half = [lines(part, "{x} {y} {z} 5") for part in (POINTS[:250], POINTS[250:])]
    (tmp_path / "c.pts").write_text("".join(f"250\n{text}" for text in half))
    cloud = open_cloud(str(tmp_path / "c.pts"))
    np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS, atol=1e-5)
    assert cloud.losses == {}


def test_the_unit_in_the_names_of_the_columns(tmp_path: Path):
    (tmp_path / "c.csv").write_text("X [mm],Y [mm],Z [mm]\n" + lines(1000.0 * POINTS, "{x},{y},{z}"))
    cloud = open_cloud(str(tmp_path / "c.csv"))
    np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS, atol=1e-5)
    assert any("millimetres" in warning for warning in cloud.description.warnings)


def table(header: str, row: str) -> str:
    return header + "\n" + "".join(f"{row}\n".replace("#", str(k)) for k in range(300))


@pytest.mark.slow_after(7)
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (table("x_m,y_m,dbh_cm,class", "1.5,2.#,30.1,tree"), r"table of trees.*'dbh_cm'.*--truth"),
        (table("id;X;Y;Height", "#;1.5;2.5;21.5"), r"table of trees.*--truth"),
        (table("x_m,y_m,z_m,sigma_m,views", "1.5,2.#,3.1,0.1,3"), r"result of `stemmap map`"),
        (table("x,y,class", "1.5,2.5,1"), r"names no z"),
        (table("lat,lon,alt", "48.1,11.#,512.0"), r"degrees of longitude and latitude"),
        (table("", "1.# 4.5 5.5 6.5 0 0 0.6 0.8"), r"list of poses"),
        (table("", "1 0 0 4.5 0 1 0 5.5 0 0 1 6.#"), r"list of poses"),
        ("x,y,z\n" + "1.5,2.5,3.5\n" * 20, r"only 20 rows"),
        ("a remark about the plot\n" * 300, r"lines are no points, such as 'a remark"),
    ],
)
@pytest.mark.parametrize("name", ["t.csv", "t.txt"])
def test_other_tables_are_refused_by_what_they_are(tmp_path: Path, capsys, text, says, name):
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=says):
        open_cloud(str(tmp_path / name))
    assert main(["map", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "again" not in told
    assert not (tmp_path / "out").exists()


def test_a_folder_lists_texts_of_points_and_no_other_texts(tmp_path: Path):
    (tmp_path / "plot.csv").write_text(lines(POINTS, "{x},{y},{z}"))
    (tmp_path / "plot.pts").write_text("500\n" + lines(POINTS, "{x} {y} {z} 5"))
    (tmp_path / "truth.csv").write_text(table("x_m,y_m,dbh_cm,class", "1.5,2.#,30.1,tree"))
    (tmp_path / "poses.txt").write_text(table("", "1.# 4.5 5.5 6.5 0 0 0.6 0.8"))
    (tmp_path / "times.txt").write_text(table("", "12.#"))
    assert recordings_in(tmp_path) == ["plot.csv", "plot.pts"]


def ptx(points: np.ndarray, t: list[float], yaw: float) -> str:
    """A station with 100 directions of no return, whose points are given in the frame of the file."""
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    axes = "".join("{} {} {}\n".format(*row) for row in R.T)
    matrix = "".join("{} {} {} 0\n".format(*row) for row in R.T) + "{} {} {} 1\n".format(*t)
    rows = "".join("{:.6f} {:.6f} {:.6f} 0.5 9 9 9\n".format(*row) for row in (points - t) @ R)
    head = f"{len(points) // 100 + 1}\n100\n" + "{} {} {}\n".format(*t) + axes + matrix
    return head + 100 * "0 0 0 0.500000 0 0 0\n" + rows


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("stations", [1, 2])
def test_stations_of_a_ptx_file_are_read_in_one_frame(tmp_path: Path, stations: int, end: str):
    path = tmp_path / "plot.ptx"
    parts = np.split(POINTS[:400], stations)
    path.write_text(
        "".join(ptx(part, [5.0 + k, 6.0, 1.6], 0.7 * k) for k, part in enumerate(parts)), newline=end
    )
    cloud = open_cloud(str(path))
    np.testing.assert_allclose(np.concatenate(list(cloud.points())), POINTS[:400], atol=2e-6)
    assert cloud.losses == {}
    assert cloud.description.kind.startswith(f"whole cloud, PTX, {stations} station")


def test_a_cut_ptx_file_is_read_up_to_its_end(tmp_path: Path):
    path = tmp_path / "plot.ptx"
    path.write_text("\n".join(ptx(POINTS[:400], [0.0, 0.0, 1.6], 0.0).splitlines()[:310]) + "\n")
    cloud = open_cloud(str(path))
    assert sum(map(len, cloud.points())) == 200
    assert cloud.losses == {"points that the files promise but do not hold": 200}


@pytest.mark.parametrize("name", ["plot.ptx", "plot.txt"])
def test_a_ptx_file_is_refused_if_its_stations_would_lie_on_one_another(tmp_path: Path, name: str):
    path = tmp_path / name
    path.write_text(2 * ptx(POINTS[:400], [5.0, 6.0, 1.6], 0.0))
    with pytest.raises(SourceError, match="not registered"):
        open_cloud(str(path))


def test_times_before_the_coordinates_are_no_coordinates(tmp_path: Path):
    path = tmp_path / "plot.txt"
    path.write_text(lines(POINTS, "1654001234.123456 {x} {y} {z} 20"))
    np.testing.assert_allclose(np.concatenate(list(open_cloud(str(path)).points())), POINTS, atol=1e-5)


def test_utf_16_says_what_to_do(tmp_path: Path):
    (tmp_path / "c.xyz").write_text(lines(POINTS, "{x} {y} {z}"), encoding="utf-16")
    with pytest.raises(SourceError, match=r"UTF-16.*UTF-8"):
        open_cloud(str(tmp_path / "c.xyz"))


def test_damaged_texts_never_crash(tmp_path: Path):
    rng = np.random.default_rng(5)
    whole = ("//X;Y;Z\n" + lines(POINTS, "{x};{y};{z}")).encode()
    for k in range(200):
        content = bytearray(whole[: int(rng.integers(1, len(whole)))] if k % 3 == 0 else whole)
        for at in rng.integers(0, min(len(content), 60 if k % 2 else len(content)), 6):
            content[at] = int(rng.integers(0, 256))
        (tmp_path / "c.csv").write_bytes(bytes(content))
        with suppress(ScanFileError):
            assert sum(len(part["x"]) for part in open_table(tmp_path / "c.csv").parts()) <= 520


def test_a_line_without_end_takes_no_memory(tmp_path: Path):
    with (tmp_path / "c.xyz").open("wb") as file:
        file.write(lines(POINTS, "{x} {y} {z}").encode())
        file.write(b"1" * (40 << 20))
    cloud = open_cloud(str(tmp_path / "c.xyz"))
    assert sum(len(part) for part in cloud.points()) == 500


@pytest.mark.slow
def test_a_text_is_mapped_told_of_and_driven_through(tmp_path: Path, capsys):
    points = plot(np.random.default_rng(1), per_m2=900)
    text = io.StringIO()
    np.savetxt(text, points, fmt="%.3f", delimiter=";", header="X;Y;Z", comments="")
    (tmp_path / "plot.csv").write_text(text.getvalue())
    assert main(["map", str(tmp_path / "plot.csv"), "--out", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["trees"] == 9
    capsys.readouterr()
    assert main(["info", str(tmp_path / "plot.csv")]) == 0
    told = capsys.readouterr().out
    assert "whole cloud, text" in told
    assert "metres, as the file names no unit" in told
    assert open_source(str(tmp_path / "plot.csv")).description.kind.endswith("whole cloud (text)")
