"""Let the system ask a file server again what is in a folder."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

_EVERY_S = 1.0


class FreshLook:
    """Has names in a folder seen that another machine has made there, at most once a second.

    NFS believes for up to a minute that there is no file of a name; opening its folder makes it ask the server. On a
    disk of this machine that takes microseconds.

    Args:
        folder: The folder.
        clock: A monotonic clock, in seconds.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder, self._clock = folder, clock
        self._looked_at = -float("inf")

    def take(self) -> None:
        """Open the folder, if it is time to; whether that is possible doesn't matter here."""
        now = self._clock()
        # Ray may have carried this to another machine, whose clock began at another time.
        if not 0.0 <= now - self._looked_at < _EVERY_S:
            self._looked_at = now
            with contextlib.suppress(OSError):
                os.close(os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC))
