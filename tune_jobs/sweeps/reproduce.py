"""Run a trial again from its record, and say whether it comes to the same."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from analysis.comparison.repetition import Changed, Repetition, causes, first_difference
from analysis.records import FORMAT_VERSION, CheckpointRecord, IterationRecord, SweepRecord, TrialPlan, TrialRecord
from analysis.selection import error_summary
from analysis.wording import counted
from policies.arguments import checked
from policies.envs.modules import allow_modules
from policies.errors import CannotRunError, NotFoundError, SpecError
from policies.guard.guard import guarding
from policies.hyperparams import TrainedHyperparams, make_hyperparams
from policies.packed.sizes import group_key, is_padded_beside, may_round_by_place
from policies.portable.file import read_policy
from tune_jobs.plan.engine_choice import pack_key
from tune_jobs.process.ran_with import versions
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.scheduler import SchedulerSpec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.candidates import readable_trials
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.store.logs import continued_from
from tune_jobs.store.opening import open_sweep
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.changed_code import git_commit
from tune_jobs.sweeps.drive import machine_here, settled
from tune_jobs.sweeps.outcome import Progress, SweepResult
from tune_jobs.sweeps.repeating import plan_of_repetition
from tune_jobs.sweeps.sources import find_source, find_trial
from tune_jobs.sweeps.stages import run_sweep
from tune_jobs.sweeps.storage import folder_at, local_path

_LONG_S = 1e9
_WEIGHTS = "policy.safetensors"
_MAX_NAMED = 3


@checked
def reproduce(
    source: str | Path,
    *,
    output: str | Path | None = None,
    storage: str | Path | None = None,
    progress: Progress = "auto",
) -> Repetition:
    """Run a trial again from its record, as it ran, and compare every iteration of the two; the trial is only read.

    It runs until the last iteration that is recorded, also where a scheduler ended the trial there; a trial that failed
    for one more. It runs on this machine, by the engine that is recorded; a member of a pack is a pack of its own, as
    its random numbers do not depend on the others (decision 10). What came after the trial had continued from a
    checkpoint, because it was interrupted, failed or waited for others, can't be repeated, and is not compared.

    Args:
        source: `SWEEP/t0003`, or the trial's folder.
        output: Folder to keep the repetition in, which must not exist; None: it is removed.
        storage: Folder for sweeps.
        progress: The same as for `launch`.

    Returns:
        Equal or not; if not, from which iteration on, and what is other now: CPU, versions, environment variables.

    Raises:
        NotFoundError: There is no such trial, or it has done no iteration.
        SpecError: No trial was named, it is one of population based training, which continued from checkpoints of
            others, or the folder is a URL.
        CannotRunError: It cannot run here, or the folder exists or cannot be written.
        SweepInterrupted: Ctrl-C, SIGTERM or SIGHUP ended it.
    """
    store, trial_id = find_source(source, storage)
    if trial_id is None:
        raise SpecError(
            f"{store.name} is a sweep; one of its trials is repeated at a time.",
            f"Name one, such as {store.name}/t0000.",
        )
    trial, sweep = find_trial(store, trial_id), store.read_record()
    spec = stored_spec(sweep)
    recorded = store.trial(trial.trial_id).read_iterations()
    _check(store, trial, spec, recorded)
    repeatable = _repeatable(store, trial, recorded)
    # Read now: while the repetition trains, the trial may go on, and write the iterations after its checkpoint anew.
    ours = _Ours(trial, sweep, recorded, repeatable, _weights_by_iteration(store, trial, repeatable))
    where, is_kept = _folder(output, store.name)
    again = open_sweep(where)
    again.create()
    try:
        _write(again, sweep, spec, trial, repeatable[-1].iteration if repeatable else 1)
        _train_again(again.place, progress)
        return _compared(store, again, ours, folder_at(again.place) if is_kept else None)
    except BaseException:
        # What has trained is there to be looked at; anything else would be in the way of the next try.
        if is_kept and not _has_begun(again, trial.trial_id):
            again.discard()
        raise
    finally:
        if not is_kept:
            shutil.rmtree(where.parent, ignore_errors=True)


def _check(store: Sweep, trial: TrialRecord, spec: SweepSpec, recorded: Sequence[IterationRecord]) -> None:
    name = f"{store.name}/{trial.trial_id}"
    if spec.scheduler.is_population:
        raise SpecError(
            f"{name} is of a population: it continued from checkpoints of other trials, so it can't be repeated by "
            "itself.",
            "Launch the sweep again to repeat the population: in packs it comes to the same; on engine rllib only with "
            "resources that run one process at a time.",
        )
    if not trial.has_point or not recorded:
        why = f": it failed before ({error_summary(trial.error)})" if trial.status == "failed" else ""
        raise NotFoundError(
            f"{name} has done no iteration that could be repeated{why}.",
            f"See `tune-jobs trials {name_in_commands(store.place)}`.",
        )


def _repeatable(store: Sweep, trial: TrialRecord, recorded: Sequence[IterationRecord]) -> list[IterationRecord]:
    """Return the iterations before the trial continued from a checkpoint for the first time; mostly all."""
    continued = continued_from(store.trial(trial.trial_id).newest_log())
    return [item for item in recorded if continued is None or item.iteration <= continued]


def _folder(output: str | Path | None, name: str) -> tuple[Path, bool]:
    """Return the folder of the repetition, and whether it is kept."""
    if output is None:
        return Path(tempfile.mkdtemp(prefix="tune-jobs-reproduce-")) / name, False
    folder = local_path(output)
    if os.path.lexists(folder):
        raise CannotRunError(f"{folder} exists already.", "Give a folder that does not exist; it is made.")
    return folder, True


def _write(again: Sweep, sweep: SweepRecord, spec: SweepSpec, trial: TrialRecord, last_iteration: int) -> None:
    """Write a sweep of the one trial: nothing but its stop rules, and what ended trials, is other.

    The search stays, though the point is known: what is allowed in a space depends on it. So does the name in the sweep
    file, as a folder may have names that it may not.
    """
    # One that failed did so in the iteration after the last that is recorded.
    cap = last_iteration + (trial.status == "failed")
    stop = spec.stop.model_copy(
        update={"num_iterations": min(spec.stop.num_iterations, max(1, cap)), "time_s": _LONG_S}
    )
    confirm = spec.confirm.model_copy(update={"max_share": 0})
    changes = {"stop": stop, "scheduler": SchedulerSpec(), "max_retries": 0, "confirm": confirm}
    plan = TrialPlan.model_validate({name: getattr(trial, name) for name in TrialPlan.model_fields})
    again.trial(trial.trial_id).write_record(pending_record(plan))
    again.write_record(
        sweep.model_copy(
            update={
                "format_version": FORMAT_VERSION, "name": again.name, "state": "created",
                "spec": spec.model_copy(update=changes).model_dump(mode="json"), "num_trials": 1,
                "created_at": time.time(), "started_at": None, "ended_at": None, "run_time_s": 0.0,
                "versions": versions(), "git_commit": git_commit(), "address": None, "job": None,
                "waiting": None, "replications": (), "repeats": f"{sweep.name}/{trial.trial_id}",
            }
        )
    )  # fmt: skip


def _has_begun(again: Sweep, trial_id: str) -> bool:
    """Return whether anything of a repetition has trained."""
    return again.trial(trial_id).has_results() or any(known.status != "pending" for known in readable_trials(again))


@run_alone
@guarding(start=True)
def _train_again(place: str, progress: str) -> SweepResult:
    """Run the one trial of a folder, in Ray's processes, as it ran."""
    store = open_sweep(place)
    record = store.read_record()
    allow_modules(record.allowed_modules)
    spec = stored_spec(record)
    (trial,) = store.read_trials()
    machine = machine_here()
    plan = plan_of_repetition(spec, trial, record, machine)
    with store.lock(), settled(store):
        return run_sweep(store, plan, address=None, machine=machine, finish=False, progress=progress)


@dataclass(frozen=True)
class _Ours:
    """A trial as it was recorded when its repetition began."""

    trial: TrialRecord
    sweep: SweepRecord
    recorded: Sequence[IterationRecord]
    repeatable: Sequence[IterationRecord]
    weights: Mapping[int, str | None]
    """The digests of its checkpoints' weights, by iteration."""


def _compared(store: Sweep, again: Sweep, ours: _Ours, kept_in: Path | None) -> Repetition:
    trial, recorded, repeatable = ours.trial, ours.recorded, ours.repeatable
    (repeated,) = again.read_trials()
    # The last recorded iteration of a trial that a scheduler or a signal ended may lie between two evaluations.
    ended = trial.status not in ("completed", "failed") or len(repeatable) < len(recorded)
    difference = first_difference(repeatable, again.trial(trial.trial_id).read_iterations(), may_lack_evaluation=ended)
    last = repeatable[-1].iteration if difference is None and repeatable else 0
    same = [
        ours.weights[theirs.iteration] == _weights(again, theirs)
        for theirs in repeated.checkpoints
        if theirs.iteration in ours.weights and theirs.iteration <= last
    ]
    known = trial.ran_with or ours.sweep.versions
    changed = list(causes(known, repeated.ran_with or versions()))
    commits = (ours.sweep.git_commit, again.read_record().git_commit)
    if commits[0] != commits[1]:
        changed.append(Changed("git commit", *(commit or "none" for commit in commits)))
    return Repetition(
        name=f"{store.name}/{trial.trial_id}",
        num_iterations=len(recorded),
        num_compared=len(repeatable),
        first_difference=None if difference is None else difference[0],
        differences=() if difference is None else difference[1],
        num_equal_weights=sum(same),
        num_other_weights=len(same) - sum(same),
        causes=tuple(changed),
        notes=tuple(_notes(store, again, trial, repeated, len(recorded) - len(repeatable), is_known="cpu" in known)),
        knows_cpu="cpu" in known,
        folder=kept_in,
    )


def _weights_by_iteration(
    store: Sweep, trial: TrialRecord, repeatable: Sequence[IterationRecord]
) -> dict[int, str | None]:
    found = {}
    for item in trial.checkpoints:
        if repeatable and item.iteration <= repeatable[-1].iteration:
            # One that is gone is not compared.
            with contextlib.suppress(NotFoundError):
                found[item.iteration] = _weights(store, item)
    return found


def _weights(store: Sweep, checkpoint: CheckpointRecord) -> str | None:
    folder = store.checkpoint_folder(checkpoint)
    path = folder / _WEIGHTS
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _notes(
    store: Sweep, again: Sweep, trial: TrialRecord, repeated: TrialRecord, num_left_out: int, *, is_known: bool
) -> list[str]:
    notes = []
    if num_left_out:
        notes.append(
            f"The last {counted(num_left_out, 'iteration')} can't be repeated: the trial was interrupted, failed or "
            "waited for others, and continued from its checkpoint with new episodes."
        )
    if trial.status == "stopped":
        notes.append("A scheduler ended the trial there; the repetition ended at the same iteration.")
    if trial.status in ("running", "paused"):
        notes.append(f"The trial is {trial.status}: it was repeated as far as it was recorded.")
    if trial.status == "failed" or repeated.status == "failed":
        notes.append(_failures(trial, repeated))
    if trial.engine == "packed" and (depends := _depends_on_pack(store, trial, _num_outputs(again, repeated))):
        notes.append(depends)
    if not is_known:
        here = ", ".join(f"{name} {value}" for name, value in repeated.ran_with.items() if name not in versions())
        notes.append(
            "The record is of an older version, which wrote down neither the CPU nor environment variables; here they "
            f"are: {here}."
        )
    return notes


def _num_outputs(again: Sweep, repeated: TrialRecord) -> int | None:
    """Return how many outputs a trial's policy has; None: it has written none."""
    for checkpoint in repeated.checkpoints:
        layers = read_policy(again.checkpoint_folder(checkpoint)).network.layers
        return len(layers[-1].bias)
    return None


def _depends_on_pack(store: Sweep, trial: TrialRecord, num_outputs: int | None) -> str:
    """Say why a trial's sums may have been rounded otherwise in its pack (decision 10); empty: they were not."""
    spec = stored_spec(store.read_record())
    # Of all packed trials: records have the process that each ran in last, which after a resume is another one.
    packed = {
        item.trial_id: cast("TrainedHyperparams", make_hyperparams(spec.algorithm, dict(item.hyperparams)))
        for item in store.read_trials()
        if item.engine == "packed" and item.has_point
    }
    ours = packed.pop(trial.trial_id)
    beside = {name: theirs for name, theirs in packed.items() if pack_key(theirs) == pack_key(ours)}
    wider = [name for name, theirs in beside.items() if is_padded_beside(ours, theirs)]
    if wider:
        more = f" and {counted(len(wider) - _MAX_NAMED, 'other')}" if len(wider) > _MAX_NAMED else ""
        return (
            "It was repeated alone. In its pack its layers may have been padded to the wider ones of "
            f"{', '.join(wider[:_MAX_NAMED])}{more}: then the last bits of its sums depend on those, its random "
            "numbers do not."
        )
    has_group = any(group_key(theirs) == group_key(ours) for theirs in beside.values())
    if has_group and may_round_by_place(ours, num_outputs):
        return (
            "It was repeated alone. With its numbers of rows and units, libraries may round the last bits of its sums "
            "by its place among the trials of its pack; its random numbers do not depend on that."
        )
    if beside and spec.resources.num_gpus:
        return (
            "It was repeated alone: on a GPU the last bits of its sums may depend on how many trials of its pack are "
            "computed together, its random numbers do not."
        )
    return ""


def _failures(trial: TrialRecord, repeated: TrialRecord) -> str:
    if trial.status != "failed":
        return f"The repetition failed: {error_summary(repeated.error)}"
    if repeated.status != "failed":
        return f"The trial had failed ({error_summary(trial.error)}); the repetition did not, in the next iteration."
    return f"Both failed; the trial: {error_summary(trial.error)}; the repetition: {error_summary(repeated.error)}"
