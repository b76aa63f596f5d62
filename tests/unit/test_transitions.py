"""What becomes of a trial's record, and that its file stays the one it was."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest

from analysis.records import (
    FINISHED,
    ChangeRecord,
    CheckpointRecord,
    TrialPlan,
    TrialRecord,
    TrialState,
    TrialStatus,
)
from policies.envs.tallies import Reached
from tune_jobs.cli import output
from tune_jobs.store import transitions
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_files import dump
from tune_jobs.sweeps import live_table

SAMPLE = Path(__file__).parent / "samples" / "trial_record.json"
PLAN = TrialPlan(trial_id="t0002", index=2, point_index=1, seed=2048, point={"lr": 0.1}, hyperparams={"lr": 0.1})
CHECKPOINT = CheckpointRecord(trial_id="t0002", iteration=3, num_env_steps=300, evaluation_return=4.5)
CHANGE = ChangeRecord(
    iteration=2, num_env_steps=200, source_trial_id="t0001", source_iteration=2, before={"lr": 0.1}, after={"lr": 0.2},
    time=1_700_000_000.5,
)  # fmt: skip
RECORD = TrialRecord(
    **dict(PLAN), status="failed", error="it broke", num_failures=2, num_iterations=3, started_at=5.0, ended_at=9.0,
    notes=("old",), node="there", pid=1,
)  # fmt: skip


def test_the_file_of_a_trial_is_as_it_was_before_its_record_was_made_of_parts() -> None:
    record = TrialRecord(
        trial_id="t0002", index=2, point_index=1, seed_index=0, seed=2048, point={"lr": 0.2},
        hyperparams={"lr": 0.2, "hidden_sizes": [64, 64]}, has_point=True, engine="packed", changes=(CHANGE,),
        status="stopped", stop_reason="scheduler, at 300 env steps", error="it broke", num_failures=1,
        num_iterations=3, num_env_steps=300, num_episodes=7, time_s=float("inf"), training_return=float("nan"),
        evaluation_return=4.5, best_evaluation_return=4.5, best_iteration=3, notes=("a note",), node="10.0.0.1/ab",
        pid=12, ran_with={"cpu": "a CPU"}, started_at=1_700_000_000.25, ended_at=1_700_000_001.0,
        checkpoints=(CHECKPOINT,),
    )  # fmt: skip
    # What records have got since.
    newer = ' "objective_score": null,\n'
    assert dump(record).count(newer) == 1
    assert dump(record).replace(newer, "") == SAMPLE.read_text(encoding="utf-8")
    assert TrialRecord.model_validate_json(SAMPLE.read_bytes()) == record


def test_every_field_of_a_record_is_planned_or_of_the_state() -> None:
    assert list(TrialRecord.model_fields) == [*TrialPlan.model_fields, *TrialState.model_fields]
    assert set(Progress.model_fields) == {*TrialState.model_fields, "evaluated", "iterations"}


def test_a_planned_trial_waits_with_what_is_planned_of_it() -> None:
    record = transitions.pending_record(PLAN)
    assert record == TrialRecord(**dict(PLAN))
    assert (record.status, record.num_env_steps, record.checkpoints) == ("pending", 0, ())


@pytest.mark.parametrize(
    ("become", "expected"),
    [
        (lambda record: transitions.begun(record, 10.0), {"status": "running", "error": None, "ended_at": None}),
        (transitions.paused, {"status": "paused"}),
        (
            lambda record: transitions.stopped(record, 10.0),
            {"status": "stopped", "stop_reason": "scheduler, at 0 env steps", "ended_at": 10.0},
        ),
        (
            lambda record: transitions.failed(record, "again", 10.0, retried=True, reached=None),
            {"status": "pending", "error": "again", "num_failures": 3},
        ),
        (
            lambda record: transitions.failed(record, "again", 10.0, retried=False, reached=Reached(4, 400, 8, 1.5)),
            {
                "status": "failed", "error": "again", "num_failures": 3, "ended_at": 10.0, "num_iterations": 4,
                "num_env_steps": 400, "num_episodes": 8, "time_s": 1.5,
            },
        ),
        (transitions.tried_again, {"status": "pending", "error": None}),
        (
            lambda record: transitions.with_point(record, {"lr": 1.0}, {"lr": 1.0, "gamma": 0.9}),
            {"point": {"lr": 1.0}, "hyperparams": {"lr": 1.0, "gamma": 0.9}},
        ),
        (
            lambda record: transitions.with_change(record, CHANGE, {"lr": 0.2}),
            {"point": {"lr": 0.2}, "hyperparams": {"lr": 0.2}, "changes": (CHANGE,)},
        ),
        (
            lambda record: transitions.with_change(
                transitions.with_change(record, CHANGE, {}), CHANGE, {"lr": 0.2, "gamma": 0.9}
            ),
            {"point": {"lr": 0.2}, "hyperparams": {"lr": 0.2, "gamma": 0.9}, "changes": (CHANGE, CHANGE)},
        ),
        (lambda record: transitions.with_checkpoints(record, [CHECKPOINT]), {"checkpoints": (CHECKPOINT,)}),
    ],
)  # fmt: skip
def test_what_becomes_of_a_record_changes_so_much_of_it_and_no_more(
    become: Callable[[TrialRecord], TrialRecord], expected: dict[str, Any]
) -> None:
    assert become(RECORD) == RECORD.model_copy(update=expected)


def test_a_trial_that_begins_again_began_when_it_first_did() -> None:
    assert transitions.begun(transitions.pending_record(PLAN), 10.0).started_at == 10.0
    assert transitions.begun(RECORD, 10.0).started_at == 5.0


def test_what_a_process_tells_is_all_but_failures_and_where_it_runs() -> None:
    progress = Progress(
        status="running", evaluated=True, num_iterations=4, num_env_steps=400, notes=("new", "old"), started_at=7.0,
        checkpoints=(CHECKPOINT,),
    )  # fmt: skip
    record = transitions.told(RECORD, progress, node="here", pid=12)
    assert TrialPlan(**{name: getattr(record, name) for name in TrialPlan.model_fields}) == PLAN
    assert (record.num_failures, record.notes, record.node, record.pid) == (2, ("old", "new"), "here", 12)
    assert (record.status, record.error, record.num_env_steps, record.started_at, record.ended_at) == (
        "running", None, 400, 7.0, None,
    )  # fmt: skip
    assert record.checkpoints == (CHECKPOINT,)


def test_a_process_does_not_tell_what_there_is_no_field_for() -> None:
    with pytest.raises(ValueError, match="iteration"):
        Progress(status="running", evaluated=True, iteration=4)  # type: ignore[call-arg]


def test_every_status_is_shown() -> None:
    statuses = set(get_args(TrialStatus))
    assert set(live_table.STATUS_STYLES) == set(output.STATUS_ORDER) == statuses
    assert statuses > FINISHED
