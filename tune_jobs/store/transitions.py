"""How a trial's record changes: every change of its status and of what it is to train is a function here.

Only the process that drives the sweep changes records. Times are Unix times in seconds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from analysis.records import ChangeRecord, CheckpointRecord, TrialPlan, TrialRecord, TrialState
from policies.envs.tallies import Reached
from policies.errors import fit
from tune_jobs.store.progress import Progress

# Of a trial: what was damaged when it was opened, the newest.
_MAX_NOTES = 20
# Of a failure: what was said, and 15 lines of a log.
_MAX_ERROR = 20_000


def pending_record(plan: TrialPlan) -> TrialRecord:
    """Return the record of a trial that has not begun."""
    return TrialRecord.model_validate(dict(plan))


def with_point(record: TrialRecord, point: dict[str, Any], hyperparams: dict[str, Any]) -> TrialRecord:
    """Return the record after the trial's point was chosen."""
    return record.model_copy(update={"point": point, "hyperparams": hyperparams, "has_point": True})


def with_change(record: TrialRecord, change: ChangeRecord, hyperparams: dict[str, Any]) -> TrialRecord:
    """Return the record of a trial of a population that is to continue from another's checkpoint, with other values."""
    changes = (*record.changes, change)
    return record.model_copy(update={"point": change.after, "hyperparams": hyperparams, "changes": changes})


def with_checkpoints(record: TrialRecord, checkpoints: Sequence[CheckpointRecord]) -> TrialRecord:
    """Return the record with the checkpoints that were found on disk."""
    return record.model_copy(update={"checkpoints": tuple(checkpoints)})


def begun(record: TrialRecord, now: float) -> TrialRecord:
    """Return the record after a process took the trial."""
    started_at = now if record.started_at is None else record.started_at
    return record.model_copy(update={"status": "running", "started_at": started_at, "ended_at": None, "error": None})


def told(record: TrialRecord, progress: Progress, *, node: str, pid: int) -> TrialRecord:
    """Return the record after the trial's process told where the trial stands."""
    state = {name: getattr(progress, name) for name in TrialState.model_fields}
    notes = (*record.notes, *(note for note in progress.notes if note not in record.notes))[-_MAX_NOTES:]
    if progress.status == "stopped":
        state["stop_reason"] = _by_scheduler(progress)
    return record.model_copy(
        update={**state, "notes": notes, "num_failures": record.num_failures, "node": node, "pid": pid}
    )


def paused(record: TrialRecord) -> TrialRecord:
    """Return the record of a trial that will continue from its latest checkpoint."""
    return record.model_copy(update={"status": "paused"})


def moved(record: TrialRecord, note: str) -> TrialRecord:
    """Return the record of a trial whose node was lost; it has not failed, and goes on elsewhere."""
    return record.model_copy(update={"status": "pending", "notes": (*record.notes, note)[-_MAX_NOTES:]})


def stopped(record: TrialRecord, now: float) -> TrialRecord:
    """Return the record after the scheduler ended the trial."""
    return record.model_copy(update={"status": "stopped", "stop_reason": _by_scheduler(record), "ended_at": now})


def _by_scheduler(state: TrialState) -> str:
    return f"scheduler, at {state.num_env_steps} env steps"


def failed(record: TrialRecord, error: str, now: float, *, retried: bool, reached: Reached | None) -> TrialRecord:
    """Return the record after the trial failed, for good or to be tried again.

    Args:
        record: The trial.
        error: Why it failed; the middle of a long text is left out.
        now: When.
        retried: Whether it is tried again.
        reached: How far it was; None: as far as the record says.
    """
    changes: dict[str, Any] = {} if reached is None else dataclasses.asdict(reached)
    changes |= {"num_failures": record.num_failures + 1, "error": fit(error, _MAX_ERROR)}
    if retried:
        return record.model_copy(update={**changes, "status": "pending"})
    return record.model_copy(update={**changes, "status": "failed", "ended_at": now})


def tried_again(record: TrialRecord) -> TrialRecord:
    """Return the record of a trial that failed for good and is to run again."""
    return record.model_copy(update={"status": "pending", "error": None})
