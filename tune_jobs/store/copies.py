"""Checkpoints that a trial of a population took over from another trial.

A copy lies in the trial's own folder, `copied/<iteration>/`, whole and verified, so that it stays when the other trial
deletes its own. It counts once the trial's record has a change of that iteration: one that has none, because the driver
was killed in between, is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from analysis.records import ChangeRecord, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.contract import Trial

_ATTEMPTS = 5


def copy_latest_checkpoint(source: Trial, target: Trial, iteration: int) -> CheckpointRecord:
    """Copy the latest checkpoint of a trial into another's folder, and verify the copy.

    Args:
        source: The trial whose checkpoint is wanted. It may be training on and deleting checkpoints meanwhile.
        target: The trial that goes on from it.
        iteration: Iterations the target has done.

    Returns:
        The record of the checkpoint that was copied.

    Raises:
        CheckpointError: There is none, or it is damaged.
    """
    reason: Exception | None = None
    for _ in range(_ATTEMPTS):
        try:
            known = source.checkpoints()
            if not known:
                break
            return target.copy_checkpoint(source.checkpoint_folder(known[-1].iteration), iteration)
        except (OSError, NotFoundError) as error:
            # Deleted while it was being copied: there is a newer one.
            reason = error
    raise CheckpointError(
        f"Trial {source.trial_id} has no checkpoint that trial {target.trial_id} could go on from"
        + (f": {reason}." if reason is not None else "."),
        "See the trial's log and the storage folder; the sweep goes on without this copy.",
    )


def pending_copy(trial: Trial, change: ChangeRecord | None, latest_iteration: int) -> Path | None:
    """The copy that a trial goes on from, if none of its own checkpoints is newer.

    Args:
        trial: The trial.
        change: Its newest change.
        latest_iteration: Of its own latest checkpoint; 0: it has none.
    """
    if change is None or latest_iteration > change.iteration:
        return None
    folder = trial.copied_checkpoint(change.iteration)
    return folder if folder.is_dir() else None


def remove_uncounted_copies(trial: Trial, changes: Sequence[ChangeRecord]) -> None:
    """Delete copies that do not count, of a driver that was killed before it wrote so; for the driver, at its start."""
    trial.remove_copies(keep=[change.iteration for change in changes])
