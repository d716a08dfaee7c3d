"""Opens the database durably and creates its tables, or checks their version."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from pipeline.errors import StemmapError

# Version of the tables, in the header of the file (PRAGMA user_version).
VERSION = 10


def _prepare_tables(connection: sa.Connection) -> None:
    """Create the tables of an empty database, or complete those of versions 8 and 9, and store VERSION.

    Raises:
        StemmapError: The tables are of another version or of another program.
    """
    version = int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())
    if version in (8, 9):  # annotations are work of people: columns that may be empty are added
        for column in ("reach FLOAT", "dbh_who VARCHAR(60)")[version - 8 :]:
            connection.exec_driver_sql(f"ALTER TABLE annotations ADD COLUMN {column}")
        connection.exec_driver_sql(f"PRAGMA user_version = {VERSION}")
        version = VERSION
    if not version and not sa.inspect(connection).get_table_names():
        metadata.create_all(connection)
        connection.exec_driver_sql(f"PRAGMA user_version = {VERSION}")
    elif version != VERSION:
        author = "a newer" if version > VERSION else "another program or an older"
        raise StemmapError(
            f"it was written by {author} stemmap (tables {version}, this one reads {VERSION})",
            remedy="Move the file away to start with an empty one",
        )


FILE_NAME = "annotations.sqlite"
_PATIENCE_MS = 5000


def open_engine(folder: Path | None) -> sa.Engine:
    """Return the engine of a database with current tables.

    Args:
        folder: Folder of the SQLite file, created if necessary; None keeps the database in memory.

    Raises:
        StemmapError: The folder cannot be used, or the database is damaged, of another version or of another
            program; it is not modified.
    """
    if folder is None:
        return _checked(_sqlite(":memory:"), "memory")
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise StemmapError(
            f"annotations cannot be stored: {(error.strerror or str(error)).lower()}",
            where=str(folder),
            remedy="Name another folder with STEMMAP_FOLDER",
        ) from None
    return _checked(_sqlite(str(path)), str(path))


def _sqlite(database: str) -> sa.Engine:
    """Return an engine with one connection to a SQLite file or ":memory:"; each transaction locks out other
    writers from its beginning."""
    # One connection, used by one thread at a time; an in-memory database exists as long as it.
    engine = sa.create_engine(
        "sqlite+pysqlite://",
        creator=lambda: sqlite3.connect(database, isolation_level=None, check_same_thread=False),
        poolclass=sa.StaticPool,
    )

    @sa.event.listens_for(engine, "connect")
    def _(connection: sqlite3.Connection, _record: Any) -> None:  # noqa: ANN401
        connection.execute(f"PRAGMA busy_timeout = {_PATIENCE_MS}")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")

    @sa.event.listens_for(engine, "begin")
    def _(connection: sa.Connection) -> None:
        # Writes depend on the reads before them: no other writer may come between.
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _checked(engine: sa.Engine, where: str) -> sa.Engine:
    """Check a database, create its tables if it is new, and return the engine; it is disposed of after an
    error.

    Args:
        engine: The engine.
        where: The database, for errors.

    Raises:
        StemmapError: The database is damaged, of another version or program, or cannot be read.
    """
    keep = "It was not changed: move it away to start with an empty one, or restore a copy"
    try:
        with engine.begin() as connection:
            result = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one()
            if result != "ok":
                raise StemmapError("the annotations are damaged", where=where, remedy=keep)
            _prepare_tables(connection)
        # Stored in the file, so it is set only once the database is known to be ours.
        with closing(engine.raw_connection()) as raw:
            raw.execute("PRAGMA journal_mode = WAL")
    except StemmapError as error:
        engine.dispose()
        if error.where:
            raise
        what = f"the annotations cannot be used: {error.what}"
        raise StemmapError(what, where=where, remedy=error.remedy or keep) from None
    except (SQLAlchemyError, sqlite3.Error) as error:
        engine.dispose()
        raise StemmapError(
            f"the annotations cannot be read: {reason_of(error)}", where=where, remedy=keep
        ) from None
    return engine


def reason_of(error: Exception) -> str:
    """Return the reason of a database error in one line of lower case, at most 300 characters."""
    return " ".join(str(getattr(error, "orig", None) or error).lower().split())[:300]


metadata = sa.MetaData()

# Sources: all runs of a recording share its annotations.
runs = sa.Table(
    "runs",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("source", sa.String(4200), nullable=False, comment="digest of what was recorded, else the URI"),
    sa.Column("uri", sa.String(4096), nullable=False),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("opened_ns", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("source"),
)

annotated = sa.Table(
    "annotations",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("run", sa.ForeignKey("runs.id"), nullable=False, index=True),
    sa.Column("x", sa.Float, nullable=False),
    sa.Column("y", sa.Float, nullable=False),
    sa.Column("kind", sa.String(10), nullable=False),
    sa.Column("dbh", sa.Float),
    sa.Column("plot", sa.JSON(none_as_null=True), comment="further values of a class"),
    sa.Column("reach", sa.Float, comment="[m], see Content"),
    sa.Column("who", sa.String(60), nullable=False),
    sa.Column("dbh_who", sa.String(60), comment="author of the DBH, see Annotation"),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("deleted", sa.Boolean, nullable=False),
    sa.Column(
        "made_by", sa.Integer, nullable=False, comment="the change that led to the current content; 0 none"
    ),
    sqlite_autoincrement=True,
)

steps = sa.Table(
    "steps",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("run", sa.ForeignKey("runs.id"), nullable=False),
    sa.Column("browser", sa.String(60), nullable=False),
    sa.Column("who", sa.String(60), nullable=False),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
    sa.Column(
        "state", sa.String(10), nullable=False, comment="done, undone, or left: no longer to be undone"
    ),
    sa.Index("steps_of_a_browser", "run", "browser", "state", "id"),
    sqlite_autoincrement=True,
)

changes = sa.Table(
    "changes",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("step", sa.ForeignKey("steps.id"), nullable=False, index=True),
    sa.Column("annotation", sa.ForeignKey("annotations.id"), nullable=False),
    sa.Column("before", sa.JSON(none_as_null=True)),
    sa.Column("after", sa.JSON(none_as_null=True)),
    sa.Column("made_before", sa.Integer, nullable=False, comment="the change that led to `before`"),
    sqlite_autoincrement=True,
)

parameter_sets = sa.Table(
    "parameter_sets",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("name", sa.String(60), nullable=False),
    sa.Column("toml", sa.Text, nullable=False, comment="the file that --config takes"),
    sa.Column("who", sa.String(60), nullable=False),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
    sa.UniqueConstraint("name"),
)

# Runs: one row for each time that a source was opened and mapped.
records = sa.Table(
    "run_records",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("run", sa.ForeignKey("runs.id"), nullable=False, index=True),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("uri", sa.String(4096), nullable=False),
    sa.Column("kind", sa.String(200), nullable=False),
    sa.Column("odometry", sa.String(4096), nullable=False),
    sa.Column("seed", sa.BigInteger, nullable=False),
    sa.Column(
        "chosen", sa.JSON(none_as_null=True), comment="topics and mounting, see SourceRequest.kept_choices"
    ),
    sa.Column("begun_ns", sa.BigInteger, nullable=False),
    sa.Column("changed_ns", sa.BigInteger, nullable=False),
    sa.Column("deleted_ns", sa.BigInteger),
    sa.Column(
        "scans", sa.Integer, nullable=False, comment="mapped; figures, parameters and map are of the last"
    ),
    sa.Column("all_scans", sa.Integer),
    sa.Column("time_s", sa.Float, nullable=False),
    sa.Column("distance_m", sa.Float, nullable=False),
    sa.Column("lost", sa.Float, comment="share of the scans, from 0 to 1"),
    sa.Column("trees", sa.Integer, nullable=False),
    sa.Column("preset", sa.String(100), nullable=False),
    sa.Column("parameters", sa.JSON(none_as_null=True), nullable=False),
    sa.Column("scores", sa.JSON(none_as_null=True)),
    sqlite_autoincrement=True,
)

# Separate from the records, so that their list is small.
maps = sa.Table(
    "run_maps",
    metadata,
    sa.Column("record", sa.ForeignKey("run_records.id"), primary_key=True),
    sa.Column("map", sa.JSON(none_as_null=True), nullable=False),
    sa.Column("files", sa.LargeBinary, comment="zip of its result files, from the end of the run"),
)

revisions = sa.Table(
    "parameter_revisions",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("record", sa.ForeignKey("run_records.id"), nullable=False, index=True),
    sa.Column("revision", sa.Integer, nullable=False),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
    sa.Column("time_s", sa.Float, nullable=False, comment="of the scan that stood in the run"),
    sa.Column("who", sa.String(60), nullable=False),
    sa.Column("preset", sa.String(100), nullable=False),
    sa.Column("changes", sa.JSON(none_as_null=True), nullable=False, comment="name: [before, after]"),
    sqlite_autoincrement=True,
)

uploads = sa.Table(
    "uploads",
    metadata,
    sa.Column("file", sa.String(100), primary_key=True, comment="name in the folder of uploads"),
    sa.Column("name", sa.String(200), nullable=False, comment="that it had where it came from"),
    sa.Column("kind", sa.String(200), nullable=False),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("at_ns", sa.BigInteger, nullable=False),
)
