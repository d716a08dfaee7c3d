"""Saved sets in the store."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.store.records import MOST_SETS, SavedSet, UnknownError
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
