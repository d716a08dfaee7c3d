"""A simulated robot in a real cloud: route, returns, ground truth, and refused requests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.common.settings import Settings
from app.extensions.clouds import cloud_drive
from app.extensions.clouds.cloud_drive import first_surfels, lay_surfels, open_drive
from app.extensions.clouds.drive_address import parse_drive
from app.web.routes.access import permitted_uri
from pipeline.errors import SourceError
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.simulation.lidar import SpinningLidar
from tests.pipeline.plots import PLACES, plot, stem, write_las


def open_source(uri: str, options: SourceOptions | None = None) -> SimulatedSource:
    return open_drive(uri, Path(), options or SourceOptions())


UTM = (470600.0, 3810200.0, 2278.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cloud")
    write_las(folder / "plot.laz", plot(np.random.default_rng(1), slope=0.1), offset=UTM)
    rows = "".join(f"{x + UTM[0]},{y + UTM[1]},{200 * r}\n" for x, y, r in PLACES)
    (folder / "stems.csv").write_text("x_m,y_m,dbh_cm\n" + rows)
    return folder


@pytest.fixture(scope="module")
def source(files):
    return open_source(f"sim:cloud?file={files / 'plot.laz'}&truth={files / 'stems.csv'}&odometry=exact")


def test_the_run_begins_at_the_origin_and_ahead(source):
    path = source.truth().path
    assert np.abs([path.x[0], path.y[0], path.yaw[0]]).max() < 1e-6


def test_a_loop_ends_where_it_began(source):
    path = source.truth().path
    assert np.hypot(path.x[-1], path.y[-1]) < 0.7, "the last scan begins within a second of the end"
    assert source.description.warnings == ()


@pytest.mark.slow
def test_a_loop_that_is_cut_short_says_so(files, monkeypatch):
    monkeypatch.setattr(cloud_drive, "LONGEST", 12.0)
    uri = f"sim:cloud?file={files / 'plot.laz'}"
    cut = open_source(uri).description
    assert cut.scans == 120
    (warning,) = cut.warnings
    assert "12 s are driven" in warning
    whole = int(warning.split("duration=")[1].split()[0])
    asked = open_source(f"{uri}&duration={whole}").description
    assert (asked.scans, asked.warnings) == (10 * whole, ())


def test_the_way_keeps_clear_of_the_stems_and_goes_around(source):
    path, trees = source.truth().path, source.truth().trees
    away = np.hypot(path.x[:, None] - trees.x, path.y[:, None] - trees.y) - 0.5 * trees.dbh
    assert away.min() > 0.2
    assert np.ptp(path.x) > 4.0
    assert np.ptp(path.y) > 4.0


def test_distances_between_stems_are_those_of_the_table(source):
    trees = source.truth().trees
    told = np.hypot(trees.x[:, None] - trees.x, trees.y[:, None] - trees.y)
    true = np.hypot(PLACES[:, None, 0] - PLACES[:, 0], PLACES[:, None, 1] - PLACES[:, 1])
    assert np.abs(told - true).max() < 1e-6
    assert trees.dbh == pytest.approx(2.0 * PLACES[:, 2])


def test_the_same_scan_comes_alone_and_in_order(source, files):
    again = open_source(f"sim:cloud?file={files / 'plot.laz'}&truth={files / 'stems.csv'}&odometry=exact")
    assert again.description.digest == source.description.digest
    assert np.array_equal(again.run.sweep(7).scan.points, source.run.sweep(7).scan.points)


def test_other_seeds_give_other_noise(source, files):
    other = open_source(f"sim:cloud?file={files / 'plot.laz'}&seed=1&odometry=exact")
    assert other.description.digest != source.description.digest
    a, b = other.run.sweep(0).scan.points, source.run.sweep(0).scan.points
    assert a.shape != b.shape or not np.array_equal(a, b)
    assert other.truth().trees is None


def test_beams_meet_a_trunk_where_it_is_and_not_its_far_side():
    rng = np.random.default_rng(2)
    trunk = stem(5.0, 0.0, 0.15, rng, taper=0.0, sigma=0.002, per_m2=2500) - np.array([0.0, 0.0, 2.0])
    s = lay_surfels(trunk.astype(np.float32))
    lidar = SpinningLidar()
    R, o = np.broadcast_to(np.eye(3), (lidar.columns, 3, 3)).copy(), np.zeros((lidar.columns, 3))
    beams = lidar.beams()
    ranges = first_surfels(s, R, o, beams, lidar.optics)
    met = np.isfinite(ranges)
    place = beams[met] * ranges[met][:, None]
    off = np.hypot(place[:, 0] - 5.0, place[:, 1]) - 0.15
    assert met.sum() > 100
    assert np.abs(np.median(off)) < 0.005
    assert np.abs(off).max() < 0.03
    assert place[:, 0].max() < 5.06, "nothing of the far side"


def test_the_side_of_a_sparse_trunk_is_no_wall():
    """Points 4 cm apart on one side of a trunk look as flat as ground: discs as wide would stand out."""
    angle, height = np.meshgrid(np.arange(-0.6, 0.61, 0.3), np.arange(0.0, 2.0, 0.04))
    x, y = 5.0 - 0.14 * np.cos(angle.ravel()), 0.14 * np.sin(angle.ravel())
    s = lay_surfels(np.column_stack([x, y, height.ravel()]).astype(np.float32))
    assert s.radius.max() < 0.03
    level = np.column_stack([angle.ravel(), height.ravel(), np.zeros(angle.size)])
    assert lay_surfels((level * [0.13, 1.0, 1.0]).astype(np.float32)).radius.max() > 0.03, "ground is closed"


@pytest.mark.parametrize(
    ("uri", "why"),
    [
        ("sim:cloud", "not named"),
        ("sim:cloud?file=a.laz&trees=3", "no option"),
        ("sim:cloud?file=a.laz&sigma=9", "does not fit"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(uri, why):
    with pytest.raises(SourceError, match=why):
        parse_drive(uri)


def test_a_missing_or_broken_cloud_is_one_line(files):
    (files / "broken.laz").write_bytes(b"LASF and nothing")
    for name in ("nothing.laz", "broken.laz", "stems.csv"):
        with pytest.raises(SourceError) as told:
            open_source(f"sim:cloud?file={files / name}")
        assert "\n" not in str(told.value)


def test_a_cloud_without_a_free_way_is_refused(files):
    rng = np.random.default_rng(3)
    wall = rng.uniform(0.0, 2.0, (60_000, 3))
    write_las(files / "full.laz", wall)
    with pytest.raises(SourceError, match="no free way"):
        open_source(f"sim:cloud?file={files / 'full.laz'}")


def test_from_another_machine_a_cloud_is_read_only_from_the_folder_of_recordings(files, tmp_path):
    far = replace(Settings(), host="0.0.0.0", recordings=files)  # noqa: S104
    assert permitted_uri(f"sim:cloud?file={files / 'plot.laz'}", far, any_file=False) is not None
    assert permitted_uri("sim:stand", far, any_file=False) == "sim:stand"
    assert permitted_uri(f"sim:cloud?file={tmp_path / 'other.laz'}", far, any_file=False) is None
    inside = f"file={files / 'plot.laz'}"
    assert permitted_uri(f"sim:cloud?{inside}&truth=/etc/passwd", far, any_file=False) is None
    assert permitted_uri(f"sim:cloud?{inside}/../../other.laz", far, any_file=False) is None
    for again in ("sim:", "sim:sim:", "sim:file://"):
        assert permitted_uri(f"sim:cloud?file={again}{tmp_path / 'other.laz'}", far, any_file=False) is None
    assert permitted_uri("sim:cloud?file=/etc/passwd", replace(far, recordings=None), any_file=False) is None
