"""Resume or extend a sweep: find what is left to run, and check that its trials are still the same."""

from __future__ import annotations

import contextlib

from analysis.records import FINISHED, SweepRecord
from policies.envs.modules import allow_modules
from policies.errors import CannotRunError
from policies.guard.guard import guarding
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.process.interruption import current
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.rules import check_extendable
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
    with contextlib.ExitStack() as stack:
        stack.enter_context(store.lock())
        # The request was for a process that was killed.
        store.clear_stop_request()
        stack.enter_context(settled(store))
        record = store.read_record()
        allow_modules(record.allowed_modules)
        spec = stored_spec(record)
        if num_samples:
            check_extendable(spec)
        spec = spec.model_copy(update={"num_samples": spec.num_samples + num_samples})
        machine = machine_here() if address is None else None
        if machine is None:
            connection = stack.enter_context(connected(address, None))
            from tune_jobs.ray_tune.cluster import check_storage

            check_storage(store.folder)
        plan = make_plan(spec, machine or connection.machine, store.read_trials(), retry_failed=retry_failed)
        check_same_trials(store, plan)
        with current().shielded():
            _add_trials(store, record, spec, plan, address, retry_failed=retry_failed)
        return run_sweep(store, plan, address=address, machine=machine, finish=finish, progress=progress)


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
