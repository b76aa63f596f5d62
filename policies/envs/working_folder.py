"""Keep this process in a folder that exists, wherever environments go."""

from __future__ import annotations

import contextlib
import os


def _folder() -> str | None:
    """Return the folder that this process works in; None: it was removed, or can't be told."""
    with contextlib.suppress(OSError):
        return os.getcwd()  # noqa: PTH109 (it is only gone back to)
    return None


_BEGAN_IN = _folder()


def leave_removed_folder() -> None:
    """Go back to the folder that this process began in if an environment went to one that it has removed since.

    In a folder that is none no process can be started, and no module be looked for.
    """
    if _BEGAN_IN is not None and _folder() is None:
        with contextlib.suppress(OSError):  # that one was removed too
            os.chdir(_BEGAN_IN)
