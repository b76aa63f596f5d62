"""Checkpoints that a trial of a population took over from another trial.

A copy lies in the trial's own folder, `copied/<iteration>/`, whole and verified, so that it stays when the other trial
deletes its own. It counts once the trial's record has a change of that iteration: one that has none, because the driver
was killed in between, is ignored.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Sequence
from pathlib import Path

from analysis.records import ChangeRecord, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.names import COPIES_FOLDER
from tune_jobs.store.places import remove_folder, within
from tune_jobs.store.trial_store import TrialStore

_ATTEMPTS = 5


def copied_folder(trial: TrialStore, iteration: int) -> Path:
    """Where a trial's copy of another's checkpoint lies, taken over at an iteration of its own."""
    return within(trial.folder, COPIES_FOLDER, f"{iteration:06d}")


def copy_latest_checkpoint(source: TrialStore, target: TrialStore, iteration: int) -> CheckpointRecord:
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
    final = copied_folder(target, iteration)
    temporary = final.with_name(f".{final.name}")
    reason: Exception | None = None
    for _ in range(_ATTEMPTS):
        try:
            known = source.checkpoints()
            if not known:
                break
            remove_folder(temporary)
            # Links stay links, which `verify_checkpoint` refuses: what they point to is not to get in here.
            shutil.copytree(source.checkpoint_folder(known[-1].iteration), temporary, symlinks=True)
            record = verify_checkpoint(temporary)
        except (OSError, shutil.Error, NotFoundError) as error:
            # Deleted while it was being copied: there is a newer one.
            reason = error
            continue
        remove_folder(final)
        temporary.replace(final)
        return record
    remove_folder(temporary)
    raise CheckpointError(
        f"Trial {source.trial_id} has no checkpoint that trial {target.trial_id} could go on from"
        + (f": {reason}." if reason is not None else "."),
        "See the trial's log and the storage folder; the sweep goes on without this copy.",
    )


def pending_copy(trial: TrialStore, change: ChangeRecord | None, latest_iteration: int) -> Path | None:
    """The copy that a trial goes on from, if none of its own checkpoints is newer.

    Args:
        trial: The trial.
        change: Its newest change.
        latest_iteration: Of its own latest checkpoint; 0: it has none.
    """
    if change is None or latest_iteration > change.iteration:
        return None
    folder = copied_folder(trial, change.iteration)
    return folder if folder.is_dir() else None


def remove_uncounted_copies(trial: TrialStore, changes: Sequence[ChangeRecord]) -> None:
    """Delete copies that do not count, of a driver that was killed before it wrote so; for the driver, at its start."""
    folder = within(trial.folder, COPIES_FOLDER)
    counted = {copied_folder(trial, change.iteration).name for change in changes}
    if folder.is_dir():
        for path in folder.iterdir():
            if path.name not in counted:
                remove_folder(path)
        with contextlib.suppress(OSError):
            folder.rmdir()


def remove_copies(trial: TrialStore) -> None:
    """Delete a trial's copies: it has a newer checkpoint of its own."""
    remove_folder(within(trial.folder, COPIES_FOLDER))
