"""The status of sweeps, read from their files and locks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.records import SweepRecord, TrialRecord, TrialStatus
from analysis.selection import NoUsableTrialError, select_best
from policies.arguments import checked
from policies.errors import CheckpointError, TuneJobsError
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.local_storage import open_storage
from tune_jobs.sweeps.forecast import Forecast, caps_of, forecast
from tune_jobs.sweeps.storage import storage_folder


@dataclass(frozen=True)
class BestSoFar:
    """The checkpoint that would win now; it is not confirmed."""

    trial_id: str
    iteration: int
    num_env_steps: int
    """Env steps of its trial until then."""
    point: dict[str, Any]
    seed: int
    score: float
    """Mean evaluation return of the point, over its seeds."""


@dataclass(frozen=True)
class SweepStatus:
    """The status of a sweep."""

    sweep: SweepRecord
    counts: dict[TrialStatus, int]
    """Number of trials by status."""
    alive: bool
    """Whether a process runs the sweep now."""
    num_env_steps: int = 0
    """Env steps of all trials so far."""
    max_env_steps: int | None = None
    """The most env steps that there will be, those of ended trials and the caps of the others; None: not known."""
    env_steps_per_s: float | None = None
    """Of the running trials together; None: not known, or none runs."""
    time_left_s: float | None = None
    """An estimate of the seconds until all trials have ended; None: not known, or nothing runs."""
    best: BestSoFar | None = None
    """None: no trial has been evaluated yet, or none that was may win."""


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
    record, alive, trials = store.read_record(), store.is_driven(), store.read_trials()
    counts = Counter(trial.status for trial in trials)
    if record.state == "running" and not alive:
        # Its process was killed before it could write that it ended.
        record = record.model_copy(update={"state": "interrupted"})
        counts["paused"] += counts.pop("running", 0)
    so_far = _forecast(record, trials, alive=alive)
    return SweepStatus(
        record,
        {name: number for name, number in counts.items() if number},
        alive,
        num_env_steps=sum(trial.num_env_steps for trial in trials),
        max_env_steps=None if so_far is None else so_far.max_env_steps,
        env_steps_per_s=None if so_far is None else so_far.env_steps_per_s,
        time_left_s=None if so_far is None else so_far.time_left_s,
        best=_best(trials),
    )


def _forecast(record: SweepRecord, trials: Sequence[TrialRecord], *, alive: bool) -> Forecast | None:
    try:
        return forecast(trials, caps_of(stored_spec(record), trials), running=alive)
    except CheckpointError:
        # The status of a sweep of another version is still told.
        return None


def _best(trials: Sequence[TrialRecord]) -> BestSoFar | None:
    try:
        best = select_best(trials)
    except NoUsableTrialError:
        return None
    checkpoint = best.checkpoint
    point = best.trial.point_at(checkpoint.iteration)
    return BestSoFar(
        best.trial.trial_id, checkpoint.iteration, checkpoint.num_env_steps, point, best.trial.seed, best.point_score
    )
