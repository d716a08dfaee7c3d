"""Saved sets in the store, and a database of an older version that gets room for them."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from app.store.opening import FILE_NAME
from app.store.records import MOST_SETS, Author, Content, SavedSet, UnknownError
from app.store.store import Store
from pipeline.errors import StemmapError


def test_sets_are_kept_by_name(tmp_path: Path):
    store = Store(tmp_path, lambda: 7)
    store.sets.save("b", "[slam]\n", "Ann")
    store.sets.save("a", "x", "Bob")
    store.sets.save("b", "y", "Cid")
    store.close()
    again = Store(tmp_path)
    assert again.sets.all() == [SavedSet("a", "x", "Bob", 7), SavedSet("b", "y", "Cid", 7)]
    again.sets.delete("a")
    with pytest.raises(UnknownError, match="a"):
        again.sets.delete("a")
    again.close()


def test_there_is_an_end_of_them_and_the_others_stay():
    store = Store(None)
    for number in range(MOST_SETS):
        store.sets.save(f"set {number}", "", "Ann")
    store.sets.save("set 0", "changed", "Ann")
    with pytest.raises(StemmapError, match="Delete some"):
        store.sets.save("one more", "", "Ann")
    assert len(store.sets.all()) == MOST_SETS


def test_a_database_of_the_first_version_keeps_its_annotations(tmp_path: Path):
    store = Store(tmp_path)
    run = store.open_run("digest", "run.mcap", "run.mcap")
    store.add(run, Author("a" * 16, "Ann"), [Content(1.0, 2.0)])
    store.close()
    with sqlite3.connect(tmp_path / FILE_NAME) as connection:  # as the first version made it
        connection.execute("DROP TABLE parameter_sets")
        connection.execute("UPDATE schema_version SET version = 1")
    connection.close()
    again = Store(tmp_path)
    again.sets.save("mine", "x", "Ann")
    assert [row.content for row in again.annotations(run)] == [Content(1.0, 2.0)]
    assert len(again.sets.all()) == 1
    again.close()
