"""A sweep in every store of stores.py, for the tests of what all stores promise; and records to write into it."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stores import HARNESSES, Harness

from analysis.best_records import BestRecord, EvaluationRecord
from analysis.records import CheckpointRecord, IterationRecord, SweepRecord, TrialRecord
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.objects import asked, owners, trial_state

SWEEP, TRIAL, RESULTS = "sweep.json", "trials/t0000/trial.json", "trials/t0000/results.jsonl"
BEST, PACK = "best/evaluation.json", "packs/p00.json"
NO_IDS = ["", ".", "..", "../t0000", "t0000/", "/t0000", "t000", "T0000", "t00000000000", "t0000\n", "t0000\0", "*"]


# What fails in the calls of a file system; that of an object store is in test_objects_faults.
ON_DISK = pytest.mark.parametrize("harness", ["local"], indirect=True)

Reopen = Callable[[], Sweep]
"""Opens the sweep as another process does."""


@pytest.fixture(params=HARNESSES)
def harness(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Harness:
    # What the store says of an owner is believed for a second, which no test waits for.
    monkeypatch.setattr(owners, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(trial_state, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(asked, "_EVERY_S", 0.0)
    return HARNESSES[request.param](tmp_path)


@pytest.fixture
def sweep(harness: Harness) -> Sweep:
    made = harness.storage().sweep("mine")
    made.create()
    return made


@pytest.fixture
def trial(sweep: Sweep) -> Trial:
    return sweep.trial("t0000")


@pytest.fixture
def another(harness: Harness) -> Reopen:
    """The sweep as another process opens it."""
    return lambda: harness.storage().sweep("mine")


def make_sweep(**changes: Any) -> SweepRecord:
    values: dict[str, Any] = {
        "name": "mine", "state": "running", "spec": {"a": 1}, "evaluation_seeds": (1, 2), "num_trials": 2,
        "confirmation_seeds": (3,), "created_at": 5.0,
    }  # fmt: skip
    return SweepRecord(**values | changes)


def make_trial(index: int = 0, **changes: Any) -> TrialRecord:
    values: dict[str, Any] = {
        "trial_id": f"t{index:04d}",
        "index": index,
        "point_index": index,
        "seed": index,
        "point": {"lr": 0.1},
    }
    return TrialRecord(**values | changes)


def make_iteration(number: int, **changes: Any) -> IterationRecord:
    return IterationRecord(iteration=number, num_env_steps=100 * number, num_episodes=number, time_s=number, **changes)


def make_checkpoint(iteration: int, **changes: Any) -> CheckpointRecord:
    values: dict[str, Any] = {"trial_id": "t0000", "iteration": iteration, "num_env_steps": 100 * iteration}
    return CheckpointRecord(**values | changes)


def make_best(**changes: Any) -> BestRecord:
    evaluation = EvaluationRecord(policy="p", env_id="E-v0", seeds=(1,), returns=(0.0,), lengths=(3,))
    values: dict[str, Any] = {"checkpoint": make_checkpoint(1), "point": {}, "seed": 0, "selection_score": -1.0,
              "confirmation": evaluation, "random": evaluation}  # fmt: skip
    return BestRecord(**values | changes)


def fill(folder: Path, content: str = "abc") -> None:
    """What an engine and the trial write into a checkpoint."""
    (folder / "policy.json").write_text("{}")
    (folder / "policy.safetensors").write_text("")
    (folder / "state").mkdir()
    (folder / "state" / "weights").write_text(content)


def killed(act: Callable[[Callable[..., None]], object]) -> None:
    """Do something in a process that is killed within it: `act` is given what to call there."""
    child = os.fork()
    if not child:
        try:
            act(lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        finally:
            os._exit(0)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])


def numbers(another: Reopen) -> list[int]:
    return another().trial("t0000").checkpoint_iterations()
