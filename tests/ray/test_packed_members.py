"""Members come and go, are saved and restored; what becomes of one does not depend on the others."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
import torch
from packed_rllib import MODULE, PPOMember, assert_same_stats, learner_of, state_of
from trials import make_task

from policies.acting.policy import NetworkPolicy
from policies.activations import ACTIVATIONS
from policies.errors import CheckpointError
from policies.hyperparams import PPOHyperparams
from policies.packed.envs.vector import EnvKind
from policies.packed.member import AnyMember, MemberStats, Weights
from policies.portable.file import PortablePolicy, save_policy
from tune_jobs.training.protocol import IterationStats, TrialTask

if TYPE_CHECKING:
    from policies.packed.ppo.stack import PPOStack
    from tune_jobs.training.packed import PackedEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

SHARED = {"train_batch_size": 256, "minibatch_size": 64, "num_epochs": 4, "num_envs": 8, "lr": 3e-3}


def make_stack(env_id: str, env_args: dict[str, Any] | None = None, **shared: Any) -> PPOStack:
    from policies.packed.envs.make import make_packed_envs
    from policies.packed.make import make_stack as make

    hyperparams = PPOHyperparams(**{**SHARED, **shared})
    kind: EnvKind = "vectorised" if env_id == "CartPole-v1" else "scalar"
    return cast("PPOStack", make(hyperparams, make_packed_envs(env_id, env_args, hyperparams.num_envs, kind=kind)))


def add(stack: PPOStack, name: str, seed: int, member: PPOMember | None = None, **values: Any) -> None:
    from policies.packed.initial import new_member

    if member is None:
        hyperparams = PPOHyperparams(**{**SHARED, **values})
        member = new_member(name, hyperparams, seed, stack.envs.observation_space, stack.envs.action_space)
    stack.add(member, seed)


# Of all kinds, so that the one that is watched stands alone in a group, or is padded with others in one.
OTHERS = [
    {"hidden_sizes": (size, size), "activation": activation, "lr": lr, "vf_clip_param": clip}
    for size, activation, lr, clip in (
        (20, "tanh", 1e-3, None), (24, "tanh", 1e-2, 5.0), (64, "relu", 3e-4, None), (22, "tanh", 1e-3, 1.0),
        (17, "tanh", 3e-3, None), (24, "silu", 1e-3, None), (23, "tanh", 1e-4, None), (19, "tanh", 5e-3, 3.0),
        (18, "tanh", 1e-3, None), (21, "tanh", 1e-3, None), (24, "tanh", 2e-3, None),
    )
]  # fmt: skip
WATCHED = {"hidden_sizes": (21, 18), "grad_clip": 0.5, "entropy_coeff": 0.01}


def in_pack(
    env_id: str, num_others: int, *, comings_and_goings: bool = False, **shared: Any
) -> tuple[PPOMember, list[MemberStats]]:
    """The watched member after 5 iterations beside others, and what its iterations gave."""
    stack, seen = make_stack(env_id, **shared), []
    for index in range(num_others // 2):
        add(stack, f"o{index}", index, **{**OTHERS[index], **shared})
    add(stack, "watched", 77, **{**WATCHED, **shared})
    for index in range(num_others // 2, num_others):
        add(stack, f"o{index}", index, **{**OTHERS[index], **shared})
    for iteration in range(5):
        seen.append(stack.train_iteration()["watched"])
        if comings_and_goings:
            stack.remove(f"o{2 * iteration}")
            add(stack, f"n{iteration}", 100 + iteration, **{**OTHERS[iteration], **shared})
            if iteration == 2:
                stack.remove("o1")
    member = copy.deepcopy(stack.member("watched"))
    stack.envs.close()
    return member, seen


@pytest.mark.parametrize(("env_id", "shared"), [
    ("CartPole-v1", {}),
    ("CartPole-v1", {"vf_share_layers": True, "use_kl_loss": True, "normalize_observations": True}),
    ("Pendulum-v1", {"normalize_observations": True, "train_batch_size": 128}),
])  # fmt: skip
def test_a_member_does_not_depend_on_the_others(env_id: str, shared: dict[str, Any]) -> None:
    """Weights after 5 iterations; all that differs is what products of padded sizes round otherwise.

    Rounding changes a component of a gradient by a share of 1e-4 at most, of those that are a thousandth of the
    largest; 80 updates of the learning rate's size, 3e-3, move a weight by 2.4e-5 with that. Another action would move
    all of them by hundredths. That there is none is no chance: each choice compares two numbers that rounding moves by
    1e-7, and there are a thousand.
    """
    alone, seen_alone = in_pack(env_id, 0, **shared)
    assert alone.num_updates == 5 * 4 * shared.get("train_batch_size", 256) // 64
    for num_others, changes in ((2, False), (11, True)):
        packed, seen = in_pack(env_id, num_others, comings_and_goings=changes, **shared)
        for name, value in alone.weights.items():
            np.testing.assert_allclose(packed.weights[name], value, rtol=1e-4, atol=1e-4, err_msg=name)
        # The very same episodes: not one action was another.
        for ours, theirs in zip(seen, seen_alone, strict=True):
            assert ours.num_env_steps == theirs.num_env_steps
            np.testing.assert_allclose(ours.episodes, theirs.episodes, rtol=1e-4)
            assert ours.learner == pytest.approx(theirs.learner, rel=1e-3, abs=1e-4)
        assert packed.rng.bit_generator.state == alone.rng.bit_generator.state
        assert packed.num_env_steps == alone.num_env_steps
        assert packed.num_optimizer_steps == alone.num_optimizer_steps


@pytest.mark.parametrize("shared", [
    {"hidden_sizes": (32,)}, {"hidden_sizes": (64,)}, {"hidden_sizes": (64,), "num_envs": 1},
    # Arrays whose lengths are no multiples of what a processor computes at once.
    *({"hidden_sizes": (21,), "minibatch_size": 50, "activation": activation} for activation in ACTIVATIONS),
])  # fmt: skip
def test_of_equal_sizes_a_member_does_not_depend_on_the_others_to_the_bit(shared: dict[str, Any]) -> None:
    """Nothing is padded: each matrix of its own has the shape that it has alone, and so its sums are the same.

    Of episodes that are truncated after 50 steps one member has many where another has none.
    """

    def weights_beside(num_others: int) -> dict[str, bytes]:
        stack = make_stack("CartPole-v1", {"max_episode_steps": 50}, **shared)
        add(stack, "watched", 77, **shared)
        for index in range(num_others):
            add(stack, f"o{index}", index, **{**shared, "lr": 1e-3 * (index + 1)})
        for _ in range(20):
            stack.train_iteration()
        found = {name: value.tobytes() for name, value in stack.member("watched").weights.items()}
        stack.envs.close()
        return found

    alone = weights_beside(0)
    assert weights_beside(3) == alone
    assert weights_beside(9) == alone


def test_members_of_one_seed_are_the_same() -> None:
    stack = make_stack("CartPole-v1")
    for name in ("a", "b"):
        add(stack, name, 5)
    add(stack, "c", 6)
    stats = stack.train_iteration()
    assert_same_stats(stats["a"], stats["b"])
    assert stats["a"].episodes != stats["c"].episodes
    stack.envs.close()


# -- on disk


def assert_same_arrays(ours: Weights, theirs: Weights) -> None:
    assert set(ours) == set(theirs)
    for name, value in theirs.items():
        assert ours[name].dtype == value.dtype
        np.testing.assert_array_equal(ours[name], value)


def assert_same_member(ours: AnyMember, theirs: AnyMember) -> None:
    assert_same_arrays(ours.weights, theirs.weights)
    assert set(ours.moments) == set(theirs.moments)
    for name, value in theirs.moments.items():
        assert_same_arrays(ours.moments[name], value)
    assert ours.rng.bit_generator.state == theirs.rng.bit_generator.state
    skipped = ("weights", "moments", "rng", "member_id")
    for name in type(theirs).__dataclass_fields__:
        if name not in skipped:
            assert getattr(ours, name) == getattr(theirs, name), name


@pytest.mark.parametrize("shared", [{}, {"use_kl_loss": True, "normalize_observations": True, "vf_share_layers": True}])
def test_a_member_that_was_saved_goes_on_as_if_it_had_not_been(tmp_path: Path, shared: dict[str, Any]) -> None:
    from policies.packed.state import load_member, save_member

    stack = make_stack("CartPole-v1", **shared)
    add(stack, "a", 5, **{**WATCHED, **shared})
    add(stack, "b", 6, **shared)
    for _ in range(2):
        stack.train_iteration()
    before = stack.remove("a")
    assert before.num_optimizer_steps == before.num_updates == 32
    assert set(before.moments) == {"exp_avg", "exp_avg_sq"}
    save_member(before, tmp_path / "packed")
    loaded = cast("PPOMember", load_member(tmp_path / "packed", "a"))
    assert_same_member(loaded, before)
    ends = []
    for member in (before, loaded):
        again = make_stack("CartPole-v1", **shared)
        add(again, "a", 9, member)
        for _ in range(2):
            again.train_iteration()
        ends.append(again.member("a"))
        again.envs.close()
    assert ends[0].num_iterations == 4
    assert_same_member(*ends)
    stack.envs.close()


LR = 3e-3
Saved = tuple[Path, TrialTask, PortablePolicy]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, ray_session: None) -> Saved:
    """(a checkpoint of a trial of the packed engine, its task, its policy)."""
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine()
    task = make_task(
        tmp_path_factory.mktemp("sweep"), lr=LR, lr_final=0.0, lr_decay_steps=1000, use_kl_loss=True, kl_target=1e-9,
        normalize_observations=True, activation="silu", hidden_sizes=[12],
    )  # fmt: skip
    engine.add(task, None)
    engine.add(make_task(task.sweep_place, trial_id="t0001", use_kl_loss=True, normalize_observations=True), None)
    for _ in range(3):
        engine.train_iteration()
    folder = tmp_path_factory.mktemp("checkpoints") / "000003"
    policy = engine.policy("t0000")
    save_policy(policy, folder)
    engine.save("t0000", folder)
    engine.close()
    return folder, task, policy


@pytest.fixture
def engine() -> Iterator[PackedEngine]:
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine()
    yield engine
    engine.close()


def test_a_trial_goes_on_from_its_checkpoint(checkpoint: Saved, engine: PackedEngine) -> None:
    from policies.packed.state import load_member

    folder, task, policy = checkpoint
    saved = load_member(folder / "packed", "t0000")
    engine.add(task, folder)
    (stack,) = engine._stacks.values()
    assert_same_member(stack.member("t0000"), saved)
    for layer, other in zip(engine.policy("t0000").network.layers, policy.network.layers, strict=True):
        np.testing.assert_array_equal(layer.weight, other.weight)
    stats = engine.train_iteration()["t0000"]
    assert isinstance(stats, IterationStats)
    assert stats.num_env_steps == 4 * 128
    assert stats.learner["lr"] == pytest.approx(LR * (1 - 0.512))
    assert engine.policy("t0000").training["iteration"] == 4


def test_a_checkpoint_is_an_rllib_algorithm_that_trains_on(checkpoint: Saved) -> None:
    from policies.packed.state import load_member
    from policies.packed.to_rllib import algorithm_from_checkpoint

    folder, _, policy = checkpoint
    saved = load_member(folder / "packed", "t0000")
    algorithm = algorithm_from_checkpoint(folder)
    learner = learner_of(algorithm)
    weights, moments = state_of(learner)
    assert_same_arrays(weights, saved.weights)
    steps = moments.pop("step")
    assert {float(value) for value in steps.values()} == {saved.num_optimizer_steps} == {3 * 2 * 2}
    for name, value in saved.moments.items():
        assert_same_arrays(moments[name], value)
    assert algorithm.iteration == 3
    # The penalty's weight has grown in every iteration, and does in RLlib's next.
    assert float(learner.curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.2 * 1.5**3)
    acting = {name: value.numpy() for name, value in algorithm.env_runner.module.state_dict().items()}
    assert_same_arrays(acting, {name: saved.weights[name] for name in acting})

    rows = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    with torch.no_grad():
        logits = algorithm.get_module(MODULE).forward_inference({"obs": torch.from_numpy(rows)})["action_dist_inputs"]
    actions = NetworkPolicy(policy).act(rows)
    np.testing.assert_array_equal(actions, logits.argmax(dim=-1).numpy())
    assert 0 < np.mean(actions) < 1

    result = algorithm.train()
    found = result["learners"][MODULE]
    steps = result["env_runners"]["num_env_steps_sampled_lifetime"]
    assert 4 * 128 <= steps < 4 * 128 + 4
    assert algorithm.iteration == 4
    assert found["default_optimizer_learning_rate"] == pytest.approx(LR * (1 - steps / 1000))
    assert found["curr_kl_coeff"] == pytest.approx(0.2 * 1.5**4)
    assert np.isfinite(found["total_loss"])
    assert found["mean_kl_loss"] < 0.1
    after, moments = state_of(learner)
    assert int(after["obs_count"]) == steps
    # Two passes over the 128 rows, and those that RLlib adds at the end of each chunk of an episode.
    (num_steps,) = {float(value) for value in moments["step"].values()}
    assert 12 + 4 <= num_steps <= 12 + 6
    # Not a jump, as there would be with moments that begin at 0 or with other statistics.
    assert 0 < np.abs(after["pi.weight"] - saved.weights["pi.weight"]).max() < 10 * LR
    algorithm.stop()


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-10])


def edit(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        description = json.loads(path.read_text())
        change(description)
        path.write_text(json.dumps(description))

    return damage


def without_a_weight(path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    save_file({name: value for name, value in tensors.items() if name != "weights/pi.bias"}, path)


def without_a_moment(path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    save_file({name: value for name, value in tensors.items() if name != "exp_avg/pi.bias"}, path)


def with_another_shape(path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    save_file({**tensors, "exp_avg_sq/pi.bias": np.zeros(3, np.float32)}, path)


DAMAGE: dict[str, tuple[str, Callable[[Path], object]]] = {
    "no tensors": ("state.safetensors", lambda path: path.unlink()),
    "no description": ("state.json", lambda path: path.unlink()),
    "tensors cut short": ("state.safetensors", cut_short),
    "description cut short": ("state.json", cut_short),
    "no JSON object": ("state.json", lambda path: path.write_text("[1]")),
    "no bytes": ("state.json", lambda path: path.write_bytes(b"\xff\xfe")),
    "a newer format": ("state.json", edit(lambda found: found.update(format_version=99))),
    "a format that is no number": ("state.json", edit(lambda found: found.update(format_version=None))),
    "no hyperparameters": ("state.json", edit(lambda found: found.pop("hyperparams"))),
    "an unknown hyperparameter": ("state.json", edit(lambda found: found["hyperparams"].update(warmth=1))),
    "an unknown algorithm": ("state.json", edit(lambda found: found.update(algorithm="sac"))),
    "a counter less": ("state.json", edit(lambda found: found["counters"].pop("num_updates"))),
    "a counter that is no number": ("state.json", edit(lambda found: found["counters"].update(num_env_steps="many"))),
    "a counter of nothing": ("state.json", edit(lambda found: found["counters"].update(kl_coeff=None))),
    "no counters": ("state.json", edit(lambda found: found.update(counters=[]))),
    "another generator": ("state.json", edit(lambda found: found["rng"].update(bit_generator="MT19937"))),
    "no generator": ("state.json", edit(lambda found: found.update(rng=None))),
    "a weight less": ("state.safetensors", without_a_weight),
    "a moment less": ("state.safetensors", without_a_moment),
    "another shape": ("state.safetensors", with_another_shape),
    "another seed": ("state.json", edit(lambda found: found.update(seed=1))),
    "other hyperparameters": ("state.json", edit(lambda found: found["hyperparams"].update(gamma=0.5))),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_state_is_refused(checkpoint: Saved, engine: PackedEngine, tmp_path: Path, kind: str) -> None:
    folder, task, _ = checkpoint
    copied = tmp_path / folder.name
    shutil.copytree(folder, copied)
    name, damage = DAMAGE[kind]
    damage(copied / "packed" / name)
    with pytest.raises(CheckpointError) as raised:
        engine.add(task, copied)
    assert raised.value.hint
    # Nothing is left of it, and others can come.
    assert not engine._stacks
    engine.add(task, folder)
    assert set(engine.train_iteration()) == {"t0000"}


def test_a_checkpoint_of_another_engine_is_refused(checkpoint: Saved, engine: PackedEngine, tmp_path: Path) -> None:
    _, task, policy = checkpoint
    save_policy(policy, tmp_path / "000001")
    with pytest.raises(CheckpointError, match="the packed engine did not write it"):
        engine.add(task, tmp_path / "000001")
