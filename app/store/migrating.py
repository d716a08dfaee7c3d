"""Brings a database of an older version to this one."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Column, Connection, MetaData, String, Table, insert, inspect, select

from app.store.tables import metadata
from pipeline.errors import StemmapError

# Oldest first; the last is what `app.store.tables` says.
REVISIONS = ("0001", "0002", "0003", "0004", "0005")
_FOLDER = Path(__file__).parent / "migrations"
# As alembic makes and reads it.
_version = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))
_BEFORE_ALEMBIC = "schema_version"
_OWN_VERSIONS = {1: "0001", 2: "0002"}


def bring_up_to_date(connection: Connection) -> None:
    """Make the tables, or bring those of an older version to this one, within the open transaction.

    Raises:
        StemmapError: They are of a newer version, or not ours.
    """
    names = set(inspect(connection).get_table_names())
    if not names:
        metadata.create_all(connection)
        _stamp(connection, REVISIONS[-1])
        return
    if _BEFORE_ALEMBIC in names and _version.name not in names:
        _leave_own_version(connection)
    elif _version.name not in names:
        raise StemmapError("it is a database of another program")
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
    """The first databases counted their version in a table of their own."""
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
