"""Remove a sweep's folder so that no remains of it hold its name, nor anything that is written of it meanwhile.

NFS keeps a removed file that is open under another name until it is closed, and its folder with it. Who removes a sweep
holds its lock, which is such a file: so the folder gets a hidden name under the lock, and is removed once that is free.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

from policies.errors import CannotRunError, NotFoundError
from tune_jobs.store import names
from tune_jobs.store.places import refuse_linked_sweep, remove_file, remove_folder
from tune_jobs.store.presence import is_file, is_folder


def remove_sweep(folder: Path, lock: AbstractContextManager[None]) -> None:
    """Remove a sweep's folder.

    Args:
        folder: The folder.
        lock: Holds the sweep's lock.

    Raises:
        CannotRunError: A process drives the sweep, or the folder can't be removed, such as a symbolic link.
    """
    refuse_linked_sweep(folder)
    hidden = _hidden(folder)
    try:
        with lock:
            put_aside(folder)
        shutil.rmtree(hidden)
    except OSError as error:
        left = hidden if hidden.exists() else folder
        raise CannotRunError(
            f"Sweep {folder.name} cannot be removed as a whole: {error}.", f"Remove what is left of it: {left}."
        ) from error


def put_aside(folder: Path) -> Path:
    """Give a sweep's folder the hidden name, under which it is no sweep, and return that; it is to be removed then.

    Under its own name, what a kill leaves of it would hold that for ever.

    Raises:
        OSError: It can't be renamed, and is as it was.
        CannotRunError: Its record can't be removed.
    """
    hidden = _hidden(folder)
    remove_folder(hidden)
    remove_file(folder.replace(hidden) / names.SWEEP_RECORD)
    return hidden


def check_not_removed(folder: Path) -> None:
    """Check that a sweep's folder is one still, before anything is written there.

    Raises:
        NotFoundError: It was removed.
    """
    if _is_removed(folder):
        raise removed_meanwhile(folder.name)


@contextlib.contextmanager
def unless_removed(folder: Path, part: Path) -> Iterator[None]:
    """Let the block write a part of a sweep, and leave nothing of it if the sweep is removed meanwhile.

    Args:
        folder: The sweep's folder.
        part: The folder in it that the block writes to, and makes if it is missing.

    Raises:
        NotFoundError: The sweep was removed, before the block or in it.
    """
    check_not_removed(folder)
    try:
        yield
    finally:
        is_removed = _is_removed(folder)
        if is_removed:
            remove_folder(part)
            # Nothing else may be in it: somebody may take the name just now.
            with contextlib.suppress(OSError):
                folder.rmdir()
    if is_removed:
        raise removed_meanwhile(folder.name)


def removed_meanwhile(name: str) -> NotFoundError:
    """Return the error for something that is not written, as its sweep was removed."""
    return NotFoundError(
        f"Sweep {name} was removed meanwhile, so nothing was written of it.", "List the sweeps with `tune-jobs list`."
    )


def _hidden(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.deleted")


def _is_removed(folder: Path) -> bool:
    # A sweep has trials before it has a record; what is written too late makes neither.
    return not is_file(folder / names.SWEEP_RECORD) and not is_folder(folder / names.TRIALS_FOLDER)
