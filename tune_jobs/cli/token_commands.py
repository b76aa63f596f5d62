"""The commands about the service's tokens: make, list, revoke. They need no service, and one may run meanwhile."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tune_jobs.cli.base import json_option, storage_option
from tune_jobs.cli.serve_command import database_option, folder_option
from tune_jobs.cli.server import here_only

if TYPE_CHECKING:
    from tune_jobs.service.access.callers import Role
    from tune_jobs.service.access.gate import Gate

# Not imported from where they are declared, as help would then wait for SQLAlchemy; a test compares them.
ROLES = ("viewer", "submitter", "admin")


@click.group()
def token() -> None:
    """Make, list and revoke the tokens of the service, which others than this machine's users need."""


@token.command()
@click.argument("name")
@click.option("--role", type=click.Choice(ROLES), required=True,
              help="A viewer looks, a submitter runs and changes their own sweeps, an admin changes all.")  # fmt: skip
@click.option("--days", type=click.FloatRange(0, min_open=True), default=365.0, show_default=True,
              help="How long it is valid.")  # fmt: skip
@database_option
@folder_option
@storage_option
@json_option
def make(
    *, name: str, role: Role, days: float, database: str | None, folder: Path | None, storage: str | None, as_json: bool
) -> None:
    """Make a token and print it, which happens only once.

    NAME is whose it is, and the owner of what is submitted with it.
    """
    from tune_jobs.cli import token_view

    with _gate(database, folder, storage) as gate:
        made, secret = gate.tokens.make(name, role, days)
        gate.write_command("token make", made)
    token_view.show_new(made, secret, as_json=as_json)


@token.command(name="list")
@database_option
@folder_option
@storage_option
@json_option
def list_tokens(*, database: str | None, folder: Path | None, storage: str | None, as_json: bool) -> None:
    """List all tokens, without what is secret of them."""
    from tune_jobs.cli import token_view

    with _gate(database, folder, storage) as gate:
        token_view.show_tokens(gate.tokens.all(), gate.tokens.now(), as_json=as_json)


@token.command()
@click.argument("token_id", metavar="ID")
@database_option
@folder_option
@storage_option
@json_option
def revoke(*, token_id: str, database: str | None, folder: Path | None, storage: str | None, as_json: bool) -> None:
    """Revoke a token, by its id as `tune-jobs token list` shows it. A service that runs follows within seconds."""
    from tune_jobs.cli import token_view

    with _gate(database, folder, storage) as gate:
        revoked = gate.tokens.revoke(token_id)
        gate.write_command("token revoke", revoked)
    token_view.show_revoked(revoked, as_json=as_json)


def _gate(database: str | None, folder: Path | None, storage: str | None) -> AbstractContextManager[Gate]:
    from tune_jobs.service.access.gate import opened_gate
    from tune_jobs.service.config import ServiceConfig
    from tune_jobs.sweeps.storage import absolute_folder, storage_place

    here_only()
    config = ServiceConfig(storage=storage_place(storage), database=database, own_folder=absolute_folder(folder))
    return opened_gate(config)
