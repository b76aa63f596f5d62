"""What tables, figures and files of a sweep are made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.best_records import BestRecord
from analysis.exports.frames import SweepData
from policies.errors import NotFoundError

if TYPE_CHECKING:
    from tune_jobs.spec.sweep_spec import SweepSpec
    from tune_jobs.store.contract import Sweep


def sweep_data(store: Sweep) -> SweepData:
    """Return what the tables and figures of a sweep are made of.

    Raises:
        CheckpointError: The record of the sweep or of a trial is damaged.
    """
    from analysis.report_data import goal_of
    from tune_jobs.store.candidates import read_results
    from tune_jobs.sweeps.status import trials_as_left

    best: BestRecord | None = None
    try:
        best = store.read_best()
    except NotFoundError:
        # No winner was chosen yet, or it can't be read: then the env's own threshold counts.
        best = None
    spec, record = spec_of(store), store.read_record()
    return SweepData(
        trials=trials_as_left(store),
        results=read_results(store),
        objective=spec.objective.type,
        num_env_steps=spec.stop.num_env_steps,
        threshold=goal_of(record, best),
        has_settings=not spec.scheduler.is_population,
        num_iterations=record.max_iterations,
    )


def spec_of(store: Sweep) -> SweepSpec:
    """Return the sweep file of a sweep.

    Raises:
        CheckpointError: It is of another version, or damaged.
    """
    from tune_jobs.spec.file import stored_spec

    return stored_spec(store.read_record())
