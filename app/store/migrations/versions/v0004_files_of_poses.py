"""Odometry may be a file of poses: its path needs the room of one."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Widen the column. SQLite holds no text to a length, and a table that is made anew there would lose what
    others refer to."""
    if op.get_bind().dialect.name != "sqlite":
        op.alter_column(
            "run_records",
            "odometry",
            existing_type=sa.String(20),
            type_=sa.String(4096),
            existing_nullable=False,
        )
