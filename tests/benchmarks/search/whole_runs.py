"""Runs that are made and kept as a whole, of methods that look at trainings before their end; several at once.

A run's trainings have no use outside of it, as where they were ended, or what they went on from, depends on the others.
So a run is made in one process, as a pack, and kept when it is over: a kill takes those with it that were being made.
"""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.benchmarks.search.pack_trainer import PackTrainer
from tests.benchmarks.search.runs import Run, finite
from tests.benchmarks.search.schedulers import SEARCH_OF_ASHA, Stage, Tuned, task_of, tested, tuned
from tests.benchmarks.search.tasks import Task
from tests.benchmarks.search.trainings import whole_lines

Make = Callable[[Task, str, int], dict[str, Any]]


def make(task: Task, method: str, number: int) -> dict[str, Any]:
    """Make a run, and test what it found on seeds on which nothing was chosen; returns it as JSON-like data."""
    task = task_of(task, method, number)
    trainer = PackTrainer(task, in_step=method not in SEARCH_OF_ASHA)
    found = tuned(task, method, number, trainer)
    trainer.close()
    trainer = PackTrainer(task)
    test = tested(task, found.best, trainer)
    trainer.close()
    return row_of(method, number, found, test)


def row_of(method: str, number: int, found: Tuned, test: float) -> dict[str, Any]:
    """Return a run as it is kept; the other schedules follow from its number and from what the rule was told."""
    return {
        "method": method,
        "run": number,
        "scores": list(map(finite, found.scores)),
        "num_env_steps": found.num_env_steps,
        "best": found.scores.index(max(found.scores)),
        "schedule": _plain(found.best),
        "test": finite(test),
        "told": found.told,
    }


def _plain(schedule: Sequence[Stage]) -> list[dict[str, Any]]:
    return [{"from_env_steps": stage.from_env_steps, "point": dict(stage.point)} for stage in schedule]


def run_of(row: Mapping[str, Any]) -> Run:
    """Return what a run found; its best is a point, or a schedule where its values changed."""

    def number(score: float | None) -> float:
        return -math.inf if score is None else score

    schedule = row["schedule"]
    best = schedule[0]["point"] if len(schedule) == 1 else {"schedule": schedule}
    return Run(tuple(map(number, row["scores"])), best, number(row["test"]))


class WholeRuns:
    """The runs of one task, in a file of JSON lines.

    Args:
        task: The task.
        file: Where they are kept; it need not exist.
        num_processes: How many are made at once.
        make: Makes one.
    """

    def __init__(self, task: Task, file: Path, num_processes: int, make: Make = make) -> None:
        self._task, self._file, self._num_processes, self._make = task, file, num_processes, make
        rows = map(json.loads, whole_lines(file))
        self._known: dict[tuple[str, int], dict[str, Any]] = {(row["method"], row["run"]): row for row in rows}

    def runs(self, methods: Sequence[str], num_runs: int) -> dict[tuple[str, int], Run]:
        """Return the runs of each method; those that are not known are made."""
        wanted = [(method, number) for method in methods for number in range(num_runs)]
        missing = [name for name in wanted if name not in self._known]
        if missing:
            self._make_all(missing)
        return {name: run_of(self._known[name]) for name in wanted}

    def _make_all(self, missing: Sequence[tuple[str, int]]) -> None:
        context = multiprocessing.get_context("spawn")
        num_processes = min(self._num_processes, len(missing))
        with ProcessPoolExecutor(num_processes, mp_context=context) as pool, self._file.open("a") as file:
            made = [pool.submit(self._make, self._task, *name) for name in missing]
            for future in as_completed(made):
                row = future.result()
                self._known[row["method"], row["run"]] = row
                file.write(json.dumps(row) + "\n")
                file.flush()
                print(f"{self._task.name}: run {row['run']} of {row['method']} ended", flush=True)
