"""Find out whether a sweep's winner can be written before policies play for minutes, such as in a colleague's sweep."""

from __future__ import annotations

import os

from policies.errors import CannotRunError
from tune_jobs.store import names
from tune_jobs.store.contract import Sweep
from tune_jobs.store.urls import folder_of, is_url


def may_write_best(sweep: Sweep) -> bool:
    """Whether this user may write the winner, as far as is known; an object store says so where it is written."""
    if is_url(sweep.place):
        return True
    folder = folder_of(sweep.place)
    best = folder / names.BEST_FOLDER
    place = best if best.exists() else folder
    # What is removed just now is told where it is missed.
    return os.access(place, os.W_OK | os.X_OK) or not place.exists()


def check_best_writable(sweep: Sweep) -> None:
    """Check that this user may write the winner.

    Raises:
        CannotRunError: They may not.
    """
    if not may_write_best(sweep):
        raise CannotRunError(
            f"The best policy of sweep {sweep.name} cannot be written: {sweep.place} may only be read.",
            "Let its owner choose it, or copy the folder to a storage of your own.",
        )
