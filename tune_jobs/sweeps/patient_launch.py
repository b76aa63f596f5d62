"""Launch a sweep that may have to wait for a cluster's nodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policies.guard.guard import guarding
from tune_jobs.plan.user_code import Source, load_source
from tune_jobs.store.opening import open_sweep
from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.create import removed_if_not_begun, write_created
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.resume import go_on
from tune_jobs.sweeps.storage import stem_of, storage_place


@run_alone
@guarding(start=True)
def launch_and_wait(
    source: Source,
    overrides: Sequence[str],
    name: str | None,
    storage: str | Path | None,
    address: str | None,
    *,
    finish: bool,
    progress: str,
    rl_module: type[Any] | str | None,
    wait_for_nodes: float,
) -> SweepResult:
    """Write a sweep, and run it once there are nodes: meanwhile everybody who reaches the storage sees it wait.

    The arguments are those of `tune_jobs.launch`.

    Raises:
        SpecError: As for `tune_jobs.launch`. Nothing was written.
        CannotRunError: It cannot run there, and nothing was kept; or no nodes came in time, and the sweep is kept.
    """
    spec = load_source(source, overrides, rl_module)
    chosen = name if name is not None else spec.name
    created = write_created(spec, chosen, stem_of(source), storage_place(storage), address)
    with removed_if_not_begun(created):
        store = open_sweep(created.place)
        return go_on(store, address, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes)
