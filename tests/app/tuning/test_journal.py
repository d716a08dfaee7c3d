"""The journal of a search: a full disk, a killed process and two processes at one trial do it no harm."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.training.learned_forests import Forests
from app.tuning.search import Search
from app.tuning.storage import Journal, _locked, cut_half_line
from pipeline.classification.forest import ALL_AROUND, FILE
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.app.tuning.test_search import plan

LINE = {"op_code": 0, "text": "x" * 300}


def entries(path: Path) -> list[object]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_disk_that_gets_full_is_told_and_leaves_no_part_of_a_line(tmp_path):
    resource = pytest.importorskip("resource")
    path = tmp_path / "a.journal"
    journal = Journal(str(path))
    journal.append_logs([LINE])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # What there is room for is a part of what is written.
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, before[1]))
    try:
        with pytest.raises(StemmapError, match="the trials cannot be kept"):
            journal.append_logs([LINE])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert entries(path) == [LINE]
    journal.append_logs([LINE])
    assert entries(path) == [LINE, LINE]


@pytest.mark.parametrize("half", ["", '{"op_code', "y" * 200_000])
def test_what_a_killed_process_wrote_in_part_is_cut_off_by_who_writes_next(tmp_path, half):
    path = tmp_path / "a.journal"
    journal, other = Journal(str(path)), Journal(str(path))
    journal.append_logs([LINE])
    with path.open("a") as file:
        file.write(half)
    other.append_logs([LINE, LINE])
    assert entries(path) == [LINE, LINE, LINE] == list(journal.read_logs(0))
    with path.open("a") as file:
        file.write(half)
    cut_half_line(path)
    assert entries(path) == [LINE, LINE, LINE]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]  # no lock is left


def test_a_journal_that_is_taken_away_is_told_in_a_line(tmp_path):
    path = tmp_path / "a.journal"
    journal = Journal(str(path))
    journal.append_logs([LINE])
    path.unlink()
    with pytest.raises(StemmapError, match="the trials cannot be read: no such file"):
        list(journal.read_logs(0))


def test_a_lock_that_somebody_took_away_does_not_hide_what_was_written(tmp_path):
    path = tmp_path / "a.journal"
    journal = Journal(str(path))
    with _locked(path):
        Path(f"{path}.lock").unlink()
    journal.append_logs([LINE])
    assert entries(path) == [LINE]


def test_a_file_of_one_half_line_is_empty_then(tmp_path):
    path = tmp_path / "a.journal"
    path.write_text("z" * 200_000)
    cut_half_line(path)
    assert not path.stat().st_size


def test_two_processes_that_take_over_one_trial_make_the_same_of_it(tmp_path):
    told = plan(tmp_path)
    one, other = Search(told), Search(told)
    try:
        one.begin()
        other.begin()
        asked = one.study.ask()
        for axis in told.axes:
            axis.suggest(asked)
        first = one._make(asked.number, asked.params)
        assert other._make(asked.number, asked.params) == first
        assert one.trials() == other.trials() == [first]
    finally:
        one.close()
        other.close()


def test_a_search_begins_with_decision_trees_that_were_learned(tmp_path, monkeypatch):
    data = json.loads(FILE.read_text(encoding="utf-8"))
    name = Forests(tmp_path).keep({**data, ALL_AROUND: data[ALL_AROUND][:20]})
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path))
    start = preset("forest").replace({"classification.forest": name})
    search = Search(plan(tmp_path, start=start.model_dump()))
    try:
        assert search.begin().loss is not None
    finally:
        search.close()
