"""Pointers to checkpoints of a sweep folder, which Ray Tune carries in the place of checkpoints of its own.

Tune (2.60) would carry a checkpoint through files in the folder of its run, which is one of the driver's machine:
another node has none where the sweep is in an object store. So a pointer is carried in a result itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ray import tune
from ray.train._internal.checkpoint_manager import _TrainingResult

from tune_jobs.store.contract import Trial

POINTER = "pointer.json"
_NO_FOLDER = "/no-folder-of-checkpoints-of-tune"
"""Where Tune believes a checkpoint to be; nobody looks there."""


def pointer_to(place: str, trial: Trial) -> str:
    """Return a pointer to a trial's latest checkpoint, as JSON.

    Args:
        place: The sweep's place.
        trial: The trial; it may have no checkpoint.
    """
    return json.dumps({"sweep_place": place, "trial_id": trial.trial_id, "iteration": latest_iteration(trial)})


def latest_iteration(trial: Trial) -> int:
    """Return the latest iteration of a trial's checkpoints on disk, damaged or not; 0 if it has none."""
    return max(trial.checkpoint_iterations(), default=0)


def result_of(pointer: str, metrics: Mapping[str, Any] | None = None, folder: str | None = None) -> _TrainingResult:
    """Return a pointer as Tune takes what a trial has saved.

    Args:
        pointer: From `pointer_to`.
        metrics: What the trial had reported last.
        folder: Where Tune asked for the checkpoint.
    """
    # A checkpoint that is none would be taken for a save that failed.
    checkpoint = tune.Checkpoint.from_directory(folder or _NO_FOLDER)
    return _TrainingResult(checkpoint, {**(metrics or {}), POINTER: pointer})
