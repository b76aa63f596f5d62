"""Trials run again in Ray's processes: on the machine on which they ran, they come to the same, to the bit."""

from pathlib import Path
from typing import Any

import pytest

import tune_jobs
from tests.narrowing import present

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

SPEC: dict[str, Any] = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "space": {"lr": {"loguniform": [1e-3, 1e-2]}, "hidden_sizes": {"grid": [[8], [16]]}},
    "hyperparams": {"num_envs": 4, "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2},
    "num_samples": 1,
    "stop": {"num_env_steps": 640},
    "evaluation": {"every_iterations": 2, "num_episodes": 3},
    "resources": {"max_concurrent": 2},
}


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_a_trial_comes_to_the_same_by_itself(tmp_path: Path, engine: str) -> None:
    tune_jobs.launch({**SPEC, "engine": engine}, name="mine", storage=tmp_path, finish=False, progress="none")
    trials = tune_jobs.trials("mine", storage=tmp_path)
    assert {trial.status for trial in trials} == {"completed"}
    assert all("cpu" in trial.ran_with and "numpy" in trial.ran_with for trial in trials)
    before = {path: path.read_bytes() for path in (tmp_path / "mine").rglob("*") if path.is_file()}
    found = tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=tmp_path / "again", progress="none")
    assert found.equal, found.lines()
    assert (found.num_iterations, found.num_compared, found.causes) == (5, 5, ())
    assert found.num_equal_weights >= 1
    assert {path: path.read_bytes() for path in (tmp_path / "mine").rglob("*") if path.is_file()} == before
    (again,) = tune_jobs.trials(present(found.folder))
    assert (again.engine, again.seed, again.hyperparams) == (engine, trials[1].seed, trials[1].hyperparams)
