"""Sweeps of baselines, from their one trial to the page, and baselines that are called by name."""

import subprocess
import sys
from pathlib import Path

import pytest
from test_baselines import make_task, run_trial

from policies.acting.baselines import ConstantPolicy
from policies.acting.load import load_policy
from policies.errors import CheckpointError
from policies.hyperparams import Algorithm
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.sweeps.drive import write_new


def finished_sweep(tmp_path: Path, algorithm: Algorithm, **hyperparams: int) -> SweepStore:
    """A sweep of one trial, run without Ray Tune."""
    spec = load_spec(
        {
            "env": "CartPole-v1",
            "algorithm": algorithm,
            "hyperparams": {"env_steps_per_iteration": 100, **hyperparams},
            "stop": {"num_env_steps": 1000},
            "evaluation": {"num_episodes": 5},
        }
    )
    store = SweepStore(tmp_path / "mine")
    store.create()
    plan = make_plan(spec, Machine(1))
    write_new(store, spec, plan, None)
    task = make_task(
        store.folder, algorithm, hyperparams=plan.trials[0].hyperparams, stop=spec.stop, checkpoints=spec.checkpoints
    )
    run_trial(task)
    trial = store.trial("t0000")
    record = trial.read_record()
    trial.write_record(
        record.model_copy(
            update={"status": "completed", "checkpoints": tuple(trial.checkpoints()), "num_iterations": 10}
        )
    )
    return store


def test_the_best_of_a_baselines_sweep_is_confirmed_filmed_and_reported(tmp_path: Path) -> None:
    store = finished_sweep(tmp_path, "constant", action=1)
    best = finish.choose_best(store)
    assert 8 <= best.confirmation.mean_return <= 11 < best.random.mean_return
    policy = load_policy(store.best_folder)
    assert isinstance(policy, ConstantPolicy)
    assert policy.description == "constant action 1"
    videos = finish.make_videos(store)
    assert all(path.stat().st_size > 1000 for path in videos.values())
    page = finish.make_report(store).read_text()
    assert "After training" not in page
    assert "A constant action on CartPole-v1" in page


def test_random_play_scores_as_the_random_policy_does(tmp_path: Path) -> None:
    best = finish.choose_best(finished_sweep(tmp_path, "random"))
    assert best.confirmation.returns == best.random.returns


def test_a_baseline_is_not_restored_to_rllib(tmp_path: Path) -> None:
    finished_sweep(tmp_path, "random")
    with pytest.raises(CheckpointError, match="is of the baseline random") as caught:
        sweeps.restore("mine/t0000", storage=tmp_path)
    assert "load_policy" in caught.value.hint


def test_baselines_are_evaluated_and_filmed_by_name(tmp_path: Path) -> None:
    record, random = sweeps.evaluate("constant", env_id="CartPole-v1", num_episodes=5)
    assert record.policy == "constant action 0"
    assert 8 <= record.mean_return <= 11
    assert random.policy == "random policy"
    assert sweeps.evaluate("constant", env_id="Pendulum-v1", num_episodes=1, action=[2])[0].policy == (
        "constant action [2.0]"
    )
    paths = sweeps.video("constant", env_id="CartPole-v1", action=1, output=tmp_path / "left.mp4")
    assert paths["mp4"].stat().st_size > 1000


def test_playing_a_baseline_needs_neither_ray_nor_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "import tune_jobs.training.baseline, tune_jobs.training.trial_loop, policies.acting.baselines\n"
        "from policies.acting.policy import RandomPolicy\n"
        "RandomPolicy.for_env('CartPole-v1').act([0, 0, 0, 0])\n"
        "assert not {'ray', 'torch'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)
