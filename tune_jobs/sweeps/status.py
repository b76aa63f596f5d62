"""How sweeps stand, by their files and locks."""

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
    """A sweep in a few numbers."""

    sweep: SweepRecord
    counts: dict[TrialStatus, int]
    """Number of trials by status."""
    alive: bool
    """Whether a process runs it now."""


@checked
def status(sweep: str | Path, *, storage: str | Path | None = None) -> SweepStatus:
    """How a sweep stands.

    Raises:
        NotFoundError: No such sweep.
    """
    from tune_jobs.sweeps.conclude import find_sweep

    return _status(find_sweep(sweep, storage))


@checked
def list_sweeps(storage: str | Path | None = None) -> list[SweepStatus]:
    """How every sweep in a storage folder stands, by name; one that cannot be read is left out with a warning."""
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
        # Its process was killed before it could write so.
        record = record.model_copy(update={"state": "interrupted"})
        counts["paused"] += counts.pop("running", 0)
    return SweepStatus(record, {name: number for name, number in counts.items() if number}, alive)
