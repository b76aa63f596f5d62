"""The results of a sweep: its trials as records, and its report."""

from __future__ import annotations

from pathlib import Path, PosixPath
from typing import TYPE_CHECKING

from analysis.notebook import BriefList, film_html, page_html, rows_html
from analysis.points import value_text
from analysis.records import TrialRecord
from analysis.selection import score_trial
from analysis.wording import PLAIN_NONE, return_text
from policies.arguments import checked
from policies.envs.modules import allowed_again
from tune_jobs.sweeps.outcome import Progress

if TYPE_CHECKING:
    from analysis.front_view import FrontView
    from analysis.importance import WhatMattered
    from tune_jobs.store.contract import Sweep


class Trials(BriefList[TrialRecord]):
    """The trials of a sweep, by index."""

    def _repr_html_(self) -> str:
        from analysis.tables import point_names, shown_point

        names = point_names(self)
        rows = []
        for trial in self:
            # The values that the score was reached with; a population goes on with others.
            point = shown_point(trial)
            scored = score_trial(trial)
            score = return_text(None if scored is None else scored.score, none=PLAIN_NONE)
            values = (value_text(point, name) for name in names)
            rows.append([trial.trial_id, trial.status, score, f"{trial.num_env_steps:,}", *values])
        return rows_html(["trial", "status", "score", "env steps", *names], rows)


class ReportPath(PosixPath):
    """The path of a report's page, which a notebook shows as a link and the page itself."""

    def _repr_html_(self) -> str | None:
        # The paths that are made of this one are of this class too.
        return page_html(self) if self.suffix == ".html" else None


class Films(dict[str, Path]):
    """The paths of films, by what they are."""

    def _repr_html_(self) -> str:
        # The one that shows most comes first.
        return film_html(
            sorted(self.values(), key=lambda path: ("before_after" not in path.name, path.suffix == ".gif"))
        )


@checked
def trials(sweep: str | Path, *, storage: str | Path | None = None) -> list[TrialRecord]:
    """Return the records of a sweep's trials, by index; those that ran when its process was killed are paused.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.sources import find_sweep
    from tune_jobs.sweeps.status import trials_as_left

    return Trials(trials_as_left(find_sweep(sweep, storage)))


@checked
def importance(sweep: str | Path, *, storage: str | Path | None = None) -> WhatMattered:
    """Say which hyperparameters a sweep's scores depend on, as its report does.

    Scores are what settings are judged by (`objective` in the sweep file). It can be asked of a sweep that still runs.

    Returns:
        The share of each searched hyperparameter, the most important first, with its interval; the adjusted scores of
        its values; pairs that matter together; and ends of its values that are worth moving. `too_few` says why
        nothing can be said, if that is so.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.sources import find_sweep

    return importance_of(find_sweep(sweep, storage))


def importance_of(store: Sweep) -> WhatMattered:
    """Say which hyperparameters a sweep's scores depend on; see `importance`."""
    from analysis.importance import what_mattered
    from tune_jobs.sweeps.exports import sweep_data

    data = sweep_data(store)
    return what_mattered(store.read_record(), data.trials, data.results, threshold=data.threshold)


def front_view_of(store: Sweep) -> FrontView:
    """Set a sweep's settings against their cost, as its report does; it may still run."""
    from analysis.front_view import front_view
    from tune_jobs.sweeps.gathered import spec_of, sweep_data

    return front_view(sweep_data(store), spec_of(store).objective.cost)


@allowed_again()
@checked
def report(sweep: str | Path, *, storage: str | Path | None = None, progress: Progress = "auto") -> ReportPath:
    """Write a sweep's report and return the path of its index.html.

    Args:
        sweep: Name or folder.
        storage: Folder for sweeps.
        progress: The same as for `best`.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.conclude import make_report
    from tune_jobs.sweeps.live_view import working
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    with working(store.name, "writing the report", progress) as say:
        return ReportPath(make_report(store, say=say))
