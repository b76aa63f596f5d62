"""The status of sweeps, read from their files and locks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from analysis.records import SweepRecord, TrialStatus
from policies.arguments import checked
from policies.errors import TuneJobsError
from tune_jobs.store.contract import Sweep
from tune_jobs.store.local_storage import open_storage
from tune_jobs.sweeps.storage import storage_folder


@dataclass(frozen=True)
class SweepStatus:
    """The status of a sweep."""

    sweep: SweepRecord
    counts: dict[TrialStatus, int]
    """Number of trials by status."""
    alive: bool
    """Whether a process runs the sweep now."""


@checked
def status(sweep: str | Path, *, storage: str | Path | None = None) -> SweepStatus:
    """Return the status of a sweep.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.conclude import find_sweep

    return _status(find_sweep(sweep, storage))


@checked
def list_sweeps(storage: str | Path | None = None) -> list[SweepStatus]:
    """Return the status of every sweep in a storage folder, by name; sweeps that cannot be read give a warning."""
    from tune_jobs.store.candidates import leave_out

    found = []
    for store in open_storage(storage_folder(storage)).sweeps():
        try:
            found.append(_status(store))
        except TuneJobsError as error:
            leave_out(error)
    return found


def _status(store: Sweep) -> SweepStatus:
    record, alive = store.read_record(), store.is_driven()
    counts = Counter(trial.status for trial in store.read_trials())
    if record.state == "running" and not alive:
        # Its process was killed before it could write that it ended.
        record = record.model_copy(update={"state": "interrupted"})
        counts["paused"] += counts.pop("running", 0)
    return SweepStatus(record, {name: number for name, number in counts.items() if number}, alive)
