"""The RLlib engine: the same trial is the same again in a warm process, and a restored one goes on."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rllib_engines import engine
from trials import TRIAL_SEED, make_task, run_trial

from analysis.records import ChangeRecord
from policies.errors import CannotRunError, CheckpointError, NonFiniteWeightsError, NotFoundError
from policies.packed.member import Weights
from tune_jobs.spec.sections import StopSpec
from tune_jobs.training.protocol import IterationStats, TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["engine"]

COPIED = ChangeRecord(
    iteration=1, num_env_steps=100, source_trial_id="t0000", source_iteration=1, before={}, after={}, time=0.0
)


def weights_after(
    engine: RLlibEngine, task: TrialTask, num_iterations: int = 2
) -> tuple[Weights, list[IterationStats]]:
    """The learner's weights of a fresh trial, and what its iterations gave."""
    from policies.rllib.restore import learner_weights

    engine.build(task, None)
    stats = [engine.train_iteration() for _ in range(num_iterations)]
    return learner_weights(engine.algorithm), stats


def same(ours: Mapping[str, NDArray[Any]], theirs: Mapping[str, NDArray[Any]]) -> bool:
    assert set(ours) == set(theirs)
    return all(np.array_equal(ours[name], theirs[name]) for name in ours)


def save(engine: RLlibEngine, folder: Path) -> Path:
    """A checkpoint as a trial saves it, but without a manifest."""
    from policies.portable.file import save_policy

    folder.mkdir(parents=True)
    engine.save(folder)
    save_policy(engine.policy(), folder)
    return folder


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_trial_is_the_same_again_in_a_warm_process(engine: RLlibEngine, tmp_path: Path, algorithm: str) -> None:
    """However many other numbers the process has drawn, and whatever it trained in between."""
    task = make_task(tmp_path, algorithm)
    first, first_stats = weights_after(engine, task)
    weights_after(engine, make_task(tmp_path, "ppo", seed=3 * TRIAL_SEED, env_id="Pendulum-v1"), 1)
    np.random.rand(7)  # noqa: NPY002 (RLlib draws from the global generator)
    again, again_stats = weights_after(engine, task)
    assert same(first, again)
    assert first_stats == again_stats


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_trials_of_other_seeds_are_other_trials(engine: RLlibEngine, tmp_path: Path, algorithm: str) -> None:
    first, first_stats = weights_after(engine, make_task(tmp_path, algorithm))
    other, other_stats = weights_after(engine, make_task(tmp_path, algorithm, seed=TRIAL_SEED + 1024))
    drawn = [name for name in first if not name.endswith("_const")]
    assert not any(np.array_equal(first[name], other[name]) for name in drawn)
    assert first_stats[0].episodes != other_stats[0].episodes


def test_iterations_tell_whole_episodes_and_all_env_steps(engine: RLlibEngine, tmp_path: Path) -> None:
    _, stats = weights_after(engine, make_task(tmp_path, grad_clip=5.0), 6)
    steps = [item.num_env_steps for item in stats]
    assert all(128 <= after - before < 128 + 4 for before, after in zip([0, *steps], steps, strict=False))
    episodes = [episode for item in stats for episode in item.episodes]
    # CartPole gives 1 a step, so the return of a whole episode is its length; those running are not counted.
    assert all(episode_return == length for episode_return, length in episodes)
    running = steps[-1] - sum(length for _, length in episodes)
    assert 0 <= running < 4 * 500
    # Of 768 steps of four beginners, nearly all belong to episodes that have ended; chunks would be as many, shorter.
    assert running < 300
    assert max(length for _, length in episodes) > 32
    learner = stats[-1].learner
    assert {"total_loss", "policy_loss", "vf_loss", "entropy", "lr", "gradient_norm"} <= set(learner)
    assert learner["lr"] == pytest.approx(3e-4)
    assert 0 < learner["entropy"] <= np.log(2) + 1e-6


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_restored_trial_goes_on(engine: RLlibEngine, tmp_path: Path, algorithm: str) -> None:
    from policies.rllib.restore import learner_weights
    from tune_jobs.training.rllib import RLlibEngine

    task = make_task(tmp_path, algorithm)
    weights, stats = weights_after(engine, task, 3)
    folder = save(engine, tmp_path / "000003")
    after = RLlibEngine()
    after.build(task, folder)
    assert same(learner_weights(after.algorithm), weights)
    runner_weights = after.algorithm.env_runner.module.get_state()
    assert same(runner_weights, {name: weights[name] for name in runner_weights})
    assert after.algorithm.iteration == 3
    before, now = stats[-1].num_env_steps, after.train_iteration().num_env_steps
    # On from there; of DQN's the first 30 fill its replay buffer again.
    iteration = {"ppo": 128, "dqn": 60}[algorithm]
    assert iteration <= now - before < iteration + 4
    assert not same(learner_weights(after.algorithm), weights)
    assert after.policy().training["iteration"] == 4
    after.close()


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_two_restores_of_a_checkpoint_are_the_same(engine: RLlibEngine, tmp_path: Path, algorithm: str) -> None:
    """A trial that is retried from a checkpoint goes the same way again; and other ways from other checkpoints."""
    from policies.rllib.restore import learner_weights

    task = make_task(tmp_path, algorithm)
    weights_after(engine, task, 1)
    folders = [save(engine, tmp_path / name / "000001") for name in ("a", "b")]
    folders.append(save(engine, tmp_path / "000002"))
    results = []
    for folder in folders:
        engine.build(task, folder)
        stats = engine.train_iteration()
        results.append((learner_weights(engine.algorithm), stats.episodes))
    assert same(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]
    assert results[0][1] != results[2][1]


def test_a_restored_trial_does_not_see_its_first_episodes_again(engine: RLlibEngine, tmp_path: Path) -> None:
    task = make_task(tmp_path)
    engine.build(task, None)
    drawn = [torch.rand(3)]
    folder = save(engine, tmp_path / "000001")
    fresh = engine.algorithm.env_runner.sample(num_timesteps=40)
    engine.build(task, folder)
    drawn.append(torch.rand(3))
    restored = engine.algorithm.env_runner.sample(num_timesteps=40)
    # Nor does it explore by the same numbers.
    assert not torch.equal(*drawn)
    first = [{tuple(chunk.get_observations(0)) for chunk in chunks} for chunks in (fresh, restored)]
    assert len(first[0]) >= 4
    assert first[0].isdisjoint(first[1])


@pytest.mark.parametrize("num_env_runners", [0, 1], ids=["itself", "an env runner"])
def test_dqn_fills_its_replay_buffer_again(engine: RLlibEngine, tmp_path: Path, num_env_runners: int) -> None:
    """It is not in checkpoints; training on a handful of transitions would undo what was learned."""
    task = make_task(tmp_path, "dqn", learning_starts=50, num_env_runners=num_env_runners)
    weights_after(engine, task, 2)
    before = engine.algorithm
    assert len(before.replay) == before.num_env_steps == 120
    counts = before.num_updates, before.num_episodes, before.learner.target_updates_at
    folder = save(engine, tmp_path / "000002")
    engine.build(task, folder)
    after = engine.algorithm
    # Not while it is built: iterations fill it, each with its limit of time.
    assert (len(after.replay), after.num_env_steps) == (0, 120)
    assert (after.num_updates, after.num_episodes, after.learner.target_updates_at) == counts
    assert after.num_updates == 71
    # What is sampled for it counts: an env step is an env step.
    goes_on = [(engine.train_iteration(), after.num_updates, len(after.replay)) for _ in range(2)]
    assert [stats.num_env_steps for stats, *_ in goes_on] == [180, 240]
    # It learns on at 170 env steps, 50 later, as many as at the start.
    assert [(updates, size) for _, updates, size in goes_on] == [(71 + 11, 60), (71 + 11 + 60, 120)]
    assert all("total_loss" in stats.learner for stats, *_ in goes_on)


def test_dqn_with_env_runners_sends_them_its_weights(engine: RLlibEngine, tmp_path: Path) -> None:
    engine.build(make_task(tmp_path, "dqn", num_env_runners=1), None)
    engine.train_iteration()
    engine.train_iteration()
    algorithm = engine.algorithm
    (theirs,) = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: runner.module.get_state(), local_env_runner=False
    )
    ours = algorithm.learner_group.get_weights()["default_policy"]
    assert same(theirs, {name: ours[name] for name in theirs})


@pytest.mark.parametrize("changes", [{}, {"lr": 0.002, "changes": (COPIED,)}], ids=["resumed", "copied"])
def test_env_runners_get_the_weights_of_a_restore_though_those_before_have_not_arrived(
    engine: RLlibEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    """They would sample with an untrained policy. A trial of a population copies another one's."""
    from ray import cloudpickle

    from policies.rllib.config import build_algorithm_config
    from tune_jobs.training import rllib
    from tune_jobs.training.env_runner import EnvRunner

    class Slow(EnvRunner):
        def set_state(self, state: Any) -> None:
            time.sleep(1.5)
            super().set_state(state)

    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    monkeypatch.setattr(rllib, "EnvRunner", Slow)
    build = build_algorithm_config

    def with_a_limit(*args: Any, **kwargs: Any) -> Any:
        return build(*args, **kwargs).env_runners(sample_timeout_s=60.0)

    # As checkpoints are that were written before; of itself, a config has none.
    monkeypatch.setattr(rllib, "build_algorithm_config", with_a_limit)
    engine.build(make_task(tmp_path, "ppo", num_env_runners=1), None)
    engine.train_iteration()
    folder = save(engine, tmp_path / "000001")
    monkeypatch.setattr(rllib, "build_algorithm_config", build)
    engine.build(make_task(tmp_path, "ppo", num_env_runners=1, **changes), folder)
    algorithm = engine.algorithm
    assert algorithm.config.sample_timeout_s is None
    (theirs,) = algorithm.env_runner_group.foreach_env_runner(
        lambda runner: runner.module.get_state(), local_env_runner=False
    )
    ours = algorithm.learner_group.get_weights()["default_policy"]
    assert same(theirs, {name: ours[name] for name in theirs})


def test_a_damaged_checkpoint_is_never_a_fresh_start(engine: RLlibEngine, tmp_path: Path) -> None:
    task = make_task(tmp_path)
    weights_after(engine, task, 1)
    folder = save(engine, tmp_path / "000001")
    (folder / "policy.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError):
        engine.build(task, folder)
    with pytest.raises(NotFoundError):
        engine.build(task, tmp_path / "000009")


def test_nothing_is_left_of_a_closed_trial(engine: RLlibEngine, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="build"):
        engine.algorithm  # noqa: B018
    engine.close()
    engine.build(make_task(tmp_path), None)
    engine.close()
    engine.close()
    with pytest.raises(RuntimeError, match="build"):
        engine.train_iteration()


def test_the_policy_is_the_one_that_trains(engine: RLlibEngine, tmp_path: Path) -> None:
    from policies.rllib.restore import learner_weights

    task = make_task(tmp_path)
    weights_after(engine, task, 1)
    policy = engine.policy()
    weights = learner_weights(engine.algorithm)
    np.testing.assert_array_equal(policy.network.layers[0].weight, weights["encoder.actor_encoder.mlp.0.weight"])
    assert policy.training == {
        "trial_id": "t0000",
        "seed": TRIAL_SEED,
        "hyperparams": task.hyperparams,
        "iteration": 1,
    }
    engine.train_iteration()
    assert not np.array_equal(engine.policy().network.layers[0].weight, policy.network.layers[0].weight)


def test_a_trial_with_env_runners_of_its_own(engine: RLlibEngine, tmp_path: Path) -> None:
    """Their episodes are told too; and one that dies ends the trial, which RLlib would not."""
    task = make_task(tmp_path, num_env_runners=1)
    engine.build(task, None)
    stats = engine.train_iteration()
    assert 128 <= stats.num_env_steps < 136
    assert stats.episodes
    folder = save(engine, tmp_path / "000001")
    engine.build(task, folder)
    assert engine.train_iteration().num_env_steps > stats.num_env_steps
    import ray

    group = engine.algorithm.env_runner_group
    for actor in group._worker_manager.actors().values():
        ray.kill(actor)
    with pytest.raises((CannotRunError, ray.exceptions.RayError)):
        engine.train_iteration()


def test_a_whole_trial_with_this_engine(engine: RLlibEngine, tmp_path: Path) -> None:
    """The loop and the engine together; what the loop does is tested without Ray."""
    task = make_task(tmp_path, stop=StopSpec(num_env_steps=300))
    progress = run_trial(task, engine)
    assert (progress.status, progress.num_iterations) == ("completed", 3)
    assert progress.num_env_steps >= 300
    assert [record.iteration for record in progress.checkpoints] == [1, 2, 3]
    assert all(Path(tmp_path / record.path / "rllib").is_dir() for record in progress.checkpoints)
    assert progress.evaluation_return is not None


# -- training that went wrong


def test_gradients_that_are_not_finite_are_an_error_and_not_set_to_0(engine: RLlibEngine, tmp_path: Path) -> None:
    engine.build(make_task(tmp_path, lr=1e30), None)
    with pytest.raises(NonFiniteWeightsError, match="gradients of an update are NaN or infinite"):
        engine.train_iteration()


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_weights_that_are_not_finite_are_named_where_actions_are_drawn(
    engine: RLlibEngine, tmp_path: Path, env_id: str
) -> None:
    engine.build(make_task(tmp_path, env_id=env_id), None)
    module = engine.algorithm.env_runner.module
    with torch.no_grad():
        next(parameter for name, parameter in module.named_parameters() if name.startswith("pi.")).fill_(torch.nan)
    with pytest.raises(NonFiniteWeightsError, match=r"outputs are NaN or infinite: \d+ weights are too, first in pi"):
        engine.algorithm.env_runner.sample(num_timesteps=8, explore=True)


def test_an_update_by_weights_that_are_not_finite_names_them(engine: RLlibEngine, tmp_path: Path) -> None:
    engine.build(make_task(tmp_path), None)
    learner = engine.algorithm.learner_group._learner
    with torch.no_grad():
        for name, parameter in learner.module["default_policy"].unwrapped().named_parameters():
            if name.startswith("pi."):
                parameter.fill_(torch.nan)
    with pytest.raises(NonFiniteWeightsError, match=r"NaN or infinite: \d+ weights are too, first in pi"):
        engine.train_iteration()
