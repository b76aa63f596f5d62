"""Environments of a user's own and the wrappers around them, in real trials and in Ray's processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from trials import make_task, run_trial

from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.envs import modules as env_modules
from policies.errors import EnvError
from policies.portable.file import read_policy
from policies.replay import Transitions
from tests.narrowing import present
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.outcome import SweepResult

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

OWN = "tune_jobs_test_own"
EDGE = f"{OWN}:Edge"
FAST = {"hidden_sizes": [8], "num_envs": 4, "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2}
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())


@pytest.fixture
def engine() -> Iterator[RLlibEngine]:
    from tune_jobs.training.rllib import RLlibEngine

    engine = RLlibEngine()
    yield engine
    engine.close()


def learnt_rewards(engine: RLlibEngine) -> list[float]:
    """Every reward of the batches that the learner gets from now on."""
    learner = engine.algorithm.learner_group._learner
    seen = []
    if hasattr(learner, "update_from_transitions"):
        update = learner.update_from_transitions

        def spied(batch: Transitions, optimizer: Any) -> Any:
            seen.extend(np.asarray(batch.rewards).ravel().tolist())
            return update(batch, optimizer)

        learner.update_from_transitions = spied
    else:
        loss = learner.compute_loss_for_module

        def spied_loss(**kwargs: Any) -> Any:
            seen.extend(kwargs["batch"]["rewards"].ravel().tolist())
            return loss(**kwargs)

        learner.compute_loss_for_module = spied_loss
    return seen


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
@pytest.mark.parametrize("penalty", [None, -100.0])
def test_a_failure_penalty_reaches_the_learner_and_no_return(
    engine: RLlibEngine, tmp_path: Path, algorithm: str, penalty: float | None
) -> None:
    task = make_task(tmp_path, algorithm, failure_penalty=penalty)
    engine.build(task, None)
    learnt = learnt_rewards(engine)
    episodes: list[tuple[float, int]] = []
    while len(episodes) < 4:  # more than a fragment each: their returns go over fragments' ends
        episodes += engine.train_iteration().episodes
    # Rows of 0 are RLlib's own, for the value after a chunk's last step, and masked in the loss.
    assert set(learnt) - {0.0} == ({1.0} if penalty is None else {1.0, penalty})
    # CartPole's own reward is 1 a step, so the two are equal.
    assert all(episode_return == length for episode_return, length in episodes)


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_no_reported_return_holds_the_penalty(engine: RLlibEngine, tmp_path: Path, algorithm: str) -> None:
    task = make_task(tmp_path, algorithm, failure_penalty=-100.0)
    progress = run_trial(task, engine)
    assert present(progress.training_return) > 0
    assert present(progress.evaluation_return) > 0
    saved = read_policy(tmp_path / progress.checkpoints[-1].path)
    assert saved.env_args == {}
    assert min(evaluate_policy(load_policy(tmp_path / progress.checkpoints[-1].path), seeds=[5, 6],
                               env_id="CartPole-v1").returns) > 0  # fmt: skip


def test_a_restored_trial_goes_on_with_its_penalty(engine: RLlibEngine, tmp_path: Path) -> None:
    task = make_task(tmp_path, "ppo", failure_penalty=-100.0)
    progress = run_trial(task, engine)
    engine.build(task, tmp_path / progress.checkpoints[-1].path)
    learnt = learnt_rewards(engine)
    engine.train_iteration()
    assert -100.0 in learnt


def test_pixels_and_frames_train_and_travel_with_the_policy(engine: RLlibEngine, tmp_path: Path) -> None:
    env_args = {"pixels": True, "frame_stack": 2}
    task = make_task(
        tmp_path, "ppo", env_args=env_args, conv_filters=((4, 8, 4), (8, 4, 2)), failure_penalty=-1.0, num_envs=2
    )
    progress = run_trial(task, engine)
    assert progress.num_env_steps >= 256
    policy = load_policy(tmp_path / progress.checkpoints[-1].path)
    assert policy.env_args == env_args
    assert policy.observation_space.shape == (40, 60, 2)
    returns = evaluate_policy(policy, env_id="CartPole-v1", env_args=policy.env_args, seeds=[1, 2]).returns
    assert np.mean(returns) == progress.evaluation_return


def launch(tmp_path: Path, spec: dict[str, Any], **kwargs: Any) -> SweepResult:
    spec = {
        "algorithm": "ppo",
        "hyperparams": {**FAST, "lr": 0.01},
        "stop": {"num_env_steps": 1000},
        "evaluation": {"every_iterations": 4, "num_episodes": 3},
    } | spec
    return sweeps.launch(spec, storage=tmp_path, progress="none", name="own", **kwargs)


def test_an_own_env_class_trains_in_rays_processes_and_is_evaluated_without_penalty(tmp_path: Path) -> None:
    from tune_jobs_test_own import Edge

    env = {"id": Edge, "args": {"limit": 9}, "frame_stack": 2, "failure_penalty": -50}
    result = launch(tmp_path, {"env": env, "num_samples": 2})
    assert [trial.status for trial in result.trials] == ["completed"] * 2, result.trials[0].error
    assert result.sweep.allowed_modules == (OWN,)
    assert json.loads((result.folder / "sweep.json").read_text())["spec"]["env"]["id"] == EDGE
    # From 1 (a fall at once) to 9: no penalty in what is reported.
    for trial in result.trials:
        lines = SweepStore(result.folder).trial(trial.trial_id).read_iterations()
        returns = [number for line in lines for number in line.episode_returns]
        assert returns
        assert all(1 <= number <= 9 for number in returns)
    assert all(1 <= number <= 9 for number in present(result.best).confirmation.returns)
    assert present(result.best).confirmation.env_args == {"limit": 9, "frame_stack": 2}
    assert {"policy", "after_mp4", "report"} <= set(result.artifacts), result.notes


def test_an_env_id_of_an_allowed_module_trains_in_env_runners_too_and_goes_on_without_being_allowed_again(
    tmp_path: Path,
) -> None:
    spec = {
        "env": f"{OWN}:TestEdge",
        "space": {"gamma": {"uniform": [0.9, 0.99]}},
        "resources": {"num_env_runners": 1},
    }
    with pytest.raises(EnvError, match="not allowed"):
        launch(tmp_path, spec)
    assert not (tmp_path / "own").exists()
    env_modules.allow_modules([OWN])
    result = launch(tmp_path, spec, finish=False)
    assert [trial.status for trial in result.trials] == ["completed"], result.trials[0].error
    # Another process knows only what sweep.json says.
    env_modules._allowed.clear()
    record, _ = sweeps.evaluate("own", storage=tmp_path, num_episodes=4)
    assert (record.env_id, record.threshold) == (f"{OWN}:TestEdge-v0", 11.5)
    env_modules._allowed.clear()
    assert {path.name for path in sweeps.video("own", storage=tmp_path).values()} >= {"after.mp4"}
    env_modules._allowed.clear()
    # A policy file may come from elsewhere, and allows nothing.
    with pytest.raises(EnvError, match="not allowed"):
        sweeps.evaluate(tmp_path / "own" / "best", num_episodes=1)
    assert sweeps.extend("own", 1, storage=tmp_path, finish=False).trials[1].status == "completed"


@pytest.mark.parametrize(("engine_name", "algorithm"), [("packed", "ppo"), ("rllib", "dqn")])
def test_what_a_process_can_hold_once_trains(tmp_path: Path, engine_name: str, algorithm: str) -> None:
    env_modules.allow_modules([OWN])
    fast = {"hidden_sizes": [8], "num_envs": 2, "lr": 0.01, "train_batch_size": 128}
    fast |= {"minibatch_size": 64} if algorithm == "ppo" else {}
    spec = {"engine": engine_name, "algorithm": algorithm, "hyperparams": fast, "num_samples": 2}
    is_packed = engine_name == "packed"
    result = launch(tmp_path, spec | {"env": {"id": f"{OWN}:OneEdge", "own_process": True}}, finish=is_packed)
    assert [trial.status for trial in result.trials] == ["completed"] * 2, result.trials[0].error
    if is_packed:
        assert present(result.best).confirmation.env_args == {"own_process": True}
        assert {"policy", "after_mp4", "report"} <= set(result.artifacts), result.notes


def test_the_command_line_finds_modules_in_the_folder_it_is_run_in(tmp_path: Path) -> None:
    """With a Ray of its own, whose workers get neither this process's path nor its modules."""
    source = Path(present(sys.modules[OWN].__file__) if OWN in sys.modules else ROOT / f"tests/ray/env_plugin/{OWN}.py")
    (tmp_path / "here_envs.py").write_text(source.read_text().replace("TestEdge-v0", "HereEdge-v0"))
    (tmp_path / "sweep.yaml").write_text(
        "env: here_envs:HereEdge-v0\nalgorithm: ppo\n"
        f"hyperparams: {json.dumps(FAST)}\nstop: {{num_env_steps: 200}}\nresources: {{num_env_runners: 1}}\n"
    )
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-P", "-m", "tune_jobs.cli.commands", "launch", "sweep.yaml", "--json", "--no-finish"]

    def run(*options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*command, *options], cwd=tmp_path, env=env | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
            check=False,
        )  # fmt: skip

    refused = run()
    assert refused.returncode == 2
    assert "--allow-module here_envs" in json.loads(refused.stdout)["hint"]
    done = run("--allow-module", "here_envs")
    assert done.returncode == 0, done.stdout + done.stderr


def test_own_modules_that_only_this_processs_path_has_are_found_by_the_ray_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tune_jobs.ray_tune import local_ray

    (tmp_path / "hidden_own.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "/before")
    env_modules.allow_modules(["hidden_own"])
    env_modules.import_module_allowed("hidden_own")
    with local_ray._finding_own_modules():
        assert os.environ["PYTHONPATH"].split(os.pathsep) == [str(tmp_path), "/before"]
    assert os.environ["PYTHONPATH"] == "/before"
