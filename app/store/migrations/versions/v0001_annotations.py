"""Runs and their annotations, with every edit."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "runs",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("source", sa.String(4200), nullable=False),
        sa.Column("uri", sa.String(4096), nullable=False),
        sa.Column("name", sa.String(200), nullable=False),
        sa.Column("opened_ns", sa.BigInteger, nullable=False),
        sa.UniqueConstraint("source"),
    )
    op.create_table(
        "annotations",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False, index=True),
        sa.Column("x", sa.Float, nullable=False),
        sa.Column("y", sa.Float, nullable=False),
        sa.Column("kind", sa.String(10), nullable=False),
        sa.Column("dbh", sa.Float),
        sa.Column("who", sa.String(60), nullable=False),
        sa.Column("at_ns", sa.BigInteger, nullable=False),
        sa.Column("version", sa.Integer, nullable=False),
        sa.Column("deleted", sa.Boolean, nullable=False),
        sa.Column("made_by", sa.Integer, nullable=False),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "steps",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("run", sa.Integer, sa.ForeignKey("runs.id"), nullable=False),
        sa.Column("browser", sa.String(60), nullable=False),
        sa.Column("who", sa.String(60), nullable=False),
        sa.Column("at_ns", sa.BigInteger, nullable=False),
        sa.Column("state", sa.String(10), nullable=False),
        sa.Index("steps_of_a_browser", "run", "browser", "state", "id"),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "changes",
        sa.Column("id", sa.Integer, primary_key=True),
        sa.Column("step", sa.Integer, sa.ForeignKey("steps.id"), nullable=False, index=True),
        sa.Column("annotation", sa.Integer, sa.ForeignKey("annotations.id"), nullable=False),
        sa.Column("before", sa.JSON(none_as_null=True)),
        sa.Column("after", sa.JSON(none_as_null=True)),
        sa.Column("made_before", sa.Integer, nullable=False),
        sqlite_autoincrement=True,
    )
