"""The results of a sweep: its trials as records and as a table, and its report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.records import TrialRecord
from policies.arguments import checked
from policies.envs.modules import allowed_again
from policies.errors import NotFoundError

if TYPE_CHECKING:
    import pandas as pd


@checked
def trials(sweep: str | Path, *, storage: str | Path | None = None) -> list[TrialRecord]:
    """Return the records of a sweep's trials, by index.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.store.candidates import read_trials
    from tune_jobs.sweeps.conclude import find_sweep

    return read_trials(find_sweep(sweep, storage))


@checked
def dataframe(sweep: str | Path, *, storage: str | Path | None = None) -> pd.DataFrame:
    """Return a sweep's trials as a pandas DataFrame, one row per trial: the table `trials.csv` of its report.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from analysis.report_data import goal_of
    from analysis.tables import trials_frame
    from tune_jobs.store.candidates import read_trials
    from tune_jobs.sweeps.conclude import find_sweep, read_results

    store = find_sweep(sweep, storage)
    try:
        best = store.read_best()
    except NotFoundError:
        # No winner was chosen yet, or it can't be read: then the env's own threshold counts.
        best = None
    return trials_frame(read_trials(store), read_results(store), threshold=goal_of(store.read_record(), best))


@allowed_again()
@checked
def report(sweep: str | Path, *, storage: str | Path | None = None) -> Path:
    """Write a sweep's report and return the path of its index.html.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.conclude import find_sweep, make_report

    return make_report(find_sweep(sweep, storage))
