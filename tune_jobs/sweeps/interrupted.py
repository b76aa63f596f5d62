"""What is raised where a sweep is ended by a signal."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tune_jobs.sweeps.outcome import SweepResult


class SweepInterrupted(KeyboardInterrupt):
    """A launch, drive, resume or extend was ended by Ctrl-C, SIGTERM or SIGHUP; what was done is saved.

    A `KeyboardInterrupt`, so that it ends the script that launched, also a loop over launches with an
    `except Exception` in it.

    Args:
        result: What there is of the sweep; None: it had not begun, and what was there before is as it was.
    """

    def __init__(self, result: SweepResult | None = None) -> None:
        super().__init__("The sweep was interrupted.")
        self.result = result
