"""Find out how far trials are within an iteration, whose records are written at its end alone."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from analysis.records import TrialRecord
from policies.envs.tallies import Reached, read_tally
from policies.errors import TuneJobsError
from tune_jobs.store.contract import Sweep


def reached_of(store: Sweep) -> Callable[[str], Reached | None]:
    """Return what reads how far a running trial of a sweep is, by its id; None: its process is on another machine."""

    def read(trial_id: str) -> Reached | None:
        # Where its folder can't be read or made, others say so; whoever only looks goes on.
        with contextlib.suppress(TuneJobsError, OSError):
            return read_tally(store.trial(trial_id).tally_path)
        return None

    return read


def as_reached(record: TrialRecord, reached: Reached | None) -> TrialRecord:
    """Return a trial's record with what the trial has trained since it was written.

    Args:
        record: The record.
        reached: How far the trial is; None: it is not known.
    """
    if reached is None or record.status != "running" or reached.num_env_steps <= record.num_env_steps:
        return record
    return record.model_copy(update={"num_env_steps": reached.num_env_steps, "time_s": reached.time_s})


def reached_by_now(store: Sweep, trials: Sequence[TrialRecord]) -> dict[str, Reached]:
    """Return how far the running trials of a sweep are, by their ids; those on other machines are left out."""
    # What a process that was killed had trained since is lost.
    if all(trial.status != "running" for trial in trials) or not store.is_driven():
        return {}
    read = reached_of(store)
    running = [trial.trial_id for trial in trials if trial.status == "running"]
    return {trial_id: reached for trial_id in running if (reached := read(trial_id)) is not None}


def up_to_now(store: Sweep, trials: Sequence[TrialRecord]) -> Sequence[TrialRecord]:
    """Return the trials of a sweep with what those that run on this machine have trained by now."""
    reached = reached_by_now(store, trials)
    return [as_reached(trial, reached.get(trial.trial_id)) for trial in trials] if reached else trials
