"""Print what mattered in a sweep: tables for people, one JSON document for programs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tune_jobs.cli.output import make_console, make_table, print_json
from tune_jobs.cli.whole_columns import print_whole

if TYPE_CHECKING:
    from rich.console import Console

    from analysis.importance import WhatMattered

_BAR = 20


def show_importance(found: WhatMattered, *, as_json: bool) -> None:
    """Print the share of each hyperparameter, the scores of its values, and what follows."""
    if as_json:
        print_json(found)
        return
    from analysis.importance.words import interval, percent, sentences

    console = make_console()
    for sentence in sentences(found):
        console.print(sentence)
    known = [item for item in found.hyperparams if item.share is not None]
    if known:
        table = make_table("hyperparameter", "share", "95 % interval", "", "")
        for item in known:
            bar = "█" * round(_BAR * (item.share or 0.0))
            verdict = "mattered" if item.is_clear else "may be chance"
            style = "" if item.is_clear else "dim"
            table.add_row(item.name, percent(item.share), interval(item), verdict, bar, style=style)
        print_whole(console, table)
    if found.effects:
        _show_effects(console, found)


def _show_effects(console: Console, found: WhatMattered) -> None:
    from analysis.importance.words import SCORES, score_interval, score_text

    # Of too few points nothing is.
    is_adjusted = any(level.adjusted is not None for effect in found.effects for level in effect.levels)
    how = "; adjusted for the other hyperparameters" if is_adjusted else ""
    console.print(f"Scores by value: {SCORES[found.objective]}{how}")
    table = make_table("hyperparameter", "value", "points", "mean", "adjusted", "95 % interval")
    for effect in found.effects:
        for level in effect.levels:
            cells = [level.label, f"{level.num_points:,}", score_text(level.mean, found.objective)]
            cells += [
                score_text(level.adjusted, found.objective),
                score_interval(level.low, level.high, found.objective),
            ]
            table.add_row(effect.name if level is effect.levels[0] else "", *cells)
    print_whole(console, table)
    for effect in found.effects:
        if effect.why_not_comparable:
            console.print(f"Not comparable: {effect.why_not_comparable}", style="yellow")
