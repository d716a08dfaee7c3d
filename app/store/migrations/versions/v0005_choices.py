"""Which topics and mounting a run was opened with, so that its replay has them too."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the column; of older runs nobody knows."""
    op.add_column("run_records", sa.Column("chosen", sa.JSON(none_as_null=True)))
