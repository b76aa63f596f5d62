"""What of a trial's folder training can continue from; what is damaged is set aside, never deleted, and never silently.

Results that can't be read go to `results.damaged`, checkpoints and copies to `damaged/`; only the owner does it.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from analysis.records import FORMAT_VERSION, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from policies.files import RefusedFileError, read_regular
from tune_jobs.store.contract import Trial
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.names import DAMAGED_RESULTS, MANIFEST, RESULTS
from tune_jobs.store.places import within
from tune_jobs.store.record_files import seal
from tune_jobs.store.results_file import ResultsFile


def take_up_results(trial: Trial) -> tuple[ResultsFile, list[str]]:
    """Read a trial's results, and set aside what of them cannot be read.

    The lines stay in results.jsonl until the trial writes what it goes on with.

    Returns:
        What can be read, and what to tell of the rest.

    Raises:
        CheckpointError: They cannot be read now.
    """
    try:
        found = trial.read_results()
    except CheckpointError as error:
        if not isinstance(error.__cause__, RefusedFileError):
            raise
        target = trial.set_aside_results()
        return ResultsFile(), [f"{error.message} It is kept as {target}; the trial goes on without it."]
    unreadable = [bad.content for bad in found.bad] + ([found.tail] if found.tail else [])
    if unreadable:
        trial.keep_damaged_results(unreadable)
    if found.tail:
        # What every kill may leave, and no damage: it is done again.
        trial.write_log(f"{trial.trial_id}: {RESULTS} ended within a line; it is kept in {DAMAGED_RESULTS}")
    return found, [f"{RESULTS}: {bad}; it is kept in {DAMAGED_RESULTS}" for bad in found.bad]


def take_up_checkpoints(trial: Trial) -> tuple[list[CheckpointRecord], list[str]]:
    """The checkpoints a trial goes on with, the last of them verified; damaged ones are set aside.

    Of the older ones only the manifests are read: the files are checked before they are used.

    Returns:
        The checkpoints, oldest first, and what to tell of those that were set aside.

    Raises:
        CheckpointError: One is of a newer format, or cannot be read now: nothing says that it is damaged.
    """
    known: list[CheckpointRecord] = []
    damaged: list[tuple[Path, NotFoundError]] = []
    for iteration in trial.checkpoint_iterations():
        try:
            known.append(trial.checkpoint(iteration))
        except NotFoundError as error:
            damaged.append((_damaged(trial.checkpoint_folder(iteration), error), error))
    while known:
        folder = trial.checkpoint_folder(known[-1].iteration)
        try:
            trial.verify_checkpoint(known[-1].iteration)
            break
        except NotFoundError as error:
            damaged.append((_damaged(folder, error), error))
            known.pop()
    start = f"checkpoint {known[-1].iteration:06d}" if known else "its start: no older one is whole"
    notes = [
        f"checkpoint {folder.name} is damaged and kept as {trial.set_aside(folder)}; "
        f"the trial goes on from {start}. {error.message}"
        for folder, error in damaged
    ]
    return known, notes


def take_up_copy(trial: Trial, folder: Path) -> tuple[Path | None, list[str]]:
    """Another trial's checkpoint that this one goes on from, verified; None, and set aside, if it is damaged."""
    try:
        verify_checkpoint(folder)
    except NotFoundError as error:
        target = trial.set_aside(_damaged(folder, error), prefix="copied-")
        note = (
            f"the copied checkpoint {folder.name} is damaged and kept as {target}; the trial goes on from its own "
            f"latest checkpoint, with the values it was given. {error.message}"
        )
        return None, [note]
    return folder, []


def _damaged(folder: Path, error: NotFoundError) -> Path:
    """The checkpoint's folder, if what is wrong with it is damage.

    Raises:
        NotFoundError: It is not, or may pass.
    """
    if isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError | RefusedFileError):
        raise error
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        manifest = json.loads(read_regular(within(folder, MANIFEST)))
        # A version beyond ours is no flipped bit if the seal holds.
        if manifest["format_version"] > FORMAT_VERSION and manifest["sha256"] == seal(manifest):
            raise error
    return folder
