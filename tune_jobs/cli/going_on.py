"""Say by which command a sweep goes on, and by which its failed trials run again: `resume` alone leaves them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from analysis.wording import counted

if TYPE_CHECKING:
    from analysis.records import TrialRecord
    from tune_jobs.sweeps.outcome import SweepResult


def how_to_resume(result: SweepResult) -> str:
    """Return the command that goes on with a sweep of this machine's."""
    # Most commands that print something need no store, which takes as long to load as all else here.
    from tune_jobs.store.opening import open_sweep, resume_command

    return resume_command(open_sweep(result.place), result.sweep)


def notes_of(result: SweepResult) -> list[str]:
    """Return what is to be noted of a sweep of this machine's, how its failed trials run again included."""
    return [*result.notes, *retry_notes(result.trials, lambda: how_to_resume(result), interrupted=result.interrupted)]


def retry_notes(trials: Sequence[TrialRecord], resume: Callable[[], str], *, interrupted: bool) -> list[str]:
    """Return the note on a sweep's failed trials; none where there are none, or where it goes on first.

    Args:
        trials: Its trials.
        resume: Makes the command that goes on with it.
        interrupted: Whether something of it is left to run.
    """
    failed = sum(trial.status == "failed" for trial in trials)
    if not failed or interrupted:
        return []
    them = "it" if failed == 1 else "them"
    return [
        f"{counted(failed, 'trial')} failed. Once the cause is mended, `{resume()} --retry-failed` runs {them} again."
    ]
