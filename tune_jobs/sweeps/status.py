"""The status of sweeps, read from their files and locks."""

from __future__ import annotations

import shlex
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from analysis.notebook import BriefList, brief_repr, facts_html, rows_html
from analysis.records import SweepRecord, TrialRecord, TrialStatus
from analysis.selection import NoUsableTrialError, select_best
from analysis.waits import WaitRecord
from analysis.wording import PLAIN_NONE, counted, duration, return_text, setting_text
from policies.arguments import checked
from policies.errors import CheckpointError, TuneJobsError
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import open_storage, open_sweep, resume_command
from tune_jobs.store.transitions import paused
from tune_jobs.store.urls import is_url
from tune_jobs.sweeps.forecast import Forecast, caps_of, forecast
from tune_jobs.sweeps.storage import storage_place


@dataclass(frozen=True)
class BestSoFar:
    """The checkpoint that leads by its evaluations; of a finished sweep the policy that was chosen."""

    trial_id: str
    iteration: int
    num_env_steps: int
    """Env steps of its trial until then."""
    point: dict[str, Any]
    seed: int
    score: float
    """Mean evaluation return of the point, over its seeds; of a finished sweep that of the policy."""


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
    lacks_seeds: bool = field(default=False, compare=False, metadata={"json": None})
    """Whether its trials are done and no policy was chosen, before which its leading settings get more seeds."""
    place: str | None = field(default=None, compare=False, metadata={"json": None})
    """The folder or URL by which commands find it here; None: they find it by its name, as at a service."""

    @property
    def state(self) -> str:
        """The sweep's state; interrupted if it was running when its process was killed."""
        return "interrupted" if self.sweep.state == "running" and not self.alive else self.sweep.state

    @property
    def told_state(self) -> str:
        """The sweep's state for a list, in which nothing else says that it waits."""
        return self.state if self.waits_for is None else "waiting for nodes"

    @property
    def told_counts(self) -> str:
        """The number of trials by status, as text."""
        return ", ".join(f"{number:,} {name}" for name, number in self.counts.items() if number) or "none"

    def facts(self, program: str = "tune-jobs") -> dict[str, str]:
        """Return what is known, each with its name, for a reader.

        Args:
            program: How a command begins that finds the sweep by its name.
        """
        facts = {
            "sweep": self.sweep.name,
            "state": self.state,
            **self._waits(),
            "progress": self._progress(),
            "trials": f"{self.sweep.num_trials:,}: {self.told_counts}",
            "best so far": _best_text(self.best),
            "speed": "" if self.env_steps_per_s is None else f"{self.env_steps_per_s:,.0f} env steps/s",
            "time left": self._time_left(program),
            "run time": self._run_time(),
        }
        return {name: text for name, text in facts.items() if text}

    @property
    def waits_for(self) -> WaitRecord | None:
        """The nodes that the sweep waits for now; None: it doesn't wait."""
        return self.sweep.waiting if self.alive else None

    def _waits(self) -> dict[str, str]:
        wait = self.sweep.waiting
        if wait is None:
            return {}
        told = wait.told(time.time(), is_over=not self.alive)
        return {"waits for" if self.alive else "waited for": told}

    def _progress(self) -> str:
        if self.max_env_steps is None:
            return counted(self.num_env_steps, "env step")
        if self.num_env_steps >= self.max_env_steps:
            return f"100 %: {counted(self.num_env_steps, 'env step')}"
        # Rounded down, so that 100 % means done.
        share = 100 * self.num_env_steps // self.max_env_steps
        return f"{share} %: {self.num_env_steps:,} of at most {counted(self.max_env_steps, 'env step')}"

    def _time_left(self, program: str) -> str:
        if not self.alive:
            if self.sweep.state == "completed":
                return self._what_is_left(program) if self.lacks_seeds else ""
            verb = "starts" if self.sweep.state == "created" else "continues"
            return f"nothing runs; `{self._how_to_resume(program)}` {verb} it"
        if self.sweep.state == "completed":
            return "the trials are done; the best is being confirmed and filmed, and the report written"
        if self.waits_for is not None:
            return "not known while it waits for nodes"
        if self.time_left_s is None:
            return self._why_unknown()
        return f"about {duration(self.time_left_s, tenths=False, none=PLAIN_NONE)}"

    def _what_is_left(self, program: str) -> str:
        told = "more seeds for its leading settings (confirm), and the best policy"
        return f"nothing runs; `{self._how_to_resume(program)}` does what follows the trials: {told}"

    def _how_to_resume(self, program: str) -> str:
        if self.place is None:
            return f"{program} resume {shlex.quote(self.sweep.name)}"
        return resume_command(open_sweep(self.place), self.sweep)

    def _why_unknown(self) -> str:
        """Say why there is no estimate, though the sweep runs."""
        if not self.num_env_steps:
            return "not known before the first env steps are reported"
        # Those that ended say nothing of how many run at once from now on.
        trials = "leaders that get more seeds" if self._is_replicating() else "trials that are left"
        return f"not known before the {trials} report env steps"

    def _is_replicating(self) -> bool:
        """Whether the last trials that the sweep got are more seeds of points that it had."""
        from tune_jobs.sweeps.confirm import recent_rounds

        try:
            return bool(self.sweep.replications and recent_rounds(self.sweep))
        except CheckpointError:
            # The status of a sweep of another version is still told.
            return False

    def _run_time(self) -> str:
        before, started = self.sweep.run_time_s, self.sweep.started_at
        if not self.alive or self.sweep.state == "completed":
            return duration(before, none=PLAIN_NONE)
        if before == 0 and started is not None:
            return duration(max(0.0, time.time() - started), tenths=False, none=PLAIN_NONE)
        # When this run began is not recorded.
        return f"{duration(before, none=PLAIN_NONE)} before this run"

    def __repr__(self) -> str:
        hidden = ("sweep", "lacks_seeds", "place")
        told = {each.name: getattr(self, each.name) for each in fields(self) if each.name not in hidden}
        return brief_repr("SweepStatus", name=self.sweep.name, state=self.state, **told)

    def _repr_html_(self) -> str:
        facts = self.facts()
        return facts_html(f"Sweep {facts.pop('sweep')}", facts)


class Sweeps(BriefList[SweepStatus]):
    """The sweeps of a storage folder, by name."""

    def _repr_html_(self) -> str:
        rows = [
            (each.sweep.name, each.told_state, each.told_counts, _best_text(each.best).split("  ")[0]) for each in self
        ]
        return rows_html(("sweep", "state", "trials", "best so far"), rows)


def _best_text(best: BestSoFar | None) -> str:
    if best is None:
        return "no evaluation yet"
    point = ", ".join(f"{name} {setting_text(value)}" for name, value in best.point.items())
    where = f"{best.trial_id}, at {best.num_env_steps:,} env steps"
    return f"{return_text(best.score)}  {point or 'no searched values'}  ({where})"


@checked
def status(sweep: str | Path, *, storage: str | Path | None = None) -> SweepStatus:
    """Return the status of a sweep.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from tune_jobs.sweeps.sources import find_sweep

    return _status(find_sweep(sweep, storage))


@checked
def list_sweeps(storage: str | Path | None = None) -> list[SweepStatus]:
    """Return the status of every sweep in a storage folder, by name; sweeps that cannot be read give a warning."""
    from tune_jobs.store.candidates import leave_out

    found = Sweeps()
    for seen in _each(open_storage(storage_place(storage)).sweeps()):
        if isinstance(seen, TuneJobsError):
            leave_out(seen)
        else:
            found.append(seen)
    return found


def _each(stores: Sequence[Sweep]) -> Iterable[SweepStatus | TuneJobsError]:
    """Look at several sweeps; at those of an object store side by side, as each look waits for answers."""
    if not any(is_url(store.place) for store in stores):
        return map(_readable, stores)
    # Folders need none of it.
    import contextvars
    from concurrent.futures import ThreadPoolExecutor

    from tune_jobs.store.objects.at_once import AT_ONCE

    contexts = [contextvars.copy_context() for _ in stores]
    # Not those for single requests, for which each of these waits.
    with ThreadPoolExecutor(AT_ONCE, "list") as pool:
        return list(pool.map(lambda context, store: context.run(_readable, store), contexts, stores))


def _readable(store: Sweep) -> SweepStatus | TuneJobsError:
    """Return the status of a sweep, or why it can't be read."""
    try:
        return _status(store)
    except TuneJobsError as error:
        return error


def _status(store: Sweep) -> SweepStatus:
    from tune_jobs.store.candidates import readable_trials
    from tune_jobs.sweeps.reached import up_to_now

    record = store.read_record()
    return replace(status_of(store, record, up_to_now(store, readable_trials(store))), place=store.place)


def was_killed(record: SweepRecord, *, alive: bool) -> bool:
    """Whether a sweep's process was killed before it could write that it ended, and which trials it left."""
    return record.state == "running" and not alive


def as_left(trials: Sequence[TrialRecord]) -> list[TrialRecord]:
    """Return the trials of a sweep whose process was killed: those that ran will continue from their checkpoints."""
    return [paused(trial) if trial.status == "running" else trial for trial in trials]


def trials_as_left(store: Sweep) -> list[TrialRecord]:
    """Return the records of a stored sweep's trials, as `trials` does.

    Raises:
        CheckpointError: The record of the sweep is damaged.
    """
    from tune_jobs.store.candidates import read_trials

    found = read_trials(store)
    # The lock is looked at where it matters alone.
    runs = any(trial.status == "running" for trial in found)
    return as_left(found) if runs and was_killed(store.read_record(), alive=store.is_driven()) else found


def status_of(
    store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord], *, alive: bool | None = None
) -> SweepStatus:
    """Return the status of a sweep whose records have been read.

    Args:
        store: The sweep.
        record: Its record.
        trials: The records of its trials.
        alive: Whether a process runs it now; None: it is looked for.
    """
    if record.name != store.name:
        # Somebody has renamed or copied its folder: by that name it is listed and found.
        record = record.model_copy(update={"name": store.name})
    alive = store.is_driven() if alive is None else alive
    if was_killed(record, alive=alive):
        record, trials = record.model_copy(update={"state": "interrupted"}), as_left(trials)
    counts = Counter(trial.status for trial in trials)
    so_far = _forecast(record, trials, alive=alive)
    best = _confirmed(store, record, trials) or _best(trials)
    return SweepStatus(
        record,
        dict(counts),
        alive,
        num_env_steps=sum(trial.num_env_steps for trial in trials),
        max_env_steps=None if so_far is None else so_far.max_env_steps,
        env_steps_per_s=None if so_far is None else so_far.env_steps_per_s,
        time_left_s=None if so_far is None else so_far.time_left_s,
        best=best,
        lacks_seeds=not alive and lacks_seeds(store, record, trials),
    )


def _forecast(record: SweepRecord, trials: Sequence[TrialRecord], *, alive: bool) -> Forecast | None:
    try:
        return forecast(trials, caps_of(stored_spec(record), trials), running=alive)
    except CheckpointError:
        # The status of a sweep of another version is still told.
        return None


def _confirmed(store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord]) -> BestSoFar | None:
    """Return the winner of a finished sweep, which its evaluations alone do not show."""
    from tune_jobs.sweeps.current_best import is_outdated

    if record.state != "completed" or not store.has_best():
        return None
    try:
        best = store.read_best()
        if is_outdated(store, best, trials):
            return None
    except TuneJobsError:
        return None
    at = best.checkpoint
    return BestSoFar(at.trial_id, at.iteration, at.num_env_steps, best.point, best.seed, best.selection_score)


def lacks_seeds(store: Sweep, record: SweepRecord, trials: Sequence[TrialRecord]) -> bool:
    """Whether a sweep was ended between its trials and its `confirm`, as far as its records tell without its results.

    Args:
        store: The sweep.
        record: Its record.
        trials: Its trials, of which one at least must have an evaluation that may win.
    """
    from tune_jobs.plan.points import num_points_of
    from tune_jobs.sweeps.confirm import largest_race

    if record.state != "completed" or record.replications or store.has_best() or _best(trials) is None:
        return False
    try:
        spec = stored_spec(record)
        return largest_race(spec, num_points_of(spec, record.chosen_points)) is not None
    except CheckpointError:
        # The status of a sweep of another version is still told.
        return False


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
