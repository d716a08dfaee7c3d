"""Opens the database durably, creates its tables and migrates those of older versions."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    Column,
    Connection,
    Engine,
    MetaData,
    StaticPool,
    String,
    Table,
    create_engine,
    event,
    insert,
    inspect,
    make_url,
    select,
)
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from app.store.tables import metadata
from pipeline.errors import StemmapError

# Oldest first; the last one corresponds to `app.store.tables`.
REVISIONS = ("0001", "0002", "0003", "0004", "0005")
_FOLDER = Path(__file__).parent / "migrations"
# Version table of alembic.
_version = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))
_BEFORE_ALEMBIC = "schema_version"
_OWN_VERSIONS = {1: "0001", 2: "0002"}


def bring_up_to_date(connection: Connection) -> None:
    """Create the tables, or migrate those of an older version, within the open transaction.

    Raises:
        StemmapError: The tables are of a newer version or of another program.
    """
    names = set(inspect(connection).get_table_names())
    if not names:
        metadata.create_all(connection)
        _stamp(connection, REVISIONS[-1])
        return
    if _BEFORE_ALEMBIC in names and _version.name not in names:
        _leave_own_version(connection)
    elif _version.name not in names:
        raise StemmapError("this database belongs to another program")
    standing = connection.execute(select(_version.c.version_num)).scalar()
    if standing not in REVISIONS:
        raise _newer(standing)
    if standing != REVISIONS[-1]:
        upgrade(connection)


def upgrade(connection: Connection, revision: str = "head") -> None:
    """Run the migrations up to a revision."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_FOLDER).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, revision)


def _leave_own_version(connection: Connection) -> None:
    """Convert the version table of the first databases to that of alembic."""
    own = Table(_BEFORE_ALEMBIC, MetaData(), autoload_with=connection)
    version = connection.execute(select(own.c.version)).scalar()
    if version not in _OWN_VERSIONS:
        raise _newer(version)
    own.drop(connection)
    _stamp(connection, _OWN_VERSIONS[version])


def _stamp(connection: Connection, revision: str) -> None:
    _version.create(connection)
    connection.execute(insert(_version).values(version_num=revision))


def _newer(version: object) -> StemmapError:
    return StemmapError(
        f"it was written by a newer stemmap (tables {version}, this one knows {REVISIONS[-1]})",
        remedy="Start the newer stemmap",
    )


FILE_NAME = "annotations.sqlite"
_PATIENCE_MS = 5000
_PATIENCE_S = 5
# Number of the advisory lock that every writer holds; any constant.
_LOCK = 7_330_117


def open_engine(folder: Path | None, database: str = "") -> Engine:
    """Return the engine of a database with current tables.

    Args:
        folder: Folder of the SQLite file, created if necessary; None keeps the database in memory.
        database: Address of a PostgreSQL database, used instead of the folder.

    Raises:
        StemmapError: The folder or the server cannot be used, or the database is damaged or of a newer
            version; it is not modified.
    """
    if database:
        return _open_server(database)
    if folder is None:
        return _checked(_sqlite(":memory:"), "memory")
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise StemmapError(
            f"annotations cannot be kept: {(error.strerror or str(error)).lower()}",
            where=str(folder),
            remedy="Name another folder with STEMMAP_FOLDER",
        ) from None
    return _checked(_sqlite(str(path)), str(path))


def _open_server(database: str) -> Engine:
    remedy = "Give STEMMAP_DATABASE as postgresql://name@host/database"
    try:
        url = make_url(database)
    except (ArgumentError, ValueError):
        raise StemmapError("this is not the address of a database", remedy=remedy) from None
    if url.drivername not in ("postgresql", "postgresql+psycopg"):
        raise StemmapError(f"{url.drivername} is not supported", where="STEMMAP_DATABASE", remedy=remedy)
    where = url.render_as_string(hide_password=True)
    try:
        engine = _postgresql(url)
    except ImportError:
        raise StemmapError(
            "the driver of PostgreSQL is missing", where=where, remedy="Install stemmap[postgres]"
        ) from None
    return _checked(engine, where)


def _sqlite(database: str) -> Engine:
    # One connection, used by one thread at a time; an in-memory database exists as long as it.
    engine = create_engine(
        "sqlite+pysqlite://",
        creator=lambda: sqlite3.connect(database, isolation_level=None, check_same_thread=False),
        poolclass=StaticPool,
    )

    @event.listens_for(engine, "connect")
    def _(connection: sqlite3.Connection, _record: Any) -> None:  # noqa: ANN401
        connection.execute(f"PRAGMA busy_timeout = {_PATIENCE_MS}")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA foreign_keys = ON")

    @event.listens_for(engine, "begin")
    def _(connection: Connection) -> None:
        # Writes depend on the reads before them: no other writer may come between.
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _postgresql(url: URL) -> Engine:
    engine = create_engine(
        url.set(drivername="postgresql+psycopg"),
        pool_size=1,
        max_overflow=0,
        pool_pre_ping=True,  # the server may have been restarted
        connect_args={"connect_timeout": _PATIENCE_S, "application_name": "stemmap"},
    )

    @event.listens_for(engine, "begin")
    def _(connection: Connection) -> None:
        # Equivalent to BEGIN IMMEDIATE above. A lock that is not granted in time is an error.
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {_PATIENCE_MS}")
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_LOCK})")

    return engine


def _checked(engine: Engine, where: str) -> Engine:
    keep = "It is left as it is: move it away to begin anew, or bring back a copy"
    try:
        with engine.begin() as connection:
            if engine.dialect.name == "sqlite":
                said = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar_one()
                if said != "ok":
                    raise StemmapError("the annotations are damaged", where=where, remedy=keep)
            bring_up_to_date(connection)
    except StemmapError as error:
        engine.dispose()
        if error.where:
            raise
        what = f"the annotations cannot be used: {error.what}"
        raise StemmapError(what, where=where, remedy=error.remedy or keep) from None
    except (SQLAlchemyError, sqlite3.Error) as error:
        engine.dispose()
        remedy = keep if engine.dialect.name == "sqlite" else "Look whether the server runs and lets you in"
        raise StemmapError(
            f"the annotations cannot be read: {reason_of(error)}", where=where, remedy=remedy
        ) from None
    return engine


def reason_of(error: Exception) -> str:
    """Return the reason of a database error in one line."""
    return " ".join(str(getattr(error, "orig", None) or error).lower().split())[:300]
