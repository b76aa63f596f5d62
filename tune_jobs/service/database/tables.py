"""The tables of the service's database. Every change of them is a migration, too (`migrations/versions`)."""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    Boolean,
    Column,
    Float,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
)

MOST_LETTERS = 200
"""Of the name of a sweep that has a job or a label; a sweep file allows fewer."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(column_0_label)s",
        "uq": "uq_%(table_name)s_%(column_0_name)s",
        "pk": "pk_%(table_name)s",
    }
)

jobs = Table(
    "jobs",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=True),
    Column("uid", String(32), nullable=False),
    Column("sweep", String(MOST_LETTERS), nullable=False),
    Column("verb", String(20), nullable=False),
    Column("arguments", JSON, nullable=False),
    Column("owner", String(100), nullable=False),
    Column("priority", Integer, nullable=False),
    Column("num_cpus", Float, nullable=False),
    Column("state", String(20), nullable=False),
    Column("outcome", String(20)),
    Column("message", Text),
    Column("finish_failed", Boolean),
    Column("num_attempts", Integer, nullable=False),
    Column("stop_requested", Boolean, nullable=False),
    Column("submitted_at", Float, nullable=False),
    Column("started_at", Float),
    Column("ended_at", Float),
    Index("ix_jobs_state", "state"),
    Index("ix_jobs_sweep", "sweep"),
    sqlite_autoincrement=True,
)
"""What is to be done with sweeps, in which order; times are seconds since 1970."""

submissions = Table(
    "submissions",
    metadata,
    Column("owner", String(100), primary_key=True),
    Column("key", String(200), primary_key=True),
    Column("digest", String(64), nullable=False),
    Column("job_id", Integer, nullable=False),
    Column("created_at", Float, nullable=False),
)
"""Idempotency keys: the job that the first request with a key made, and the SHA-256 of that request."""

sweeps = Table(
    "sweeps",
    metadata,
    Column("name", String(MOST_LETTERS), primary_key=True),
    Column("owner", String(100), nullable=False),
    Column("note", Text, nullable=False),
    Column("tags", JSON, nullable=False),
    Column("created_at", Float),
)
"""What people say of sweeps; a sweep without a row is nobody's.

`created_at` says of which sweep of the name: when that one was created; null: an older version wrote the row, and
no start could read the sweep yet."""

tokens = Table(
    "tokens",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("digest", String(64), nullable=False),
    Column("name", String(100), nullable=False),
    Column("role", String(20), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("revoked_at", Float),
    Column("last_used_at", Float),
    UniqueConstraint("digest"),
)
"""Who may come in: SHA-256 of tokens, never tokens."""

audit = Table(
    "audit",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=True),
    Column("at", Float, nullable=False),
    Column("who", String(100), nullable=False),
    Column("client", String(100), nullable=False),
    Column("action", String(50), nullable=False),
    Column("target", String(200), nullable=False),
    Column("status", Integer, nullable=False),
    Column("details", JSON, nullable=False),
    sqlite_autoincrement=True,
)
"""Who did what, and what the answer was."""

messages = Table(
    "messages",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("event", String(50), nullable=False),
    Column("target", Text, nullable=False),
    Column("body", Text, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("next_at", Float),
    Column("num_attempts", Integer, nullable=False),
    Column("error", Text),
    Index("ix_messages_next_at", "next_at"),
)
"""What is to be told, to whom, and when it is tried next; null: it is done, or given up."""
