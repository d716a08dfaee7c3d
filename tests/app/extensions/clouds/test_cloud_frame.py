"""Units and axes of whole clouds: results are in metres with z up, and what was changed is said."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyproj
import pytest

from app.cli import main
from app.extensions.clouds.cloud_frame import TOO_COARSE, UNNAMED, metric_crs
from app.extensions.clouds.inventory import _unit_doubt
from app.extensions.clouds.point_cloud import open_cloud
from app.extensions.clouds.records import CloudDescription
from app.extensions.clouds.up_axis import UP, UP_UNCLEAR
from pipeline.errors import SourceError
from pipeline.io.readers.base import SourceOptions
from tests.pipeline.plots import PLACES, plot, write_las

US_FT, FT = 1200.0 / 3937.0, 0.3048
PLACE = np.array([945_260.0, 400_045.0, 1655.0])  # m


@pytest.fixture(scope="module")
def points():
    return plot(np.random.default_rng(1), per_m2=900)


def las(path: Path, xyz: np.ndarray, crs: str | None, *, keys: dict[int, int] | None = None) -> str:
    """A LAS or LAZ file; with `keys` its reference system is GeoTIFF keys (LAS 1.2), else WKT (LAS 1.4)."""
    import laspy

    header = laspy.LasHeader(point_format=3 if keys else 6, version="1.2" if keys else "1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.mean(axis=0))
    if keys:
        record = laspy.vlrs.known.GeoKeyDirectoryVlr()
        parts = [1, 1, 0, len(keys)]
        for number, value in sorted(keys.items()):
            parts += [number, 0, 1, value]
        record.parse_record_data(np.array(parts, "<u2").tobytes())
        header.vlrs.append(record)
    elif crs:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = xyz.T
    data.write(str(path))
    return str(path)


def read(
    path: str | Path, *, form: str = "auto", unit: str = "auto", up: str = "auto"
) -> tuple[np.ndarray, CloudDescription]:
    cloud = open_cloud(str(path), SourceOptions(form=form, unit=unit, up=up))
    return np.concatenate(list(cloud.parts())) + cloud.description.offset, cloud.description


@pytest.mark.slow_after(5)
@pytest.mark.parametrize(
    ("crs", "keys", "flat", "high"),
    [
        ("EPSG:6430+6360", None, US_FT, US_FT),
        ("EPSG:6430+5703", None, US_FT, 1.0),
        ("EPSG:26913+6360", None, 1.0, US_FT),
        ("EPSG:6430", None, US_FT, US_FT),
        ("EPSG:2994+6360", None, FT, US_FT),
        (None, {1024: 1, 3072: 6430}, US_FT, US_FT),
        (None, {1024: 1, 3072: 26913, 4099: 9003}, 1.0, US_FT),
        (None, {1024: 1, 3072: 32767, 3076: 9002}, FT, FT),
        (None, {1024: 1, 3072: 32767, 3076: 9003, 4099: 9001}, US_FT, 1.0),
    ],
)
def test_the_units_of_the_reference_system(tmp_path, points, crs, keys, flat, high):
    wanted = points[::20] + PLACE
    scale = np.array([flat, flat, high])
    found, about = read(las(tmp_path / "c.laz", wanted / scale, crs, keys=keys))
    np.testing.assert_allclose(found, wanted, atol=1e-3)
    changed = (flat, high) != (1.0, 1.0)
    assert any("in metres" in warning for warning in about.warnings) == changed
    for unit, word in ((US_FT, "US survey feet"), (FT, "feet")):
        assert (word in about.unit) >= (unit in (flat, high))


def test_a_system_in_metres_has_the_same_places_on_the_earth():
    for text in ("EPSG:6430", "EPSG:2994", "EPSG:6430+6360"):
        scale = pyproj.CRS(text).axis_info[0].unit_conversion_factor
        own, metric = (
            pyproj.Transformer.from_crs(pyproj.CRS(crs).to_2d(), "EPSG:4269", always_xy=True)
            for crs in (text.split("+")[0], pyproj.CRS(metric_crs(text.split("+")[0])))
        )
        np.testing.assert_allclose(
            own.transform(3e6, 1.3e6), metric.transform(3e6 * scale, 1.3e6 * scale), atol=1e-9
        )


@pytest.mark.parametrize(
    ("feet", "metres"),
    [("EPSG:6430+6360", "EPSG:6429+5703")],
)
def test_the_metric_sibling_of_a_system_has_its_number(feet, metres):
    assert metric_crs(pyproj.CRS(feet).to_wkt()) == metric_crs(feet) == metres


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as text:
        return list(csv.DictReader(text))


@pytest.mark.slow
def test_a_plot_in_feet_keeps_its_coordinates_and_gets_metric_diameters(tmp_path, points, capsys):
    file = las(tmp_path / "plot.laz", (points + PLACE) / US_FT, "EPSG:6430+6360")
    truth = tmp_path / "truth.csv"
    cells = [f"{(x + PLACE[0]) / US_FT},{(y + PLACE[1]) / US_FT},{200 * r}" for x, y, r in PLACES]
    truth.write_text("easting,northing,dbh_cm\n" + "\n".join(cells))
    out = tmp_path / "out"
    assert main(["map", file, "--out", str(out), "--truth", str(truth)]) == 0
    assert "US survey feet" in capsys.readouterr().err
    trees = rows(out / "trees.csv")
    assert "x_m" not in trees[0]
    place = np.array([(float(tree["x"]), float(tree["y"])) for tree in trees]) * US_FT - PLACE[:2]
    order = np.argsort(np.round(PLACES[:, 0], 3))
    distance = np.linalg.norm(place[:, None] - PLACES[None, :, :2], axis=2)
    assert (distance.min(axis=0) < 0.03).all(), order
    dbh = np.array([float(tree["dbh_cm"]) for tree in trees])
    assert np.abs(dbh - 200.0 * PLACES[distance.argmin(axis=1), 2]).max() < 1.0
    record = json.loads((out / "run.json").read_text())
    assert record["evaluation"]["TA"]["count"] == 9
    assert record["source"]["crs_unit_m"] == [pytest.approx(US_FT), pytest.approx(US_FT)]
    ground = rows(out / "terrain.csv")
    assert abs(float(ground[0]["z"]) * US_FT - PLACE[2]) < 2.0
    # The tables are read back in metres, and GIS files are in a metric system.
    capsys.readouterr()
    assert main(["evaluate", str(out), "--truth", str(truth)]) == 0
    assert "9/9" in capsys.readouterr().out
    assert main(["export", str(out), "--to", str(tmp_path / "cloud.laz")]) == 0
    again, about = read(tmp_path / "cloud.laz")
    assert np.abs(again.mean(axis=0) - (points + PLACE).mean(axis=0)).max() < 0.05
    assert about.unit.startswith("metres")


def ply(path: Path, xyz: np.ndarray, kind: str) -> str:
    dtype = {"short": "<i2", "int": "<i4", "float": "<f4", "double": "<f8"}[kind]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n"
    head += "".join(f"property {kind} {axis}\n" for axis in "xyz") + "end_header\n"
    values = np.rint(xyz) if dtype[1] == "i" else xyz
    path.write_bytes(head.encode() + values.astype(dtype).tobytes())
    return str(path)


@pytest.mark.parametrize("kind", ["short"])
def test_whole_numbers_are_millimetres(tmp_path, points, kind):
    found, about = read(ply(tmp_path / "c.ply", 1000.0 * points, kind))
    np.testing.assert_allclose(found, points, atol=1e-3)
    assert "millimetres" in about.unit
    assert any("millimetres" in warning and "--unit" in warning for warning in about.warnings)


def test_whole_numbers_in_floats_are_millimetres(tmp_path, points):
    np.save(tmp_path / "c.npy", np.rint(1000.0 * points))
    found, _ = read(tmp_path / "c.npy")
    np.testing.assert_allclose(found, points, atol=1e-3)


def test_integer_coordinates_of_a_pcd(tmp_path, points):
    head = (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE I I I\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    (tmp_path / "c.pcd").write_bytes(head.encode() + np.rint(1000.0 * points).astype("<i4").tobytes())
    found, _ = read(tmp_path / "c.pcd", form="cloud")
    np.testing.assert_allclose(found, points, atol=1e-3)


def test_an_extent_of_millimetres_only(tmp_path, points):
    wide = points * np.array([2.0, 2.0, 3.0])  # 30 x 30 x 30 m
    found, about = read(ply(tmp_path / "c.ply", 1000.0 * wide + 0.25, "double"))
    np.testing.assert_allclose(found, wide, atol=1e-3)
    assert "millimetres" in about.unit


@pytest.mark.slow
def test_an_extent_that_is_none_of_metres_is_refused_with_the_flag(tmp_path, points, capsys):
    file = ply(tmp_path / "c.ply", 1000.0 * points + 0.25, "double")  # 15 x 15 m, or 150 x 150 m
    assert main(["map", file, "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().err
    assert "--unit mm or --unit cm" in told
    assert "Cut it" not in told
    assert main(["map", file, "--out", str(tmp_path / "out"), "--unit", "mm"]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["trees"] == 9
    assert record["chosen"]["unit"] == "mm"
    np.testing.assert_allclose(read(file, unit="mm")[0], points, atol=1e-3)


def test_a_unit_that_is_named_counts(tmp_path, points):
    found, about = read(ply(tmp_path / "c.ply", points / FT, "double"), unit="ft")
    np.testing.assert_allclose(found, points, atol=1e-4)
    assert about.unit == "feet, as requested"
    assert about.warnings == ("the coordinates are taken as feet, as requested",)


def test_a_unit_that_contradicts_the_file_is_said(tmp_path, points):
    file = write_las(tmp_path / "c.laz", points, offset=(470600.0, 3810200.0, 300.0), crs="EPSG:26912")
    [warning] = open_cloud(str(file), SourceOptions(unit="ft")).description.warnings
    assert warning.startswith(
        "the coordinates are taken as feet, as requested, though they are metres by its"
    )
    [warning] = open_cloud(str(file), SourceOptions(unit="m")).description.warnings
    assert warning == "the coordinates are taken as metres, as requested"


def test_places_on_the_earth_stay_when_the_unit_is_named(tmp_path, points):
    file = las(tmp_path / "c.laz", (points[::20] + PLACE) / US_FT, "EPSG:6430")
    _, auto = read(file)
    _, named = read(file, unit="us-ft")
    assert (named.crs, named.crs_unit) == (auto.crs, auto.crs_unit)
    _, other = read(file, unit="m")
    assert (other.crs, other.crs_unit) == (auto.crs, (1.0, 1.0))


@pytest.mark.parametrize("how", ["crs", "extent"])
def test_degrees_are_refused(tmp_path, points, how):
    degrees = np.column_stack([11.0 + points[:, 0] / 74e3, 48.0 + points[:, 1] / 111e3, points[:, 2]])
    file = tmp_path / "c.npy"
    np.save(file, degrees)
    if how == "crs":
        file = write_las(tmp_path / "c.laz", degrees, crs="EPSG:4326")
    with pytest.raises(SourceError, match=r"degrees.*UTM"):
        open_cloud(str(file))


def test_national_coordinates_that_lost_their_digits_are_refused(tmp_path, points):
    high = points + np.array([470_600.0, 6_810_200.0, 278.0])
    with pytest.raises(SourceError, match=r"6,810,.* in steps of 50 cm.*64-bit"):
        open_cloud(ply(tmp_path / "c.ply", high, "float"))
    found, _ = read(ply(tmp_path / "c.ply", high, "double"))
    np.testing.assert_allclose(found, high, atol=1e-3)


@pytest.mark.parametrize(("step", "is_too_coarse"), [(0.04, False), (0.1, True)])
def test_coordinates_whose_steps_hide_the_stems_are_told(tmp_path, points, step, is_too_coarse):
    _, about = read(ply(tmp_path / "c.ply", np.round(points / step) * step, "double"))
    assert [text.startswith(TOO_COARSE) for text in about.warnings if "in steps of" in text] == [
        is_too_coarse
    ]


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("up", ["y", "-y", "x", "-x", "-z"])
@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_a_cloud_with_another_axis_up_is_turned(tmp_path, up, slope):
    points = plot(np.random.default_rng(1), per_m2=900, slope=slope)
    found, about = read(ply(tmp_path / "c.ply", points @ UP[up], "float"))
    np.testing.assert_allclose(found, points, atol=1e-4)
    assert about.up.startswith(up)
    assert any("it was turned" in warning for warning in about.warnings)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("cut", [2.0, 3.0, 5.0])
def test_the_straight_side_of_a_plot_with_hardly_a_ground_is_no_ground(tmp_path, shared_data, cut):
    cloud = open_cloud(str(shared_data / "forest" / "LPine1_demo.laz"))
    points = np.concatenate(list(cloud.parts()))[::3, :3].astype(np.float64)
    _, about = read(ply(tmp_path / "c.ply", points[points[:, 2] < points[:, 2].min() + cut + 0.5], "float"))
    assert about.up.startswith("z")


@lru_cache
def whole(file: Path) -> np.ndarray:
    """At most 400,000 points of a real plot around their middle."""
    points = np.concatenate(list(open_cloud(str(file)).parts())).astype(np.float64)
    points = points[:: -(-len(points) // 400_000)]
    return np.asarray(points - points.mean(axis=0))


def real(shared_data: Path, name: str, cut: float | None = None, share: float = 1.0) -> np.ndarray:
    """Points of a real plot around its middle, up to a height above its lowest ground, or a share of them."""
    points = whole(shared_data / "forest" / f"{name}.laz")
    points = points[np.random.default_rng(3).random(len(points)) < share]
    return points if cut is None else points[points[:, 2] < np.percentile(points[:, 2], 1) + cut]


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("name", ["pine_plot", "LPine1_demo", "MLS_Clip"])
@pytest.mark.parametrize(
    ("up", "share"), [("z", 1.0), ("-z", 1.0), ("y", 1.0), ("-x", 1.0), ("z", 0.3), ("x", 0.3), ("-y", 0.3)]
)
def test_a_real_plot_is_turned_by_its_stems(tmp_path, shared_data, name, up, share):
    np.save(tmp_path / "c.npy", real(shared_data, name, share=share) @ UP[up])
    about = open_cloud(str(tmp_path / "c.npy"), SourceOptions(form="cloud")).description
    assert about.up.split(",")[0] == up
    assert len(about.warnings) == (up != "z")


@pytest.mark.parametrize("cut", [2.0, 4.0])
@pytest.mark.parametrize("up", ["z", "y", "-x"])
@pytest.mark.parametrize("name", ["pine_plot", "LPine1_demo", "MLS_Clip"])
def test_a_real_plot_below_its_crowns_is_turned_or_called_into_question(tmp_path, shared_data, name, up, cut):
    np.save(tmp_path / "c.npy", real(shared_data, name, cut) @ UP[up])
    about = open_cloud(str(tmp_path / "c.npy"), SourceOptions(form="cloud")).description
    found = about.up.split(",")[0]
    if up == "z":
        assert (found, about.warnings) == ("z", ())
    else:  # stems cut at both ends look alike either way up
        named = any(text.startswith(UP_UNCLEAR) and f"--up={up}" in text for text in about.warnings)
        assert found == up or (found == "z" and named)


def test_an_unclear_axis_is_exit_code_3_until_it_is_named(tmp_path, shared_data, capsys):
    np.save(tmp_path / "c.npy", real(shared_data, "LPine1_demo", 4.0) @ UP["y"])
    mapped = ["map", str(tmp_path / "c.npy"), "--as", "cloud", "--out", str(tmp_path / "out"), "--force"]
    assert main(mapped) == 3
    told = capsys.readouterr()
    assert "--up=y or --up=-y" in told.err
    assert "up: z, as usual, but it may be y or -y" in told.out
    assert main([*mapped, "--up=y"]) == 0
    assert "up: y, as requested" in capsys.readouterr().out


@pytest.mark.parametrize("R", UP.values(), ids=UP)
def test_turning_keeps_left_and_right(R):
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_the_choice_of_the_axis_counts(tmp_path, points):
    file = ply(tmp_path / "c.ply", points @ UP["y"], "float")
    np.testing.assert_allclose(read(file, up="z")[0], points @ UP["y"], atol=1e-4)
    found, about = read(file, up="y")
    np.testing.assert_allclose(found, points, atol=1e-4)
    assert about.warnings == ("y of the file points up, as requested: x and y of the map are x and -z of it",)


def test_real_plots_stay_as_they_are(shared_data):
    for name in ("pine_plot", "LPine1_demo", "MLS_Clip"):
        about = open_cloud(str(shared_data / "forest" / f"{name}.laz")).description
        assert about.up.startswith("z")
        assert about.unit.startswith("metres")
        assert about.warnings == ()


@pytest.mark.slow
def test_feet_that_are_taken_as_metres_are_doubted(tmp_path, shared_data, capsys):
    np.save(tmp_path / "feet.npy", whole(shared_data / "forest" / "MLS_Clip.laz") / FT)
    mapped = ["map", str(tmp_path / "feet.npy"), "--as", "cloud", "--out", str(tmp_path / "out"), "--force"]
    main(mapped)
    told = capsys.readouterr()
    assert "may be feet" in told.err
    assert "--unit ft" in told.err
    assert "unit: metres, as the file names no unit; up: z, as usual" in told.out
    main([*mapped, "--unit", "ft"])
    told = capsys.readouterr()
    assert "may be feet" not in told.err
    assert "unit: feet, as requested" in told.out
    radii = [float(row["radius_m"]) for row in rows(tmp_path / "out" / "detections.csv") if row["radius_m"]]
    assert min(radii) >= 0.0


@pytest.mark.parametrize(
    ("dbh", "high", "north", "doubted"),
    [(0.3, 30.0, 1.39e7, True), (0.3, 120.0, 0.0, True), (0.5, 80.0, 0.0, False), (0.7, 45.0, 0.0, True),
     (np.nan, 40.0, 9.9e6, False)],
)  # fmt: skip
def test_only_numbers_that_are_hardly_metres_are_doubted(dbh, high, north, doubted):
    about = CloudDescription("c", "made", 9, np.array([0.0, north, 0.0]), "", "", unit=UNNAMED)
    above = np.linspace(0.0, high, 1000).astype(np.float32)
    assert bool(_unit_doubt(about, np.array([dbh]), above)) == doubted
    assert not _unit_doubt(replace(about, unit="metres, by the file"), np.array([dbh]), above)
