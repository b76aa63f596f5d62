"""Load a policy to act with, from a file or from where a sweep is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from policies.acting import load
from policies.arguments import checked
from tune_jobs.store.names import SWEEP_RECORD
from tune_jobs.store.urls import is_url

if TYPE_CHECKING:
    from policies.acting.policy import Policy


@checked
def load_policy(path: str | Path) -> Policy:
    """Read a policy from its portable file; this needs neither Ray nor torch, and executes nothing in the file.

    A policy whose network is an RLModule of the user's own needs both, and its class has to be in an allowed module.

    Args:
        path: `policy.json`, `policy.safetensors`, or the folder that holds them; or the folder of a sweep, or its URL
            in an object store, of which it is the best policy.

    Raises:
        NotFoundError: There is no such file, or the sweep has no best policy yet.
        CheckpointError: The file is incomplete, altered, or of another format.
        SpecError: It needs a class from a module that is not allowed, or the URL is wrong.
        CannotRunError: The object store cannot be read.
    """
    if not is_url(path) and not Path(path, SWEEP_RECORD).is_file():
        return load.load_policy(path)
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(path)
    # With a hint if there is none.
    store.read_best()
    return load.load_policy(store.best_folder)
