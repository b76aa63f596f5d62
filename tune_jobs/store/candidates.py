"""Find the checkpoints that may be chosen as a sweep's best: those that were not changed since they were written.

A checkpoint's score is in its manifest, which is sealed, and in the line of its iteration in `results.jsonl`. A
checkpoint whose manifest was changed, or contradicts that line, is left out with a warning; the others still compete.
The point and the seed of a trial follow from its number, and are not taken from `trial.json`.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Collection, Mapping, Sequence

from analysis.compact import CompactIterations
from analysis.numbering import place_of
from analysis.records import CheckpointRecord, SweepRecord, TrialRecord
from analysis.wording import counted
from policies.errors import CheckpointError, NotFoundError, TuneJobsError
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.names import RESULTS, SWEEP_RECORD
from tune_jobs.store.presence import is_there
from tune_jobs.store.results_file import Scored
from tune_jobs.store.urls import is_url

_LOG = logging.getLogger(__name__)


def readable_trials(store: Sweep) -> list[TrialRecord]:
    """Read the records of all trials, by index; a warning names each that is damaged, and the others are returned.

    This is for those that only look: `Sweep.read_trials` refuses the sweep, so that none is trained or chosen then.

    Raises:
        CheckpointError: The trials cannot be listed.
    """
    records = []
    with store.reading(results=False):
        for trial_id in store.trial_stamps():
            try:
                records.append(store.trial(trial_id).read_record())
            except CheckpointError as error:
                leave_out(error)
    return sorted(records, key=lambda record: record.index)


def some_trials(store: Sweep, trial_ids: Collection[str]) -> dict[str, TrialRecord | CheckpointError]:
    """Read the records of some trials, by id, those of an object store side by side; of a damaged one its error.

    Raises:
        NotFoundError: One of them has no record.
    """

    def read(trial_id: str) -> TrialRecord | CheckpointError:
        try:
            return store.trial(trial_id).read_record()
        except CheckpointError as error:
            return error

    if not is_url(store.place):
        return {trial_id: read(trial_id) for trial_id in trial_ids}
    from tune_jobs.store.objects.at_once import side_by_side

    return dict(zip(trial_ids, side_by_side(read, trial_ids), strict=True))


def read_trials(store: Sweep) -> list[TrialRecord]:
    """Read the trials, by index, with those checkpoints on disk that may be chosen; see `readable_trials`.

    The checkpoints in the records are not used, because those of a killed driver may be older than what is on disk.

    Raises:
        CheckpointError: The record of the sweep is damaged.
    """
    sweep = store.read_record()
    with store.reading():
        records = [
            record.model_copy(
                update={**_place_of(record, sweep), "checkpoints": tuple(candidates(store.trial(record.trial_id)))}
            )
            for record in readable_trials(store)
        ]
    return sorted(records, key=lambda record: record.index)


def read_results(store: Sweep) -> dict[str, CompactIterations]:
    """Read every trial's results, by trial id; those that cannot be read, or are gone, give a warning and are empty."""
    found = {}
    with store.reading():
        for record in readable_trials(store):
            try:
                iterations = store.trial(record.trial_id).read_iterations()
            except CheckpointError as error:
                leave_out(error)
                iterations = []
            else:
                # Of others, what has trained may not have been written: those that died, and those that train now.
                if record.status in ("completed", "stopped") and record.num_iterations and not iterations:
                    leave_out(_results_gone(store, record))
            found[record.trial_id] = CompactIterations(iterations)
    return found


def _results_gone(store: Sweep, record: TrialRecord) -> CheckpointError:
    return CheckpointError(
        f"The results of trial {record.trial_id} in {store.place}, which has trained for "
        f"{counted(record.num_iterations, 'iteration')}, are gone: its {RESULTS} is missing or empty. It counts as a "
        "training that showed nothing."
    )


def candidates(trial: Trial) -> list[CheckpointRecord]:
    """Return a trial's checkpoints that may be chosen, oldest first; a warning names each of the others."""
    known: list[CheckpointRecord] = []
    for iteration in trial.checkpoint_iterations():
        try:
            known.append(trial.checkpoint(iteration))
        except NotFoundError as error:
            # Deleted meanwhile, if its trial still runs.
            if is_there(trial.checkpoint_folder(iteration)):
                leave_out(error)
    recorded: Mapping[int, Sequence[Scored]] = {}
    try:
        recorded = trial.scores_of({record.iteration for record in known})
    except CheckpointError as error:
        leave_out(error)
    return [record for record in known if _agrees(trial, record, recorded.get(record.iteration, []))]


def leave_out(error: TuneJobsError) -> None:
    """Warn that something is left out because of an error."""
    _warn(error.message)


@functools.lru_cache(maxsize=1024)
def _warn(message: str) -> None:
    # Only once, because a sweep is read several times at its end.
    _LOG.warning("Left out: %s", message)


def _place_of(record: TrialRecord, sweep: SweepRecord) -> dict[str, int]:
    """Return a trial's index, and the indices of its point and seed, as the plan numbers them."""
    seeds = sweep.spec.get("seeds_per_point")
    if type(seeds) is not int or seeds < 1 or sweep.repeats is not None:
        return {}  # a repetition has its one trial as another sweep numbers it
    index = int(record.trial_id[1:])
    try:
        return {"index": index, **place_of(index, seeds, sweep.replications)._asdict()}
    except ValueError as error:
        raise CheckpointError(
            f"The record of sweep {sweep.name} is damaged: {error}.", f"Restore {SWEEP_RECORD} from a backup."
        ) from error


def _agrees(trial: Trial, checkpoint: CheckpointRecord, lines: Sequence[Scored]) -> bool:
    """Whether a checkpoint's manifest agrees with the results of its iteration, if there are any."""
    # A line may be missing; there are two if two processes wrote at once.
    if checkpoint.evaluation_return is None or not lines:
        return True
    if (checkpoint.num_env_steps, checkpoint.evaluation_return) in lines:
        return True
    steps, score = lines[-1]
    leave_out(
        CheckpointError(
            f"Checkpoint {trial.checkpoint_folder(checkpoint.iteration)} says that it scored "
            f"{checkpoint.evaluation_return:g} after {checkpoint.num_env_steps} env steps; {RESULTS} "
            f"says {score} after {steps}."
        )
    )
    return False
