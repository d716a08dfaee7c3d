"""The same store on a real PostgreSQL server, started for these tests where the machine has one."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from app.store.book import Beginning, Change, Standing
from app.store.records import Author, Content, StaleError
from app.store.store import Store
from pipeline.errors import StemmapError

ANN, BOB = Author("a" * 16, "Ann"), Author("b" * 16, "Bob")


def _as_somebody() -> tuple[list[str], tuple[int, int] | None]:
    """How to run a program that refuses root, and whose files it writes then."""
    if os.name != "posix" or os.geteuid() != 0:
        return [], None
    import pwd

    try:
        person = pwd.getpwnam("postgres")
    except KeyError:
        pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
    if shutil.which("setpriv") is None:
        pytest.skip("PostgreSQL does not run as root, and there is no setpriv")
    ids = ["--reuid", str(person.pw_uid), "--regid", str(person.pw_gid), "--clear-groups"]
    return ["setpriv", *ids], (person.pw_uid, person.pw_gid)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of an empty database of a server of our own; it listens on a socket in a folder alone."""
    if given := os.environ.get("STEMMAP_TEST_DATABASE"):
        yield given
        return
    pytest.importorskip("psycopg", reason="the driver of PostgreSQL is not installed")
    initdb, pg_ctl = shutil.which("initdb"), shutil.which("pg_ctl")
    if initdb is None or pg_ctl is None:
        pytest.skip("there is no PostgreSQL server on this machine")
    prefix, owner = _as_somebody()
    # The path of a socket may not be long.
    folder = Path(f"/tmp/stemmap-{os.getpid()}")  # noqa: S108 - made here, and it must not be there before
    folder.mkdir(mode=0o700)
    try:
        if owner is not None:
            os.chown(folder, *owner)
        data = folder / "data"

        def run(*words: str) -> None:
            told = subprocess.run(
                [*prefix, *words], cwd=folder, capture_output=True, text=True, timeout=120, check=False
            )
            assert told.returncode == 0, told.stderr

        run(initdb, "-D", str(data), "-U", "stemmap", "-A", "trust", "--no-sync", "-E", "UTF8", "--locale=C")
        options = f"-c listen_addresses='' -k {folder} -F"
        run(pg_ctl, "-D", str(data), "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql://stemmap@/postgres?host={folder}"
        finally:
            run(pg_ctl, "-D", str(data), "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder)


@pytest.fixture
def store(server: str) -> Iterator[Store]:
    engine = create_engine(server.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))
        connection.execute(text("CREATE SCHEMA public"))
    engine.dispose()
    with contextlib.closing(Store(None, database=server)) as opened:
        yield opened


STANDING = Standing(
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
    record = store.book.begin(Beginning(run, "north", "run.mcap", "rosbag2", "auto", 2**63 - 1), STANDING)
    store.book.revise(record, Change(1, 0.2, "Ann", "forest", {"clustering.eps": [0.15, 0.2]}))
    store.book.revise(record, Change(2, 0.2, "Ann", "forest", {"clustering.eps": [0.2, 0.3]}))
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
