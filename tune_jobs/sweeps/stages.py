"""Run a sweep whose lock is held, stage by stage: its trials, more seeds for its leaders, and its conclusion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from analysis.records import FINISHED, ReplicationRecord
from analysis.wording import counted
from policies.errors import TuneJobsError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.adding import add_what_is_missing
from tune_jobs.sweeps.confirm import points_to_confirm
from tune_jobs.sweeps.drive import Shared, close_if_open, run_trials_of
from tune_jobs.sweeps.finishing import finish_sweep
from tune_jobs.sweeps.outcome import SweepResult


@dataclass(frozen=True)
class MoreSeeds:
    """More seeds that some points get when the trials have ended, in rounds."""

    by: Literal["replicate", "confirm"]
    next_points: Callable[[], tuple[int, ...]]
    """Says before each round which points get one more seed each; the indices may repeat. None: the end."""
    told: str
    """What it is, for the table's heading."""


def run_sweep(
    store: Sweep,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
    more: MoreSeeds | None = None,
) -> SweepResult:
    """Run the unfinished trials of a sweep whose lock is held, give its leading settings more seeds, and conclude it.

    A KeyboardInterrupt ends it with the results so far: the records are written, whatever was begun.

    Args:
        store: The sweep.
        plan: Its plan.
        address: Ray cluster to run on; None: this machine.
        machine: This machine, if Ray is started here.
        finish: Whether it is concluded; only then its `confirm` gives more seeds.
        progress: The same as for `launch`.
        more: What gives more seeds instead of `confirm`.

    Raises:
        CannotRunError: Ray cannot run here, or died.
        TuneJobsError: As `more` raises it.
    """
    try:
        return _run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress, more=more)
    except KeyboardInterrupt:
        with current().shielded():
            current().came = True
            close_if_open(store)
            return SweepResult(store.folder, store.read_record(), store.read_trials(), interrupted=True)


def _run_sweep(
    store: Sweep,
    plan: SweepPlan,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
    more: MoreSeeds | None,
) -> SweepResult:
    notes = []
    had_all = all(trial.status in FINISHED for trial in store.read_trials())
    with Shared() as shared:
        result = run_trials_of(store, plan, shared, address=address, machine=machine, progress=progress)
        rounds = more or (MoreSeeds("confirm", lambda: points_to_confirm(store), "confirm") if finish else None)
        while rounds is not None and not result.interrupted and not current().came and not store.stop_requested():
            try:
                points = rounds.next_points()
            except TuneJobsError as error:
                if more is not None:
                    raise
                notes.append(f"The leading settings were not trained again: {error}")
                break
            if not points:
                break
            had_all = False
            record = store.read_record()
            added = ReplicationRecord(num_points=plan.num_points, points=points, by=rounds.by)
            record = record.model_copy(update={"replications": (*record.replications, added)})
            plan = add_what_is_missing(store, record, stored_spec(record), plan.machine, address)
            told = f"{rounds.told}: {counted(len(points), 'training')} of {counted(len(set(points)), 'setting')}"
            result = run_trials_of(
                store, plan, shared, address=address, machine=machine, progress=progress, told=told
            )  # fmt: skip
    if result.interrupted or not finish:
        return result
    if current().came:
        return replace(result, interrupted=True)
    result = finish_sweep(store, result, progress, keep=had_all)
    return replace(result, notes=(*notes, *result.notes))
