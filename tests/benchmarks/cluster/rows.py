"""The cluster's rows of the table."""

from __future__ import annotations

from tests.benchmarks.cluster import costs

Row = tuple[str, str, str]


def rows(num_trials: int) -> list[Row]:
    """Measure all of them.

    Args:
        num_trials: Of the largest sweep.
    """
    return costs.rows(num_trials)
