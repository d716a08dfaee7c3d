"""Databases of older versions become those of this one, and nothing in them is lost."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import String, create_engine, insert

from app.store import database as migrating
from app.store import tables
from app.store.database import FILE_NAME
from app.store.records import Author, Content
from app.store.store import Store
from pipeline.errors import StemmapError

ANN = Author("a" * 16, "Ann")

# The tables as the first version made them, with a run and an annotation.
FIRST = """
CREATE TABLE schema_version (version INTEGER NOT NULL);
INSERT INTO schema_version VALUES (1);
CREATE TABLE runs (id INTEGER NOT NULL, source VARCHAR(4200) NOT NULL, uri VARCHAR(4096) NOT NULL,
  name VARCHAR(200) NOT NULL, opened_ns BIGINT NOT NULL, PRIMARY KEY (id), UNIQUE (source));
CREATE TABLE annotations (id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, run INTEGER NOT NULL,
  x FLOAT NOT NULL, y FLOAT NOT NULL,
  kind VARCHAR(10) NOT NULL, dbh FLOAT, who VARCHAR(60) NOT NULL, at_ns BIGINT NOT NULL,
  version INTEGER NOT NULL, deleted BOOLEAN NOT NULL, made_by INTEGER NOT NULL,
  FOREIGN KEY(run) REFERENCES runs (id));
CREATE INDEX ix_annotations_run ON annotations (run);
CREATE TABLE steps (id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, run INTEGER NOT NULL,
  browser VARCHAR(60) NOT NULL, who VARCHAR(60) NOT NULL, at_ns BIGINT NOT NULL, state VARCHAR(10) NOT NULL,
  FOREIGN KEY(run) REFERENCES runs (id));
CREATE INDEX steps_of_a_browser ON steps (run, browser, state, id);
CREATE TABLE changes (id INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, step INTEGER NOT NULL,
  annotation INTEGER NOT NULL, before JSON, after JSON, made_before INTEGER NOT NULL,
  FOREIGN KEY(step) REFERENCES steps (id), FOREIGN KEY(annotation) REFERENCES annotations (id));
CREATE INDEX ix_changes_step ON changes (step);
INSERT INTO runs VALUES (1, 'digest', 'run.mcap', 'run.mcap', 5);
INSERT INTO annotations VALUES (1, 1, 2.5, 3.5, 'pole', NULL, 'Ann', 7, 1, 0, 0);
"""


SECOND = """
UPDATE schema_version SET version = 2;
CREATE TABLE parameter_sets (id INTEGER NOT NULL, name VARCHAR(60) NOT NULL, toml TEXT NOT NULL,
  who VARCHAR(60) NOT NULL, at_ns BIGINT NOT NULL, PRIMARY KEY (id), UNIQUE (name));
"""


def older_version(folder: Path, statements: str = FIRST) -> None:
    with contextlib.closing(sqlite3.connect(folder / FILE_NAME)) as connection:
        connection.executescript(statements)


@pytest.mark.parametrize("statements", [FIRST, FIRST + SECOND], ids=["first", "second"])
def test_an_older_version_keeps_its_annotations(tmp_path: Path, statements: str):
    older_version(tmp_path, statements)
    for _ in range(2):  # and once more, when it is of this version already
        with contextlib.closing(Store(tmp_path)) as store:
            assert store.open_run("digest", "moved.mcap", "moved.mcap") == 1
            (row,) = store.annotations(1)
            assert (row.content, row.who, row.at_ns) == (Content(2.5, 3.5, "pole"), "Ann", 7)
            assert store.book.listed() == []
            store.sets.save("mine", "x", "Ann")
            assert [row.name for row in store.sets.all()] == ["mine"]
    with contextlib.closing(Store(tmp_path)) as store:
        store.change(1, ANN, 1, 1, Content(2.5, 4.0, "pole"))
        assert store.annotations(1)[0].version == 2


def differs(*of: Any) -> bool | None:
    """Whether two columns' types differ; of texts SQLite asks no length. None leaves it to alembic."""
    *_, inspected, declared = of
    return False if isinstance(inspected, String) and isinstance(declared, String) else None


def test_runs_that_others_refer_to_outlive_every_later_migration(tmp_path: Path):
    engine = create_engine(f"sqlite:///{tmp_path / FILE_NAME}")
    now = {"begun_ns": 1, "changed_ns": 2, "scans": 3, "time_s": 4.0, "distance_m": 5.0, "trees": 6}
    with engine.begin() as connection:
        migrating.upgrade(connection, "0003")
        connection.execute(insert(tables.runs).values(id=1, source="d", uri="a", name="a", opened_ns=1))
        record = {"id": 1, "run": 1, "name": "a", "uri": "a", "kind": "k", "odometry": "auto", "seed": 0}
        values = {"preset": "forest", "parameters": {"detection.e_max": 9.0}}
        connection.execute(insert(tables.records).values(**record, **now, **values))
        connection.execute(insert(tables.maps).values(record=1, map={"trees": []}))
    engine.dispose()
    for _ in range(2):
        with contextlib.closing(Store(tmp_path)) as store:
            (listed,) = store.book.listed()
            assert (listed["trees"], listed["name"]) == (6, "a")


def test_the_migrations_lead_to_the_tables_as_they_are_declared():
    engine = create_engine("sqlite://")
    with engine.begin() as connection:
        migrating.upgrade(connection)
        context = MigrationContext.configure(connection, opts={"compare_type": differs})
        assert compare_metadata(context, tables.metadata) == []
    engine.dispose()


def test_the_revisions_are_those_of_the_folder():
    config = Config()
    config.set_main_option("script_location", str(Path(migrating.__file__).parent / "migrations"))
    found = [script.revision for script in ScriptDirectory.from_config(config).walk_revisions()]
    assert tuple(reversed(found)) == migrating.REVISIONS


def test_a_migration_that_fails_leaves_the_database_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    older_version(tmp_path)

    def fails(*_arguments: object) -> None:
        raise StemmapError("no more")

    monkeypatch.setattr(migrating, "upgrade", fails)
    with pytest.raises(StemmapError, match="no more"):
        Store(tmp_path)
    monkeypatch.undo()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE_NAME)) as connection:
        assert connection.execute("SELECT version FROM schema_version").fetchall() == [(1,)]
    with contextlib.closing(Store(tmp_path)) as store:
        assert len(store.annotations(1)) == 1
