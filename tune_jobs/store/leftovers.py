"""Remove the incomplete files that killed processes left in a sweep's folder.

Files are written under a temporary name that tells which process writes them (`policies.files`). If that process has
ended, the file is abandoned. Only the process that holds the sweep's lock removes such files.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from policies.files import is_abandoned
from tune_jobs.store import names
from tune_jobs.store.places import remove_folder


def remove_abandoned(sweep_folder: Path, trial_ids: Iterable[str]) -> None:
    """Remove abandoned files, and a probe; trials themselves remove what was left in their checkpoints."""
    report = sweep_folder / names.REPORT_FOLDER
    parts = (sweep_folder / names.BEST_FOLDER, sweep_folder / names.PACKS_FOLDER, report, report / names.FIGURES_FOLDER)
    of_trials = (sweep_folder / names.TRIALS_FOLDER / trial_id for trial_id in trial_ids)
    for folder in (sweep_folder, *parts, *of_trials):
        if folder.is_dir() and not folder.is_symlink():
            for path in folder.glob(".*"):
                if is_abandoned(path):
                    with contextlib.suppress(OSError):
                        path.unlink()
    # A probe is only used under the lock, so none is in use now.
    probe = sweep_folder / names.PROBE_FOLDER
    if probe.is_dir() and not probe.is_symlink():
        remove_folder(probe)
