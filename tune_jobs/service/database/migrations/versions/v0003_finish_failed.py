"""Whether what follows the trials of a sweep failed, which decides the exit code of a command that waited for it."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; of jobs that have ended nobody knows."""
    op.add_column("jobs", sa.Column("finish_failed", sa.Boolean))


def downgrade() -> None:
    """Remove it."""
    op.drop_column("jobs", "finish_failed")
