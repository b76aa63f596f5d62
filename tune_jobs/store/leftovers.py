"""What a process that was killed leaves half made in a sweep's folder, and who removes it.

Files appear under a temporary name that tells who writes them (`policies.files`): that of a process that is gone is
nobody's. Only who holds the sweep's lock removes them.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from analysis.records import FINISHED
from policies.files import is_abandoned
from tune_jobs.store import names
from tune_jobs.store.places import remove_folder

if TYPE_CHECKING:
    from tune_jobs.store.sweep_store import SweepStore


def remove_leftovers(store: SweepStore) -> None:
    """Remove what nobody finishes any more; the sweep's lock has to be held."""
    trials = store.read_trials()
    report = store.folder / names.REPORT_FOLDER
    parts = (store.folder / names.BEST_FOLDER, store.folder / names.PACKS_FOLDER, report, report / names.FIGURES_FOLDER)
    of_trials = (store.folder / names.TRIALS_FOLDER / trial.trial_id for trial in trials)
    for folder in (store.folder, *parts, *of_trials):
        if folder.is_dir() and not folder.is_symlink():
            for path in folder.glob(".*"):
                if is_abandoned(path):
                    with contextlib.suppress(OSError):
                        path.unlink()
    for trial in trials:
        # The others' are removed by the process that takes them up.
        if trial.status in FINISHED:
            store.trial(trial.trial_id).remove_leftovers()
    # The nodes of a cluster are asked about the storage under the lock: nobody is asking now.
    probe = store.folder / names.PROBE_FOLDER
    if probe.is_dir() and not probe.is_symlink():
        remove_folder(probe)
