"""What became of each run: figures, map, parameters with their revisions; uploaded recordings."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "run_records",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False, index=True),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("uri", sa.String(4096), nullable=False),
        sa.Column("kind", sa.String(200), nullable=False),
        sa.Column("odometry", sa.String(20), nullable=False),
        sa.Column("seed", sa.BigInteger, nullable=False),
        sa.Column("begun_ns", sa.BigInteger, nullable=False),
        sa.Column("changed_ns", sa.BigInteger, nullable=False),
        sa.Column("deleted_ns", sa.BigInteger),
        sa.Column("scans", sa.Integer, nullable=False),
        sa.Column("all_scans", sa.Integer),
        sa.Column("time_s", sa.Float, nullable=False),
        sa.Column("distance_m", sa.Float, nullable=False),
        sa.Column("trees", sa.Integer, nullable=False),
        sa.Column("preset", sa.String(100), nullable=False),
        sa.Column("parameters", sa.JSON(none_as_null=True), nullable=False),
        sa.Column("scores", sa.JSON(none_as_null=True)),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "run_maps",
        sa.Column("record", sa.Integer, sa.ForeignKey("run_records.id"), primary_key=True),
        sa.Column("map", sa.JSON(none_as_null=True), nullable=False),
    )
    op.create_table(
        "parameter_revisions",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("record", sa.Integer, sa.ForeignKey("run_records.id"), nullable=False, index=True),
        sa.Column("revision", sa.Integer, nullable=False),
        sa.Column("at_ns", sa.BigInteger, nullable=False),
        sa.Column("time_s", sa.Float, nullable=False),
        sa.Column("who", sa.String(60), nullable=False),
        sa.Column("preset", sa.String(100), nullable=False),
        sa.Column("changes", sa.JSON(none_as_null=True), nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "uploads",
        sa.Column("file", sa.String(100), primary_key=True),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("kind", sa.String(200), nullable=False),
        sa.Column("bytes", sa.BigInteger, nullable=False),
        sa.Column("at_ns", sa.BigInteger, nullable=False),
    )
