"""Packs with convolutions: their updates are RLlib's, their checkpoints are RLlib's, and they learn from images."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import packed_dqn
import packed_rllib
import pytest
import torch
from trials import make_task, run_trial, train_pack

from policies.acting.evaluate import Evaluator
from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy
from policies.errors import CheckpointError
from policies.packed.state import load_member, save_member
from policies.portable.file import save_policy
from tests.narrowing import present
from tune_jobs.spec.sections import EvaluationSpec, StopSpec
from tune_jobs.training.protocol import IterationStats

if TYPE_CHECKING:
    from collections.abc import Mapping

    from policies.packed.member import AnyMember
    from tune_jobs.training.protocol import TrialTask

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

BYTES, NUMBERS, MASKED, BITS = "TestShades-v0", "TestFineShades-v0", "TestMaskedShades-v0", "TestBits-v0"
# An image of the same size among other members.
BESIDE, FINE_BESIDE, MASKED_BESIDE = "TestBeside-v0", "TestFineBeside-v0", "TestMaskedBeside-v0"
# Two images of that size, of two channels and of one.
PAIR = "TestPair-v0"
FILTERS = ((5, 4, 2), (3, 2, 1))
"""12 x 9 x 2 -> 5 x 3 x 5 -> 4 x 2 x 3."""
# As in `packed_rllib` and `packed_dqn`, but the gradient of a kernel is a sum over its 15 places in each row, too.
PPO_ROUNDING = 4 * (packed_rllib.ROWS * 15 + 60) * 6e-8
DQN_ROUNDING = 9 * (16 * 15 + 60) * 6e-8

# (env, what the members share, what each has of its own)
PPO: dict[str, tuple[str, dict[str, Any], list[dict[str, Any]]]] = {
    "bytes, relu": (BYTES, {"activation": "relu", "conv_filters": FILTERS}, [
        {}, {"hidden_sizes": (5,), "clip_param": 0.05, "grad_clip": 0.3}, {"hidden_sizes": (6,), "lr": 1e-3},
    ]),
    "bytes, normalised, shared layers, KL": (
        BYTES, {"conv_filters": FILTERS, "normalize_observations": True, "vf_share_layers": True, "use_kl_loss": True},
        [{"kl_coeff": 0.7}, {"hidden_sizes": (7,), "kl_target": 1e-4, "vf_clip_range": 0.02}],
    ),
    "numbers, silu, one kernel": (NUMBERS, {"activation": "silu", "conv_filters": ((4, 3, 3),)}, [
        {"hidden_sizes": (8, 6)}, {"hidden_sizes": (7, 5), "entropy_coeff": 0.1},
    ]),
    "numbers, normalised, linear": (
        NUMBERS, {"activation": "linear", "conv_filters": FILTERS, "normalize_observations": True},
        [{}, {"hidden_sizes": (5,), "grad_clip": 0.2}],
    ),
    "masked bytes, KL": (MASKED, {"conv_filters": FILTERS, "use_kl_loss": True}, [
        {"kl_coeff": 0.7}, {"hidden_sizes": (5,), "entropy_coeff": 0.1},
    ]),
    "zeros and ones": (BITS, {"conv_filters": FILTERS}, [{}, {"hidden_sizes": (5,)}]),
    "masked bytes, normalised": (MASKED, {"conv_filters": FILTERS, "normalize_observations": True}, [{}]),
    "bytes beside others, KL": (BESIDE, {"conv_filters": FILTERS, "use_kl_loss": True}, [
        {"kl_coeff": 0.7}, {"hidden_sizes": (5,), "grad_clip": 0.3}, {"hidden_sizes": (6,), "lr": 1e-3},
    ]),
    "bytes beside others, normalised, shared layers": (
        BESIDE, {"conv_filters": FILTERS, "normalize_observations": True, "vf_share_layers": True}, [{}, {"lr": 1e-3}],
    ),
    "numbers beside others, linear, two layers": (
        FINE_BESIDE, {"conv_filters": ((4, 3, 3),), "activation": "linear"},
        [{"hidden_sizes": (8, 6)}, {"hidden_sizes": (7, 5), "entropy_coeff": 0.1}],
    ),
    "bytes beside others and a mask": (MASKED_BESIDE, {"conv_filters": FILTERS}, [{}, {"hidden_sizes": (5,)}]),
    "two images": (PAIR, {"conv_filters": FILTERS}, [{}, {"hidden_sizes": (5,), "grad_clip": 0.3}]),
    "two images, normalised, shared layers": (
        PAIR, {"conv_filters": FILTERS, "normalize_observations": True, "vf_share_layers": True}, [{}, {"lr": 1e-3}],
    ),
}  # fmt: skip
DQN: dict[str, tuple[str, list[dict[str, Any]]]] = {
    "bytes, double, dueling": (BYTES, [
        {"conv_filters": FILTERS, "target_update_freq": 10},
        {"conv_filters": FILTERS, "hidden_sizes": (5,), "lr": 5e-3, "grad_clip": 0.5},
    ]),
    "bytes, normalised, n-step": (BYTES, [
        {"conv_filters": ((4, 3, 2),), "normalize_observations": True, "n_step": 3, "tau": 0.2, "activation": "elu"},
    ]),
    "numbers, prioritized": (NUMBERS, [
        {"conv_filters": FILTERS, "replay": "prioritized", "double_q": False, "dueling": False, "activation": "tanh"},
        {"conv_filters": FILTERS, "replay": "prioritized", "double_q": False, "dueling": False, "activation": "tanh",
         "hidden_sizes": (6,), "optimizer_epsilon": 1e-3},
    ]),
    "zeros and ones": (BITS, [{"conv_filters": FILTERS}, {"conv_filters": FILTERS, "hidden_sizes": (5,)}]),
    "masked bytes, double, dueling": (MASKED, [
        {"conv_filters": FILTERS, "target_update_freq": 10}, {"conv_filters": FILTERS, "hidden_sizes": (5,)},
    ]),
    "masked bytes, normalised, n-step": (MASKED, [
        {"conv_filters": ((4, 3, 2),), "normalize_observations": True, "n_step": 3, "tau": 0.2, "double_q": False},
    ]),
    "bytes beside others, double, dueling": (BESIDE, [
        {"conv_filters": FILTERS, "target_update_freq": 10}, {"conv_filters": FILTERS, "hidden_sizes": (5,)},
    ]),
    "numbers beside others, normalised": (FINE_BESIDE, [
        {"conv_filters": ((4, 3, 2),), "normalize_observations": True, "tau": 0.2, "dueling": False},
    ]),
    "bytes beside others and a mask": (MASKED_BESIDE, [{"conv_filters": FILTERS, "n_step": 2}]),
    "two images, double, dueling": (PAIR, [{"conv_filters": FILTERS}, {"conv_filters": FILTERS, "hidden_sizes": (5,)}]),
}  # fmt: skip


@pytest.mark.parametrize("num_updates", [1, 3])
@pytest.mark.parametrize("name", PPO)
def test_an_update_of_ppo_is_rllibs_for_every_member(name: str, num_updates: int) -> None:
    env_id, shared, members = PPO[name]
    pairs, stack, _ = packed_rllib.compare(env_id, [{**shared, **values} for values in members], num_epochs=num_updates)
    assert len(stack._groups) == 1
    for ours, theirs in pairs:
        for what, value in packed_rllib.differences(ours, theirs).items():
            assert value < PPO_ROUNDING, what


@pytest.mark.parametrize("name", DQN)
def test_training_phases_of_dqn_are_rllibs_for_every_member(name: str) -> None:
    env_id, members = DQN[name]
    pairs, stack = packed_dqn.compare(members, env_id=env_id)
    assert len(stack._groups) == 1
    for ours, theirs in pairs:
        for what, value in packed_dqn.differences(ours, present(theirs)).items():
            assert value < DQN_ROUNDING, what


# -- members


def assert_same(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    assert set(ours) == set(theirs)
    for name, value in theirs.items():
        assert ours[name].shape == value.shape
        np.testing.assert_array_equal(ours[name], value, err_msg=name)


def stack_of(env_id: str, algorithm: str, num_members: int, env_args: dict[str, Any], **values: Any) -> Any:
    """A stack of some members beside the one that is watched, which have other learning rates."""
    from policies.hyperparams import make_hyperparams
    from policies.packed.envs.make import make_packed_envs
    from policies.packed.initial import new_member
    from policies.packed.make import make_stack

    small = packed_rllib.SMALL if algorithm == "ppo" else packed_dqn.SMALL
    settings = {**small, "conv_filters": FILTERS, "hidden_sizes": (9,), **values}
    hyperparams: Any = make_hyperparams(algorithm, settings)  # type: ignore[arg-type]
    stack = make_stack(hyperparams, make_packed_envs(env_id, env_args, hyperparams.num_envs, kind="scalar"))
    for index in range(num_members):
        own = hyperparams.model_copy(update={"lr": 1e-3 * (index + 1)})
        name, seed = ("watched", 77) if index == 0 else (f"o{index}", index)
        stack.add(new_member(name, own, seed, stack.envs.observation_space, stack.envs.action_space), seed)
    return stack


@pytest.mark.parametrize(("env_id", "algorithm", "values"), [
    (BYTES, "ppo", {"minibatch_size": 20, "normalize_observations": True}),
    (NUMBERS, "ppo", {"minibatch_size": 33, "activation": "silu", "vf_share_layers": True}),
    (BYTES, "dqn", {"n_step": 2}),
    (MASKED, "ppo", {"minibatch_size": 20}),
    (MASKED, "dqn", {"normalize_observations": True}),
    (BESIDE, "ppo", {"minibatch_size": 20}),
    (MASKED_BESIDE, "dqn", {}),
    (PAIR, "ppo", {"minibatch_size": 20}),
    (PAIR, "dqn", {}),
    (NUMBERS, "dqn", {"normalize_observations": True, "activation": "gelu"}),
])  # fmt: skip
def test_a_member_does_not_depend_on_the_others_to_the_bit(env_id: str, algorithm: str, values: dict[str, Any]) -> None:
    """Of episodes that are truncated after 7 steps, too."""

    def weights_beside(num_others: int) -> dict[str, bytes]:
        stack = stack_of(env_id, algorithm, 1 + num_others, {"max_episode_steps": 7}, **values)
        for _ in range(6):
            stack.train_iteration()
        found = {name: value.tobytes() for name, value in stack.member("watched").weights.items()}
        stack.envs.close()
        return found

    alone = weights_beside(0)
    assert weights_beside(2) == alone
    assert weights_beside(10) == alone


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_one_that_looks_at_a_member_does_not_depend_on_one_that_sees_a_row_of_numbers(algorithm: str) -> None:
    """Both are in one stack, as `conv_filters` may be searched beside null."""
    from policies.packed.initial import new_member

    def weights(kind: str | None) -> dict[str, bytes]:
        stack = (
            stack_of(BESIDE, algorithm, 1, {}, minibatch_size=20)
            if algorithm == "ppo"
            else stack_of(BESIDE, algorithm, 1, {})
        )
        if kind is not None:
            values = stack.member("watched").hyperparams.model_copy(update={"conv_filters": None, "lr": 2e-3})
            stack.add(new_member(kind, values, 1, stack.envs.observation_space, stack.envs.action_space), 1)
        for _ in range(4):
            stack.train_iteration()
        assert len(stack._groups) == 1 + (kind is not None)
        found = {name: value.tobytes() for name, value in stack.member("watched").weights.items()}
        stack.envs.close()
        return found

    # By its name it may come first, or last.
    assert weights(None) == weights("a") == weights("z")


def test_a_member_that_was_saved_is_read_as_it_was(tmp_path: Path) -> None:
    stack = stack_of(BYTES, "ppo", 2, {}, normalize_observations=True)
    stack.train_iteration()
    member: AnyMember = copy.deepcopy(stack.member("watched"))
    stack.envs.close()
    save_member(member, tmp_path / "state")
    read = load_member(tmp_path / "state", "watched")
    assert member.weights["obs_mean"].shape == (12, 9, 2)
    assert_same(read.weights, member.weights)
    assert set(read.moments) == set(member.moments)
    for name, moments in member.moments.items():
        assert_same(read.moments[name], moments)


# -- learning

NUM_STEPS = 10
# The right action is drawn anew each step: of 20 episodes of 10, one who is blind gets 5 +/- 0.35 a time. Who has seen
# which half is brighter gets all.
LEARNED = 9.0
SEEDS = tuple(range(500, 520))
VALUES: dict[str, dict[str, Any]] = {
    "ppo": {
        "conv_filters": ((4, 3, 2),), "hidden_sizes": (16,), "activation": "relu", "lr": 0.005, "gamma": 0.0,
        "num_envs": 8, "train_batch_size": 512, "minibatch_size": 64, "num_epochs": 6,
    },
    "dqn": {
        "conv_filters": ((4, 3, 2),), "hidden_sizes": (16,), "lr": 0.003, "gamma": 0.0, "learning_starts": 100,
        "env_steps_per_iteration": 500, "train_batch_size": 32, "updates_per_env_step": 0.5, "train_freq": 2,
        "epsilon_decay": 1000,
    },
}  # fmt: skip
NUM_ITERATIONS = 5
# For two observations at once, the older of which is noise: with 16 units one of six seeds of DQN had not learned in
# time, on both engines; with 32 all of eight had, with either algorithm.
STACKED = {"hidden_sizes": (32,)}
# With the larger rate, four actions instead of two end without entropy before all are right, and it makes up for zeros
# and ones that are not scaled as such: multiplied by 1/255, they come to 4.9 to 5.3 with the smaller one.
OTHERS: dict[str, dict[str, Any]] = {"ppo": {"lr": 0.001}, "dqn": {}}


def task_of(
    folder: Path, algorithm: str, seed: int, env_id: str = BYTES, env_args: dict[str, Any] | None = None
) -> TrialTask:
    return make_task(
        folder, algorithm, **{**VALUES[algorithm], **({} if env_id == BYTES else OTHERS[algorithm])},
        env_args=env_args or {},
        trial_id=f"t{seed:04d}", seed=1024 * (seed + 1), env_id=env_id, evaluation_seeds=SEEDS,
        stop=StopSpec(num_iterations=NUM_ITERATIONS), evaluation=EvaluationSpec(num_episodes=len(SEEDS)),
    )  # fmt: skip


@pytest.mark.parametrize("env_id", [BYTES, MASKED, BITS, BESIDE, MASKED_BESIDE, PAIR])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_pack_learns_to_look(algorithm: str, env_id: str, tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, algorithm, seed, env_id) for seed in range(2)]
    for policy in train_pack(tasks, tmp_path, NUM_ITERATIONS):
        with Evaluator(env_id, {}, SEEDS) as evaluator:
            assert evaluator.run(policy).mean_return >= LEARNED


@pytest.mark.parametrize("env_id", [BESIDE, MASKED_BESIDE])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_both_engines_learn_to_look_at_a_member_of_stacked_observations(
    algorithm: str, env_id: str, tmp_path: Path
) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    env_args, folders = {"frame_stack": 2}, [tmp_path / "packed", tmp_path / "rllib"]
    tasks = [task_of(folder, algorithm, 0, env_id, env_args) for folder in folders]
    tasks = [replace(task, hyperparams={**task.hyperparams, **STACKED}) for task in tasks]
    (packed,) = train_pack(tasks[:1], folders[0], NUM_ITERATIONS)
    engine = RLlibEngine()
    progress = run_trial(tasks[1], engine)
    engine.close()
    assert progress.status == "completed", progress
    for policy in (packed, load_policy(folders[1] / progress.checkpoints[-1].path)):
        image = policy.portable.network.image  # type: ignore[attr-defined]
        assert [part.num_channels for part in image.parts] == [2, 2]
        with Evaluator(env_id, env_args, SEEDS) as evaluator:
            assert evaluator.run(policy).mean_return >= LEARNED


@pytest.mark.parametrize("env_id", [MASKED, BESIDE, MASKED_BESIDE, PAIR])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_trial_of_rllibs_learns_to_look_at_what_is_no_plain_image(
    algorithm: str, env_id: str, tmp_path: Path
) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    engine = RLlibEngine()
    progress = run_trial(task_of(tmp_path, algorithm, 0, env_id), engine)
    engine.close()
    assert progress.status == "completed", progress
    policy = load_policy(tmp_path / progress.checkpoints[-1].path)
    # From the environment as its author registered it: no wrapper of ours.
    env, total = gym.make(env_id), 0.0
    inner: Any = env.unwrapped
    for seed in SEEDS:
        observation, _ = env.reset(seed=seed)
        for _ in range(NUM_STEPS):
            # That of the others is among what they observe, if they have one.
            mask = inner.action_masks() if env_id == MASKED else None
            observation, reward, *_ = env.step(policy.act(observation, mask))
            total += float(reward)
    assert total / len(SEEDS) >= LEARNED


def test_a_checkpoint_of_images_that_were_scaled_otherwise_does_not_go_on(tmp_path: Path) -> None:
    from policies.packed.to_rllib import algorithm_from_checkpoint
    from tune_jobs.training.packed import PackedEngine

    engine, folder = PackedEngine(), tmp_path / "000001"
    engine.add(task := task_of(tmp_path, "ppo", 0, BITS), None)
    engine.train_iteration()
    policy = engine.policy(task.trial_id)
    engine.save(task.trial_id, folder)
    engine.close()
    save_policy(policy, folder)
    engine = PackedEngine()
    engine.add(task, folder)
    engine.close()
    # As a former version wrote it, which divided all bytes by 255.
    save_policy(replace(policy, network=replace(policy.network, scale=1 / 255)), folder)
    words = "trained on images of bytes times 0.00392157, and this version multiplies them by 1"
    engine = PackedEngine()
    with pytest.raises(CheckpointError, match=words) as caught:
        engine.add(task, folder)
    assert caught.value.hint.startswith("Launch the sweep anew")
    engine.close()
    with pytest.raises(CheckpointError, match=words):
        algorithm_from_checkpoint(folder)


@pytest.mark.parametrize(
    ("algorithm", "env_id"),
    [("ppo", BYTES), ("dqn", BYTES), ("ppo", BESIDE), ("dqn", BESIDE), ("ppo", PAIR), ("dqn", PAIR)],
)
def test_a_checkpoint_goes_on_and_is_an_rllib_algorithm(algorithm: str, env_id: str, tmp_path: Path) -> None:
    from policies.packed.to_rllib import algorithm_from_checkpoint
    from tune_jobs.training.packed import PackedEngine

    engine, folder = PackedEngine(), tmp_path / "000001"
    engine.add(task := task_of(tmp_path, algorithm, 0, env_id), None)
    engine.train_iteration()
    save_policy(engine.policy(task.trial_id), folder)
    engine.save(task.trial_id, folder)
    engine.close()
    member, policy = load_member(folder / "packed", task.trial_id), load_policy(folder)
    assert isinstance(policy, NetworkPolicy)
    rllib = algorithm_from_checkpoint(folder)
    weights, moments = packed_rllib.state_of(packed_rllib.learner_of(rllib))
    assert_same(weights, member.weights)
    for name, found in member.moments.items():
        assert_same(moments[name], found)
    rng = np.random.default_rng(0)
    images: Any = rng.integers(0, 256, (100, 12, 9, 2), dtype=np.uint8)
    if env_id == BESIDE:
        parts = [rng.normal(size=(100, 3)), images.reshape(100, -1), np.eye(2)[rng.integers(0, 2, 100)]]
        images = np.concatenate(parts, axis=1).astype(np.float32)
    if env_id == PAIR:
        parts = [np.eye(2)[rng.integers(0, 2, 100)], images.reshape(100, -1), rng.normal(size=(100, 3 + 108 + 3))]
        images = np.concatenate(parts, axis=1).astype(np.float32)
    with torch.no_grad():
        module = rllib.get_module(packed_rllib.MODULE)
        outputs = module.forward_inference({"obs": torch.from_numpy(images)})
    greedy = outputs["actions"] if "actions" in outputs else outputs["action_dist_inputs"].argmax(dim=-1)
    np.testing.assert_array_equal(policy.act(images), greedy.numpy())
    rllib.stop()
    # And in a pack, from where it was.
    again = PackedEngine()
    again.add(task, folder)
    (stack,) = again._stacks.values()
    assert_same(stack.member(task.trial_id).weights, member.weights)
    assert isinstance(stats := again.train_iteration()[task.trial_id], IterationStats)
    assert stats.num_env_steps > member.num_env_steps
    again.close()
