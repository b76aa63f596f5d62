"""Free the name of a sweep that a killed process was writing."""

from __future__ import annotations

import contextlib

from policies.errors import TuneJobsError
from tune_jobs.store import names
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.places import names_in
from tune_jobs.store.urls import folder_of, is_url


def free_half_made(storage: Storage, name: str) -> None:
    """Remove what a process has written of a sweep, if it was killed before the sweep's record, so that it is none.

    What is being written now, and anything else of that name, is left alone.
    """
    sweep = storage.sweep(name)
    with contextlib.suppress(TuneJobsError):
        # Looked at before it is locked, too: a lock is a file there.
        if storage.is_taken(name) and _is_half_made(sweep):
            with sweep.lock():
                if _is_half_made(sweep):
                    sweep.discard()


def _is_half_made(sweep: Sweep) -> bool:
    """Whether there is only what comes before a sweep's record: the name's claim, the locks and the trials' records."""
    if is_url(sweep.place):
        from tune_jobs.store.objects.bucket import Bucket
        from tune_jobs.store.objects.object_sweep import OF_A_NEW_SWEEP

        folders, objects = Bucket(ObjectUrl.parse(sweep.place)).children()
        return {*folders, *(item.key for item in objects)} <= OF_A_NEW_SWEEP
    return all(part == names.TRIALS_FOLDER or part.startswith(".") for part in names_in(folder_of(sweep.place)))
