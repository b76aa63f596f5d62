"""The cases of DQN's hyperparameters in a pack: each changes training as it should, or fails.

Here those of an update, which compare two members, one with the hyperparameter changed, with RLlib's Learner, and of
the network; the others are in `packed_dqn_traces`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from packed_dqn import ROUNDING, DQNMember, Learned, add, compare, differences, make_stack, q_values_of

from policies.activations import ACTIVATIONS
from policies.packed.dqn.replay import StackedPrioritizedReplay
from tests.narrowing import present
from tests.rounding import assert_network

Case = Callable[[], object]
CASES: dict[str, Case] = {}


def arrives(*names: str) -> Callable[[Case], Case]:
    """Make a function the case of these fields."""

    def add_names(check: Case) -> Case:
        for name in names:
            assert name not in CASES
            CASES[name] = check
        return check

    return add_names


# -- of an update


def updates(shared: dict[str, Any] | None = None, **values: Any) -> tuple[Learned, Learned]:
    """Training phases of two members, the second one with these values, and as RLlib's Learner makes them."""
    shared = shared or {}
    ((plain, _), (changed, theirs)), _ = compare([shared, {**shared, **values}], seeds=[3, 3], only=[1])
    for what, value in differences(changed, present(theirs)).items():
        assert value < ROUNDING, what
    return plain, changed


def other_weights(one: Learned, another: Learned, updates_before: int = 0) -> float:
    """The largest difference of the weights after an update."""
    ours, theirs = one.weights[updates_before], another.weights[updates_before]
    return max(float(np.abs(ours[name] - theirs[name]).max()) for name in ours)


def check_update(shared: dict[str, Any] | None = None, **values: Any) -> None:
    """RLlib's update with these values is the pack's, and another one than without."""
    plain, changed = updates(shared, **values)
    assert other_weights(plain, changed) > 1e-4


def check_shared(values: dict[str, Any], shared: dict[str, Any] | None = None) -> None:
    """The same of what all members of a stack have in common."""
    ((plain, _),) = compare([shared or {}], seeds=[3], only=[])[0]
    ((changed, expected),) = compare([{**(shared or {}), **values}], seeds=[3])[0]
    assert max(differences(changed, present(expected)).values()) < ROUNDING
    assert abs(plain.losses[0] - changed.losses[0]) > 1e-4


@arrives("lr")
def check_lr() -> None:
    check_update(lr=5e-3)


@arrives("grad_clip")
def check_grad_clip() -> None:
    plain, changed = updates(grad_clip=0.3)
    norms = [np.sqrt(sum((value**2).sum() for value in one.gradients[0].values())) for one in (plain, changed)]
    assert norms[0] > 0.5
    assert norms[1] == pytest.approx(0.3, rel=1e-4)


@arrives("optimizer")
def check_optimizer() -> None:
    for name, moments in (("adam", {"exp_avg", "exp_avg_sq"}), ("rmsprop", {"square_avg"})):
        for ours, theirs in compare([{"optimizer": name}])[0]:
            assert max(differences(ours, present(theirs)).values()) < ROUNDING
            assert set(ours.moments) == moments


@arrives("optimizer_epsilon")
def check_optimizer_epsilon() -> None:
    check_update(optimizer_epsilon=0.1)
    check_update({"optimizer": "rmsprop"}, optimizer_epsilon=0.1)


@arrives("adam_beta1")
def check_adam_beta1() -> None:
    check_update(adam_beta1=0.3)


@arrives("adam_beta2")
def check_adam_beta2() -> None:
    check_update(adam_beta2=0.3)


@arrives("rmsprop_rho")
def check_rmsprop_rho() -> None:
    check_update({"optimizer": "rmsprop"}, rmsprop_rho=0.5)


@arrives("rmsprop_momentum")
def check_rmsprop_momentum() -> None:
    check_update({"optimizer": "rmsprop"}, rmsprop_momentum=0.8)


@arrives("double_q")
def check_double_q() -> None:
    check_shared({"double_q": False})


@arrives("dueling")
def check_dueling() -> None:
    check_shared({"dueling": False})


@arrives("reward_scale")
def check_reward_scale() -> None:
    check_update(reward_scale=0.1)
    # Beside one that is not scaled, and alone.
    check_update({"n_step": 2}, reward_scale=3.0)


@arrives("td_loss")
def check_td_loss() -> None:
    check_shared({"td_loss": "mse"})


@arrives("target_network")
def check_target_network() -> None:
    check_shared({"target_network": False}, {"double_q": False})


@arrives("tau")
def check_tau() -> None:
    plain, changed = updates({"tau": 0.1, "target_update_freq": 1}, tau=0.8)
    assert other_weights(plain, changed) > 1e-2


@arrives("prioritized_alpha")
def check_prioritized_alpha() -> None:
    stack = make_stack(replay="prioritized")
    for name, alpha in (("a", 0.0), ("b", 1.0)):
        add(stack, name, 0, replay="prioritized", prioritized_alpha=alpha)
    replay = stack._replay
    assert isinstance(replay, StackedPrioritizedReplay)
    slots = replay.slots(["a", "b"])
    replay.add(slots, np.zeros((2, 2, replay.num_columns), dtype=np.float32))
    replay.set_priorities(slots, np.array([[0, 1]] * 2), np.array([[1.0, 100.0]] * 2, dtype=np.float32))
    leaves = replay._priorities.leaves.reshape(2, -1)[slots, :2]
    np.testing.assert_allclose(leaves[:, 1] / leaves[:, 0], [1.0, 100.0], rtol=1e-4)
    stack.envs.close()


@arrives("prioritized_beta")
def check_prioritized_beta() -> None:
    plain, changed = updates({"replay": "prioritized", "prioritized_beta": 0.0}, prioritized_beta=1.0)
    assert all(np.ptp(present(batch.weights)) == 0 for batch in plain.batches)
    assert all(np.ptp(present(batch.weights)) > 0.01 for batch in changed.batches)


@arrives("prioritized_epsilon")
def check_prioritized_epsilon() -> None:
    stack = make_stack(replay="prioritized")
    for name, epsilon in (("a", 1e-6), ("b", 0.5)):
        add(stack, name, 0, replay="prioritized", prioritized_alpha=1.0, prioritized_epsilon=epsilon)
    replay = stack._replay
    assert isinstance(replay, StackedPrioritizedReplay)
    slots = replay.slots(["a", "b"])
    replay.add(slots, np.zeros((2, 2, replay.num_columns), dtype=np.float32))
    replay.set_priorities(slots, np.array([[0, 1]] * 2), np.array([[1.0, 0.0]] * 2, dtype=np.float32))
    leaves = replay._priorities.leaves.reshape(2, -1)[slots, :2]
    np.testing.assert_allclose(leaves[:, 1] / leaves[:, 0], [1e-6 / (1 + 1e-6), 0.5 / 1.5], rtol=1e-6)
    stack.envs.close()


# -- of the network


def check_first_q_values(**values: Any) -> DQNMember:
    """A member's first Q-values are those of RLlib's module with the seed."""
    from policies.rllib.config import build_algorithm_config

    stack = make_stack(**values)
    member = add(stack, "m", 1234, **values)
    algorithm = build_algorithm_config(member.hyperparams, env_id="CartPole-v1", seed=1234).build_algo()
    module = algorithm.learner_group._learner.module["default_policy"].unwrapped()
    assert set(module.state_dict()) == set(member.weights)
    for name, value in module.state_dict().items():
        np.testing.assert_array_equal(member.weights[name], value.numpy())
    stack._arrange()
    observations = np.random.default_rng(0).normal(size=(1, 50, 4)).astype(np.float32)
    found = stack._groups[0].act(observations)[0]
    expected = q_values_of(module, observations[0])
    # But for what all actions have in common.
    assert_network(found[:, 1] - found[:, 0], expected[:, 1] - expected[:, 0], num_terms=200)
    algorithm.stop()
    stack.envs.close()
    return member


@arrives("hidden_sizes")
def check_hidden_sizes() -> None:
    for sizes in ((7,), (12, 5, 9)):
        member = check_first_q_values(hidden_sizes=sizes)
        found = [
            value.shape[0] for name, value in member.weights.items() if name.startswith("encoder.mlp") and "w" in name
        ]
        assert tuple(found) == sizes


@arrives("activation")
def check_activation() -> None:
    for activation in ACTIVATIONS:
        check_first_q_values(activation=activation, hidden_sizes=(8, 6))


@arrives("initializer")
def check_initializer() -> None:
    found = [check_first_q_values(initializer=name) for name in ("torch", "he_uniform", "orthogonal")]
    first = [member.weights["encoder.mlp.0.weight"] for member in found]
    assert not any(np.allclose(first[index], first[index - 1]) for index in range(3))


@arrives("conv_filters")
def check_conv_filters() -> None:
    stack = make_stack("TestShades-v0")
    filters = (((5, 4, 2),), ((3, 2, 1), (4, 3, 2)))
    for index, one in enumerate(filters):
        add(stack, f"m{index}", index, conv_filters=one)
    stack.train_iteration()
    assert [len(group.members) for group in stack._groups] == [1, 1]
    for index, shapes in enumerate(([(5, 2, 4, 4)], [(3, 2, 2, 2), (4, 3, 3, 3)])):
        weights = stack.member(f"m{index}").weights
        kernels = {key: value.shape for key, value in weights.items() if key.startswith("encoder.conv")}
        assert [shape for key, shape in kernels.items() if key.endswith("weight")] == shapes
    stack.envs.close()


@arrives("normalize_observations")
def check_normalize_observations() -> None:
    check_shared({"normalize_observations": True})
