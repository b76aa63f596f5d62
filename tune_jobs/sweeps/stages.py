"""Run a sweep whose lock is held, stage by stage: its trials, more seeds for its leaders, and its conclusion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from analysis.records import FINISHED, ReplicationRecord
from analysis.wording import counted
from policies.errors import TuneJobsError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.points import num_points_of
from tune_jobs.plan.sweep_plan import SweepPlan
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import resume_command
from tune_jobs.sweeps.adding import add_what_is_missing
from tune_jobs.sweeps.confirm import points_to_confirm
from tune_jobs.sweeps.drawing import import_ahead
from tune_jobs.sweeps.drive import Shared, close_if_open, run_trials_of
from tune_jobs.sweeps.finishing import finish_sweep
from tune_jobs.sweeps.lost_storage import told_if_it_is_gone
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.races import last_race, next_round

RACE = "more seeds"
"""What the rounds of a race are called."""


@dataclass(frozen=True)
class MoreSeeds:
    """More seeds that some points get when the trials have ended, in rounds."""

    next_round: Callable[[], ReplicationRecord | None]
    """Says before each round which points get one more seed each; None: that was all."""
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
        more: What gives more seeds; None: a race that was interrupted, else `confirm`.

    Raises:
        CannotRunError: Ray cannot run here, or died; or the storage is gone.
        TuneJobsError: As `more` raises it.
    """
    shared = Shared()
    try:
        with told_if_it_is_gone(store, lambda: None if shared.monitor is None else shared.monitor.reported_at):
            return _run_sweep(
                store, plan, shared, address=address, machine=machine, finish=finish, progress=progress, more=more
            )
    except KeyboardInterrupt:
        with current().shielded():
            current().came = True
            close_if_open(store)
            return SweepResult(store.place, store.read_record(), store.read_trials(), interrupted=True)


def _run_sweep(
    store: Sweep,
    plan: SweepPlan,
    shared: Shared,
    *,
    address: str | None,
    machine: Machine | None,
    finish: bool,
    progress: str,
    more: MoreSeeds | None,
) -> SweepResult:
    notes = []
    had_all = all(trial.status in FINISHED for trial in store.read_trials())
    with shared:
        result = run_trials_of(store, plan, shared, address=address, machine=machine, progress=progress)
        rounds = more or _own_rounds(store, finish=finish)
        while rounds is not None and not result.interrupted and not current().came and not store.stop_requested():
            try:
                added = rounds.next_round()
            except TuneJobsError as error:
                if more is not None:
                    raise
                notes.append(f"The leading settings were not trained again: {error}")
                break
            if added is None:
                break
            had_all = False
            record = store.read_record()
            record = record.model_copy(update={"replications": (*record.replications, added)})
            plan = add_what_is_missing(store, record, stored_spec(record), plan.machine, address)
            trainings, settings = len(added.points), len(set(added.points))
            told = f"{rounds.told}: {counted(trainings, 'training')} of {counted(settings, 'setting')}"
            result = run_trials_of(
                store, plan, shared, address=address, machine=machine, progress=progress, told=told
            )  # fmt: skip
        if finish and not result.interrupted and not current().came:
            # Ray's end and what is played next leave this process little to do.
            import_ahead()
    if result.interrupted:
        return result
    if not finish:
        return replace(result, notes=_what_is_left_out(store))
    if current().came:
        return replace(result, interrupted=True)
    result = finish_sweep(store, result, progress, keep=had_all)
    return replace(result, notes=(*notes, *result.notes))


def _own_rounds(store: Sweep, *, finish: bool) -> MoreSeeds | None:
    """Return the rounds that nobody asks for anew: those of a race that was interrupted, else the sweep's `confirm`."""
    if last_race(store.read_record()) is not None:
        return MoreSeeds(lambda: next_round(store), RACE)
    return MoreSeeds(lambda: _round_of_confirm(store), "confirm") if finish else None


def _what_is_left_out(store: Sweep) -> tuple[str, ...]:
    """Return a note on more seeds that the sweep's `confirm` would have given now; none, if it would not."""
    try:
        wanted = points_to_confirm(store)
    except TuneJobsError:
        # Who wants them is told what is wrong.
        return ()
    if not wanted:
        return ()
    told = f"the {len(set(wanted))} leading settings got no more seeds (confirm), as nothing was to follow the trials"
    return (f"{told}: `{resume_command(store, store.read_record())}` does both.",)


def _round_of_confirm(store: Sweep) -> ReplicationRecord | None:
    points = points_to_confirm(store)
    if not points:
        return None
    record = store.read_record()
    num_points = num_points_of(stored_spec(record), record.chosen_points)
    return ReplicationRecord(num_points=num_points, points=points, by="confirm")
