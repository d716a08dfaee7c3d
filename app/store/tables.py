"""The tables, and how a database of an older version becomes one of this version."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    insert,
    inspect,
    select,
    update,
)

from pipeline.errors import StemmapError

metadata = MetaData()

schema = Table("schema_version", metadata, Column("version", Integer, nullable=False))

runs = Table(
    "runs",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("source", String(4200), nullable=False, comment="digest of what was recorded, else the URI"),
    Column("uri", String(4096), nullable=False),
    Column("name", String(200), nullable=False),
    Column("opened_ns", BigInteger, nullable=False),
    UniqueConstraint("source"),
)

annotated = Table(
    "annotations",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False, index=True),
    Column("x", Float, nullable=False),
    Column("y", Float, nullable=False),
    Column("kind", String(10), nullable=False),
    Column("dbh", Float),
    Column("who", String(60), nullable=False),
    Column("at_ns", BigInteger, nullable=False),
    Column("version", Integer, nullable=False),
    Column("deleted", Boolean, nullable=False),
    Column("made_by", Integer, nullable=False, comment="the change that led to what stands; 0 none"),
    sqlite_autoincrement=True,
)

steps = Table(
    "steps",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False),
    Column("browser", String(60), nullable=False),
    Column("who", String(60), nullable=False),
    Column("at_ns", BigInteger, nullable=False),
    Column("state", String(10), nullable=False, comment="done, undone, or left: no longer to be undone"),
    Index("steps_of_a_browser", "run", "browser", "state", "id"),
    sqlite_autoincrement=True,
)

changes = Table(
    "changes",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("step", ForeignKey("steps.id"), nullable=False, index=True),
    Column("annotation", ForeignKey("annotations.id"), nullable=False),
    Column("before", JSON(none_as_null=True)),
    Column("after", JSON(none_as_null=True)),
    Column("made_before", Integer, nullable=False, comment="the change that led to `before`"),
    sqlite_autoincrement=True,
)

parameter_sets = Table(
    "parameter_sets",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("name", String(60), nullable=False),
    Column("toml", Text, nullable=False, comment="the file that --config takes"),
    Column("who", String(60), nullable=False),
    Column("at_ns", BigInteger, nullable=False),
    UniqueConstraint("name"),
)


def _add_parameter_sets(connection: Connection) -> None:
    parameter_sets.create(connection)


# The function at place k makes a database of version k + 1 into one of version k + 2.
MIGRATIONS: tuple[Callable[[Connection], None], ...] = (_add_parameter_sets,)
VERSION = 1 + len(MIGRATIONS)


def bring_up_to_date(connection: Connection) -> None:
    """Make the tables, or bring those of an older version to this one.

    Raises:
        StemmapError: They are of a newer version, or not ours.
    """
    names = inspect(connection).get_table_names()
    if not names:
        metadata.create_all(connection)
        connection.execute(insert(schema).values(version=VERSION))
        return
    if schema.name not in names:
        raise StemmapError("it is a database of another program")
    version = connection.execute(select(schema.c.version)).scalar_one()
    if version > VERSION:
        raise StemmapError(
            f"it was written by a newer stemmap (version {version} of the tables, this one knows {VERSION})",
            remedy="Start the newer stemmap",
        )
    for migrate in MIGRATIONS[version - 1 :]:
        migrate(connection)
    connection.execute(update(schema).values(version=VERSION))
