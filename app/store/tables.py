"""Tables of the current version; `app.store.migrations` converts older ones."""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

metadata = MetaData()

# Sources: all runs of a recording share its annotations.
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

# Runs: one row for each time that a source was opened and mapped.
records = Table(
    "run_records",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("run", ForeignKey("runs.id"), nullable=False, index=True),
    Column("name", String(200), nullable=False),
    Column("uri", String(4096), nullable=False),
    Column("kind", String(200), nullable=False),
    Column("odometry", String(4096), nullable=False),
    Column("seed", BigInteger, nullable=False),
    Column("chosen", JSON(none_as_null=True), comment="topics and mounting, see SourceRequest.kept_choices"),
    Column("begun_ns", BigInteger, nullable=False),
    Column("changed_ns", BigInteger, nullable=False),
    Column("deleted_ns", BigInteger),
    Column("scans", Integer, nullable=False, comment="mapped; figures, parameters and map are of the last"),
    Column("all_scans", Integer),
    Column("time_s", Float, nullable=False),
    Column("distance_m", Float, nullable=False),
    Column("trees", Integer, nullable=False),
    Column("preset", String(100), nullable=False),
    Column("parameters", JSON(none_as_null=True), nullable=False),
    Column("scores", JSON(none_as_null=True)),
    sqlite_autoincrement=True,
)

# Separate from the records, so that their list is small.
maps = Table(
    "run_maps",
    metadata,
    Column("record", ForeignKey("run_records.id"), primary_key=True),
    Column("map", JSON(none_as_null=True), nullable=False),
)

revisions = Table(
    "parameter_revisions",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("record", ForeignKey("run_records.id"), nullable=False, index=True),
    Column("revision", Integer, nullable=False),
    Column("at_ns", BigInteger, nullable=False),
    Column("time_s", Float, nullable=False, comment="of the scan that stood in the run"),
    Column("who", String(60), nullable=False),
    Column("preset", String(100), nullable=False),
    Column("changes", JSON(none_as_null=True), nullable=False, comment="name: [before, after]"),
    sqlite_autoincrement=True,
)

uploads = Table(
    "uploads",
    metadata,
    Column("file", String(100), primary_key=True, comment="name in the folder of uploads"),
    Column("name", String(200), nullable=False, comment="that it had where it came from"),
    Column("kind", String(200), nullable=False),
    Column("bytes", BigInteger, nullable=False),
    Column("at_ns", BigInteger, nullable=False),
)
