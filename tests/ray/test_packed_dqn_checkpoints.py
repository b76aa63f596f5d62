"""DQN members on disk: what was saved goes on, in a pack or as an RLlib Algorithm; replay memories are filled again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from packed_dqn import SMALL, q_values_of
from packed_rllib import MODULE, learner_of, state_of
from trials import fill_replay, make_task

from policies.acting.policy import NetworkPolicy
from policies.packed.dqn.stack import DQNStack
from policies.packed.member import AnyMember, Weights
from policies.portable.file import PortablePolicy, save_policy
from tune_jobs.training.protocol import IterationStats, TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.packed import PackedEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

VARIANTS: dict[str, dict[str, Any]] = {
    "adam, hard": {"target_update_freq": 40, "lr": 3e-3, "lr_final": 0.0, "lr_decay_steps": 1000},
    "adam, normalised, prioritized, soft": {
        "normalize_observations": True, "replay": "prioritized", "tau": 0.1, "dueling": False, "activation": "silu"
    },
    "rmsprop, by episodes": {
        "optimizer": "rmsprop", "rmsprop_momentum": 0.5, "target_update_unit": "episode", "target_update_freq": 2,
        "epsilon_unit": "episode", "epsilon_decay": 50,
    },
    "rmsprop, without momentum": {"optimizer": "rmsprop", "target_update_freq": 40},
    "no target network, no replay": {"target_network": False, "double_q": False, "replay": "none"},
}  # fmt: skip
ITERATIONS = 3
Trained = tuple[Path, TrialTask, PortablePolicy, dict[str, Any]]


def task_of(folder: str | Path, trial_id: str = "t0000", **values: Any) -> TrialTask:
    # 1.2 updates a phase: some are due and not made.
    return make_task(folder, "dqn", trial_id=trial_id, **{**SMALL, "updates_per_env_step": 0.3, **values})


@pytest.fixture
def engine() -> Iterator[PackedEngine]:
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine()
    yield engine
    engine.close()


def write_checkpoint(engine: PackedEngine, folder: Path, trial_id: str = "t0000") -> PortablePolicy:
    policy = engine.policy(trial_id)
    save_policy(policy, folder)
    engine.save(trial_id, folder)
    return policy


@pytest.fixture(params=VARIANTS)
def trained(request: pytest.FixtureRequest, tmp_path: Path, engine: PackedEngine) -> Trained:
    """(checkpoint, its task, its policy, the values): of a trial that was trained beside another one."""
    values = VARIANTS[request.param]
    task = task_of(tmp_path, **values)
    engine.add(task, None)
    engine.add(task_of(tmp_path, "t0001", **{**values, "hidden_sizes": [5]}), None)
    for _ in range(ITERATIONS):
        engine.train_iteration()
    folder = tmp_path / "000003"
    policy = write_checkpoint(engine, folder)
    assert_same_member(load(folder), member_of(engine))
    for name in ("t0000", "t0001"):
        engine.remove(name)
    return folder, task, policy, values


def load(folder: Path) -> AnyMember:
    from policies.packed.state import load_member

    return load_member(folder / "packed", "t0000")


def member_of(engine: PackedEngine, trial_id: str = "t0000") -> AnyMember:
    (stack,) = engine._stacks.values()
    return stack.member(trial_id)


def assert_same_arrays(ours: Weights, theirs: Weights) -> None:
    assert set(ours) == set(theirs)
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value, err_msg=name)


def assert_same_member(ours: AnyMember, theirs: AnyMember) -> None:
    assert_same_arrays(ours.weights, theirs.weights)
    assert set(ours.moments) == set(theirs.moments)
    for name, value in theirs.moments.items():
        assert_same_arrays(ours.moments[name], value)
    assert ours.rng.bit_generator.state == theirs.rng.bit_generator.state
    for name in type(theirs).__dataclass_fields__:
        if name not in ("weights", "moments", "rng"):
            assert getattr(ours, name) == getattr(theirs, name), name


def test_a_trial_goes_on_from_its_checkpoint_and_fills_its_memory_first(trained: Trained, engine: PackedEngine) -> None:
    folder, task, policy, values = trained
    saved = load(folder)
    assert saved.due > 0
    assert saved.num_target_updates > 0 or not values.get("target_network", True)
    ends = []
    for beside_others in (False, True):
        engine.add(task, folder)
        assert_same_member(member_of(engine), saved)
        for layer, other in zip(engine.policy("t0000").network.layers, policy.network.layers, strict=True):
            np.testing.assert_array_equal(layer.weight, other.weight)
        if beside_others:
            engine.add(task_of(task.sweep_place, "t0001", **values), None)
        counts = []
        for _ in range(3):
            stats = engine.train_iteration()["t0000"]
            assert isinstance(stats, IterationStats)
            counts.append((stats.num_env_steps, member_of(engine).num_updates))
        ends.append(member_of(engine))
        for name in ("t0000", "t0001")[: 1 + beside_others]:
            engine.remove(name)
    # 64 env steps an iteration; the first 32 after the restore are without learning, but for the last of their phases.
    steps, updates = zip(*counts, strict=True)
    assert steps == tuple(64 * (ITERATIONS + number) for number in (1, 2, 3))
    phases = 9 if values.get("replay") != "none" else 13
    made = [count - before for before, count in zip((saved.num_updates, *updates), updates, strict=False)]
    assert made[0] == int(saved.due + 1.2 * phases + 1e-9)
    assert sum(made) == int(saved.due + 1.2 * (phases + 32) + 1e-9)
    assert ends[0].num_iterations == ITERATIONS + 3
    # Its memory has nothing of other members in it.
    for name, value in ends[0].weights.items():
        np.testing.assert_allclose(ends[1].weights[name], value, atol=1e-4)


@pytest.mark.parametrize("trained", [name for name in VARIANTS if "no replay" not in name], indirect=True)
def test_while_its_memory_is_filled_a_member_explores_and_its_weights_stay(
    trained: Trained, engine: PackedEngine
) -> None:
    folder, task, *_ = trained
    saved = load(folder)
    # A whole iteration long.
    engine.add(task, folder)
    (stack,) = cast("list[DQNStack]", list(engine._stacks.values()))
    stack._refilled_at["t0000"] = saved.num_env_steps + 65
    stats = engine.train_iteration()["t0000"]
    assert isinstance(stats, IterationStats)
    member = member_of(engine)
    assert_same_arrays(member.weights, saved.weights)
    assert (member.num_updates, member.due) == (saved.num_updates, saved.due)
    assert stats.num_env_steps == saved.num_env_steps + 64
    assert stats.learner == {}
    assert stack._replay.sizes(stack._replay.slots(["t0000"])) == [64]
    engine.train_iteration()
    assert member_of(engine).num_updates > saved.num_updates


def test_a_checkpoint_is_an_rllib_algorithm_that_trains_on(trained: Trained) -> None:
    from policies.packed.to_rllib import algorithm_from_checkpoint

    folder, _, policy, values = trained
    saved = load(folder)
    algorithm = algorithm_from_checkpoint(folder)
    learner = learner_of(algorithm)
    weights, moments = state_of(learner)
    assert_same_arrays(weights, saved.weights)
    assert any(name.startswith("_target_") for name in weights) == values.get("target_network", True)
    assert {float(value) for value in moments.pop("step").values()} == {saved.num_optimizer_steps}
    assert set(moments) == set(saved.moments) != set()
    for name, value in saved.moments.items():
        assert_same_arrays(moments[name], value)
    assert algorithm.iteration == ITERATIONS
    for name in ("num_env_steps", "num_episodes", "num_updates"):
        assert getattr(algorithm, name) == getattr(saved, name) > 0, name
    assert algorithm._due == saved.due
    assert learner.target_updates_at == saved.target_updates_at
    assert learner.num_target_updates == saved.num_target_updates
    acting = {name: value.numpy() for name, value in algorithm.env_runner.module.state_dict().items()}
    assert_same_arrays(acting, {name: saved.weights[name] for name in acting})

    rows = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    q_values = q_values_of(algorithm.get_module(MODULE), rows)
    np.testing.assert_array_equal(NetworkPolicy(policy).act(rows), q_values.argmax(axis=1))

    fill_replay(algorithm, 32)
    assert_same_arrays(state_of(learner)[0], saved.weights)
    result = algorithm.train()
    steps = result["env_runners"]["num_env_steps_sampled_lifetime"]
    # What fills the memory is counted by the algorithm, not by RLlib.
    assert 64 * (ITERATIONS + 1) <= steps < 64 * (ITERATIONS + 1) + 4
    assert 32 <= algorithm.num_env_steps - steps < 36
    new_updates = algorithm.num_updates - saved.num_updates
    assert new_updates == int(saved.due + 0.3 * (steps - saved.num_env_steps) + 1e-9)
    assert algorithm.iteration == ITERATIONS + 1
    found = result["learners"][MODULE]
    assert np.isfinite(found["total_loss"])
    if "lr_final" in values:
        # RLlib's vector env has steps that only reset.
        assert found["lr"] == pytest.approx(3e-3 * (1 - algorithm.num_env_steps / 1000), abs=3e-3 * 0.005)
    after, moments = state_of(learner)
    assert {float(value) for value in moments["step"].values()} == {saved.num_optimizer_steps + new_updates}
    assert not np.array_equal(after["encoder.mlp.0.weight"], saved.weights["encoder.mlp.0.weight"])
    assert all(np.isfinite(value).all() for value in after.values())
    algorithm.stop()


def test_a_member_that_had_not_learnt_yet_is_restored_as_one(tmp_path: Path, engine: PackedEngine) -> None:
    """It learns as soon as its env steps and its memory are enough, with no second wait."""
    task = task_of(tmp_path, learning_starts=100)
    engine.add(task, None)
    engine.train_iteration()
    write_checkpoint(engine, tmp_path / "000001")
    engine.remove("t0000")
    engine.add(task, tmp_path / "000001")
    assert member_of(engine).num_updates == 0
    engine.train_iteration()
    # At 100 env steps and in each of the seven phases after it.
    assert member_of(engine).num_updates == int(8 * 1.2)


def test_restored_again_while_its_memory_is_filled(tmp_path: Path, engine: PackedEngine) -> None:
    task = task_of(tmp_path, learning_starts=80)
    engine.add(task, None)
    for _ in range(2):
        engine.train_iteration()
    write_checkpoint(engine, tmp_path / "000002")
    for folder in ("000002", "000003"):
        engine.remove("t0000")
        engine.add(task, tmp_path / folder)
        before = member_of(engine).num_updates
        engine.train_iteration()
        assert member_of(engine).num_updates == before > 0
        write_checkpoint(engine, tmp_path / "000003")
    engine.train_iteration()
    # It has 80 transitions after 16 more env steps.
    assert member_of(engine).num_updates == pytest.approx(before + 13 * 1.2, abs=1)
