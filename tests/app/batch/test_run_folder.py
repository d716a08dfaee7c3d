"""Halves of maps that killed runs left: found in the data folders only, and taken away on request."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from app.batch import run_folder
from app.common.settings import Settings
from app.store.records import UnknownError
from pipeline.errors import StemmapError
from pipeline.io.result_files import RunFiles
from tests.app.server_for_tests import BEARER, running

LONG_AGO_S = 1_000_000.0
NOW_S = LONG_AGO_S + run_folder.QUIET_S + 1.0


def half_a_map(folder: Path, content: str = "scan,x_m\n") -> Path:
    """As a killed `stemmap map` leaves it, long ago."""
    left = folder / ".unfinished-abc"
    left.mkdir(parents=True)
    (left / "detections.csv").write_text(content)
    for path in (left / "detections.csv", left):
        os.utime(path, (LONG_AGO_S, LONG_AGO_S))
    return left


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    (tmp_path / "data").mkdir()
    return Settings(recordings=tmp_path / "data", folder=tmp_path / "kept")


def test_halves_are_found_where_runs_and_exports_are_written(settings: Settings) -> None:
    assert settings.recordings is not None
    assert run_folder.partial_outputs(settings) == []
    half_a_map(settings.recordings)
    half_a_map(settings.recordings / "north")
    half_a_map(settings.recordings / "north" / "deeper")  # no data folder of ours
    (settings.recordings / "north" / ".unfinished-file").write_text("no folder")
    found = run_folder.partial_outputs(settings, NOW_S)
    assert {each.name for each in found} == {".unfinished-abc", "north/.unfinished-abc"}
    assert [(each.size, each.changed_s, each.quiet) for each in found] == [(9, int(LONG_AGO_S), True)] * 2


def test_what_is_deleted_is_a_half_map_and_nothing_else(settings: Settings, tmp_path: Path) -> None:
    assert settings.recordings is not None
    left = half_a_map(settings.recordings / "north")
    whole = settings.recordings / "north" / "run.json"
    whole.write_text("{}")
    outside = half_a_map(tmp_path / "outside")
    (settings.recordings / "link").symlink_to(outside.parent)
    (settings.recordings / ".unfinished-link").symlink_to(outside)
    for name in ("north", "", "../outside/.unfinished-abc", "link/.unfinished-abc", ".unfinished-link"):
        with pytest.raises(UnknownError):
            run_folder.delete_partial_output(name, settings, NOW_S)
    run_folder.delete_partial_output("north/.unfinished-abc", settings, NOW_S)
    assert not left.exists()
    assert whole.exists()
    assert (outside / "detections.csv").exists()


def test_one_that_may_go_on_is_left_alone(settings: Settings) -> None:
    assert settings.recordings is not None
    left = half_a_map(settings.recordings)
    with pytest.raises(StemmapError, match="ten minutes"):
        run_folder.delete_partial_output(left.name, settings, LONG_AGO_S + 1.0)
    assert left.exists()


async def test_the_page_of_runs_tells_of_it_and_deletes_it(settings: Settings) -> None:
    assert settings.recordings is not None
    left = half_a_map(settings.recordings / "north")
    async with running(settings) as (client, _):
        told = (await client.get("/api/runs", headers=BEARER)).json()["unfinished"]
        assert [(each["name"], each["quiet"]) for each in told] == [("north/.unfinished-abc", True)]
        unknown = await client.delete("/api/runs/unfinished?name=north", headers=BEARER)
        assert unknown.status_code == 404
        gone = await client.delete("/api/runs/unfinished?name=north/.unfinished-abc", headers=BEARER)
        assert gone.status_code == 200
        assert (await client.get("/api/runs", headers=BEARER)).json()["unfinished"] == []
    assert not left.exists()


def test_a_map_says_at_its_start_what_lies_in_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from app.cli import main

    half_a_map(tmp_path)
    assert main(["map", "/nowhere.mcap", "--out", str(tmp_path)]) == 1
    first = capsys.readouterr().err.splitlines()[0]
    assert ".unfinished-abc is the partial output of a run that was killed" in first


def test_a_map_that_is_still_written_is_not_taken_away_however_silent_it_is(settings: Settings) -> None:
    """A robot that says nothing for an hour, or a laptop that slept."""
    assert settings.recordings is not None
    files = RunFiles(settings.recordings / "north")
    (left,) = (settings.recordings / "north").glob(".unfinished-*")
    for path in (left / "detections.csv", left):
        os.utime(path, (LONG_AGO_S, LONG_AGO_S))
    name = f"north/{left.name}"
    assert [each.quiet for each in run_folder.partial_outputs(settings, NOW_S)] == [False]
    with pytest.raises(StemmapError, match="a stemmap process writes to it"):
        run_folder.delete_partial_output(name, settings, NOW_S)
    assert left.is_dir()
    files._detections.close()  # as when the process ends
    run_folder.delete_partial_output(name, settings, NOW_S)
    assert not left.exists()
