"""Whoever reads records copes with numbers that are NaN, infinite or too large to add."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeEngine
from fake_sweeps import Result
from synthetic_sweep import Synthetic, make_sweep
from trial_runs import Trial

from analysis.report import build_report
from analysis.tables import groups_frame, iterations_frame, steps_to_solve_frame, trials_frame
from tests.narrowing import present
from tune_jobs.cli.output import show_best, show_evaluation, show_result, show_status, show_sweeps
from tune_jobs.cli.trials_table import show_trials
from tune_jobs.store.event_files import ScalarWriter
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.live_table import summary_line
from tune_jobs.sweeps.monitor import SweepMonitor
from tune_jobs.sweeps.outcome import SweepResult
from tune_jobs.sweeps.status import SweepStatus

VALUES = [math.nan, math.inf, -math.inf, 1.7e308]


def spoilt(value: float) -> Synthetic:
    """A sweep in which every number that may be any is this one."""
    made = make_sweep(points=[{"lr": 0.1}, {"lr": 0.01}], failed=(1,))

    def again(record: Any, **changes: Any) -> Any:
        return type(record).model_validate(record.model_dump() | changes)

    scores = {"training_return": value, "evaluation_return": value}
    numbers = {"time_s": value, "episode_returns": (value, 1.0, value), "learner": {"loss": value, "lr": None}}
    made.results = {name: [again(item, **numbers, **scores) for item in items] for name, items in made.results.items()}
    made.trials = [
        again(trial, time_s=value, started_at=value, **scores, checkpoints=[again(trial.checkpoints[0], **scores)])
        for trial in made.trials
    ]
    made.sweep = again(made.sweep, created_at=value, started_at=value, ended_at=value, run_time_s=value)
    returns = (value, -value, *present(made.best).confirmation.returns[2:])
    confirmation = again(present(made.best).confirmation, returns=returns)
    random = again(present(made.best).random, returns=(value,) * len(present(made.best).random.returns))
    made.best = again(made.best, selection_score=value, confirmation=confirmation, random=random)
    return made


@pytest.fixture(params=VALUES, ids=str)
def made(request: pytest.FixtureRequest) -> Synthetic:
    return spoilt(request.param)


def test_the_report_and_the_tables_are_made(made: Synthetic, tmp_path: Path) -> None:
    path = build_report(
        str(tmp_path), target=tmp_path / "report", sweep=made.sweep, trials=made.trials, results=made.results,
        best=made.best, videos={},
    )  # fmt: skip
    assert "winner" in path.read_text().lower()
    assert len(trials_frame(made.trials, made.results, threshold=195.0)) == 2
    assert len(iterations_frame(made.results)) == sum(map(len, made.results.values()))
    for frame in (groups_frame, steps_to_solve_frame):
        arguments = (["lr"],) if frame is groups_frame else ()
        assert len(frame(made.trials, made.results, *arguments, threshold=195.0)) == 2


@pytest.mark.parametrize("as_json", [False, True])
def test_everything_is_shown_and_json_is_json(
    made: Synthetic, tmp_path: Path, capsys: pytest.CaptureFixture[str], as_json: bool
) -> None:
    status = SweepStatus(made.sweep, {"completed": 1, "failed": 1}, alive=False)
    result = Result(str(tmp_path), made.sweep, made.trials, made.best, None, {})
    shown: list[Callable[[], None]] = [
        lambda: show_result(cast("SweepResult", result), as_json=as_json),
        lambda: show_sweeps([status], as_json=as_json),
        lambda: show_status(status, as_json=as_json),
        lambda: show_trials(made.trials, as_json=as_json),
        lambda: show_best(present(made.best), as_json=as_json),
        lambda: show_evaluation(present(made.best).confirmation, present(made.best).random, as_json=as_json),
    ]
    for show in shown:
        show()
        out = capsys.readouterr().out
        assert out.strip()
        if as_json:
            json.loads(out, parse_constant=lambda token: pytest.fail(f"{token} is no JSON"))


def test_the_running_sweep_is_shown_and_written_for_tensorboard(made: Synthetic, tmp_path: Path) -> None:
    running = [trial.model_copy(update={"status": "running"}) for trial in made.trials]
    monitor = SweepMonitor("mine", running, caps={trial.trial_id: 100_000 for trial in running})
    monitor.update(made.trials[0])
    assert "1 completed" in summary_line(monitor)
    writer = ScalarWriter(SweepStore(tmp_path))
    for trial in made.trials:
        writer.write(trial, made.results[trial.trial_id])
    writer.flush()
    assert list(tmp_path.glob("trials/*/tensorboard/*"))


def test_a_trial_with_returns_of_nan_and_infinity_goes_on_and_is_reported(tmp_path: Path) -> None:
    def episodes(iteration: int) -> tuple[float, float]:
        return (VALUES[iteration % 4], 1.0)

    def score(iteration: int) -> float:
        return VALUES[iteration % 3] if iteration % 2 else float(iteration)

    first = Trial(tmp_path, engine=FakeEngine(episodes, raise_at=8), scores=score)
    with pytest.raises(ZeroDivisionError):
        first.run()
    again = Trial(tmp_path, engine=FakeEngine(episodes), scores=score, stop={"num_iterations": 12})
    progress = again.run()
    assert (progress.status, progress.num_iterations, progress.best_evaluation_return) == ("completed", 12, 12.0)
    results = again.results
    assert [record.iteration for record in results] == list(range(1, 13))
    assert repr([record.episode_returns[0] for record in results]) == repr([VALUES[i % 4] for i in range(1, 13)])
    made = make_sweep(points=[{"lr": 0.1}])
    report = build_report(
        str(tmp_path), target=tmp_path / "report", sweep=made.sweep, trials=made.trials, results={"t0000": results},
        best=made.best, videos={},
    )  # fmt: skip
    assert report.is_file()
    assert len(iterations_frame({"t0000": results})) == 12
