"""The length of training as a searched value, in whole sweeps: each trial ends at its own, on both engines."""

from pathlib import Path

import pytest
from test_search import SLOW
from test_sweeps import FAST

from analysis.records import TRAINING_LENGTH
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_each_trial_ends_at_its_own_length(tmp_path: Path, engine: str) -> None:
    spec = {
        "env": {**SLOW, "args": {}}, "algorithm": "ppo", "hyperparams": FAST, "engine": engine, "confirm": "none",
        "space": {TRAINING_LENGTH: {"grid": [128, 384, 640]}}, "objective": ["return", "env_steps"],
        "evaluation": {"every_iterations": 2, "num_episodes": 2}, "checkpoints": {"keep": 0},
    }  # fmt: skip
    result = sweeps.launch(spec, storage=tmp_path, name="mine", progress="none", finish=False)
    assert [trial.num_env_steps for trial in result.trials] == [128, 384, 640]
    assert [trial.engine for trial in result.trials] == [engine] * 3
    assert result.trials[0].stop_reason == "num_env_steps 128 >= 128"
    for trial in SweepStore(tmp_path / "mine").read_trials():
        assert trial.num_env_steps == trial.point[TRAINING_LENGTH]
        assert TRAINING_LENGTH not in trial.hyperparams
