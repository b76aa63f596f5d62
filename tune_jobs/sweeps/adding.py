"""Write the trials that a sweep is to have and does not have yet, once it is checked that the others are the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from analysis.numbering import planned_places
from analysis.records import FINISHED, FORMAT_VERSION, TRAINING_LENGTH, ChosenPointRecord, SweepRecord, TrialRecord
from policies.errors import CannotRunError, CheckpointError, SpecError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Hyperparams
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.points import num_points_of, point_hyperparams
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.process.interruption import current
from tune_jobs.search.chosen_point import checked_point, trial_of_point
from tune_jobs.search.points import planned_points
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Sweep
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.transitions import pending_record, tried_again
from tune_jobs.sweeps.changed_code import check_same_spaces, spaces_of


def add_what_is_missing(
    store: Sweep,
    record: SweepRecord,
    spec: SweepSpec,
    machine: Machine,
    address: str | None,
    *,
    retry_failed: bool = False,
) -> SweepPlan:
    """Plan the sweep of a record, and write the record and the trials that do not exist yet.

    Raises:
        CannotRunError: Its trials would be others now, or of another environment; nothing was written.
    """
    _check_numbering(record, spec)
    trials = store.read_trials()
    plan = make_plan(
        spec, machine, trials, replications=record.replications, chosen_points=record.chosen_points,
        retry_failed=retry_failed,
    )  # fmt: skip
    check_same_trials(store, plan)
    with current().shielded():
        _add_trials(store, record, spec, plan, address, retry_failed=retry_failed)
    return plan


def with_chosen_point(
    record: SweepRecord, spec: SweepSpec, trials: Sequence[TrialRecord], given: Mapping[str, Any], named: str
) -> SweepRecord:
    """Return the record of a sweep with one more point, which somebody chose; the arguments are those of `new_point`.

    Raises:
        SpecError: The sweep takes no points, this one is wrong, or the sweep has it already.
    """
    num_points = num_points_of(spec, record.chosen_points)
    added = ChosenPointRecord(num_points=num_points, point=new_point(record, spec, trials, given, named))
    return record.model_copy(update={"chosen_points": (*record.chosen_points, added)})


def new_point(
    record: SweepRecord, spec: SweepSpec, trials: Sequence[TrialRecord], given: Mapping[str, Any], named: str
) -> dict[str, Any]:
    """Return a point that somebody chose, checked, and as the sweep's own points are written.

    Args:
        record: The sweep's record.
        spec: The sweep.
        trials: Its trials.
        given: Values by the names of searched hyperparameters.
        named: How a command names the sweep.

    Raises:
        SpecError: The sweep takes no points, this one is wrong, or a trial has it already.
    """
    point = checked_point(spec, given)
    point_hyperparams(spec, point, None)
    if (known := trial_of_point(spec, point, trials)) is not None:
        raise SpecError(
            f"Sweep {record.name} has this point already: trial {known.trial_id} has its values.",
            f"Choose other values; `tune-jobs replicate {named}` trains the leading points with more seeds.",
        )
    if any(item.point == point for item in record.chosen_points):
        raise SpecError(
            f"Sweep {record.name} has this point already; it was not trained yet.",
            f"Run what is missing with `tune-jobs resume {named}`.",
        )
    return point


def _check_numbering(record: SweepRecord, spec: SweepSpec) -> None:
    try:
        planned_points(spec, record.chosen_points)
        planned_places(num_points_of(spec, record.chosen_points), spec.seeds_per_point, record.replications)
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
    known = HYPERPARAMS_BY_ALGORITHM[store.read_record().spec["algorithm"]]
    for record in store.read_trials():
        trial = planned.get(record.trial_id)
        # A point that a search method chose depends on the trials that had ended then, which may be more by now.
        same = trial is not None and (
            not trial.has_point
            or (
                trial.point.get(TRAINING_LENGTH) == record.point.get(TRAINING_LENGTH)
                and _same_values(trial.hyperparams, record, known)
            )
        )
        if trial is None or trial.seed != record.seed or not same:
            raise CannotRunError(
                f"Trial {record.trial_id} of sweep {store.name} is not the one its spec gives: {SWEEP_RECORD} was "
                "changed, or was written by a version that draws other points.",
                f"Restore {SWEEP_RECORD} from a backup, or launch a new sweep.",
            )


def _same_values(planned: Mapping[str, Any], record: TrialRecord, known: type[Hyperparams]) -> bool:
    """Whether planned hyperparameters are those that a trial began with, as far as its record still has them.

    Names that an older version lacked have defaults. What did not act at first and was given a value by a change of a
    population is not looked at: the record has that value in the place of the one before.
    """
    began, fields = record.first_hyperparams, known.model_fields
    added = {name: fields[name].default for name in planned if name in fields and name not in began}
    first = record.changes[0].before if record.changes else {}
    replaced = {name for change in record.changes for name in change.after if name not in first}
    alike = ({**added, **began}, planned)
    ours, theirs = ({name: each[name] for name in each if name not in replaced} for each in alike)
    return ours == theirs


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
    check_same_spaces(record, known.values(), plan.env)
    # The sweep's record comes first: if this process is killed then, trials are missing, which a resume adds. Trials
    # that the sweep's spec does not give would be refused for good.
    changes = {"spec": spec.model_dump(mode="json"), "num_trials": len(plan.trials), "address": address}
    # The spec is written with all fields of this version.
    changes |= {"format_version": FORMAT_VERSION, "state": "running", "env_spaces": spaces_of(plan.env)}
    store.write_record(record.model_copy(update=changes))
    for trial_record in todo:
        store.trial(trial_record.trial_id).write_record(trial_record, soon=True)
    store.settle()
