"""The results of a sweep: its trials as records and as a table, and its report."""

from __future__ import annotations

from pathlib import Path, PosixPath
from typing import TYPE_CHECKING

from analysis.notebook import BriefList, film_html, page_html, rows_html
from analysis.records import TrialRecord
from analysis.selection import score_trial
from analysis.wording import PLAIN_NONE, return_text, setting_text
from policies.arguments import checked
from policies.envs.modules import allowed_again
from policies.errors import NotFoundError

if TYPE_CHECKING:
    import pandas as pd


class Trials(BriefList[TrialRecord]):
    """The trials of a sweep, by index."""

    def _repr_html_(self) -> str:
        names = list(dict.fromkeys(name for trial in self for name in trial.point))
        rows = []
        for trial in self:
            scored = score_trial(trial)
            score = return_text(None if scored is None else scored.score, none=PLAIN_NONE)
            values = (setting_text(trial.point.get(name)) for name in names)
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
    """Return the records of a sweep's trials, by index.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.store.candidates import read_trials
    from tune_jobs.sweeps.conclude import find_sweep

    return Trials(read_trials(find_sweep(sweep, storage)))


@checked
def dataframe(sweep: str | Path, *, storage: str | Path | None = None) -> pd.DataFrame:
    """Return a sweep's trials as a pandas DataFrame, one row per trial: the table `trials.csv` of its report.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from analysis.report_data import goal_of
    from analysis.tables import trials_frame
    from tune_jobs.store.candidates import read_results, read_trials
    from tune_jobs.sweeps.conclude import find_sweep

    store = find_sweep(sweep, storage)
    try:
        best = store.read_best()
    except NotFoundError:
        # No winner was chosen yet, or it can't be read: then the env's own threshold counts.
        best = None
    return trials_frame(read_trials(store), read_results(store), threshold=goal_of(store.read_record(), best))


@allowed_again()
@checked
def report(sweep: str | Path, *, storage: str | Path | None = None) -> ReportPath:
    """Write a sweep's report and return the path of its index.html.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.conclude import find_sweep, make_report

    return ReportPath(make_report(find_sweep(sweep, storage)))
