"""The tables of the benchmark of the search: what each method found, beside what ARLBench publishes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from analysis.wording import counted
from tests.benchmarks.search.confirmed_runs import CONFIRMED
from tests.benchmarks.search.kept import made
from tests.benchmarks.search.runs import METHODS, NUM_RUNS
from tests.benchmarks.search.tasks import TASKS
from tune_jobs.spec.sections import AUTO_SEARCH

Kept = Mapping[tuple[str, str], dict[str, Any] | None]
"""What was kept of the runs, by task and method."""


def tables(kept: Kept) -> Iterator[str]:
    """Yield the lines of the page's tables; a cell without runs is empty."""
    everything = list(dict.fromkeys(method for (_, method), found in kept.items() if found is not None))
    # What these name is not the highest of many scores while tuning, so that they have none that could be compared.
    confirmed = [method for method in everything if method in CONFIRMED]
    methods = [method for method in everything if method not in CONFIRMED]
    tasks = [task for task in TASKS if any(kept.get((task, method)) for method in methods)]
    yield "The best point of a run by its score while tuning, as ARLBench publishes it, mean of the runs:"
    yield ""
    yield from _table(kept, tasks, methods, "score", published=True)
    yield ""
    yield "The same points trained again on five seeds on which nothing was chosen:"
    yield ""
    yield from _table(kept, tasks, [*methods, *confirmed], "test", published=False)
    yield ""
    # The more methods, the fewer tasks that all of them have run as often as any.
    often = [_most_often(kept, task, methods) for task in tasks]
    choosing = [method for method in methods if method in METHODS]
    default = [method for method in methods if method in ("random", AUTO_SEARCH)]
    everywhere = [method for method in methods if all(method in some for some in often)]
    for some in dict.fromkeys(map(tuple, (default, choosing, everywhere, *sorted(often, key=len), methods))):
        yield from _ranks(kept, tasks, some)
    for named in dict.fromkeys(((*default, *confirmed), (*methods, *confirmed)) if confirmed else ()):
        yield from _ranks(kept, tasks, named, {"test": "on test seeds"})
    yield ""
    yield made(found for task in tasks for method in everything if (found := kept.get((task, method))) is not None)


def _most_often(kept: Kept, task: str, methods: Sequence[str]) -> tuple[str, ...]:
    """Return the methods that have run a task as often as any."""
    num_runs = {method: len(found["runs"]) for method in methods if (found := kept.get((task, method))) is not None}
    return tuple(method for method, number in num_runs.items() if number == max(num_runs.values()))


def values_of(found: dict[str, Any], what: str) -> list[float]:
    """Return one number of each run: `score`, the best while tuning, or `test`; -inf where a seed failed."""

    def number(value: float | None) -> float:
        return -math.inf if value is None else value

    return [max(map(number, run["scores"])) if what == "score" else number(run["test"]) for run in found["runs"]]


def _table(kept: Kept, tasks: list[str], methods: list[str], what: str, *, published: bool) -> Iterator[str]:
    theirs = list(TASKS[tasks[0]].published) if published and tasks else []
    yield f"| task | {' | '.join([*methods, *(f'ARLBench: {name}' for name in theirs)])} |"
    yield "|---" * (1 + len(methods) + len(theirs)) + "|"
    for task in tasks:
        cells = [_cell(found, what) if (found := kept.get((task, method))) else "" for method in methods]
        cells += [f"{TASKS[task].published[name]:g}" for name in theirs]
        yield f"| {task} | {' | '.join(cells)} |"


def _cell(found: dict[str, Any], what: str) -> str:
    values = np.array(values_of(found, what))
    of = "" if len(values) == NUM_RUNS else f" (of {len(values)})"
    if len(values) < 2 or not np.isfinite(values).all():
        return f"{values.mean():.1f}{of}"
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))
    return f"{values.mean():.1f} ± {half:.1f}{of}"


_BOTH = {"score": "while tuning", "test": "on test seeds"}


def _ranks(kept: Kept, tasks: list[str], methods: Sequence[str], by: Mapping[str, str] = _BOTH) -> Iterator[str]:
    """Yield mean ranks over the tasks that all methods have run equally often, each run compared with its number's."""

    def num_runs(task: str) -> set[int]:
        return {len(found["runs"]) if (found := kept.get((task, method))) else 0 for method in methods}

    # One run beside five would count as much as all of theirs.
    whole = [task for task in tasks if len(num_runs(task)) == 1 and 0 not in num_runs(task)]
    if not whole or len(methods) < 2:
        return
    told = []
    for what, words in by.items():
        ranks = []
        for task in whole:
            rows = [values_of(found, what) for method in methods if (found := kept[task, method])]
            ranks.append(stats.rankdata(-np.array(rows), axis=0).mean(axis=1))
        means = np.mean(ranks, axis=0)
        named = ", ".join(f"{method} {mean:.2f}" for method, mean in zip(methods, means, strict=True))
        told.append(f"{words}: {named}")
    yield f"Mean rank of {len(methods)} over {counted(len(whole), 'task')}, {'; '.join(told)}."
