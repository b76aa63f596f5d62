"""Find what a text names: a sweep, or one trial of a sweep."""

from __future__ import annotations

import contextlib
import shlex
from pathlib import Path

from analysis.records import TrialRecord
from policies.errors import NotFoundError
from policies.portable.file import BASELINE_KINDS
from policies.suggestions import did_you_mean
from tune_jobs.store.candidates import read_trials
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep
from tune_jobs.store.opening import is_url, open_storage, open_sweep, sweep_of_trial
from tune_jobs.store.urls import join_place, name_of_place, outer_place
from tune_jobs.sweeps.storage import place_named, split_trial, storage_place


def find_sweep(sweep: str | Path, storage: str | Path | None = None) -> Sweep:
    """Find a sweep by its place, or by its name in the storage.

    Raises:
        NotFoundError: There is no such sweep.
    """
    by_place = open_sweep(place_named(sweep))
    if by_place.exists():
        return by_place
    if is_url(by_place.place):
        raise NotFoundError(
            f"There is no sweep at {by_place.place}.",
            f"List the sweeps with `tune-jobs list --storage {shlex.quote(outer_place(by_place.place))}`.",
        )
    root = storage_place(storage)
    if is_url(root):
        with contextlib.suppress(NotFoundError):  # it may be `SWEEP/TRIAL`
            store = open_storage(root).sweep(str(sweep))
            if store.exists():
                return store
    elif (store := open_sweep(join_place(root, str(sweep)))).exists():
        return store
    known = [item.name for item in open_storage(root).sweeps()]
    raise NotFoundError(
        f"No sweep {str(sweep)!r} in {root}.{did_you_mean(sweep, known)}",
        "List the sweeps with `tune-jobs list`; name another storage with --storage.",
    )


def names_baseline(source: str, storage: str | Path | None = None) -> bool:
    """Whether a text without an environment names a baseline policy: former versions let sweeps be called so."""
    if source not in BASELINE_KINDS:
        return False
    try:
        find_sweep(source, storage)
    except NotFoundError:
        return True
    return False


def find_source(source: str | Path, storage: str | Path | None = None) -> tuple[Sweep, str | None]:
    """Find a sweep by name or place, or a trial of one: `SWEEP/t0003`, or the trial's place.

    Returns:
        The sweep, and the trial's id as it was given, which need not exist; None: it is the sweep.

    Raises:
        NotFoundError: There is no such sweep.
    """
    place = place_named(source)
    if (of_trial := sweep_of_trial(place)) is not None:
        return of_trial, name_of_place(place)
    try:
        return find_sweep(source, storage), None
    except NotFoundError as error:
        sweep, trial_id = split_trial(str(source).rstrip("/"))
        if not sweep:
            raise
        try:
            return find_sweep(sweep, storage), trial_id
        except NotFoundError:
            raise error from None


def find_trial(store: Sweep, trial_id: str) -> TrialRecord:
    """Return the record of a trial.

    Raises:
        NotFoundError: The sweep has no such trial.
    """
    trials = {record.trial_id: record for record in read_trials(store)}
    if trial_id not in trials:
        raise NotFoundError(
            f"Sweep {store.name} has no trial {trial_id!r}; it has {len(trials)} trials."
            f"{did_you_mean(trial_id, list(trials))}",
            f"List them with `tune-jobs trials {name_in_commands(store.place)}`.",
        )
    return trials[trial_id]
