"""All trials, and those that failed with their causes."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.collapse import COLLAPSE_MEANS
from analysis.page.source import Source, point_text
from analysis.records import TrialRecord
from analysis.report_tables import COLLAPSED, Table, trial_table
from analysis.selection import error_summary

if TYPE_CHECKING:
    from markupsafe import Markup

MAX_ROWS = 50
"""How many trials the table shows at first, and where scripts don't run."""
_MAX_ERROR_CHARS = 4_000
_MAX_CAUSES = 20
_MAX_MEMBERS = 20


@dataclass(frozen=True)
class Failure:
    """A cause for which trials failed."""

    anchor: str
    summary: str
    """The line of the error that names it."""
    text: str
    """The end of the whole error, of the first of the trials."""
    members: list[tuple[str, str, int]]
    """The first trials that failed so: id, point, and how often each failed."""
    num_trials: int


@dataclass(frozen=True)
class AllTrials:
    """What the sections `trials` and `failures` show."""

    table: Table
    """The first trials."""
    num_trials: int
    more: Markup
    """The other trials as JSON, which the page's script shows: a list of rows of cells [value, text, kind, href]."""
    failures: list[Failure]
    num_other_causes: int
    """How many causes are not listed."""
    collapse_means: str
    """When a trial collapsed; empty: none did."""


def section(source: Source) -> AllTrials:
    """Return what the sections show."""
    causes = failures(source.trials)
    listed = causes[:_MAX_CAUSES]
    table = trial_table(
        source.trials,
        source.results,
        goal=source.goal,
        best=source.best,
        core_seconds=source.core_seconds,
        errors=_anchors(source.trials, listed),
    )
    means = COLLAPSE_MEANS if COLLAPSED in table.headings else ""
    first = Table(table.headings, table.rows[:MAX_ROWS])
    return AllTrials(first, len(table.rows), _json(table), listed, len(causes) - len(listed), means)


def failures(trials: Sequence[TrialRecord]) -> list[Failure]:
    """Return the causes for which trials failed, those of most trials first; trials with the same error are one."""
    by_cause: defaultdict[str, list[TrialRecord]] = defaultdict(list)
    for trial in sorted(trials, key=lambda item: item.index):
        if trial.status == "failed":
            by_cause[error_summary(trial.error)].append(trial)
    found = [
        Failure(
            anchor=f"error-{members[0].trial_id}",
            summary=summary,
            text=(members[0].error or "")[-_MAX_ERROR_CHARS:],
            members=[(trial.trial_id, point_text(trial.point), trial.num_failures) for trial in members[:_MAX_MEMBERS]],
            num_trials=len(members),
        )
        for summary, members in by_cause.items()
    ]
    return sorted(found, key=lambda item: -item.num_trials)


def _anchors(trials: Sequence[TrialRecord], listed: Sequence[Failure]) -> Mapping[str, str]:
    """Return where the cause of each failed trial is told, by the trial's id."""
    anchors = {failure.summary: failure.anchor for failure in listed}
    summaries = {trial.trial_id: error_summary(trial.error) for trial in trials if trial.status == "failed"}
    return {trial_id: anchors[summary] for trial_id, summary in summaries.items() if summary in anchors}


def _json(table: Table) -> Markup:
    """Return the rows after the first ones as JSON that can't end the element it stands in."""
    from markupsafe import Markup

    rows = [[_brief(cell) for cell in row] for row in table.rows[MAX_ROWS:]]
    text = json.dumps(rows, separators=(",", ":"), default=str)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)  # noqa: S704  (no sign of HTML is left in it)


def _brief(cell: tuple[object, ...]) -> list[object]:
    """Return a cell without what is empty at its end."""
    items = list(cell)
    while len(items) > 1 and items[-1] == "":
        items.pop()
    return items
