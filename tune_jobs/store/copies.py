"""Copy checkpoints from one trial of a population to another.

A copy is in the trial's own folder, `copied/<iteration>/`, whole and verified, so that it stays when the other trial
deletes the original. It counts only if the trial's record has a change of that iteration; without one, because the
driver was killed in between, the copy is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence

from analysis.records import ChangeRecord, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.contract import Trial

_ATTEMPTS = 5


def copy_latest_checkpoint(source: Trial, target: Trial, iteration: int) -> CheckpointRecord:
    """Copy the latest checkpoint of a trial into another's folder, and verify the copy.

    Args:
        source: The trial whose checkpoint is wanted. It may train on and delete checkpoints meanwhile.
        target: The trial that continues from it.
        iteration: The number of iterations that the target has done.

    Returns:
        The record of the checkpoint that was copied.

    Raises:
        CheckpointError: There is no checkpoint, or it is damaged.
    """
    reason: Exception | None = None
    for _ in range(_ATTEMPTS):
        try:
            known = source.checkpoints()
            if not known:
                break
            with source.reading_checkpoint(known[-1].iteration) as folder:
                return target.copy_checkpoint(folder, iteration)
        except (OSError, NotFoundError) as error:
            # It was deleted while it was copied, so there is a newer one.
            reason = error
    raise CheckpointError(
        f"Trial {source.trial_id} has no checkpoint from which trial {target.trial_id} could continue"
        + (f": {reason}." if reason is not None else "."),
        "Look for the cause in the trial's log and the storage folder; the sweep continues without this copy.",
    )


def remove_uncounted_copies(trial: Trial, changes: Sequence[ChangeRecord]) -> None:
    """Delete copies that do not count, left by a driver that was killed; the next driver does this at its start."""
    trial.remove_copies(keep=[change.iteration for change in changes])
