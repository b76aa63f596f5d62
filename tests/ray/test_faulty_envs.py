"""Sweeps in which environments give NaN or end the process: those trials fail, all else goes on and can be read."""

from pathlib import Path

import pandas as pd
import pytest

from tests.narrowing import present
from tune_jobs.spec.seeds import trial_seeds
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

NUM_ENVS = 4
FAULTS = {
    1: ("nan", "The reward of env step 6 of an episode of TestTrouble-v0 was NaN."),
    2: ("inf", "The reward of env step 6 of an episode of TestTrouble-v0 was infinite."),
    3: ("-inf", "The reward of env step 6 of an episode of TestTrouble-v0 was minus infinity."),
    4: ("SystemExit", "TestTrouble-v0 raised an error in step(): SystemExit: the cart has had enough ("),
}


@pytest.mark.parametrize("engine", ["packed", "rllib"])
def test_faulty_trials_fail_alone_and_the_sweep_is_read_retried_and_resumed(tmp_path: Path, engine: str) -> None:
    seeds = trial_seeds(0, 5)
    # In the second iteration of 32 vector steps, in the fourth episode.
    troubles = {str(seeds[index]): {"how": how, "at": 36} for index, (how, _) in FAULTS.items()}
    spec = {
        "env": {"id": "TestTrouble-v0", "args": {"troubles": troubles}},
        "algorithm": "ppo",
        "hyperparams": {
            "hidden_sizes": [8], "num_envs": NUM_ENVS, "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2,
        },
        "space": {"lr": {"loguniform": [1e-3, 1e-2]}},
        "num_samples": 5,
        "stop": {"num_env_steps": 640},
        "evaluation": {"every_iterations": 2, "num_episodes": 3},
        "max_retries": 0,
        "engine": engine,
    }  # fmt: skip
    result = sweeps.launch(spec, name="mine", storage=tmp_path, progress="none")
    assert [trial.status for trial in result.trials] == ["completed", *["failed"] * 4]
    assert [trial.num_failures for trial in result.trials] == [0, 1, 1, 1, 1]
    for index, (_, words) in FAULTS.items():
        trial = result.trials[index]
        assert present(trial.error).startswith(words)
        # One whole iteration and the steps before the fault.
        assert (trial.num_iterations, trial.num_env_steps) == (1, NUM_ENVS * 35)
        assert trial.num_episodes == NUM_ENVS * 3
    assert "report" in result.artifacts
    assert "was NaN" in result.artifacts["report"].read_text()
    frame = sweeps.dataframe("mine", storage=tmp_path)
    assert isinstance(frame, pd.DataFrame)
    assert list(frame["status"]) == [trial.status for trial in result.trials]
    assert present(result.best).checkpoint.trial_id == "t0000"
    assert sweeps.trials("mine", storage=tmp_path) == result.trials

    resumed = sweeps.resume("mine", storage=tmp_path, progress="none", finish=False)
    assert [trial.status for trial in resumed.trials] == [trial.status for trial in result.trials]
    # Mended.
    store = SweepStore(result.folder)
    record = store.read_record()
    record.spec["env"]["args"] = {}
    store.write_record(record)
    retried = sweeps.resume("mine", storage=tmp_path, progress="none", finish=False, retry_failed=True)
    assert [(trial.status, trial.error) for trial in retried.trials] == [("completed", None)] * 5
    assert not list(store.folder.glob("trials/*/.tally"))
