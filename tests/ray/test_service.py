"""A real service with a real sweep: over HTTP and by commands, stopped, resumed, extended, drained and begun again."""

import json
import urllib.error
from pathlib import Path

import pytest
import yaml
from fake_sweeps import RunCommand, run  # noqa: F401 (a fixture)
from served import Served

from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments

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


def test_a_sweep_from_its_submission_to_its_report(
    storage: Path, tmp_path: Path, run: RunCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("TUNE_JOBS_SERVER", "TUNE_JOBS_TOKEN", "TUNE_JOBS_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
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
        (tmp_path / "short.yaml").write_text(yaml.safe_dump(SPEC | {"stop": {"num_env_steps": 2_560}}))
        command = ("--server", server.url)
        followed = run(*command, "launch", "short.yaml", "--json")
        assert followed.exit_code == 0, followed.output
        assert followed.stderr.splitlines()[0] == "short: waits for its turn"
        assert "100 %" in followed.stderr.splitlines()[-1]
        launched = json.loads(followed.stdout)
        assert [trial["status"] for trial in launched["trials"]] == ["completed"] * 2
        best = json.loads(run(*command, "best", "short", "--json").stdout)
        assert best == launched["best"]
        assert best["checkpoint"]["trial_id"] in {trial["trial_id"] for trial in launched["trials"]}
        assert "report" in json.loads(run(*command, "report", "short", "--json").stdout)
        page = (storage / "short" / "report" / "index.html").read_bytes()
        assert (tmp_path / "short-report.html").read_bytes() == page
        for words in (("importance", "short"), ("compare", "short"), ("trials", "short"), ("compare", "short", "mine")):
            assert run(*command, *words).output == run(*words, "--storage", storage).output
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
