"""The error that is raised when a signal ends a sweep."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import SweepResult


class SweepInterrupted(KeyboardInterrupt):
    """A launch, drive, resume or extend was ended by Ctrl-C, SIGTERM or SIGHUP; what was done is saved.

    It is a `KeyboardInterrupt`, so that it ends the script that launched the sweep, even a loop over launches with an
    `except Exception` in it.

    Args:
        result: The results of the sweep so far; None: it had not begun, and nothing was changed.
    """

    def __init__(self, result: SweepResult | None = None) -> None:
        super().__init__("The sweep was interrupted.")
        self.result = result
