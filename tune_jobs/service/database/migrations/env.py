"""Run migrations on the connection that the service gives."""

from alembic import context

from tune_jobs.service.database.tables import metadata

connection = context.config.attributes["connection"]
# SQLite changes a table by making it anew.
context.configure(connection=connection, target_metadata=metadata, render_as_batch=connection.dialect.name == "sqlite")
with context.begin_transaction():
    context.run_migrations()
