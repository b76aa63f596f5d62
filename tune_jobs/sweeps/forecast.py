"""How far the trials of a sweep are, in env steps, and how long the others take: from their records alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from analysis.records import FINISHED, TrialRecord
from policies.hyperparams import make_hyperparams
from tune_jobs.plan.estimates import planned_env_steps
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.spec.training_length import as_trained


@dataclass(frozen=True)
class Forecast:
    """How far a sweep's trials are."""

    num_env_steps: int
    """Env steps of all trials so far."""
    max_env_steps: int
    """The most that there will be: of a trial that ended what it took, of another one its cap."""
    env_steps_per_s: float | None
    """Of the running trials together, since each of them began; None: they have not reported any, or none runs."""
    time_left_s: float | None
    """Seconds until all trials have ended, if those that have not take as many env steps as those that have."""

    @property
    def share(self) -> float:
        """The share of the env steps that is done, from 0 to 1."""
        return self.num_env_steps / self.max_env_steps if self.max_env_steps else 1.0


def caps_of(spec: SweepSpec, trials: Sequence[TrialRecord]) -> dict[str, int]:
    """Return the env steps after which each trial ends at the latest, by its id."""
    return {trial.trial_id: _cap(spec, trial) for trial in trials}


def _cap(spec: SweepSpec, trial: TrialRecord) -> int:
    try:
        # Before the search method has chosen the point, its values are the defaults.
        values = make_hyperparams(spec.algorithm, dict(trial.hyperparams))
        return planned_env_steps(as_trained(spec, trial.point), values)
    except ValidationError:
        # Of a record that another version has written.
        return spec.stop.num_env_steps


def forecast(trials: Sequence[TrialRecord], caps: Mapping[str, int], *, running: bool = True) -> Forecast:
    """Sum up how far trials are.

    Args:
        trials: The trials of a sweep.
        caps: The cap of each, as from `caps_of`.
        running: Whether a process runs the sweep; if not, nothing is said of speed and time.
    """
    done = sum(trial.num_env_steps for trial in trials)
    left = [trial for trial in trials if trial.status not in FINISHED]
    most = done + sum(max(0, caps[trial.trial_id] - trial.num_env_steps) for trial in left)
    rate = _rate(left) if running else None
    if not running:
        return Forecast(done, most, None, None)
    if not left:
        return Forecast(done, most, None, 0.0)
    ended = [trial.num_env_steps for trial in trials if trial.status in ("completed", "stopped")]
    usual = math.ceil(sum(ended) / len(ended)) if ended else None
    work = sum(_left(trial, caps[trial.trial_id], usual) for trial in left)
    return Forecast(done, most, rate, None if rate is None else work / rate)


def _rate(left: Sequence[TrialRecord]) -> float | None:
    # The times of trials and not of the sweep: what starting Ray takes is no part of them, nor are earlier runs.
    rates = [trial.num_env_steps / trial.time_s for trial in left if trial.status == "running" and trial.time_s > 0]
    rate = sum(rates)
    return rate if 0 < rate < math.inf else None


def _left(trial: TrialRecord, cap: int, usual: int | None) -> int:
    # One that takes more than is usual may go on to its cap.
    until = cap if usual is None or trial.num_env_steps >= usual else min(usual, cap)
    return max(0, until - trial.num_env_steps)
