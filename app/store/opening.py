"""Opens the database so that what it acknowledges stays, and says in one line why it cannot."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, StaticPool, create_engine, event
from sqlalchemy.exc import SQLAlchemyError

from app.store.tables import bring_up_to_date
from pipeline.errors import StemmapError

FILE_NAME = "annotations.sqlite"
_PATIENCE_MS = 5000


def open_engine(folder: Path | None) -> Engine:
    """The engine on the database of a folder, which is made if it is not there; None keeps all in memory.

    Raises:
        StemmapError: The folder cannot be used, or the file is damaged or of a newer version. The file is
            left as it is.
    """
    if folder is None:
        return _checked(_engine(":memory:"), "memory")
    path = folder / FILE_NAME
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise StemmapError(
            f"annotations cannot be kept: {(error.strerror or str(error)).lower()}",
            where=str(folder),
            remedy="Name another folder with STEMMAP_FOLDER",
        ) from None
    return _checked(_engine(str(path)), str(path))


def _engine(database: str) -> Engine:
    # One connection, used by one thread at a time; a memory database lives as long as it.
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
        # Reads are followed by writes that rest on them: nobody else may write between.
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _checked(engine: Engine, where: str) -> Engine:
    keep = "It is left as it is: move it away to begin anew, or bring back a copy"
    try:
        with engine.begin() as connection:
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
        reason = str(getattr(error, "orig", error)).lower()
        raise StemmapError(f"the annotations cannot be read: {reason}", where=where, remedy=keep) from None
    return engine
