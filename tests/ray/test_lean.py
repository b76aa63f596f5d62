"""What Ray Tune is spared, so that the driver's cost of a trial does not grow with their number."""

import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ray.tune.execution.tune_controller import TuneController
from ray.tune.experiment import Trial
from scripted_packs import make_sweep

from tune_jobs.ray_tune.lean import Sealed, without_state_of_trials
from tune_jobs.ray_tune.lost_nodes import NodeLosses
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.tune_events import TrialEvents
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper

pytestmark = pytest.mark.ray


class _NotLookedAt(list[Any]):
    """All trials of a sweep."""

    def __iter__(self) -> Iterator[Any]:
        raise AssertionError("looked at all trials")


def _trial(trial_id: str) -> Any:
    return types.SimpleNamespace(config={"trial_id": trial_id}, trial_id=trial_id, status=Trial.RUNNING)


def _events(folder: Path, num_trials: int) -> tuple[TrialEvents, RecordKeeper]:
    store = make_sweep(folder, num_trials)
    keeper = RecordKeeper(store, [f"t{i:04d}" for i in range(num_trials)], lambda record: None)
    losses = NodeLosses(lambda trial: 0, lambda error: None)
    return TrialEvents(store, keeper, 600.0, RayWatch({}, grace_s=1.0), losses), keeper


def test_a_paused_trial_is_noted_without_a_look_at_all_trials(tmp_path: Path) -> None:
    events, keeper = _events(tmp_path / "mine", 3)
    trials = [_trial(f"t{i:04d}") for i in range(2)]
    for trial in trials:
        events.on_trial_start(0, _NotLookedAt(), trial)
    events.on_step_end(1, _NotLookedAt())
    assert [keeper.record(f"t{i:04d}").status for i in range(3)] == ["running", "running", "pending"]
    trials[0].status = Trial.PAUSED
    events.on_step_end(2, _NotLookedAt())
    assert [keeper.record(f"t{i:04d}").status for i in range(3)] == ["paused", "running", "pending"]
    # It goes on, and is paused again.
    trials[0].status = Trial.RUNNING
    events.on_trial_start(3, _NotLookedAt(), trials[0])
    assert keeper.record("t0000").status == "running"
    trials[0].status = Trial.PAUSED
    events.on_step_end(4, _NotLookedAt())
    assert keeper.record("t0000").status == "paused"
    assert keeper.running == {"t0001"}


def test_a_report_is_passed_on_as_it_is_and_not_kept(tmp_path: Path) -> None:
    events, keeper = _events(tmp_path / "mine", 1)
    trial = _trial("t0000")
    events.on_trial_start(0, [], trial)
    progress = Progress(status="running", num_env_steps=7, evaluated=False)
    result = {"progress": Sealed(progress), "node": "here", "pid": 5}
    assert "num_env_steps" not in repr(result)
    events.on_trial_result(1, [], trial, result)
    assert keeper.record("t0000").num_env_steps == 7
    assert "progress" not in result


def test_tune_saves_no_trials_during_a_run_alone() -> None:
    controller = TuneController.__new__(TuneController)
    controller._trials_to_cache, controller._trial_metadata = set(), {"t0000": "its state"}
    with without_state_of_trials():
        assert controller._get_trial_checkpoints() == {}
    assert controller._get_trial_checkpoints() == {"t0000": "its state"}
