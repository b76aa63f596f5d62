"""Find what training can continue from in a trial's folder; damaged parts are set aside with a note, never deleted.

Results that can't be read are moved to `results.damaged`, checkpoints and copies to `damaged/`; only the owner does
this.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from analysis.records import FORMAT_VERSION, ChangeRecord, CheckpointRecord
from policies.errors import CheckpointError, NotFoundError
from policies.files import RefusedFileError, read_regular
from tune_jobs.store.contract import Trial
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.names import DAMAGED_RESULTS, MANIFEST, RESULTS
from tune_jobs.store.places import within
from tune_jobs.store.presence import is_folder
from tune_jobs.store.record_files import seal
from tune_jobs.store.results_file import ResultsFile


def take_up_results(trial: Trial) -> tuple[ResultsFile, list[str]]:
    """Read a trial's results, and set aside the lines that cannot be read.

    The lines stay in results.jsonl until the trial writes the results that it continues with.

    Returns:
        What can be read, and notes on the rest.

    Raises:
        CheckpointError: The results cannot be read now.
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
        # Half a line after a kill is not damage: the iteration is repeated.
        trial.write_log(f"{trial.trial_id}: {RESULTS} ended within a line; it is kept in {DAMAGED_RESULTS}")
    return found, [f"{RESULTS}: {bad}; it is kept in {DAMAGED_RESULTS}" for bad in found.bad]


def take_up_checkpoints(trial: Trial) -> tuple[list[CheckpointRecord], list[str]]:
    """Return the checkpoints that a trial continues with, the last of them verified; damaged ones are set aside.

    Only the manifests of the older ones are read: their files are checked before they are used.

    Returns:
        The checkpoints, oldest first, and notes on those that were set aside.

    Raises:
        CheckpointError: One has a newer format, or cannot be read now, so it may not be damaged.
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


def take_up_copy(trial: Trial, change: ChangeRecord | None, latest_iteration: int) -> tuple[Path | None, list[str]]:
    """Return the copy that a trial continues from, verified, if none of its own checkpoints is newer; see `copies`.

    Args:
        trial: The trial.
        change: Its newest change.
        latest_iteration: The iteration of its own latest checkpoint; 0: it has none.

    Returns:
        The copy, or None, and a note on one that is missing, or damaged and set aside.

    Raises:
        CheckpointError: It cannot be found out whether there is one, or it cannot be read now.
    """
    if change is None or latest_iteration > change.iteration:
        return None, []
    folder = trial.copied_checkpoint(change.iteration)
    goes_on = "the trial goes on from its own latest checkpoint, with the values it was given."
    if not is_folder(folder):
        return None, [f"the copied checkpoint {folder.name} is missing; {goes_on}"]
    try:
        verify_checkpoint(folder)
    except NotFoundError as error:
        target = trial.set_aside(_damaged(folder, error), prefix="copied-")
        return None, [f"the copied checkpoint {folder.name} is damaged and kept as {target}; {goes_on} {error.message}"]
    return folder, []


def _damaged(folder: Path, error: NotFoundError) -> Path:
    """Return the checkpoint's folder, if the error means damage.

    Raises:
        NotFoundError: The error does not mean damage, or may be temporary.
    """
    if isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError | RefusedFileError):
        raise error
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        manifest = json.loads(read_regular(within(folder, MANIFEST)))
        # If the seal is right, a newer version number is not a damaged byte.
        if manifest["format_version"] > FORMAT_VERSION and manifest["sha256"] == seal(manifest):
            raise error
    return folder
