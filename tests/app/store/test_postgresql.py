"""The same store on a real PostgreSQL server, started for these tests where the machine has one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.sources.request import SourceRequest
from app.store.records import Author, Change, Content, NewRun, RunFigures, StaleError
from app.store.store import Store
from pipeline.errors import StemmapError
from tests.postgresql import empty, running

ANN, BOB = Author("a" * 16, "Ann"), Author("b" * 16, "Bob")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running() as address:
        yield address


@pytest.fixture
def store(server: str) -> Iterator[Store]:
    empty(server, "public")
    with contextlib.closing(Store(None, database=server)) as opened:
        yield opened


STANDING = RunFigures(
    3, None, 0.2, 1.5, 1, "forest", {"clustering.eps": 0.15}, {"f1": 1.0}, {"trees": [], "path": []}
)


def test_annotations_are_kept_and_stale_edits_refused(store: Store, server: str):
    run = store.open_run("d", "u", "n")
    (id_,) = store.add(run, ANN, [Content(0.0, 0.0)])
    with contextlib.closing(Store(None, database=server)) as other:
        assert other.open_run("d", "u", "n") == run
        other.change(run, BOB, id_, 1, Content(1.0, 0.0))
        with pytest.raises(StaleError, match="changed by Bob"):
            store.change(run, ANN, id_, 1, Content(2.0, 0.0))
        other.undo(run, BOB)
        assert store.annotations(run)[0].content == Content(0.0, 0.0)
        other.redo(run, BOB)
    assert store.annotations(run)[0].content == Content(1.0, 0.0)
    assert store.open_run("x" * 4096, "u", "n") == store.open_run("x" * 4096, "u", "n") != run


def test_runs_are_written_renamed_deleted_and_brought_back(store: Store):
    run = store.open_run("d", "u", "n")
    record = store.book.begin(
        NewRun(run, "north", "rosbag2", SourceRequest("run.mcap", "auto", 2**63 - 1)), STANDING
    )
    store.book.revise_all(record, [Change(1, 0.2, "Ann", "forest", {"clustering.eps": [0.15, 0.2]})])
    store.book.revise_all(record, [Change(2, 0.2, "Ann", "forest", {"clustering.eps": [0.2, 0.3]})])
    store.book.rename(record, "north stand")
    whole = store.book.whole(record)
    assert (whole["name"], whole["seed"], whole["map"]) == (
        "north stand",
        2**63 - 1,
        {"trees": [], "path": []},
    )
    assert [each["changes"] for each in whole["revisions"]] == [{"clustering.eps": [0.15, 0.3]}]
    store.book.delete(record)
    assert store.book.listed() == []
    store.book.bring_back(record)
    assert [row["id"] for row in store.book.listed()] == [record]
    store.book.add_upload("up.mcap", "mine.mcap", "rosbag2", 10**12)
    assert store.book.uploads()["up.mcap"]["bytes"] == 10**12


def test_a_server_that_is_not_there_is_said_without_the_password(tmp_path: Path):
    pytest.importorskip("psycopg", reason="the driver of PostgreSQL is not installed")
    with pytest.raises(StemmapError) as refusal:
        Store(None, database=f"postgresql://ann:secret@/stand?host={tmp_path}")
    assert "secret" not in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("address", ["mysql://a@b/c", "nonsense", "postgresql+asyncpg://a@b/c", "://"])
def test_an_address_that_is_none_of_postgresql_is_refused(address: str):
    with pytest.raises(StemmapError, match="postgresql://name@host/database"):
        Store(None, database=address)
