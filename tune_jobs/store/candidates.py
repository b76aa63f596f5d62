"""Which checkpoints of a sweep may be chosen as its best: those that are what was written, and scored what they say.

A checkpoint's score is in its manifest, which is sealed, and in the line of its iteration in `results.jsonl`. One whose
manifest was changed, or which contradicts its line, is left out with a warning; the others still compete. What tells
points and seeds apart is not taken from `trial.json` but follows from the trial's number.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping, Sequence

from analysis.records import CheckpointRecord, SweepRecord, TrialRecord
from analysis.selection import Selection, select_best
from policies.errors import CheckpointError, NotFoundError, TuneJobsError
from policies.portable.file import PortablePolicy, read_policy
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.names import RESULTS
from tune_jobs.store.results_file import Scored
from tune_jobs.store.transitions import with_checkpoints

_LOG = logging.getLogger(__name__)


def read_trials(store: Sweep) -> list[TrialRecord]:
    """The trials, by index, with those checkpoints on disk that may be chosen.

    What the records say of checkpoints is not asked: a killed driver's may lag behind what is on disk.

    Raises:
        CheckpointError: The record of the sweep or of a trial is damaged.
    """
    sweep = store.read_record()
    records = [
        record.model_copy(
            update={**_place_of(record, sweep), "checkpoints": tuple(candidates(store.trial(record.trial_id)))}
        )
        for record in store.read_trials()
    ]
    return sorted(records, key=lambda record: record.index)


def candidates(trial: Trial) -> list[CheckpointRecord]:
    """A trial's checkpoints that may be chosen, oldest first; a warning names each of the others."""
    known: list[CheckpointRecord] = []
    for iteration in trial.checkpoint_iterations():
        try:
            known.append(trial.checkpoint(iteration))
        except NotFoundError as error:
            # Gone since, if its trial runs on.
            if trial.checkpoint_folder(iteration).exists():
                leave_out(error)
    recorded: Mapping[int, Sequence[Scored]] = {}
    try:
        recorded = trial.scores_of({record.iteration for record in known})
    except CheckpointError as error:
        leave_out(error)
    return [record for record in known if _agrees(trial, record, recorded.get(record.iteration, []))]


def choose(store: Sweep, trials: Sequence[TrialRecord]) -> tuple[Selection, PortablePolicy]:
    """The best whose checkpoint is whole, and its policy; a warning names what would have come before it.

    Args:
        store: The sweep.
        trials: As `read_trials` gives them.

    Raises:
        NoUsableTrialError: No trial can win; the message says why.
    """
    remaining = list(trials)
    while True:
        selection = select_best(remaining)
        try:
            store.trial(selection.checkpoint.trial_id).verify_checkpoint(selection.checkpoint.iteration)
            return selection, read_policy(store.checkpoint_folder(selection.checkpoint))
        except NotFoundError as error:
            leave_out(error)
            remaining = [_without(record, selection.checkpoint) for record in remaining]


def leave_out(error: TuneJobsError) -> None:
    """Warn that something is as if it were not there."""
    _warn(error.message)


@functools.lru_cache(maxsize=1024)
def _warn(message: str) -> None:
    # Once: a sweep that ends is read several times.
    _LOG.warning("Left out: %s", message)


def _without(record: TrialRecord, checkpoint: CheckpointRecord) -> TrialRecord:
    return with_checkpoints(record, [item for item in record.checkpoints if item != checkpoint])


def _place_of(record: TrialRecord, sweep: SweepRecord) -> dict[str, int]:
    """Which trial it is of which point, as the plan numbers them."""
    seeds = sweep.spec.get("seeds_per_point")
    if type(seeds) is not int or seeds < 1:
        return {}
    index = int(record.trial_id[1:])
    return {"index": index, "point_index": index // seeds, "seed_index": index % seeds}


def _agrees(trial: Trial, checkpoint: CheckpointRecord, lines: Sequence[Scored]) -> bool:
    """Whether a checkpoint says the same as the results of its iteration, if there are any."""
    # A line may be lost; two are there where two processes wrote at once.
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
