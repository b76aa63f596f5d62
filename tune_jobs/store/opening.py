"""Open a storage or a sweep by its place: a folder, or the URL of an object store. See `urls`."""

from __future__ import annotations

import shlex
from pathlib import Path

from analysis.records import SweepRecord
from policies.errors import SpecError
from tune_jobs.store import probe
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Storage, Sweep
from tune_jobs.store.local_storage import LocalStorage
from tune_jobs.store.names import TRIALS_FOLDER
from tune_jobs.store.objects.url import ObjectUrl
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.urls import folder_of, is_url, name_of_place, outer_place

__all__ = [
    "is_same_place",
    "is_url",
    "open_storage",
    "open_sweep",
    "others_write",
    "resume_command",
    "sweep_of_trial",
]


def open_storage(place: str | Path) -> Storage:
    """Return the storage at a place, which need not exist.

    Raises:
        SpecError: The place is a URL that is wrong.
    """
    if is_url(place):
        from tune_jobs.store.objects.object_storage import ObjectStorage

        return ObjectStorage(ObjectUrl.parse(str(place)))
    return LocalStorage(folder_of(place))


def open_sweep(place: str | Path) -> Sweep:
    """Return the sweep at a place, which need not exist yet.

    Raises:
        SpecError: The place is a URL that is wrong.
    """
    if is_url(place):
        # Loaded for those that have one: it takes longer than all of the local store.
        from tune_jobs.store.objects.object_sweep import ObjectSweep

        return ObjectSweep(ObjectUrl.parse(str(place)))
    return SweepStore(folder_of(place))


def is_same_place(one: str, other: str) -> bool:
    """Whether two places are one: a folder also by a link to it, a URL with or without what says how it is reached."""
    if one == other:
        return True
    try:
        if not is_url(one) and not is_url(other):
            return folder_of(one).samefile(folder_of(other))
        return is_url(one) and is_url(other) and _is_same_url(ObjectUrl.parse(one), ObjectUrl.parse(other))
    except (OSError, ValueError, SpecError):
        # A folder of another machine, or a record's text that is no place.
        return False


def _is_same_url(one: ObjectUrl, other: ObjectUrl) -> bool:
    # What only one of them says, the other takes from its environment; a region does not tell which bucket it is.
    both = (one.settings.keys() & other.settings.keys()) - {"region"}
    return one.short == other.short and all(
        one.settings[name].rstrip("/") == other.settings[name].rstrip("/") for name in both
    )


def others_write(place: str | Path) -> None:
    """Read a sweep anew from now on, whose lock this process holds: another process writes its records for this one."""
    if is_url(place):
        from tune_jobs.store.objects.held import held

        if (known := held(ObjectUrl.parse(str(place)))) is not None:
            known.let_others_write()


def resume_command(sweep: Sweep, record: SweepRecord | None) -> str:
    """Return the command that goes on with a sweep where it ran last; a name means one in the default storage.

    Args:
        sweep: The sweep.
        record: Its record; None: it can't be read, and where it ran is not known.
    """
    at = ""
    if record is not None and record.job is not None:
        at = f" --address {shlex.quote(record.job.address)} --detach"
    elif record is not None and record.address is not None:
        at = f" --address {shlex.quote(record.address)}"
    return f"tune-jobs resume {name_in_commands(sweep.place)}{at}"


def answer(place: str, machine: str) -> str:
    """Answer the question of a probe, for this machine; see `contract.Probe`.

    Args:
        place: The probe's place.
        machine: A name of this machine.

    Raises:
        FileNotFoundError: The folder cannot be seen here.
        CannotRunError: Something cannot be done there from here.
    """
    if is_url(place):
        from tune_jobs.store.objects import probe as of_objects

        return of_objects.answer(place, machine)
    return probe.answer(place, machine)


def sweep_of_trial(place: str | Path) -> Sweep | None:
    """Return the sweep that a trial's place is in; None: it is in none.

    Raises:
        SpecError: The place is a URL that is wrong.
    """
    trials = outer_place(str(place))
    if name_of_place(trials) != TRIALS_FOLDER:
        return None
    sweep = open_sweep(outer_place(trials))
    return sweep if sweep.exists() else None
