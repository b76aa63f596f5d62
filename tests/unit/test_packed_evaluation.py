from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
from policy_factory import balancing_policy, make_policy, make_portable, register_test_envs

import policies.packed.evaluation
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import NetworkPolicy, Policy, RandomPolicy
from policies.activations import ACTIVATIONS
from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from policies.errors import EnvError, NonFiniteWeightsError
from policies.packed.evaluation import evaluate_many
from policies.portable.file import Layer, Normalization
from policies.portable.forward import ForwardPass, ForwardPasses

register_test_envs()


@pytest.fixture(autouse=True)
def own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules of these tests are allowed, and are not any more when they are over."""
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["odd_envs", "policy_factory"])


def assert_as_alone(
    policies: Sequence[Policy],
    *,
    env_id: str = "CartPole-v1",
    env_args: dict[str, Any] | None = None,
    seeds: range | Sequence[int] = range(12),
    cap: int | None = None,
) -> list[Episodes]:
    with Evaluator(env_id, env_args, seeds, max_episode_steps=cap) as evaluator:
        expected = [evaluator.run(policy) for policy in policies]
        assert evaluate_many(evaluator, policies) == expected
        assert [evaluator.run(policy) for policy in policies] == expected  # and it is as it was before
    return expected


def with_network(policy: NetworkPolicy, **changes: Any) -> NetworkPolicy:
    network = dataclasses.replace(policy.portable.network, **changes)
    return NetworkPolicy(dataclasses.replace(policy.portable, network=network))


def deep(skill: str, activation: str = "relu", hidden: tuple[int, ...] = (8, 8)) -> NetworkPolicy:
    """A balancing policy with hidden layers, so that episodes are of all lengths; its numbers are random besides."""
    linear = balancing_policy("CartPole-v1", skill).portable
    weight = linear.network.layers[0].weight
    rng = np.random.default_rng(len(skill))
    sizes = (4, *hidden)
    layers = []
    for num_in, num_out in itertools.pairwise(sizes):
        weight_here = 0.02 * rng.normal(size=(num_out, num_in)).astype(np.float32)
        layers.append(Layer(weight_here, np.zeros(num_out, np.float32), activation))
    layers[0].weight[:2] += np.array([weight[1], -weight[1]])
    for layer in layers[1:]:
        layer.weight[:2, :2] += np.eye(2, dtype=np.float32)
    last = 0.02 * rng.normal(size=(2, hidden[-1])).astype(np.float32)
    last[1, :2] += np.array([1, -1], np.float32)
    network = dataclasses.replace(linear.network, layers=(*layers, Layer(last, np.zeros(2, np.float32))))
    return NetworkPolicy(dataclasses.replace(linear, network=network))


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("counts", [(20, 20, 20), (1, 1, 1), (7, 1, 40), (3, 0, 5)])
def test_networks_give_the_outputs_that_they_give_alone_to_the_last_bit(
    activation: str, counts: tuple[int, int, int]
) -> None:
    some = [make_policy("CartPole-v1", activation=activation, seed=seed, hidden=(64, 50)) for seed in range(4)]
    normal = Normalization(np.ones(4, np.float32), np.full(4, 0.7, np.float32), 2.0)
    some[1:3] = [with_network(policy, normalization=normal, scale=0.9) for policy in some[1:3]]
    observations = np.random.default_rng(0).normal(size=(sum(counts), 4)).astype(np.float32)
    passes = ForwardPasses([ForwardPass(policy.portable.network) for policy in some]).choose([1, 2, 3])
    outputs = passes(observations, counts)
    parts = np.split(observations, np.cumsum(counts)[:-1])
    expected = [policy.outputs(part) for policy, part in zip(some[1:], parts, strict=True)]
    np.testing.assert_array_equal(outputs, np.concatenate(expected))


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_policies_have_the_episodes_that_they_have_alone(activation: str) -> None:
    random = [make_policy("CartPole-v1", activation=activation, seed=seed, hidden=(19, 33)) for seed in range(6)]
    skilled = [deep(skill, activation, hidden=(19, 33)) for skill in ("good", "fair", "poor")]
    results = assert_as_alone([*random, *skilled])
    assert len({length for result in results for length in result.lengths}) > 20


def test_policies_of_many_shapes_and_kinds_side_by_side() -> None:
    mean, std = np.array([0.1, -0.2, 0.01, 0.3], np.float32), np.array([1.3, 0.7, 0.1, 1.1], np.float32)
    normal = Normalization(mean, std, 1.5)
    policies = [
        make_policy("CartPole-v1", hidden=(64, 64), seed=1),
        deep("fair", hidden=(64, 64)),
        make_policy("CartPole-v1", hidden=(32,), algorithm="dqn", activation="relu", seed=2),
        balancing_policy("CartPole-v0", "poor"),
        make_policy("CartPole-v1", hidden=(64, 64), seed=3),
        balancing_policy("CartPole-v1", "wobbly"),
        make_policy("CartPole-v1", hidden=(32,), seed=4),
        with_network(make_policy("CartPole-v1", hidden=(32,), seed=5), normalization=normal),
        with_network(make_policy("CartPole-v1", hidden=(32,), seed=6), normalization=normal, scale=0.3),
        with_network(
            make_policy("CartPole-v1", hidden=(32,), seed=7), normalization=Normalization(mean, 2 * std, 0.4), scale=1.7
        ),
        with_network(make_policy("CartPole-v1", hidden=(32,), seed=8), scale=2.5),
        RandomPolicy.for_env("CartPole-v1", seed=3),
    ]
    assert_as_alone(policies)
    assert_as_alone(policies[::-1], seeds=[5])
    assert_as_alone(policies[:1])


def test_a_class_of_somebody_s_own_acts_as_it_does() -> None:
    class Contrary(NetworkPolicy):
        def act(self, observations: Any, mask: Any = None) -> Any:
            return 1 - super().act(observations, mask)

    policies = [Contrary(deep("good").portable), deep("good")]
    contrary, good = assert_as_alone(policies)
    assert contrary.mean_return < 20 < good.mean_return


@pytest.mark.parametrize(
    ("env_args", "cap"),
    [
        (None, 30),
        ({"max_episode_steps": 40}, None),
        ({"max_episode_steps": 40}, 60),
        ({"sutton_barto_reward": True}, 90),
    ],
)
def test_caps_limits_and_other_rewards(env_args: dict[str, Any], cap: int | None) -> None:
    policies = [deep(skill) for skill in ("good", "fair", "poor")]
    results = assert_as_alone(policies, env_args=env_args, cap=cap)
    assert max(results[0].lengths) == (cap if cap is not None and cap != 60 else 40)
    assert min(results[2].lengths) < 40


def test_more_episodes_than_are_played_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policies.packed.evaluation, "_MAX_ROWS", 25)
    some = [deep(skill, hidden=hidden) for hidden in ((8, 8), (9,)) for skill in ("good", "wobbly", "poor")]
    assert_as_alone(some, cap=120)
    assert_as_alone(some[:3], seeds=range(40), cap=50)


def test_weights_that_are_not_finite_come_back_as_the_error() -> None:
    broken = [make_portable("CartPole-v1", seed=seed) for seed in (1, 2)]
    broken[0].network.layers[0].weight[0, 0] = np.nan
    broken[1].network.layers[1].bias[0] = np.inf
    others = [make_policy("CartPole-v1", seed=3), deep("poor")]
    with Evaluator("CartPole-v1", None, range(6)) as evaluator:
        results = evaluate_many(evaluator, [NetworkPolicy(broken[0]), others[0], NetworkPolicy(broken[1]), others[1]])
        assert [results[1], results[3]] == [evaluator.run(policy) for policy in others]
    assert all(isinstance(result, NonFiniteWeightsError) for result in (results[0], results[2]))
    assert "layer 0" in str(results[0])
    assert "layer 1" in str(results[2])


def test_a_policy_for_another_env_comes_back_as_the_error() -> None:
    with Evaluator("CartPole-v1", None, range(3)) as evaluator:
        wrong, right = evaluate_many(evaluator, [make_policy("Acrobot-v1"), deep("poor")])
        assert right == evaluator.run(deep("poor"))
    with pytest.raises(EnvError, match="is for Acrobot-v1, whose observations"):
        raise cast("Exception", wrong)


def test_other_envs_are_played_one_policy_after_the_other() -> None:
    policies = [make_policy("Pendulum-v1", seed=seed) for seed in range(3)]
    assert_as_alone(policies, env_id="Pendulum-v1", seeds=range(2), cap=20)
    assert_as_alone([make_policy("TestWalk-v0", seed=1)], env_id="TestWalk-v0", env_args={"end": 1.0}, cap=50)


def test_an_env_that_raises_fails_the_policies_it_raises_at() -> None:
    with Evaluator("TestWalk-v0", {"fail_at": 3}, [5, 6]) as evaluator:
        results = evaluate_many(evaluator, [make_policy("TestWalk-v0", seed=seed) for seed in (1, 2)])
    assert all(isinstance(result, EnvError) for result in results)
    assert "the motor broke" in str(results[0])


def test_no_policies_have_no_episodes() -> None:
    with Evaluator("CartPole-v1", None, [1]) as evaluator:
        assert evaluate_many(evaluator, []) == []
