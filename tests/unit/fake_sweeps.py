"""The command line, and a stand-in for what it calls."""

import dataclasses
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click.testing
import pytest
from fake_results import COMPARISON, EQUAL, IMPORTANCE

from analysis.best_records import BestRecord, EvaluationRecord
from analysis.records import CheckpointRecord, SweepRecord, TrialRecord
from tune_jobs.cli.commands import cli
from tune_jobs.sweeps.status import SweepStatus

ROOT = Path(__file__).parents[2]
SMALL = "env: CartPole-v1\nalgorithm: ppo\nspace: {lr: {uniform: [1e-4, 1e-2]}}\nnum_samples: 2\n"
HEAVY = ("ray", "torch", "pandas", "matplotlib", "imageio", "PIL")

RunCommand = Callable[..., click.testing.Result]
"""The arguments of `tune-jobs` -> what came of it."""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunCommand:
    """Run a command in an empty folder; whatever goes wrong has to be a message, not an exception."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUNE_JOBS_STORAGE", raising=False)

    def invoke(*arguments: object) -> click.testing.Result:
        result = click.testing.CliRunner().invoke(cli, [str(argument) for argument in arguments], prog_name="tune-jobs")
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        assert "Traceback" not in result.output
        return result

    return invoke


# -- a stand-in for tune_jobs.sweeps.verbs, whose trials take minutes


@dataclasses.dataclass(frozen=True)
class Result:
    place: str = dataclasses.field(metadata={"json": "folder"})
    sweep: SweepRecord
    trials: list[TrialRecord]
    best: BestRecord | None
    why_no_best: str | None
    artifacts: dict[str, Path]
    interrupted: bool = False
    notes: tuple[str, ...] = ("no video: it can't be drawn",)
    exit_code: int = 0


SWEEP = SweepRecord(
    name="mine",
    state="completed",
    spec={},
    evaluation_seeds=(1,),
    confirmation_seeds=(9,),
    num_trials=2,
    created_at=0.0,
    run_time_s=200.0,
)
CHECKPOINT = CheckpointRecord(
    trial_id="t0001",
    iteration=30,
    num_env_steps=30_720,
    evaluation_return=200.0,
)
TRIALS = [
    TrialRecord(
        trial_id="t0000",
        index=0,
        point_index=0,
        seed=1,
        point={"lr": 0.1, "hidden_sizes": [64, 32]},
        status="failed",
        error="ValueError: [bold]step[/bold] broke\n  more",
        num_env_steps=5,
    ),
    TrialRecord(
        trial_id="t0001",
        index=1,
        point_index=1,
        seed=2,
        point={"lr": 3e-5, "hidden_sizes": [64]},
        status="completed",
        stop_reason="training_return",
        training_return=float("nan"),
        best_evaluation_return=200.0,
        time_s=61.0,
        checkpoints=(CHECKPOINT,),
    ),
]


def evaluation(policy: str, *returns: float, threshold: float | None = 195.0) -> EvaluationRecord:
    return EvaluationRecord(
        policy=policy,
        env_id="CartPole-v0",
        seeds=tuple(range(5, 5 + len(returns))),
        returns=returns,
        lengths=(1,) * len(returns),
        threshold=threshold,
    )


BEST = BestRecord(
    checkpoint=CHECKPOINT,
    point={"lr": 3e-5},
    seed=2,
    selection_score=200.0,
    confirmation=evaluation("best", 190.0, 200.0),
    random=evaluation("random", 20.0, 22.0),
)


class FakeSweeps(types.ModuleType):
    """In the place of `tune_jobs.sweeps.verbs`."""

    calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]]
    answers: dict[str, Any]


@pytest.fixture
def sweeps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeSweeps:
    """Calls are kept in `.calls`; what they return or raise can be replaced in `.answers`."""
    fake = FakeSweeps("tune_jobs.sweeps.verbs")
    folder = tmp_path / "sweeps" / "mine"
    result = Result(str(folder), SWEEP, TRIALS, BEST, None, {"report": folder / "report" / "index.html"}, exit_code=3)
    status = SweepStatus(SWEEP, {"completed": 1, "failed": 1, "running": 0}, alive=False)
    fake.calls = []
    fake.answers = {
        "launch": result,
        "resume": result,
        "extend": result,
        "inject": result,
        "replicate": result,
        "stop": True,
        "status": status,
        "list_sweeps": [status],
        "trials": TRIALS,
        "best": BEST,
        "evaluate": (evaluation("x", 195.0), evaluation("random", 20.0)),
        "video": {"mp4": Path("a.mp4")},
        "report": Path("index.html"),
        "compare": COMPARISON,
        "export": {"trials": Path("mine-csv/trials.csv"), "settings": Path("mine-csv/settings.csv")},
        "importance": IMPORTANCE,
        "reproduce": EQUAL,
    }

    def make(name: str) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            fake.calls.append((name, args, kwargs))
            print("a library's chatter")
            answer = fake.answers[name]
            if isinstance(answer, BaseException):
                raise answer
            return answer

        return call

    for name in fake.answers:
        setattr(fake, name, make(name))
    monkeypatch.setitem(sys.modules, "tune_jobs.sweeps.verbs", fake)
    import tune_jobs.sweeps

    monkeypatch.setattr(tune_jobs.sweeps, "verbs", fake, raising=False)
    return fake
