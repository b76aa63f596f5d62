"""A restored DQN Algorithm of either engine fills its replay memory before it learns, as a restored trial does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from trials import fill_replay, make_task

from analysis.records import ChangeRecord
from policies.portable.file import save_policy
from tune_jobs.training.protocol import TrialTask

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

STARTS, BATCH, PER_ITERATION = 60, 8, 40
BOTH = pytest.mark.parametrize("engine", ["rllib", "packed"])


def task_of(folder: Path, **values: Any) -> TrialTask:
    small = {
        "hidden_sizes": (8,), "num_envs": 2, "learning_starts": STARTS, "train_batch_size": BATCH, "train_freq": 4,
        "env_steps_per_iteration": PER_ITERATION,
    }  # fmt: skip
    return make_task(folder, "dqn", **{**small, **values})


def checkpoint_of(task: TrialTask, engine: str, num_iterations: int) -> Path:
    folder = Path(task.sweep_place) / f"{num_iterations:06d}"
    folder.mkdir()
    if engine == "rllib":
        from tune_jobs.training.rllib import RLlibEngine

        single = RLlibEngine()
        single.build(task, None)
        for _ in range(num_iterations):
            single.train_iteration()
        save_policy(single.policy(), folder)
        single.save(folder)
        single.close()
        return folder
    from tune_jobs.training.packed import PackedEngine

    pack = PackedEngine()
    pack.add(task, None)
    for _ in range(num_iterations):
        pack.train_iteration()
    save_policy(pack.policy(task.trial_id), folder)
    pack.save(task.trial_id, folder)
    pack.close()
    return folder


def restored(folder: Path, engine: str) -> Any:
    if engine == "rllib":
        from tune_jobs.training.rllib import algorithm_from_checkpoint

        return algorithm_from_checkpoint(folder)
    from policies.packed.to_rllib import algorithm_from_checkpoint as from_pack

    return from_pack(folder)


def watch_updates(algorithm: Any) -> list[tuple[int, int]]:
    """(env steps since now, transitions in the memory) of each phase with updates from now on."""
    seen: list[tuple[int, int]] = []
    update, before = algorithm.learner.update_from_replay, algorithm.num_env_steps

    def spied(replay: Any, num_updates: int, **values: Any) -> Any:
        seen.append((values["num_env_steps"] - before, len(replay)))
        return update(replay, num_updates, **values)

    algorithm.learner.update_from_replay = spied
    return seen


def weights_of(algorithm: Any) -> dict[str, NDArray[Any]]:
    state = algorithm.learner.module["default_policy"].state_dict()
    return {name: value.numpy().copy() for name, value in state.items()}


@BOTH
@pytest.mark.parametrize(
    "values", [{"replay": "prioritized"}, {"normalize_observations": True, "updates_per_env_step": 0.3}]
)
def test_it_learns_from_a_memory_as_full_as_when_learning_began(
    tmp_path: Path, engine: str, values: dict[str, Any]
) -> None:
    algorithm = restored(checkpoint_of(task_of(tmp_path, **values), engine, 3), engine)
    before, due, num_updates = weights_of(algorithm), algorithm._due, algorithm.num_updates
    assert num_updates > 0
    assert len(algorithm.replay) == 0
    seen = watch_updates(algorithm)
    algorithm.train()
    # Fewer env steps than learning waits for: nothing is learnt, of weights and statistics.
    assert seen == []
    assert (algorithm.num_updates, algorithm._due) == (num_updates, due)
    for name, value in weights_of(algorithm).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
    algorithm.train()
    steps, size = seen[0]
    # A phase is four env steps, or five.
    assert STARTS <= steps < STARTS + 5
    assert size >= STARTS - 4
    assert algorithm.num_updates > num_updates
    after = weights_of(algorithm)
    if "obs_count" in after:
        # Of the two iterations' 80 env steps those after the first 60, but for whole phases.
        assert 0 < after["obs_count"] - before["obs_count"] <= 2 * PER_ITERATION + 8 - STARTS
    algorithm.stop()


@BOTH
def test_without_replay_it_learns_from_the_next_steps(tmp_path: Path, engine: str) -> None:
    algorithm = restored(checkpoint_of(task_of(tmp_path, replay="none", train_freq=BATCH), engine, 3), engine)
    seen = watch_updates(algorithm)
    algorithm.train()
    assert seen[0][0] < STARTS / 2
    algorithm.stop()


@BOTH
def test_one_that_has_not_learnt_waits_no_second_time(tmp_path: Path, engine: str) -> None:
    algorithm = restored(checkpoint_of(task_of(tmp_path), engine, 1), engine)
    assert algorithm.num_updates == 0
    seen = watch_updates(algorithm)
    algorithm.train()
    assert STARTS - PER_ITERATION - 4 <= seen[0][0] <= STARTS - PER_ITERATION + 4
    algorithm.stop()


@BOTH
def test_a_memory_that_was_filled_by_hand_is_learnt_from_at_once(tmp_path: Path, engine: str) -> None:
    algorithm = restored(checkpoint_of(task_of(tmp_path), engine, 3), engine)
    fill_replay(algorithm, STARTS)
    seen = watch_updates(algorithm)
    algorithm.train()
    assert seen[0][0] in (4, 5)
    algorithm.stop()


def test_a_trial_that_goes_on_fills_its_memory_in_ordinary_iterations(tmp_path: Path) -> None:
    """Each has its limit of time, and stop rules are looked at after each."""
    from tune_jobs.training.rllib import RLlibEngine

    task = task_of(tmp_path, normalize_observations=True)
    folder = checkpoint_of(task, "rllib", 3)
    engine = RLlibEngine()
    engine.build(task, folder)
    before, steps = weights_of(engine.algorithm), engine.algorithm.num_env_steps
    # Of three iterations, as the checkpoint has it.
    assert 3 * PER_ITERATION <= steps < 3 * (PER_ITERATION + 5)
    assert len(engine.algorithm.replay) == 0
    seen = watch_updates(engine.algorithm)
    assert PER_ITERATION <= engine.train_iteration().num_env_steps - steps < PER_ITERATION + 5
    assert seen == []
    for name, value in weights_of(engine.algorithm).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
    engine.train_iteration()
    assert STARTS <= seen[0][0] < STARTS + 5
    # The statistics, too, are learnt from those env steps alone that come after.
    learnt = weights_of(engine.algorithm)["obs_count"] - before["obs_count"]
    assert 0 < learnt <= engine.algorithm.num_env_steps - steps - STARTS + 5
    engine.close()


def test_a_trial_has_no_larger_memory_than_it_fills_and_what_is_restored_has_it_whole(tmp_path: Path) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    ends = []
    for capacity in (2_000, 10**15):
        task = task_of(tmp_path, replay_capacity=capacity)
        engine = RLlibEngine()
        engine.build(task, None)
        stats = [engine.train_iteration() for _ in range(2)]
        assert len(engine.algorithm.replay) <= engine.algorithm.replay.capacity < 100
        ends.append((stats, weights_of(engine.algorithm)))
        engine.close()
    (stats, weights), (stats2, weights2) = ends
    assert stats == stats2
    for name, value in weights.items():
        np.testing.assert_array_equal(weights2[name], value, err_msg=name)
    algorithm = restored(checkpoint_of(task_of(tmp_path, replay_capacity=3_000), "rllib", 1), "rllib")
    assert algorithm.replay.capacity == 3_000
    algorithm.stop()


def test_however_large_its_memory_was_a_trial_is_built_without_an_env_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They would be one iteration of 20,000 env steps: of slow environments, hours."""
    from policies.rllib.env_runner import ArrayEnvRunner
    from tune_jobs.training.rllib import RLlibEngine

    folder = checkpoint_of(task_of(tmp_path), "rllib", 3)
    sampled: list[int] = []
    sample = ArrayEnvRunner.sample_transitions

    def spied(self: Any, num_timesteps: int, **values: Any) -> Any:
        sampled.append(num_timesteps)
        assert len(sampled) < 2 * PER_ITERATION
        return sample(self, num_timesteps, **values)

    monkeypatch.setattr(ArrayEnvRunner, "sample_transitions", spied)
    # Among what a population may change; of a trial that is resumed it is as it was.
    change = ChangeRecord(
        iteration=3, num_env_steps=120, source_trial_id="t0009", source_iteration=3, before={}, after={}, time=0.0
    )
    engine = RLlibEngine()
    engine.build(task_of(tmp_path, learning_starts=20_000, changes=(change,), num_env_steps=120), folder)
    assert sampled == []
    assert 120 + PER_ITERATION <= engine.train_iteration().num_env_steps < 120 + PER_ITERATION + 5
    assert sampled
    engine.close()
