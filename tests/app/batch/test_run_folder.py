"""Partial outputs that killed runs left, and damaged files of runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.batch.run_folder import check_folder, read_run
from app.cli import main
from pipeline.errors import SourceError, StemmapError
from tests.app.batch.finished_runs import grid_run


def test_a_map_says_at_its_start_what_lies_in_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".unfinished-abc").mkdir()
    (tmp_path / ".unfinished-file").write_text("no folder")
    assert main(["map", "/nowhere.mcap", "--out", str(tmp_path)]) == 1
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert ".unfinished-abc is the partial output of a run that was killed" in first
    assert "unfinished" not in second


def test_measurements_of_people_without_a_run_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "by_people.csv").write_text("of_tree,x_m,y_m,dbh_tape_cm\n1,1,2,30\n")
    with pytest.raises(StemmapError, match=r"a file by_people\.csv that is not from a run"):
        check_folder(tmp_path, "00", force=False)


def test_a_cell_that_is_too_long_is_a_damaged_row(tmp_path: Path) -> None:
    folder = grid_run(tmp_path / "run")
    with (folder / "trees.csv").open("a") as file:
        file.write("1" * 140_000)
    with pytest.raises(SourceError, match="a row is damaged"):
        read_run(folder)


def test_a_seed_that_is_no_number_is_a_damaged_record(tmp_path: Path) -> None:
    folder = grid_run(tmp_path / "run")
    file = folder / "run.json"
    file.write_text(file.read_text().replace('"seed": 0', '"seed": Infinity'))
    with pytest.raises(SourceError, match=r"run\.json is damaged"):
        read_run(folder)
