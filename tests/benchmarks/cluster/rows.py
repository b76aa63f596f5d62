"""The cluster's rows of the table."""

from __future__ import annotations

from pathlib import Path

from tests.benchmarks.cluster import costs, scaling

Row = tuple[str, str, str]


def rows(repeats: int, num_trials: int, save: Path | None) -> list[Row]:
    """Measure all of them.

    Args:
        repeats: Of what is measured several times.
        num_trials: Of the largest sweep.
        save: As for `costs.rows`.
    """
    return [*scaling.rows(repeats), *costs.rows(costs.cases(num_trials), save), *largest(num_trials, save)]


def largest(num_trials: int, save: Path | None) -> list[Row]:
    """Measure the largest sweep alone.

    Args:
        num_trials: Its trials.
        save: As for `costs.rows`.
    """
    return costs.rows([costs.largest(num_trials)], save)
