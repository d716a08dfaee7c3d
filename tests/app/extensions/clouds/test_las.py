"""LAS and LAZ files: read in parts; damaged files give one clear error."""

from __future__ import annotations

import json
import os
import struct
from contextlib import suppress
from pathlib import Path

import laspy
import numpy as np
import pytest

from app.cli import main
from app.extensions.clouds.point_cloud import open_cloud
from app.extensions.clouds.sources import takes as is_cloud
from pipeline.errors import SourceError
from pipeline.io.readers.point_files import MISSING
from tests.pipeline.plots import PLACES, plot, write_las

UTM = (470600.0, 3810200.0, 2278.0)
DATA = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "../shared/data"))


@pytest.fixture(scope="module")
def points():
    return plot(np.random.default_rng(1), per_m2=800)


@pytest.mark.parametrize("name", ["plot.las", "plot.laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_points_are_read_less_an_offset_that_is_kept(tmp_path, points, name, version):
    file = write_las(tmp_path / name, points, offset=UTM, version=version)
    cloud = open_cloud(str(file))
    assert is_cloud(str(file))
    assert cloud.description.points == len(points)
    read = np.concatenate(list(cloud.parts()))
    assert read.dtype == np.float32
    assert np.abs(read + cloud.description.offset - (points + UTM)).max() < 0.0012
    assert not cloud.losses


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("crs", ["EPSG:32611", None])
def test_a_cloud_is_mapped_into_the_files_of_a_run(tmp_path, points, crs, capsys):
    file = write_las(tmp_path / "plot.laz", points, offset=UTM, crs=crs)
    (tmp_path / "truth.csv").write_text(
        "x_m,y_m,dbh_cm\n" + "".join(f"{x + UTM[0]},{y + UTM[1]},{200 * r}\n" for x, y, r in PLACES)
    )
    out = tmp_path / "out"
    assert main(["map", str(file), "--out", str(out), "--truth", str(tmp_path / "truth.csv")]) == 0
    assert "(TA) 9/9" in capsys.readouterr().out
    assert main(["evaluate", str(out), "--truth", str(tmp_path / "truth.csv")]) == 0
    assert "(TA) 9/9" in capsys.readouterr().out
    names = {
        "trees.csv",
        "trees.geojson",
        "detections.csv",
        "slices.csv",
        "path.csv",
        "terrain.csv",
        "run.json",
        "seen.csv",
    }
    assert {path.name for path in out.iterdir()} == names
    assert (out / "path.csv").read_text().count("\n") == 1
    trees = json.loads((out / "trees.geojson").read_text())
    place = np.array([feature["geometry"]["coordinates"] for feature in trees["features"]])
    if crs is None:
        assert trees["coordinateFrame"]["origin"] == "that of the cloud"
        assert np.abs(place - (PLACES[:, :2] + UTM[:2]).mean(axis=0)).max() < 10.0
    else:
        import pyproj

        back = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(*place.T)
        away = np.hypot(
            back[0][:, None] - PLACES[:, 0] - UTM[0], back[1][:, None] - PLACES[:, 1] - UTM[1]
        ).min(axis=0)
        assert "coordinateFrame" not in trees
        assert away.max() < 0.05


@pytest.mark.slow
def test_the_same_cloud_gives_the_same_bytes(tmp_path, points):
    file = write_las(tmp_path / "plot.laz", points)
    for name in ("a", "b"):
        assert main(["map", str(file), "--out", str(tmp_path / name)]) == 0
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def damage(content: bytes, at: int, new: bytes) -> bytes:
    """With some bytes changed."""
    return content[:at] + new + content[at + len(new) :]


@pytest.mark.parametrize(
    ("at", "new"),
    [
        (96, struct.pack("<I", 1 << 31)),  # where the points begin
        (100, struct.pack("<I", 1 << 31)),  # how many records before
        (105, struct.pack("<H", 65535)),  # bytes of a point
        (105, struct.pack("<H", 1)),
        (247, struct.pack("<Q", 1 << 62)),  # how many points
        (131, struct.pack("<d", float("nan"))),  # scale of x
        (155, struct.pack("<d", 1e300)),  # offset of x
    ],
)
@pytest.mark.parametrize("name", ["plot.las", "plot.laz"])
def test_a_header_that_lies_is_one_line_and_takes_no_memory(tmp_path, points, name, at, new, capsys):
    file = write_las(tmp_path / name, points[:5000])
    file.write_bytes(damage(file.read_bytes(), at, new))
    status = main(["map", str(file), "--out", str(tmp_path / "out")])
    told = capsys.readouterr().err
    assert status in (1, 3)
    assert "Traceback" not in told
    if status == 1:
        assert told.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_items_longer_than_a_point_are_refused_before_the_decoder_takes_memory_for_them(tmp_path, points):
    file = write_las(tmp_path / "plot.laz", points[:5000])
    content = file.read_bytes()
    items = content.index(b"laszip encoded") + 52 + 34  # each: kind, length, version
    assert struct.unpack_from("<HHH", content, items)[:2] in ((6, 20), (10, 30))
    file.write_bytes(damage(content, items + 2, struct.pack("<H", 65535)))
    with pytest.raises(SourceError, match="contradicts itself"):
        open_cloud(str(file))


def test_a_chunk_with_layers_longer_than_itself_ends_the_points_before_the_decoder_takes_memory(
    tmp_path, points
):
    many = np.tile(points[:10_000], (12, 1))
    file = write_las(tmp_path / "plot.laz", many, version="1.4")  # chunks of 50,000 points
    content = file.read_bytes()
    (first,) = struct.unpack_from("<I", content, 96)
    (length,) = struct.unpack_from("<H", content, 105)
    layers = first + 8 + length + 4
    sizes = np.frombuffer(content, "<u4", 9, layers)
    second = layers + 36 + int(sizes.sum()) + length + 4
    huge = struct.pack("<I", 4_000_000_000)
    file.write_bytes(damage(content, second, huge))
    cloud = open_cloud(str(file))
    assert sum(map(len, cloud.parts())) == 50_000
    assert cloud.losses == {MISSING: 70_000}
    file.write_bytes(damage(content, layers, huge))
    with pytest.raises(SourceError, match="the first chunk of the LAS file is damaged"):
        open_cloud(str(file))


@pytest.mark.parametrize("name", ["plot.las", "plot.laz"])
def test_a_file_cut_off_or_scrambled_never_crashes(tmp_path, points, name):
    whole = write_las(tmp_path / name, points[:20_000]).read_bytes()
    rng = np.random.default_rng(5)
    file = tmp_path / f"damaged{name[4:]}"
    for k in range(40):
        content = bytearray(whole[: int(rng.integers(1, len(whole)))] if k % 2 else whole)
        for at in rng.integers(0, len(content), 12):
            content[at] = int(rng.integers(0, 256))
        file.write_bytes(bytes(content))
        with suppress(SourceError):
            assert sum(len(part) for part in open_cloud(str(file)).parts()) <= 20_000


def test_an_uncompressed_file_that_is_cut_gives_what_is_there(tmp_path, points):
    file = write_las(tmp_path / "plot.las", points[:20_000])
    file.write_bytes(file.read_bytes()[: 375 + 30 * 10_000 + 7])
    cloud = open_cloud(str(file))
    assert sum(len(part) for part in cloud.parts()) == 10_000
    assert cloud.losses == {"points that the files promise but do not hold": 10_000}


def test_points_that_the_file_withholds_are_left_out_and_counted(tmp_path, points):
    file = write_las(tmp_path / "plot.las", points[:1000])
    las = laspy.read(file)
    las.withheld = np.arange(1000) % 10 == 0
    las.write(file)
    cloud = open_cloud(str(file))
    assert sum(map(len, cloud.parts())) == 900
    assert cloud.losses == {"points that have no coordinates, or that the file withholds": 100}


def test_a_file_that_is_not_there_or_is_something_else(tmp_path, capsys):
    (tmp_path / "text.laz").write_text("no points")
    for name in ("text.laz", "nothing.laz"):
        assert main(["map", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 1
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "forest" / "pine_plot.laz").exists(), reason="there is no real data")
def test_real_plots(tmp_path, capsys):
    truth = DATA / "forest" / "pine_plot_stems.csv"
    file = DATA / "forest" / "pine_plot.laz"
    assert main(["map", str(file), "--out", str(tmp_path / "pine"), "--truth", str(truth)]) == 0
    told = json.loads((tmp_path / "pine" / "run.json").read_text())["evaluation"]
    assert told["TA"]["count"] >= 15
    assert told["spurious"] <= 1
    assert told["position_rmse"] < 0.05
    assert told["dbh_rmse"] < 0.02
    assert main(["map", str(DATA / "forest" / "MLS_Clip.laz"), "--out", str(tmp_path / "mls")]) == 0
    assert 20 <= json.loads((tmp_path / "mls" / "run.json").read_text())["trees"] <= 35
