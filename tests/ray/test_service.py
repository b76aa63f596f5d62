"""A real service with a real sweep: submitted, stopped, resumed and extended over HTTP, drained and begun again."""

import urllib.error
from pathlib import Path

import pytest
from served import Served

from tune_jobs.store.sweep_store import SweepStore

pytestmark = pytest.mark.ray
SPEC = {
    "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-3, 1e-2]}}, "num_samples": 2,
    "hyperparams": {"train_batch_size": 256, "num_envs": 2}, "confirm": "none",
    "evaluation": {"every_iterations": 50, "num_episodes": 2}, "checkpoints": {"every_iterations": 20},
    # Each has about a minute to be stopped in.
    "stop": {"num_env_steps": 200_000, "evaluation_return": 1_000},
}  # fmt: skip


@pytest.fixture
def storage(tmp_path: Path) -> Path:
    return tmp_path / "sweeps"


def test_a_sweep_from_its_submission_to_its_report(storage: Path) -> None:
    server = Served(storage, "--spare-idle", "0")
    try:
        server.ask("POST", "sweeps", {"spec": SPEC, "name": "mine"})
        server.wait(lambda: server.steps("mine") > 0, "nothing was trained")
        server.ask("POST", "sweeps/mine/stop")
        assert server.wait_for_job()["outcome"] == "stopped"
        stopped = server.ask("GET", "sweeps/mine")
        assert stopped["state"] == "interrupted"
        before = stopped["num_env_steps"]
        assert 0 < before < 400_000
        # It goes on where it was; and when the service ends, too.
        server.ask("POST", "sweeps/mine/resume")
        server.wait(lambda: server.steps("mine") > before, "it does not go on")
        assert server.end() == 0
        saved = SweepStore(storage / "mine").read_record()
        assert saved.state == "interrupted"
        reached = sum(trial.num_env_steps for trial in SweepStore(storage / "mine").read_trials())
        server = Served(storage, "--spare-idle", "0")
        server.wait(lambda: server.steps("mine") > reached, "it is forgotten")
        # The time is short here: the rest is done with less.
        assert server.ask("GET", "jobs")[-1]["state"] == "running"
        server.ask("POST", "sweeps/mine/stop")
        assert server.wait_for_job()["outcome"] == "stopped"
        short = SPEC | {"stop": {"num_env_steps": 2_560}}
        server.ask("POST", "sweeps", {"spec": short, "name": "short"})
        server.ask("POST", "sweeps/short/extend", {"num_samples": 1})
        assert server.wait_for_job()["outcome"] == "completed"
        found = server.ask("GET", "sweeps/short")
        assert (found["state"], found["num_trials"], found["counts"]) == ("completed", 3, {"completed": 3})
        assert (storage / "short" / "report" / "index.html").exists()
        with pytest.raises(urllib.error.HTTPError, match="409"):
            server.ask("POST", "sweeps/short/stop")
        assert server.end() == 0
    finally:
        server.end()
