"""Write iterations.csv trial by trial: there may be millions of rows, which as one table would take gigabytes."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path

from analysis.records import IterationRecord
from analysis.tables import OF_ITERATIONS
from policies.files import atomic_path


def write_iterations(path: Path, results: Mapping[str, Sequence[IterationRecord]]) -> None:
    """Write what `tables.iterations_frame` returns, atomically and as `tables.write_csv` would.

    Args:
        path: The file.
        results: Iterations by trial id, oldest first.

    Raises:
        CannotRunError: The file cannot be written.
    """
    learner = sorted({name for items in results.values() for item in items for name in item.learner})
    numbers = attrgetter(*OF_ITERATIONS)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        # Rows are given to the writer as pandas gives them, so that numbers have the same digits.
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["trial_id", *OF_ITERATIONS, *(f"learner/{name}" for name in learner)])
        for trial_id, items in results.items():
            writer.writerows(
                [trial_id, *map(_cell, numbers(item)), *map(_cell, map(item.learner.get, learner))] for item in items
            )


def _cell(value: float | None) -> float | str:
    return "" if value is None or value != value else value  # noqa: PLR0124 (NaN alone is not equal to itself)
