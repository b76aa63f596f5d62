"""Print the hyperparameters: a list for people, one JSON document for programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tune_jobs.cli.output import make_console, print_json

if TYPE_CHECKING:
    from rich.console import Console

    from tune_jobs.spec.hyperparam_table import HyperparamTable

_INDENT = 4


def show_hyperparams(tables: Sequence[HyperparamTable], *, as_json: bool) -> None:
    """Print the hyperparameters of some algorithms."""
    if as_json:
        print_json(tables)
        return
    console = make_console()
    for table in tables:
        _show(console, table)
    console.print("Fix one under `hyperparams` in a sweep file, or search it under `space`.", style="dim")


def _show(console: Console, table: HyperparamTable) -> None:
    # Not a table: in 80 columns the meanings would stand in a strip of 20.
    from rich.padding import Padding
    from rich.text import Text

    from tune_jobs.spec.hyperparam_table import elsewhere_text

    def below(text: str, style: str = "") -> None:
        console.print(Padding(Text(text, style=style), (0, 0, 0, _INDENT), expand=False))

    console.print(Text(f"Hyperparameters of {table.algorithm}", style="bold underline"))
    for row in table.hyperparams:
        console.print(Text.assemble((row.name, "bold"), f": {_yaml(row.default)}  ", (f"({row.values})", "dim")))
        below(row.meaning)
        for library, names in elsewhere_text(row).items():
            below(f"{library}: {names}", "dim")
    if table.not_here:
        console.print(Text(f"No hyperparameters of {table.algorithm}", style="bold underline"))
        for foreign in table.not_here:
            console.print(Text.assemble(f"{foreign.library}: ", (foreign.name, "bold"), f": {foreign.difference}"))
    console.print()


def _yaml(value: Any) -> str:
    """Return a default as it is written in a sweep file."""
    return value if isinstance(value, str) else json.dumps(value)
