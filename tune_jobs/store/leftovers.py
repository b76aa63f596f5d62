"""What a process that was killed leaves half made in a sweep's folder, and who removes it.

Files appear under a temporary name that tells who writes them (`policies.files`): that of a process that is gone is
nobody's. Only who holds the sweep's lock removes them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from policies.files import is_abandoned
from tune_jobs.store import names
from tune_jobs.store.places import remove_folder


def remove_abandoned(sweep_folder: Path, trial_ids: Iterable[str]) -> None:
    """Remove the files that nobody finishes any more, and a probe; what trials left in checkpoints is theirs."""
    report = sweep_folder / names.REPORT_FOLDER
    parts = (sweep_folder / names.BEST_FOLDER, sweep_folder / names.PACKS_FOLDER, report, report / names.FIGURES_FOLDER)
    of_trials = (sweep_folder / names.TRIALS_FOLDER / trial_id for trial_id in trial_ids)
    for folder in (sweep_folder, *parts, *of_trials):
        if folder.is_dir() and not folder.is_symlink():
            for path in folder.glob(".*"):
                if is_abandoned(path):
                    with contextlib.suppress(OSError):
                        path.unlink()
    # The nodes of a cluster are asked about the storage under the lock: nobody is asking now.
    probe = sweep_folder / names.PROBE_FOLDER
    if probe.is_dir() and not probe.is_symlink():
        remove_folder(probe)
