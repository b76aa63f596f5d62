"""Members of a pack that take over another's checkpoint, and members that wait: by the engine of packs itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from trials import make_task

from analysis.records import ChangeRecord
from policies.errors import CheckpointError
from policies.packed.member import AnyMember, Weights
from tune_jobs.training.protocol import TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.packed import PackedEngine

pytestmark = pytest.mark.ray

CHANGE = ChangeRecord(
    iteration=2, num_env_steps=200, source_trial_id="t0000", source_iteration=3, before={}, after={}, time=0.0
)
DQN = {"replay": "prioritized", "double_q": True}


def task_of(folder: Path, algorithm: str, number: int, **values: Any) -> TrialTask:
    return make_task(folder, algorithm, trial_id=f"t{number:04d}", seed=1024 * (9 + number), in_step=True, **values)


def engine_with(*tasks: TrialTask) -> PackedEngine:
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine("scalar")
    for task in tasks:
        engine.add(task, None)
    return engine


def member_of(engine: PackedEngine, trial_id: str) -> AnyMember:
    return engine._member_of(trial_id)[1].member(trial_id)


def saved(engine: PackedEngine, trial_id: str, folder: Path) -> Path:
    folder.mkdir(parents=True)
    engine.save(trial_id, folder)
    return folder


def assert_equal(ours: Weights, theirs: Weights) -> None:
    assert ours.keys() == theirs.keys()
    assert ours
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name])


def copied(engine: PackedEngine, task: TrialTask, checkpoint: Path, **values: Any) -> TrialTask:
    """Let a member go on from a checkpoint, as it does after a change: with new values, by its own counts."""
    engine.remove(task.trial_id)
    after = dataclasses.replace(
        task, hyperparams=task.hyperparams | values, changes=(CHANGE,), num_env_steps=200, num_iterations=2
    )
    engine.add(after, checkpoint)
    return after


@pytest.mark.parametrize(
    ("algorithm", "values"), [("ppo", {"normalize_observations": True}), ("dqn", DQN)], ids=["ppo", "dqn"]
)
def test_a_copy_has_the_weights_moments_and_targets_and_its_own_values_counts_and_numbers(
    tmp_path: Path, algorithm: str, values: dict[str, Any]
) -> None:
    tasks = [task_of(tmp_path, algorithm, number, **values) for number in (0, 1)]
    engine = engine_with(*tasks)
    for _ in range(3):
        engine.train_iteration()
    folder = saved(engine, "t0000", tmp_path / "000003")
    copied(engine, tasks[1], folder, lr=0.02, gamma=0.5)
    source, copy = member_of(engine, "t0000"), member_of(engine, "t0001")
    assert_equal(copy.weights, source.weights)
    assert copy.moments.keys() == source.moments.keys()
    for name, moments in copy.moments.items():
        assert_equal(moments, source.moments[name])
    assert copy.hyperparams.lr == 0.02
    assert copy.hyperparams.gamma == 0.5
    assert copy.seed == tasks[1].seed
    assert copy.rng.bit_generator.state != source.rng.bit_generator.state
    assert engine.policy("t0001").training["iteration"] == 2
    results = engine.train_iteration()
    stats = results["t0001"]
    assert not isinstance(stats, Exception)
    # Its own count goes on; the schedules go by the copied one's.
    assert stats.num_env_steps == 200 + (128 if algorithm == "ppo" else 60)
    if algorithm == "ppo":
        assert stats.learner["lr"] == pytest.approx(0.02)
    assert engine.policy("t0001").training["iteration"] == 3
    engine.close()


def test_a_copied_member_of_dqn_fills_its_memory_again_before_it_learns(tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, "dqn", number, **DQN) for number in (0, 1)]
    engine = engine_with(*tasks)
    for _ in range(3):
        engine.train_iteration()
    folder = saved(engine, "t0000", tmp_path / "000003")
    copied(engine, tasks[1], folder)
    before = member_of(engine, "t0001").num_updates
    engine.train_iteration()
    # Of 60 env steps the first 30 refill it, as many as learning waited for at the start.
    assert member_of(engine, "t0001").num_updates - before == pytest.approx(30, abs=1)
    assert member_of(engine, "t0000").num_updates - before == 60
    engine.close()


def test_a_copy_goes_on_from_its_own_checkpoint_as_it_was(tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1)]
    engine = engine_with(*tasks)
    engine.train_iteration()
    after = copied(engine, tasks[1], saved(engine, "t0000", tmp_path / "000001"), lr=0.02)
    engine.train_iteration()
    own = saved(engine, "t0001", tmp_path / "000003")
    known = member_of(engine, "t0001")
    state = known.rng.bit_generator.state
    again = dataclasses.replace(after, num_env_steps=328, num_iterations=3)
    engine.remove("t0001")
    engine.add(again, own)
    assert member_of(engine, "t0001").rng.bit_generator.state == state
    stats = engine.train_iteration()["t0001"]
    assert not isinstance(stats, Exception)
    assert stats.num_env_steps == 328 + 128
    assert engine.policy("t0001").training["iteration"] == 4
    engine.close()


def test_another_trials_checkpoint_is_refused_without_a_change_and_other_shapes_always(tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1)]
    engine = engine_with(tasks[0])
    engine.train_iteration()
    folder = saved(engine, "t0000", tmp_path / "000001")
    with pytest.raises(CheckpointError, match="other hyperparameters or another seed"):
        engine.add(tasks[1], folder)
    wider = dataclasses.replace(tasks[1], changes=(CHANGE,), hyperparams=tasks[1].hyperparams | {"hidden_sizes": (9,)})
    with pytest.raises(CheckpointError, match="shape"):
        engine.add(wider, folder)
    assert list(engine.train_iteration()) == ["t0000"]
    engine.close()


# -- waiting


def weights(engine: PackedEngine, trial_id: str) -> list[Any]:
    return [layer.weight.copy() for layer in engine.policy(trial_id).network.layers]


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_members_that_wait_are_as_they_were_and_go_on_as_if_they_had_not(tmp_path: Path, algorithm: str) -> None:
    size = {"train_batch_size": 256} if algorithm == "ppo" else {"env_steps_per_iteration": 120}
    tasks = [task_of(tmp_path, algorithm, number) for number in (0, 1)]
    others = [task_of(tmp_path, algorithm, number, **size) for number in (2, 3)]
    engine, undisturbed = engine_with(*tasks, *others), engine_with(*tasks)
    for _ in range(2):
        engine.train_iteration()
    # The larger batches are as far after one iteration as the others after two.
    assert set(engine.train_iteration({"t0002", "t0003"})) == {"t0000", "t0001"}
    for _ in range(4):
        undisturbed.train_iteration()
    results = engine.train_iteration()
    assert set(results) == {"t0000", "t0001", "t0002", "t0003"}
    for name in ("t0000", "t0001"):
        np.testing.assert_equal(weights(engine, name), weights(undisturbed, name))
    alone = engine_with(*others)
    for _ in range(3):
        alone.train_iteration()
    for name in ("t0002", "t0003"):
        np.testing.assert_equal(weights(engine, name), weights(alone, name))
    for each in (engine, undisturbed, alone):
        each.close()


def test_one_that_waits_while_others_of_its_stack_train_gets_a_stack_of_its_own(tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1, 2)]
    engine, undisturbed = engine_with(*tasks), engine_with(*tasks)
    for each in (engine, undisturbed):
        each.train_iteration()
    before = weights(engine, "t0001")
    assert set(engine.train_iteration({"t0001"})) == {"t0000", "t0002"}
    np.testing.assert_equal(weights(engine, "t0001"), before)
    assert len(engine._stacks) == 2
    undisturbed.train_iteration()
    for name in ("t0000", "t0002"):
        np.testing.assert_equal(weights(engine, name), weights(undisturbed, name))
    stats = engine.train_iteration()["t0001"]
    assert not isinstance(stats, Exception)
    assert stats.num_env_steps == 256
    for name in ("t0000", "t0001", "t0002"):
        engine.remove(name)
    assert not engine._stacks
    undisturbed.close()


def test_a_member_joins_the_stack_of_those_that_are_as_far_as_it_is(tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, "ppo", number) for number in (0, 1, 2)]
    engine = engine_with(*tasks)
    for _ in range(2):
        engine.train_iteration()
    folder = saved(engine, "t0000", tmp_path / "000002")
    engine.remove("t0001")
    change = dataclasses.replace(tasks[1], changes=(CHANGE,), num_env_steps=256, num_iterations=2)
    engine.add(change, folder)
    assert len(engine._stacks) == 1
    # One that was opened again from an older checkpoint is not where the others are.
    engine.remove("t0001")
    engine.add(dataclasses.replace(change, num_env_steps=128, num_iterations=1), folder)
    assert len(engine._stacks) == 2
    engine.close()


def test_a_sweep_without_meetings_shares_stacks_as_before(tmp_path: Path) -> None:
    tasks = [dataclasses.replace(task_of(tmp_path, "ppo", number), in_step=False) for number in (0, 1)]
    engine = engine_with(tasks[0])
    engine.train_iteration()
    engine.add(tasks[1], None)
    assert len(engine._stacks) == 1
    engine.close()
