"""Of which sweep a label says something: its name may be another one's by now."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; the service's start says it of what was said before."""
    op.add_column("sweeps", sa.Column("created_at", sa.Float))


def downgrade() -> None:
    """Remove it."""
    op.drop_column("sweeps", "created_at")
