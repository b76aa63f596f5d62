"""The command that adds a point of one's own to a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from policies.errors import SpecError
from tune_jobs.cli.base import run_options, sweep_argument
from tune_jobs.cli.completion import complete_searched
from tune_jobs.cli.running import run_verb

_SHOWN = 80


@click.command()
@sweep_argument
@click.argument("values", nargs=-1, required=True, metavar="NAME=VALUE...", shell_complete=complete_searched)
@run_options
@click.pass_context
def inject(
    ctx: click.Context, /, *, sweep: str, values: tuple[str, ...], storage: str | None, as_json: bool, **options: Any
) -> None:
    """Add a point of your own to a sweep: it is trained and compared like any other.

    There is one NAME=VALUE for each searched hyperparameter; VALUE is YAML, and may lie outside of the space:

    tune-jobs inject mine lr=3e-4 "hidden_sizes=[64, 64]"
    """
    run_verb(ctx, "inject", sweep, _point_of(values), storage=storage, as_json=as_json, **options)


def _point_of(assignments: Sequence[str]) -> dict[str, Any]:
    from tune_jobs.spec.yaml import parse_value

    point: dict[str, Any] = {}
    for assignment in assignments:
        shown = assignment if len(assignment) <= _SHOWN else f"{assignment[: _SHOWN - 3]}..."
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not (name and equals and text):
            raise SpecError(f"{shown}: this is not a name and a value.", "Write NAME=VALUE, such as lr=3e-4.")
        if name in point:
            raise SpecError(f"{shown}: {name} has a value already.", "Give each name once.")
        point[name] = parse_value(text, shown)
    return point
