"""A whole cloud in each command: inspected, driven through, mapped, scored, or refused with a reason."""

from __future__ import annotations

import asyncio
import csv
import json

import numpy as np
import pytest

from app.cli import main
from app.extension import VARIABLE
from app.extensions.clouds.point_cloud import open_cloud
from app.sources.opening import check_source
from app.sources.request import SourceRequest
from app.worker.process import open_any_or_one_step
from pipeline.errors import SourceError
from pipeline.io.readers import open_source
from pipeline.io.readers.base import SourceOptions
from tests.app.cli.test_commands import stemmap
from tests.pipeline.plots import PLACES, hill, plot, write_las

UTM = (470600.0, 3810200.0, 2278.0)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A plot with nine stems."""
    folder = tmp_path_factory.mktemp("cloud")
    points = plot(np.random.default_rng(1), slope=0.1, per_m2=900)
    return write_las(folder / "plot.laz", points, offset=UTM, crs="EPSG:26912")


@pytest.fixture(scope="module")
def mapped(cloud):
    """Its map."""
    folder = cloud.parent / "map"
    assert main(["map", str(cloud), "--out", str(folder)]) == 0
    return folder


def test_info_tells_what_is_in_a_cloud_and_what_to_do_with_it(cloud, capsys, monkeypatch):
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH", raising=False)
    told = stemmap(capsys, "info", cloud)
    assert (told.code, told.err) == (0, "")
    said = {line[:11].strip(): line[11:] for line in told.out.splitlines()}
    assert said["kind"].startswith("whole cloud, LAS 1.4 compressed")
    assert said["CRS"] == "NAD83 / UTM zone 12N (EPSG:26912)"
    assert said["extent"].startswith("15.0 x 15.0 m, ")
    assert "intensity" in said["attributes"]
    assert f"stemmap map {cloud} --out out" in told.out
    record = json.loads(stemmap(capsys, "info", cloud, "--json").out)
    assert record["points"] == int(said["points"].replace(",", ""))
    assert record["low_m"][:2] == pytest.approx(UTM[:2], abs=0.1)


@pytest.mark.slow
def test_a_robot_drives_through_a_cloud_that_is_opened_as_a_run(cloud):
    opened, named = open_source(str(cloud)), open_source(f"sim:cloud?file={cloud}")
    assert opened.description.kind.startswith("simulated drive through a whole cloud (LAS 1.4")
    assert opened.description.uri == str(cloud)
    assert opened.description.digest == named.description.digest
    truth = opened.truth()
    assert truth is not None
    assert truth.trees is None


def test_a_cloud_without_a_way_says_what_to_do_instead(tmp_path):
    wall = np.random.default_rng(3).uniform(0.0, 2.0, (60_000, 3))
    with pytest.raises(SourceError, match=r"no free way .* `stemmap map`"):
        open_source(str(write_las(tmp_path / "full.laz", wall)))


def test_the_ground_is_written_where_the_cloud_shows_it(mapped):
    with (mapped / "terrain.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    x, y, z = (np.array([float(row[name]) for row in rows]) for name in ("x_m", "y_m", "z_m"))
    assert 400 < len(rows) <= 31 * 31
    off = z - UTM[2] - hill(x - UTM[0], y - UTM[1], 0.1)
    assert np.percentile(np.abs(off), 90) < 0.15
    assert {(row["sigma_m"], row["views"]) for row in rows} == {("", "")}


def test_the_map_of_a_cloud_is_judged_as_a_whole(mapped, tmp_path, capsys):
    table = tmp_path / "stems.csv"
    rows = "".join(f"{x + UTM[0]},{y + UTM[1]},{200 * r}\n" for x, y, r in PLACES)
    table.write_text("x_m,y_m,dbh_cm\n" + rows)
    told = stemmap(capsys, "evaluate", mapped, "--truth", table)
    assert told.out.startswith("trees found (TA) 9/9 (100.0 %), missed (FR) 0/9 (0.0 %) in the whole plot\n")
    stemmap(capsys, "evaluate", mapped).refused(1, "--truth", "coordinates of its file")


def test_what_needs_a_drive_is_refused_for_a_cloud_in_its_own_words(mapped, cloud, tmp_path, capsys):
    stemmap(capsys, "export", mapped, "--out", tmp_path / "states").refused(1, "has no poses")
    words = ["map", cloud, "--out", tmp_path / "out", "--stop-after", "3"]
    stemmap(capsys, *words).refused(2, "--stop-after")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (OSError("the disk is gone"), "the disk is gone"),
        (MemoryError(), "memory"),
        (RuntimeError(), "RuntimeError"),
    ],
)
def test_why_a_cloud_cannot_be_opened_is_said(cloud, monkeypatch, error, says):
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr("app.extensions.clouds.las.open_las", fails)
    with pytest.raises(SourceError, match=says):
        open_cloud(str(cloud))


@pytest.mark.parametrize("command", ["map", "info"])
def test_a_cloud_is_refused_if_its_extension_is_switched_off(command, cloud, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    words = [command, cloud, *(["--out", tmp_path / "out"] if command == "map" else [])]
    said = f"The extension clouds is switched off by {VARIABLE}."
    stemmap(capsys, *words).refused(1, "a whole cloud needs an extension", said)
    assert not (tmp_path / "out").exists()
    for address in (str(cloud), f"sim:cloud?file={cloud}"):
        with pytest.raises(SourceError, match="a whole cloud needs an extension"):
            open_any_or_one_step(address, SourceOptions())
    with pytest.raises(SourceError, match="a whole cloud needs an extension"):
        asyncio.run(check_source(SourceRequest(str(cloud))))


def test_a_drive_through_a_cloud_is_simulated_as_a_recording(tmp_path, capsys):
    run = tmp_path / "run.mcap"
    stemmap(capsys, "simulate", "cloud", "--out", run).refused(
        2, "the cloud to be driven through is not named"
    )
    stemmap(capsys, "simulate", "cloud?file=none.laz", "--out", run).refused(1, "cannot open: No such file")
