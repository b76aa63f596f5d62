"""A sweep in every store of stores.py, for the tests of what all stores promise; and records to write into it."""

import os
import signal

import pytest
from stores import HARNESSES

from analysis.records import (
    BestRecord,
    CheckpointRecord,
    EvaluationRecord,
    IterationRecord,
    SweepRecord,
    TrialRecord,
)

SWEEP, TRIAL, RESULTS = "sweep.json", "trials/t0000/trial.json", "trials/t0000/results.jsonl"
BEST, PACK = "best/evaluation.json", "packs/p00.json"
NO_IDS = ["", ".", "..", "../t0000", "t0000/", "/t0000", "t000", "T0000", "t00000000000", "t0000\n", "t0000\0", "*"]


@pytest.fixture(params=HARNESSES)
def harness(request, tmp_path):
    return HARNESSES[request.param](tmp_path)


@pytest.fixture
def sweep(harness):
    made = harness.storage().sweep("mine")
    made.create()
    return made


@pytest.fixture
def trial(sweep):
    return sweep.trial("t0000")


@pytest.fixture
def another(harness):
    """The sweep as another process opens it."""
    return lambda: harness.storage().sweep("mine")


def make_sweep(**changes):
    values = {"name": "mine", "state": "running", "spec": {"a": 1}, "evaluation_seeds": (1, 2), "num_trials": 2,
              "confirmation_seeds": (3,), "created_at": 5.0}  # fmt: skip
    return SweepRecord(**values | changes)


def make_trial(index=0, **changes):
    values = {"trial_id": f"t{index:04d}", "index": index, "point_index": index, "seed": index, "point": {"lr": 0.1}}
    return TrialRecord(**values | changes)


def make_iteration(number, **changes):
    return IterationRecord(iteration=number, num_env_steps=100 * number, num_episodes=number, time_s=number, **changes)


def make_checkpoint(iteration, **changes):
    values = {"trial_id": "t0000", "iteration": iteration, "num_env_steps": 100 * iteration}
    return CheckpointRecord(**values | changes)


def make_best(**changes):
    evaluation = EvaluationRecord(policy="p", env_id="E-v0", seeds=(1,), returns=(0.0,), lengths=(3,))
    values = {"checkpoint": make_checkpoint(1), "point": {}, "seed": 0, "selection_score": -1.0,
              "confirmation": evaluation, "random": evaluation}  # fmt: skip
    return BestRecord(**values | changes)


def fill(folder, content="abc"):
    """What an engine and the trial write into a checkpoint."""
    (folder / "policy.json").write_text("{}")
    (folder / "policy.safetensors").write_text("")
    (folder / "state").mkdir()
    (folder / "state" / "weights").write_text(content)


def killed(act):
    """Do something in a process that is killed within it: `act` is given what to call there."""
    child = os.fork()
    if not child:
        try:
            act(lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        finally:
            os._exit(0)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])


def numbers(another):
    return another().trial("t0000").checkpoint_iterations()
