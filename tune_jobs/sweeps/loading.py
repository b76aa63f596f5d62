"""Load a policy to act with, from a file or from where a sweep is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from policies.acting import load
from policies.arguments import checked
from policies.errors import NotFoundError
from policies.files import expanded
from tune_jobs.store.urls import is_url

if TYPE_CHECKING:
    from policies.acting.policy import Policy


@checked
def load_policy(path: str | Path) -> Policy:
    """Read a policy from its portable file; this needs neither Ray nor torch, and executes nothing in the file.

    A policy whose network is an RLModule of the user's own needs both, and its class has to be in an allowed module.

    Args:
        path: `policy.json`, `policy.safetensors`, or the folder that holds them; or the folder of a sweep, or its URL
            in an object store, of which it is the best policy. A ~ at the beginning is a home folder.

    Raises:
        NotFoundError: There is no such file, or the sweep has no best policy yet.
        CheckpointError: The file is incomplete, altered, or of another format.
        SpecError: It needs a class from a module that is not allowed, or the URL is wrong.
        CannotRunError: The object store cannot be read.
    """
    if not is_url(path):
        try:
            return load.load_policy(path)
        except NotFoundError:
            if not _is_sweep(expanded(path)):
                raise
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(path)
    # With a hint if there is none.
    store.read_best()
    return load.load_policy(store.best_folder)


def _is_sweep(path: Path) -> bool:
    try:
        if not path.is_dir():
            return False
    except OSError:  # who cannot look at it has been told so
        return False
    try:
        from tune_jobs.store.opening import open_sweep
    except ImportError:  # where only what acting needs is installed
        return False
    return open_sweep(path.absolute()).exists()
