"""How tokens are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from tune_jobs.cli.output import local_time, make_console, make_table, print_json
from tune_jobs.cli.whole_columns import print_whole
from tune_jobs.service.access.tokens import Token


def show_new(token: Token, secret: str, *, as_json: bool) -> None:
    """Print a token that was made: its secret alone on standard output, for a script to take."""
    if as_json:
        print_json({**_plain(token, token.created_at), "token": secret})
        return
    click.echo(secret)
    until = "" if token.expires_at is None else f", valid until {local_time(token.expires_at)}"
    click.echo(f"Token {token.id} of {token.name} ({token.role}){until}. It is not shown again.", err=True)


def show_tokens(tokens: Sequence[Token], now: float, *, as_json: bool) -> None:
    """Print all tokens."""
    if as_json:
        print_json([_plain(token, now) for token in tokens])
        return
    console = make_console()
    if not tokens:
        console.print("There are no tokens here yet.")
        return
    table = make_table("id", "name", "role", "state", "made", "expires", "last used")
    for token in tokens:
        times = (token.created_at, token.expires_at, token.last_used_at)
        told = ("never" if time is None else local_time(time) for time in times)
        table.add_row(token.id, token.name, token.role, token.state(now), *told)
    print_whole(console, table, least=("made",))


def show_revoked(token: Token, *, as_json: bool) -> None:
    """Print that a token was revoked."""
    if as_json:
        print_json({"id": token.id, "name": token.name, "revoked_at": token.revoked_at})
    else:
        click.echo(f"Token {token.id} of {token.name} is revoked.")


def _plain(token: Token, now: float) -> Mapping[str, Any]:
    return {**vars(token), "state": token.state(now)}
