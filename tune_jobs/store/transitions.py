"""What becomes of a trial's record: each way in which its status, or what it is to train, changes.

Who drives the sweep is the only one that changes records; times are Unix times, seconds.
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
    """The record of a trial that has not begun."""
    return TrialRecord.model_validate(dict(plan))


def with_point(record: TrialRecord, point: dict[str, Any], hyperparams: dict[str, Any]) -> TrialRecord:
    """A trial whose point was chosen."""
    return record.model_copy(update={"point": point, "hyperparams": hyperparams, "has_point": True})


def with_change(record: TrialRecord, change: ChangeRecord, hyperparams: dict[str, Any]) -> TrialRecord:
    """A trial of a population that is to go on from another one's checkpoint, with other values."""
    changes = (*record.changes, change)
    return record.model_copy(update={"point": change.after, "hyperparams": hyperparams, "changes": changes})


def with_checkpoints(record: TrialRecord, checkpoints: Sequence[CheckpointRecord]) -> TrialRecord:
    """A trial whose checkpoints are these, as far as is seen from outside of its process."""
    return record.model_copy(update={"checkpoints": tuple(checkpoints)})


def begun(record: TrialRecord, now: float) -> TrialRecord:
    """A trial that a process took."""
    started_at = now if record.started_at is None else record.started_at
    return record.model_copy(update={"status": "running", "started_at": started_at, "ended_at": None, "error": None})


def told(record: TrialRecord, progress: Progress, *, node: str, pid: int) -> TrialRecord:
    """A trial whose process told where it stands."""
    state = {name: getattr(progress, name) for name in TrialState.model_fields}
    notes = (*record.notes, *(note for note in progress.notes if note not in record.notes))[-_MAX_NOTES:]
    if progress.status == "stopped":
        state["stop_reason"] = _by_scheduler(progress)
    return record.model_copy(
        update={**state, "notes": notes, "num_failures": record.num_failures, "node": node, "pid": pid}
    )


def paused(record: TrialRecord) -> TrialRecord:
    """A trial that goes on later, from its latest checkpoint."""
    return record.model_copy(update={"status": "paused"})


def stopped(record: TrialRecord, now: float) -> TrialRecord:
    """A trial that the scheduler ended."""
    return record.model_copy(update={"status": "stopped", "stop_reason": _by_scheduler(record), "ended_at": now})


def _by_scheduler(state: TrialState) -> str:
    return f"scheduler, at {state.num_env_steps} env steps"


def failed(record: TrialRecord, error: str, now: float, *, retried: bool, reached: Reached | None) -> TrialRecord:
    """A trial that failed, for good or to be tried again.

    Args:
        record: The trial.
        error: Why; of a long one the middle is left out.
        now: When.
        retried: Whether it is tried again.
        reached: How far it was; None: as far as it was known to be.
    """
    changes: dict[str, Any] = {} if reached is None else dataclasses.asdict(reached)
    changes |= {"num_failures": record.num_failures + 1, "error": fit(error, _MAX_ERROR)}
    if retried:
        return record.model_copy(update={**changes, "status": "pending"})
    return record.model_copy(update={**changes, "status": "failed", "ended_at": now})


def tried_again(record: TrialRecord) -> TrialRecord:
    """A trial that failed for good, and is to run again after all."""
    return record.model_copy(update={"status": "pending", "error": None})
