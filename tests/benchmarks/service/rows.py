"""The service's rows of the table."""

from __future__ import annotations

from tests.benchmarks.service import browser, day, lists, trials

Row = tuple[str, str, str]


def rows(repeats: int, hours: float) -> list[Row]:
    """Measure all of them.

    Args:
        repeats: Of what is measured several times.
        hours: How long a day is, simulated.
    """
    return [
        *lists.rows(repeats), *browser.rows(repeats), *trials.first_step_rows(repeats), *trials.watcher_rows(repeats),
        *day.rows(hours),
    ]  # fmt: skip
