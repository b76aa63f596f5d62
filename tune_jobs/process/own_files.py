"""Whether this program's own files were changed while it runs, as by an upgrade.

What is loaded need not fit what is imported after it then: an error that nobody expected is no bug.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tune_jobs.process.own_packages import NAMES

_PACKAGES = ("tune_jobs", *NAMES)
_ROOT = Path(__file__).parents[2]
_BEGAN_AT = time.time()


def were_changed() -> bool:
    """Return whether a file of our packages was changed since this process began, or one that it has loaded is gone."""
    # Where a clock is wrong, files may be of the future: each process would find them changed.
    changed = (_BEGAN_AT < _changed_at(file) <= time.time() for file in _files())
    return any(not file.exists() for file in _loaded()) or any(changed)


def _loaded() -> Iterator[Path]:
    for name, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "")
        # A user may have packages of these names.
        if name.partition(".")[0] in _PACKAGES and _ROOT in file.parents:
            yield file


def _files() -> Iterator[Path]:
    for package in _PACKAGES:
        for folder, folders, files in os.walk(_ROOT / package):
            # What Python writes there itself.
            folders[:] = [name for name in folders if name != "__pycache__"]
            yield from (Path(folder, name) for name in files)


def _changed_at(file: Path) -> float:
    """Return when a file was put there or changed last: its time of modification may be that of a package's build.

    Another hard link changes it, too, as where uv makes a second environment.
    """
    try:
        return file.lstat().st_ctime
    except FileNotFoundError:  # replaced at this moment
        return time.time()
