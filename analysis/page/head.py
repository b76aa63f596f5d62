"""The head of the page: what was searched, and the sweep's main numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from analysis import report_data
from analysis.page.source import Source
from analysis.tables import trials_frame
from analysis.wording import number


@dataclass(frozen=True)
class Head:
    """What the head of the page shows."""

    env_id: str
    algorithm: str
    about: dict[str, str]
    """What the sweep file says of the sweep: title, description, expected."""
    facts: list[tuple[str, str]]
    """The main numbers, as pairs of label and value."""


def section(source: Source) -> Head:
    """Return what the head of the page shows."""
    return Head(
        env_id=report_data.env_of(source.sweep),
        algorithm=report_data.algorithm_of(source.sweep),
        about=report_data.about_of(source.sweep),
        facts=_facts(source),
    )


def _facts(source: Source) -> list[tuple[str, str]]:
    trials, goal = source.trials, source.goal
    frame = trials_frame(trials, source.results, threshold=goal)
    statuses = Counter(trial.status for trial in trials)
    facts = [
        ("trials", ", ".join(f"{count:,} {status}" for status, count in statuses.most_common()) or "none"),
        ("env steps", number(sum(trial.num_env_steps for trial in trials))),
    ]
    if ran := report_data.run_time_of(source.sweep):
        facts.append(("wall time", ran))
    if goal is not None:
        solved = frame["num_env_steps_to_solve"].dropna()
        facts.append(("solved in training", f"{len(solved):,} of {len(trials):,}"))
        if len(solved):
            facts.append(("fewest env steps to solve", number(int(solved.min()))))
    return facts
