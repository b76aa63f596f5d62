"""Ask what is at a path in a sweep folder, so that an error of the storage never counts as nothing being there.

From Python 3.14 on, `Path.exists`, `is_file`, `is_dir` and `is_symlink` answer each error of the system with False. By
that a trial whose checkpoints cannot be looked at for a moment would have none, and begin again over its results.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from policies.errors import CheckpointError

_ABSENT = (errno.ENOENT, errno.ENOTDIR, errno.EBADF, errno.ELOOP)


def is_there(path: Path) -> bool:
    """Whether there is anything at a path; a link counts as what it leads to.

    Raises:
        CheckpointError: This cannot be found out.
    """
    return _mode(path) is not None


def is_file(path: Path) -> bool:
    """Whether a path is a regular file, or a link to one.

    Raises:
        CheckpointError: This cannot be found out.
    """
    return (mode := _mode(path)) is not None and stat.S_ISREG(mode)


def is_folder(path: Path) -> bool:
    """Whether a path is a folder, or a link to one.

    Raises:
        CheckpointError: This cannot be found out.
    """
    return (mode := _mode(path)) is not None and stat.S_ISDIR(mode)


def is_link(path: Path) -> bool:
    """Whether a path is a symbolic link.

    Raises:
        CheckpointError: This cannot be found out.
    """
    return (mode := _mode(path, follow=False)) is not None and stat.S_ISLNK(mode)


def is_absent(error: OSError) -> bool:
    """Whether an error says that there is nothing at a path; any other leaves open what there is."""
    return error.errno in _ABSENT


def unseen(path: Path, error: OSError) -> CheckpointError:
    """Return the error for a path that cannot be looked at."""
    return CheckpointError(
        f"{path} cannot be read: {error.strerror or error}.", "Check the permissions of the folders above it."
    )


def _mode(path: Path, *, follow: bool = True) -> int | None:
    try:
        return os.stat(path, follow_symlinks=follow).st_mode  # noqa: PTH116 (of thousands of paths)
    except OSError as error:
        if is_absent(error):
            return None
        raise unseen(path, error) from error
    except ValueError:  # a NUL is in it
        return None
