"""Resume, extend or replicate a sweep: find what is left to run, and check that its trials are still the same."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from analysis.numbering import planned_places
from analysis.records import FINISHED, ReplicationRecord, SweepRecord
from policies.envs.modules import allow_modules
from policies.errors import CannotRunError, CheckpointError
from policies.guard.guard import guarding
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan, num_points_of
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.rules import check_extendable, check_replicable
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.transitions import pending_record, tried_again
from tune_jobs.sweeps.drive import connected, machine_here, run_sweep, settled
from tune_jobs.sweeps.outcome import SweepResult


@guarding()
def go_on(
    store: Sweep,
    address: str | None,
    num_samples: int,
    *,
    finish: bool,
    progress: str,
    retry_failed: bool,
) -> SweepResult:
    """Run what is missing of a sweep, and `num_samples` more samples of its space.

    Raises:
        SpecError: The space has nothing to draw more samples from.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    with _taken_over(store, address) as (machine, where):
        record = store.read_record()
        spec = stored_spec(record)
        if num_samples:
            check_extendable(spec)
        spec = spec.model_copy(update={"num_samples": spec.num_samples + num_samples})
        plan = _add_what_is_missing(store, record, spec, where, address, retry_failed=retry_failed)
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)


@guarding()
def replicate(
    store: Sweep,
    address: str | None,
    next_points: Callable[[], tuple[int, ...]],
    *,
    finish: bool,
    progress: str,
) -> SweepResult:
    """Run what is missing of a sweep, then train some of its points with more seeds, stage by stage.

    Args:
        store: The sweep.
        address: Ray cluster to run on; None: this machine.
        next_points: Says before each stage which points get one more seed each; the indices may repeat. None: the end.
        finish: The same as for `launch`.
        progress: The same as for `launch`.

    Raises:
        SpecError: The sweep cannot be replicated.
        CannotRunError: Another process runs the sweep, or it cannot run here.
    """
    with _taken_over(store, address) as (machine, where), contextlib.ExitStack() as stack:
        record = store.read_record()
        spec = stored_spec(record)
        check_replicable(spec)
        plan = _add_what_is_missing(store, record, spec, where, address)
        result = run_sweep(store, plan, address=address, machine=machine, finish=False, progress=progress)
        is_first = True
        while not result.interrupted and (points := next_points()):
            if is_first:
                # One Ray for all stages.
                stack.enter_context(connected(address, machine))
            is_first = False
            record = store.read_record()
            added = ReplicationRecord(num_points=plan.num_points, points=points)
            record = record.model_copy(update={"replications": (*record.replications, added)})
            plan = _add_what_is_missing(store, record, spec, where, address)
            result = run_sweep(store, plan, address=address, machine=machine, finish=False, progress=progress)
        stack.close()
        if result.interrupted or not finish:
            return result
        return run_sweep(store, plan, address=address, machine=machine, finish=True, progress=progress)


@contextlib.contextmanager
def _taken_over(store: Sweep, address: str | None) -> Iterator[tuple[Machine | None, Machine]]:
    """Hold the sweep's lock for the block; gives the machine to start Ray on, if any, and what the sweep runs on."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(store.lock())
        # The request was for a process that was killed.
        store.clear_stop_request()
        stack.enter_context(settled(store))
        allow_modules(store.read_record().allowed_modules)
        machine = machine_here() if address is None else None
        if machine is not None:
            yield machine, machine
            return
        connection = stack.enter_context(connected(address, None))
        from tune_jobs.ray_tune.cluster import check_storage

        check_storage(store.folder)
        yield None, connection.machine


def _add_what_is_missing(
    store: Sweep,
    record: SweepRecord,
    spec: SweepSpec,
    machine: Machine,
    address: str | None,
    *,
    retry_failed: bool = False,
) -> SweepPlan:
    """Plan the sweep of a record, and write the record and the trials that do not exist yet."""
    _check_replications(record, spec)
    trials = store.read_trials()
    plan = make_plan(spec, machine, trials, replications=record.replications, retry_failed=retry_failed)
    check_same_trials(store, plan)
    with current().shielded():
        _add_trials(store, record, spec, plan, address, retry_failed=retry_failed)
    return plan


def _check_replications(record: SweepRecord, spec: SweepSpec) -> None:
    try:
        planned_places(num_points_of(spec), spec.seeds_per_point, record.replications)
    except ValueError as error:
        raise CheckpointError(
            f"The record of sweep {record.name} is damaged: {error}.", f"Restore {SWEEP_RECORD} from a backup."
        ) from error


def check_same_trials(store: Sweep, plan: SweepPlan) -> None:
    """Check that planning again gives the trials that exist.

    Raises:
        CannotRunError: It gives others; a resumed trial would train with other values than it began with.
    """
    planned = {trial.trial_id: trial for trial in plan.trials}
    for record in store.read_trials():
        trial = planned.get(record.trial_id)
        # A point that a search method chose depends on the trials that had ended then, which may be more by now.
        same = trial is not None and (not trial.has_point or trial.hyperparams == record.first_hyperparams)
        if trial is None or trial.seed != record.seed or not same:
            raise CannotRunError(
                f"Trial {record.trial_id} of sweep {store.name} is not the one its spec gives: {SWEEP_RECORD} was "
                "changed, or was written by a version that draws other points.",
                f"Restore {SWEEP_RECORD} from a backup, or launch a new sweep.",
            )


def _add_trials(
    store: Sweep, record: SweepRecord, spec: SweepSpec, plan: SweepPlan, address: str | None, *, retry_failed: bool
) -> None:
    """Write the records of the trials that are added; nothing if there are none to run."""
    known = {trial.trial_id: trial for trial in store.read_trials()}
    todo = []
    for trial in plan.trials:
        before = known.get(trial.trial_id)
        if before is None:
            todo.append(pending_record(trial))
        elif retry_failed and before.status == "failed":
            todo.append(tried_again(before))
    if not todo and all(trial.status in FINISHED for trial in known.values()):
        return
    # The sweep's record comes first: if this process is killed then, trials are missing, which a resume adds. Trials
    # that the sweep's spec does not give would be refused for good.
    changes = {"spec": spec.model_dump(mode="json"), "num_trials": len(plan.trials), "address": address}
    store.write_record(record.model_copy(update={**changes, "state": "running"}))
    for trial_record in todo:
        store.trial(trial_record.trial_id).write_record(trial_record)
