"""What the parts of a sweep folder may be called, and that none of them leads out of it.

A sweep folder may have been edited, or come from somebody else. So nothing that is read from its files names a place:
trials, checkpoints and packs are found by their numbers. And no symbolic link in it is followed: what is read, written
or deleted through one lies elsewhere. (The sweep folder itself, and what it lies in, may be links: these are named by
whoever runs the command.)
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from analysis.records import TRIAL_ID_PATTERN
from policies.errors import CannotRunError, CheckpointError, NotFoundError

_CHECKPOINT_NAME = re.compile(r"[0-9]{6,19}")
_TRIAL_ID = re.compile(TRIAL_ID_PATTERN)
_PACK_ID = re.compile(r"p[0-9]{2,9}")


def is_trial_id(name: str) -> bool:
    """Whether a trial can be called so."""
    return _TRIAL_ID.fullmatch(name) is not None


def check_trial_id(name: str) -> str:
    """Return a trial's id if a trial can be called so.

    Raises:
        NotFoundError: It cannot.
    """
    if not is_trial_id(name):
        raise NotFoundError(
            f"{name[:80]!r} is no trial's id; they are t0000, t0001 and so on.", "List them with `tune-jobs trials`."
        )
    return name


def check_pack_id(name: str) -> str:
    """Return a pack's id if a pack can be called so.

    Raises:
        NotFoundError: It cannot.
    """
    if _PACK_ID.fullmatch(name) is None:
        raise NotFoundError(f"{name[:80]!r} is no pack's id; they are p00, p01 and so on.")
    return name


def checkpoint_iteration(name: str) -> int | None:
    """The iteration that a checkpoint folder is called by, or None if a checkpoint is not called so."""
    return int(name) if _CHECKPOINT_NAME.fullmatch(name) is not None else None


def within(folder: Path, *parts: str) -> Path:
    """A place in a folder, once it is certain that no link on the way leads elsewhere.

    Args:
        folder: Of the sweep, or in it; not looked at itself.
        parts: Names below each other, each of one part.

    Raises:
        CheckpointError: One of them is a symbolic link.
    """
    path = folder
    for part in parts:
        path /= part
        refuse_link(path)
    return path


def refuse_link(path: Path) -> None:
    """Check that a part of a sweep folder is no symbolic link.

    Raises:
        CheckpointError: It is one, or cannot be looked at.
    """
    try:
        is_link = path.is_symlink()
    except OSError as error:
        raise _unseen(path, error) from error
    if is_link:
        raise CheckpointError(
            f"{path} is a symbolic link; links in a sweep folder are not followed.",
            "Remove the link, or replace it with what it points to.",
        )


def refuse_links_in(folder: Path) -> Path:
    """Return a folder, which need not be there, if neither it nor anything in it is a symbolic link.

    Raises:
        CheckpointError: Something is.
    """
    refuse_link(folder)
    for path in folder.rglob("*"):
        refuse_link(path)
    return folder


def parts_of(folder: Path) -> list[Path]:
    """What lies in a folder; nothing if it is none.

    Raises:
        CheckpointError: It cannot be looked into.
    """
    try:
        return list(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise _unseen(folder, error) from error


def _unseen(path: Path, error: OSError) -> CheckpointError:
    return CheckpointError(
        f"{path} cannot be looked at: {error.strerror or error}.", "Check the permissions of the folders it lies in."
    )


def remove_folder(folder: Path) -> None:
    """Delete a folder with all that is in it, if it is there; of links the names alone, never what they point to.

    Args:
        folder: As `within` gave it.

    Raises:
        CheckpointError: It is a symbolic link.
    """
    refuse_link(folder)
    # It leaves links in the folder unfollowed by itself.
    shutil.rmtree(folder, ignore_errors=True)


def make_folder(folder: Path) -> None:
    """Make a folder that is not there yet, and those above it.

    Raises:
        CannotRunError: It cannot be made: something else is in its place, say.
    """
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise CannotRunError(
            f"The folder {folder} cannot be made: {error.strerror or error}.",
            "Check that what it lies in is a folder, is writable and has free space.",
        ) from error


def remove_file(path: Path) -> None:
    """Delete a file, if it is there.

    Raises:
        CannotRunError: It cannot be deleted: it is a folder, say.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise CannotRunError(
            f"{path} cannot be removed: {error.strerror or error}.", "Remove it, and try again."
        ) from error
