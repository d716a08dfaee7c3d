"""The journal of a search: a full disk, a killed process and a second search do it no harm."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import pytest

from app.store.forests import Forests
from app.tuning.plan import RunScore, Trial
from app.tuning.search import Search
from app.tuning.trials import Journal
from pipeline.classification.forest import ALL_AROUND, FILE
from pipeline.config import preset
from pipeline.errors import StemmapError
from tests.app.tuning.inline_worker import InlineProcesses
from tests.app.tuning.test_search import plan

SEARCH = {"format": 2, "seed": 0}
TRIAL = Trial(-1, {"detection.e_max": 60.0}, 0.25, (RunScore(3, 1, 0, 0, 0, 0.1, None),))


def journal_of(path: Path) -> Journal:
    return Journal(path, SEARCH)


def test_a_disk_that_gets_full_is_reported_and_leaves_no_part_of_a_line(tmp_path):
    resource = pytest.importorskip("resource")
    path = tmp_path / "a.journal"
    with closing(journal_of(path)) as journal:
        first = journal.add(TRIAL)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        # What there is room for is a part of what is written.
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 50, before[1]))
        try:
            with pytest.raises(StemmapError, match="the trials cannot be kept"):
                journal.add(TRIAL)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with closing(journal_of(path)) as journal:
        assert journal.all == [first]


@pytest.mark.parametrize("half", ["", '{"number', "y" * 200_000])
def test_what_a_killed_process_wrote_in_part_is_cut_off(tmp_path, half):
    path = tmp_path / "a.journal"
    with closing(journal_of(path)) as journal:
        made = [journal.add(TRIAL)]
    with path.open("a") as file:
        file.write(half)
    with closing(journal_of(path)) as journal:
        made.append(journal.add(TRIAL))
    with closing(journal_of(path)) as journal:
        assert journal.all == made
        assert [trial.number for trial in journal.all] == [0, 1]


@pytest.mark.parametrize("length", [0, 5])
def test_a_process_that_was_killed_while_it_began_leaves_an_empty_journal(tmp_path, length):
    path = tmp_path / "a.journal"
    journal_of(path).close()
    whole = path.read_bytes()
    path.write_bytes(whole[:length])
    journal_of(path).close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize("line", ['{"number": 3}', '{"number": 5, "values": {}, "loss": 1.0}', "[", "\xff"])
def test_a_damaged_line_is_reported_and_nothing_is_changed(tmp_path, line):
    path = tmp_path / "a.journal"
    with closing(journal_of(path)) as journal:
        journal.add(TRIAL)
    path.write_bytes(path.read_bytes() + line.encode("latin-1") + b"\n")
    before = path.read_bytes()
    with pytest.raises(StemmapError, match="the journal is damaged"):
        journal_of(path)
    assert path.read_bytes() == before


def test_of_two_searches_only_one_writes_to_a_journal(tmp_path):
    path = tmp_path / "a.journal"
    with (
        closing(journal_of(path)),
        pytest.raises(StemmapError, match="another search writes to this journal"),
    ):
        journal_of(path)


def test_a_journal_in_a_folder_that_is_not_there_is_reported_in_a_line(tmp_path):
    with pytest.raises(StemmapError, match="the trials cannot be kept: no such file"):
        journal_of(tmp_path / "none" / "a.journal")


def test_a_search_begins_with_decision_trees_that_were_learned(tmp_path, monkeypatch):
    data = json.loads(FILE.read_text(encoding="utf-8"))
    name = Forests(tmp_path).keep({**data, ALL_AROUND: data[ALL_AROUND][:20]})
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path))
    start = preset("forest").replace({"classification.forest": name})
    search_plan = plan(tmp_path, start=start.model_dump())
    with closing(InlineProcesses()) as worker, closing(Search(search_plan, worker)) as search:
        search.advance()
        assert search.start is not None
