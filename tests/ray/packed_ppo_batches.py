"""The cases of PPO's hyperparameters that say what a batch is, and how it is gone through: see `packed_ppo_cases`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from packed_ppo_cases import arrives, assert_other_gradients, updates
from packed_rllib import ROWS, make_stack, sample

from policies.packed.ppo.loss import Minibatch

if TYPE_CHECKING:
    from policies.packed.ppo.stack import Fragment, PPOStack


@arrives
def check_normalize_rewards() -> None:
    plain, changed, sampled = updates(normalize_rewards=True)
    assert_other_gradients(plain, changed)
    first, second = sampled.fragment.rewards[:, :4], sampled.fragment.rewards[:, 4:]
    np.testing.assert_array_equal(first, np.ones_like(first))
    np.testing.assert_array_equal(second, np.full_like(second, second[0, 0]))
    assert second[0, 0] < 0.5
    np.testing.assert_array_equal(sampled.fragment.own_rewards, np.ones_like(sampled.fragment.rewards))


@arrives
def check_normalize_advantages() -> None:
    plain, changed, sampled = updates(normalize_advantages=False)
    assert_other_gradients(plain, changed)
    ((_, batch),) = sampled.groups
    # Both members have the same seed, and so the same rows.
    standardised, raw = batch.advantages
    assert abs(standardised.mean()) < 1e-5
    assert abs(standardised.std() - 1.0) < 1e-5
    assert raw.std() > 1.5
    np.testing.assert_allclose(standardised, (raw - raw.mean()) / raw.std(), rtol=1e-4, atol=1e-5)


def targets_by_definition(
    values: Sequence[float], fragment: Fragment, row: int, gamma: float, gae_lambda: float
) -> list[float]:
    """Value targets of a row, from the formula: only for rows of terminated episodes and the fragment's end."""
    targets: list[float] = []
    advantage = 0.0
    for step in reversed(range(len(values) - 1)):
        ended = fragment.ended[step, row]
        following = 0.0 if ended else values[step + 1]
        advantage = (
            fragment.rewards[step, row]
            + gamma * following
            - values[step]
            + (0.0 if ended else gamma * gae_lambda * advantage)
        )
        targets.insert(0, advantage + values[step])
    return targets


def check_targets(**values: Any) -> None:
    stack = make_stack("CartPole-v1", [{"gamma": 0.5, "gae_lambda": 0.5}, values])
    sampled = sample(stack)
    ((group, batch),) = sampled.groups
    value, _ = stack._values(group, sampled.fragment, batch.observations, 0, 2)
    last = stack._evaluate(group, stack._observations, sampled.fragment.last.reshape(2, 4, 4))
    hyperparams = stack.members[1].hyperparams
    assert not sampled.fragment.cuts
    for place in range(4):
        own = [*value[:, 4 + place], last[1, place]]
        expected = targets_by_definition(own, sampled.fragment, 4 + place, hyperparams.gamma, hyperparams.gae_lambda)
        np.testing.assert_allclose(batch.value_targets[1].reshape(-1, 4)[:, place], expected, rtol=1e-4)
    stack.envs.close()


@arrives
def check_gamma() -> None:
    for gamma in (0.0, 0.3, 1.0):
        check_targets(gamma=gamma)


@arrives
def check_gae_lambda() -> None:
    for gae_lambda in (0.0, 0.3, 1.0):
        check_targets(gae_lambda=gae_lambda)


def rows_of_updates(**values: Any) -> tuple[PPOStack, list[NDArray[np.float32]], NDArray[np.float32]]:
    """(stack, the advantages of each update's rows of the second member, all advantages) of an iteration."""
    stack = make_stack("CartPole-v1", [values, values])
    sampled = sample(stack)
    ((group, batch),) = sampled.groups
    update, seen = group._update, []

    def reading(outputs: torch.Tensor, value: torch.Tensor, minibatch: Minibatch) -> torch.Tensor | None:
        seen.append(minibatch.advantages[1].numpy().copy())
        return update(outputs, value, minibatch)

    group._update = reading  # type: ignore[method-assign, assignment]
    group.learn(batch)
    group.finish()
    stack.envs.close()
    return stack, seen, batch.advantages[1]


@arrives
def check_minibatch_size() -> None:
    _, seen, rows = rows_of_updates(minibatch_size=16)
    assert [len(found) for found in seen] == [16] * 4
    # A pass is over every row once.
    np.testing.assert_array_equal(np.sort(np.concatenate(seen)), np.sort(rows))
    assert not np.array_equal(np.concatenate(seen), rows)
    # The last one is filled up with rows of a further pass.
    _, seen, _ = rows_of_updates(minibatch_size=40)
    assert [len(found) for found in seen] == [40] * 2


@arrives
def check_num_epochs() -> None:
    stack, seen, rows = rows_of_updates(minibatch_size=32, num_epochs=3)
    assert stack.members[1].num_updates == len(seen) == 6
    orders = [np.concatenate(seen[start : start + 2]) for start in (0, 2, 4)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.sort(rows))
    assert not np.array_equal(orders[0], orders[1])


@arrives
def check_train_batch_size() -> None:
    for size, steps in ((96, 96), (97, 100)):
        stack = make_stack("CartPole-v1", [{"train_batch_size": size}, {"train_batch_size": size}])
        assert [stats.num_env_steps for stats in stack.train_iteration().values()] == [steps] * 2
        # All sub-environments step together.
        assert stack.train_iteration()["m1"].num_env_steps == 2 * steps
        stack.envs.close()


@arrives
def check_num_envs() -> None:
    stack = make_stack("CartPole-v1", [{"num_envs": 16}, {"num_envs": 16}])
    fragment = sample(stack).fragment
    assert fragment.rewards.shape == (ROWS // 16, 2 * 16)
    # Each from a start of its own.
    assert len(np.unique(fragment.observations[0], axis=0)) == 32
    stack.envs.close()
