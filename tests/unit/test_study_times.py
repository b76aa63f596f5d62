"""A trial of an Optuna study began and ended when the sweep's did."""

import math
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from analysis.exports.frames import SweepData
from analysis.records import IterationRecord, TrialRecord
from tune_jobs.search.study import make_study
from tune_jobs.spec.sweep_spec import SweepSpec

optuna = pytest.importorskip("optuna")
BEGAN = 1_700_000_000.0


def study_of(path: Path | None, *given: dict[str, Any]) -> Any:
    """A study of a trial for each of some fields, all of which ended."""
    trials = [
        TrialRecord(
            trial_id=f"t{index:04d}", index=index, seed=index, point_index=index, point={"lr": 0.1},
            **({"status": "completed"} | fields),
        )
        for index, fields in enumerate(given)
    ]  # fmt: skip
    shown = IterationRecord(iteration=1, num_env_steps=100, num_episodes=10, time_s=1.0, evaluation_return=3.0)
    results = {trial.trial_id: [shown] for trial in trials}
    spec = SweepSpec.model_validate(
        {"env": {"id": "CartPole-v0"}, "algorithm": "ppo", "space": {"lr": {"uniform": [1e-3, 1.0]}}, "num_samples": 5}
    )
    return make_study(spec, SweepData(trials, results, "final", num_env_steps=100, threshold=None), "mine", path)


def local(unix_time: float) -> datetime:
    return datetime.fromtimestamp(unix_time, tz=UTC).astimezone().replace(tzinfo=None)


def test_a_trial_takes_as_long_in_a_study_as_it_took(tmp_path: Path) -> None:
    path = tmp_path / "mine.db"
    study_of(path, {"started_at": BEGAN, "ended_at": BEGAN + 500.0})
    (kept,) = optuna.load_study(study_name="mine", storage=f"sqlite:///{path}").trials
    assert kept.duration == timedelta(seconds=500)
    assert kept.datetime_start == local(BEGAN)


def test_a_trial_that_never_began_failed_in_no_time_when_it_ended(tmp_path: Path) -> None:
    path = tmp_path / "mine.db"
    study_of(path, {"status": "failed", "ended_at": BEGAN})
    (kept,) = optuna.load_study(study_name="mine", storage=f"sqlite:///{path}").trials
    assert kept.state == optuna.trial.TrialState.FAIL
    assert (kept.datetime_start, kept.datetime_complete) == (local(BEGAN), local(BEGAN))


@pytest.mark.parametrize("moment", [None, math.inf, math.nan, 1e300, -1e15])
def test_a_moment_that_is_none_is_that_of_the_export(moment: float | None) -> None:
    before = local(datetime.now(UTC).timestamp())
    known, unknown = study_of(
        None,
        {"started_at": moment, "ended_at": BEGAN},
        {"started_at": BEGAN, "ended_at": moment},
    ).trials
    assert known.datetime_start == known.datetime_complete == local(BEGAN)
    assert before - timedelta(seconds=1) <= unknown.datetime_start == unknown.datetime_complete
