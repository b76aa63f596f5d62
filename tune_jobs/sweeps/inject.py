"""Inject a point that another process can be sent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.resume import go_on
from tune_jobs.sweeps.sources import find_sweep


@run_alone
def inject_plain(
    sweep: str | Path,
    point: dict[str, Any],
    *,
    storage: str | Path | None,
    address: str | None,
    finish: bool,
    progress: str,
    wait_for_nodes: float,
) -> SweepResult:
    """Add a point to a sweep and run it; it holds what JSON can hold, as this may be done in a process of its own.

    The arguments are those of `tune_jobs.inject`.

    Raises:
        TuneJobsError: The same as of `tune_jobs.inject`.
    """
    store = find_sweep(sweep, storage)
    return go_on(store, address, point=point, finish=finish, progress=progress, wait_for_nodes=wait_for_nodes)
