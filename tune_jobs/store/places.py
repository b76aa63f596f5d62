"""Check the names of the parts of a sweep folder, so that no path leads out of it.

A sweep folder may have been edited, or come from somebody else. So no path is taken from its files: trials, checkpoints
and packs are found by their numbers. And no symbolic link in it is followed, because its target is elsewhere. (The
sweep folder itself, and the folders above it, may be links, because the user who runs the command has named them.)
"""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from analysis.records import TRIAL_ID_PATTERN
from policies.errors import CannotRunError, CheckpointError, NotFoundError
from tune_jobs.store.presence import is_absent, is_folder, is_link, is_there, unseen

_CHECKPOINT_NAME = re.compile(r"[0-9]{6,19}")
_TRIAL_ID = re.compile(TRIAL_ID_PATTERN)
_PACK_ID = re.compile(r"p[0-9]{2,9}")


def is_trial_id(name: str) -> bool:
    """Whether this can be a trial's id."""
    return _TRIAL_ID.fullmatch(name) is not None


def check_trial_id(name: str) -> str:
    """Return a trial's id if it can be one.

    Raises:
        NotFoundError: It cannot be a trial's id.
    """
    if not is_trial_id(name):
        raise NotFoundError(
            f"{name[:80]!r} is not a trial's id; they are t0000, t0001 and so on.", "List them with `tune-jobs trials`."
        )
    return name


def check_pack_id(name: str) -> str:
    """Return a pack's id if it can be one.

    Raises:
        NotFoundError: It cannot be a pack's id.
    """
    if _PACK_ID.fullmatch(name) is None:
        raise NotFoundError(f"{name[:80]!r} is not a pack's id; they are p00, p01 and so on.")
    return name


def checkpoint_iteration(name: str) -> int | None:
    """Return the iteration in the name of a checkpoint folder, or None if this is not such a name."""
    return int(name) if _CHECKPOINT_NAME.fullmatch(name) is not None else None


def within(folder: Path, *parts: str) -> Path:
    """Return a path in a folder, after checking that no part of it is a link.

    Args:
        folder: The sweep's folder or one in it, which is not checked itself.
        parts: The names of the path below the folder, one part each.

    Raises:
        CheckpointError: One of them is a symbolic link.
    """
    path = folder
    for part in parts:
        path /= part
        refuse_link(path)
    return path


def refuse_link(path: Path) -> None:
    """Check that a part of a sweep folder is not a symbolic link.

    Raises:
        CheckpointError: It is one, or this cannot be found out.
    """
    if is_link(path):
        raise CheckpointError(
            f"{path} is a symbolic link; links in a sweep folder are not followed.",
            "Remove the link, or replace it with the file or folder that it points to.",
        )


def refuse_linked_sweep(folder: Path) -> None:
    """Check that a sweep folder that is to be removed is none by a symbolic link: its files are elsewhere.

    Raises:
        CannotRunError: It is a link, or this cannot be found out.
    """
    try:
        target = folder.readlink()
    except OSError as error:
        if is_absent(error) or error.errno == errno.EINVAL:  # it is no link
            return
        raise CannotRunError(
            f"{folder} cannot be looked at: {error.strerror or error}.",
            "Check the permissions of the folders above it.",
        ) from error
    raise CannotRunError(
        f"{folder} is a symbolic link to {target}; a sweep is not removed through a link.",
        "Remove the link, or the folder that it points to.",
    )


def refuse_links_in(folder: Path) -> Path:
    """Return a folder, which need not exist, if neither it nor anything in it is a symbolic link.

    Raises:
        CheckpointError: There is a symbolic link, or it cannot be found out whether there is.
    """
    refuse_link(folder)
    for _ in parts_below(folder):
        pass
    return folder


def parts_below(folder: Path) -> Iterator[Path]:
    """Yield the contents of a folder and of the folders in it, in order; none if it is not a folder.

    Raises:
        CheckpointError: There is a symbolic link, or something cannot be read.
    """
    # Not `rglob`, which leaves out a folder that cannot be read.
    for path in sorted(parts_of(folder)):
        refuse_link(path)
        yield path
        if is_folder(path):
            yield from parts_below(path)


def parts_of(folder: Path) -> list[Path]:
    """Return the contents of a folder; none if it is not a folder.

    Raises:
        CheckpointError: It cannot be read.
    """
    return [folder / name for name in names_in(folder)]


def names_in(folder: Path) -> list[str]:
    """Return the names in a folder; none if it is not a folder.

    Raises:
        CheckpointError: It cannot be read.
    """
    try:
        return os.listdir(folder)  # noqa: PTH208 (thousands of paths take long to make)
    except OSError as error:
        if is_absent(error):
            return []
        raise unseen(folder, error) from error


def stamp_of(path: str | Path) -> tuple[int, ...]:
    """Return what changes whenever a file is replaced or written; empty: it does not exist."""
    try:
        found = os.lstat(path)
    except OSError as error:
        # What cannot be looked at counts as one that exists: whoever reads it is told.
        return () if is_absent(error) else (0,)
    return found.st_ino, found.st_size, found.st_mtime_ns


def not_older(files: Iterable[Path], others: Iterable[Path]) -> bool:
    """Whether files exist that were written when others were, or later; others that do not exist do not count."""
    try:
        oldest = min(path.stat().st_mtime_ns for path in files)
        return all(path.stat().st_mtime_ns <= oldest for path in others if is_there(path))
    except (OSError, CheckpointError):
        return False


def remove_folder(folder: Path) -> None:
    """Delete a folder and its contents, if it exists; links in it are removed, but never what they point to.

    Args:
        folder: A result of `within`.

    Raises:
        CheckpointError: It is a symbolic link.
    """
    refuse_link(folder)
    # rmtree does not follow links in the folder.
    shutil.rmtree(folder, ignore_errors=True)


def make_folder(folder: Path) -> None:
    """Make a folder, if it does not exist, and those above it.

    Raises:
        CannotRunError: It cannot be made, for example because there is a file of that name.
    """
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise CannotRunError(
            f"The folder {folder} cannot be made: {error.strerror or error}.",
            "Check that the path above it is a folder, is writable and has free space.",
        ) from error


def remove_file(path: Path) -> None:
    """Delete a file, if it exists.

    Raises:
        CannotRunError: It cannot be deleted, for example because it is a folder.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be removed: {error.strerror or error}.", "Remove it, and try again."
        ) from error
