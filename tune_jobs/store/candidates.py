"""Which checkpoints of a sweep may be chosen as its best: those that are what was written, and scored what they say.

A checkpoint's score is in its manifest, which is sealed, and in the line of its iteration in `results.jsonl`. One whose
manifest was changed, or which contradicts its line, is left out with a warning; the others still compete. What tells
points and seeds apart is not taken from `trial.json` but follows from the trial's number.
"""

from __future__ import annotations

import functools
import json
import logging
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from analysis.records import CheckpointRecord, SweepRecord, TrialRecord
from analysis.selection import Selection, select_best
from policies.errors import CheckpointError, NotFoundError, TuneJobsError
from policies.files import read_regular
from policies.portable.file import PortablePolicy, read_policy
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.results_file import MAX_RESULTS_BYTES
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore

_LOG = logging.getLogger(__name__)
_BEGINNING = re.compile(rb'\{"iteration":\s*(\d{1,18}),')
"""Of a line as it is written; others are read whole to know of which iteration they are."""

_Numbers = tuple[object, object]
"""Env steps and evaluation return."""


def read_trials(store: SweepStore) -> list[TrialRecord]:
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


def candidates(trial: TrialStore) -> list[CheckpointRecord]:
    """A trial's checkpoints that may be chosen, oldest first; a warning names each of the others."""
    known: list[CheckpointRecord] = []
    for iteration in trial.checkpoint_iterations():
        try:
            known.append(trial.checkpoint(iteration))
        except NotFoundError as error:
            # Gone since, if its trial runs on.
            if trial.checkpoint_folder(iteration).exists():
                leave_out(error)
    recorded = _recorded(trial.results_path, {record.iteration for record in known})
    return [record for record in known if _agrees(trial, record, recorded.get(record.iteration, []))]


def choose(store: SweepStore, trials: Sequence[TrialRecord]) -> tuple[Selection, PortablePolicy]:
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
            folder = store.checkpoint_folder(selection.checkpoint)
            verify_checkpoint(folder)
            return selection, read_policy(folder)
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
    return record.model_copy(update={"checkpoints": tuple(item for item in record.checkpoints if item != checkpoint)})


def _place_of(record: TrialRecord, sweep: SweepRecord) -> dict[str, int]:
    """Which trial it is of which point, as the plan numbers them."""
    seeds = sweep.spec.get("seeds_per_point")
    if type(seeds) is not int or seeds < 1:
        return {}
    index = int(record.trial_id[1:])
    return {"index": index, "point_index": index // seeds, "seed_index": index % seeds}


def _agrees(trial: TrialStore, checkpoint: CheckpointRecord, lines: Sequence[_Numbers]) -> bool:
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
            f"{checkpoint.evaluation_return:g} after {checkpoint.num_env_steps} env steps; {trial.results_path.name} "
            f"says {score} after {steps}."
        )
    )
    return False


def _recorded(path: Path, wanted: set[int]) -> dict[int, list[_Numbers]]:
    """What a trial's results say of some iterations; lines that cannot be read say nothing."""
    found: defaultdict[int, list[_Numbers]] = defaultdict(list)
    try:
        lines = read_regular(path, MAX_RESULTS_BYTES).split(b"\n")[:-1]
    except FileNotFoundError:
        return found
    except OSError as error:
        leave_out(CheckpointError(f"{path} cannot be read: {error.strerror or error}."))
        return found
    for line in lines:
        begins = _BEGINNING.match(line)
        if begins is not None and int(begins[1]) not in wanted:
            continue
        try:
            data = json.loads(line)
            if data["iteration"] in wanted:
                found[data["iteration"]].append((data["num_env_steps"], data["evaluation_return"]))
        except (ValueError, LookupError, TypeError, RecursionError):
            continue
    return found
