"""The table of score against target."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from analysis.wording import NONE, duration, number
from tests.learning.measure import Measurement, verdict
from tests.learning.targets import NUM_EPISODES, Target, Task

HEADINGS = ("preset", "target", "score", "score of each seed", "env steps", "env steps to solve", "time", "result")


def target_text(target: Target) -> str:
    """A target in a cell."""
    parts = []
    if target.score is not None:
        parts.append(f"{target.score:g}")
    if target.full_episodes is not None:
        wanted, of, full = target.full_episodes
        parts.append(f"{wanted} of {of} at {full:g}")
    if target.max_env_steps is not None:
        parts.append(f"from {target.max_env_steps:,} env steps")
    if target.solve_within is not None:
        parts.append(f"solved before {target.solve_within:,}")
    if target.times_random is not None:
        parts.append(f"{target.times_random:g} x random play")
    return ", ".join(parts)


def row(task: Task, found: Measurement | None) -> tuple[str, ...]:
    """The cells of one preset; of one that was skipped, nothing but its name and target."""
    target = target_text(task.shown_target)
    if found is None:
        return (task.preset, target, *([NONE] * 5), "skipped")
    each = ", ".join(f"{seed.score:.1f}" for seed in found.seeds) or NONE
    steps = [seed.num_env_steps for seed in found.seeds]
    span = NONE if not steps else f"{min(steps):,}" if min(steps) == max(steps) else f"{min(steps):,} to {max(steps):,}"
    solve = found.solve_median
    return (
        task.preset,
        target,
        NONE if found.score is None else f"{found.score:.1f}",
        each,
        span,
        "not in training" if solve is None else number(solve),
        duration(found.time_s),
        verdict(task, found)[1],
    )


def show(rows: Sequence[tuple[str, ...]], num_seeds: int) -> None:
    """Print the table."""
    title = f"score: median over {num_seeds} training seeds of the mean return of {NUM_EPISODES} fresh greedy episodes"
    table = Table(title=title)
    for heading in HEADINGS:
        table.add_column(heading, overflow="fold", no_wrap=heading in ("preset", "time"))
    for cells in rows:
        table.add_row(*(Text(cell, style="red" if cell.startswith("MISS") else "") for cell in cells))
    Console(width=None if sys.stdout.isatty() else 190).print(table)


def markdown(rows: Sequence[tuple[str, ...]]) -> str:
    """The table for docs/presets.md."""
    lines = [HEADINGS, ("---",) * len(HEADINGS), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |" for cells in lines)
