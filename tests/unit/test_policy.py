from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray
from policy_factory import IMAGES, make_image_policy, make_policy, make_portable, register_test_envs

from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy, RandomPolicy
from policies.activations import ACTIVATIONS
from policies.errors import NonFiniteWeightsError, ObservationError, TuneJobsError
from policies.portable.file import ActionTransform, save_policy
from policies.portable.network import PolicyNetwork
from tests.narrowing import present
from tests.rounding import assert_rounded, dense

register_test_envs()
ENVS = ["CartPole-v1", "Pendulum-v1", "TestPushes-v0", "TestWalk-v0", "MountainCarContinuous-v0"]


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_network_computes_what_torch_computes(activation: str) -> None:
    torch = pytest.importorskip("torch")
    policy = make_policy("CartPole-v1", hidden=(48, 24), activation=activation)
    kinds = {
        "linear": "Identity",
        "relu": "ReLU",
        "tanh": "Tanh",
        "silu": "SiLU",
        "elu": "ELU",
        "gelu": "GELU",
    }
    modules = []
    for layer in policy.portable.network.layers:
        linear = torch.nn.Linear(*layer.weight.shape[::-1])
        linear.weight.data, linear.bias.data = torch.from_numpy(layer.weight), torch.from_numpy(layer.bias)
        linear.double()
        modules += [linear, getattr(torch.nn, kinds[layer.activation])()]
    scale = np.array([1, 1, 10, 300])[np.arange(1000) % 4, None]  # far into the flat ends too
    observations = (np.random.default_rng(0).normal(size=(1000, 4)) * scale).astype(np.float32)
    with torch.no_grad():
        expected = torch.nn.Sequential(*modules)(torch.from_numpy(observations).double()).numpy()
    with np.errstate(all="raise", under="ignore"):
        outputs = policy.outputs(observations)
    assert outputs.dtype == np.float32
    sizes, num_roundings = dense(policy.portable.network.layers, observations)
    assert_rounded(outputs, expected, sizes=sizes, num_roundings=num_roundings)
    np.testing.assert_array_equal(policy.act(observations), outputs.argmax(axis=1))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_convolutions_compute_what_torch_computes(activation: str, normalize: bool) -> None:
    torch = pytest.importorskip("torch")
    portable = make_image_policy(activation, normalize=normalize)
    network = portable.network
    function = {"linear": torch.nn.Identity(), "gelu": torch.nn.GELU()}.get(activation)
    function = function or getattr(torch.nn.functional, activation, None) or getattr(torch, activation)
    images = np.random.default_rng(0).integers(0, 256, (1000, *IMAGES.shape), dtype=np.uint8)
    # Around 0, so that each action is the best one somewhere.
    network.layers[-1].bias[:] -= NetworkPolicy(portable).outputs(images).mean(axis=0)
    x = torch.from_numpy(images).double() / 255
    if normalize:
        mean, std = (torch.from_numpy(getattr(network.normalization, name)) for name in ("mean", "std"))
        # Terms of up to (1 + 1) / std are subtracted.
        sizes = 2 / std.expand(x.shape).double()
        x = ((x - mean) / std).clamp(-4, 4)
        assert (x.abs() == 4).any()
    else:
        sizes = x
    x, sizes, num_roundings = x.permute(0, 3, 1, 2), sizes.permute(0, 3, 1, 2), 4
    for layer in network.conv:
        weight, bias = torch.from_numpy(layer.weight).double(), torch.from_numpy(layer.bias).double()
        x = function(torch.nn.functional.conv2d(x, weight, bias, stride=layer.stride))
        sizes = torch.nn.functional.conv2d(sizes, weight.abs(), bias.abs(), stride=layer.stride)
        num_roundings = math.ceil(1.13 * num_roundings) + weight[0].numel() + 9
    x, (sizes, others) = x.flatten(1), dense(network.layers, sizes.flatten(1))
    for dense_layer in network.layers:
        weight, bias = (torch.from_numpy(part).double() for part in (dense_layer.weight, dense_layer.bias))
        x = torch.nn.functional.linear(x, weight, bias)
        x = x if dense_layer.activation == "linear" else function(x)
    policy = NetworkPolicy(portable)
    outputs = policy.outputs(images)
    assert_rounded(outputs, x, sizes=sizes, num_roundings=num_roundings + others)
    np.testing.assert_array_equal(policy.act(images), outputs.argmax(axis=1))
    assert set(cast("NDArray[Any]", policy.act(images))) == {0, 1, 2}


def test_an_action_for_an_image_does_not_depend_on_its_batch_to_the_last_bit() -> None:
    policy = NetworkPolicy(make_image_policy("tanh"))
    images = np.random.default_rng(0).integers(0, 256, (70, *IMAGES.shape), dtype=np.uint8)
    outputs = policy.outputs(images)
    for first, last in ((0, 1), (3, 40), (69, 70)):
        np.testing.assert_array_equal(policy.outputs(images[first:last]), outputs[first:last])
    assert type(policy.act(images[0])) is int
    assert cast("NDArray[Any]", policy.act(images[:0])).shape == (0,)
    with pytest.raises(ObservationError, match=r"shape \(13, 10, 2\)"):
        policy.act(images[0, :, :, 0])


@pytest.mark.parametrize("env_id", ENVS)
@pytest.mark.parametrize("kind", [NetworkPolicy, RandomPolicy])
def test_one_observation_gives_what_the_env_takes(env_id: str, kind: type[NetworkPolicy | RandomPolicy]) -> None:
    env = gym.make(env_id)
    policy = make_policy(env_id) if kind is NetworkPolicy else RandomPolicy.for_env(env_id)
    observation, _ = env.reset(seed=0)
    action = policy.act(observation)
    if isinstance(env.action_space, gym.spaces.Discrete):
        assert type(action) is int
    else:
        assert cast("NDArray[Any]", action).shape == env.action_space.shape
        assert cast("NDArray[Any]", action).dtype == env.action_space.dtype
    assert env.action_space.contains(action)
    env.step(action)
    actions = policy.act(np.stack([observation] * 5))
    assert cast("NDArray[Any]", actions).shape == (5, *present(env.action_space.shape))
    assert cast("NDArray[Any]", policy.act(np.zeros((0, len(observation))))).shape == (
        0,
        *present(env.action_space.shape),
    )
    assert policy.act(observation.tolist()) is not None


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(64, 64), (300, 7)])
def test_an_action_does_not_depend_on_its_batch_to_the_last_bit(activation: str, hidden: tuple[int, int]) -> None:
    policy = make_policy("Pendulum-v1", hidden=hidden, activation=activation)
    observations = np.random.default_rng(1).normal(size=(37, 3)).astype(np.float32)
    batch = policy.act(observations)
    for first in range(0, 37, 5):
        np.testing.assert_array_equal(
            policy.act(observations[first : first + 5]), cast("NDArray[Any]", batch)[first : first + 5]
        )
    for observation, action in zip(observations, cast("NDArray[Any]", batch), strict=True):
        np.testing.assert_array_equal(policy.act(observation), action)


def test_discrete_actions_start_where_their_space_does() -> None:
    policy = make_policy("TestWalk-v0", seed=3)
    observations = np.random.default_rng(0).normal(size=(200, 2))
    assert set(cast("NDArray[Any]", policy.act(observations)).tolist()) == {3, 4}
    np.testing.assert_array_equal(policy.act(observations), policy.outputs(observations).argmax(axis=1) + 3)


def test_q_values_act_by_the_largest() -> None:
    policy = make_policy("CartPole-v1", algorithm="dqn")
    assert policy.portable.network.kind == "q_values"
    observations = np.random.default_rng(0).normal(size=(50, 4))
    np.testing.assert_array_equal(policy.act(observations), policy.outputs(observations).argmax(axis=1))


def _gaussian(env_id: str, transform: ActionTransform) -> tuple[NDArray[np.float32], int | NDArray[Any]]:
    policy = NetworkPolicy(dataclasses.replace(make_portable(env_id, seed=5), action_transform=transform))
    observations = 3 * np.random.default_rng(0).normal(size=(300, present(policy.observation_space.shape)[0]))
    size = present(policy.action_space.shape)[0]
    return policy.outputs(observations)[:, :size], policy.act(observations)


def test_bounded_actions_are_stretched_over_the_bounds_and_clipped() -> None:
    mean, actions = _gaussian("Pendulum-v1", "unsquash")
    assert (np.abs(mean) > 1).any()
    # Stretched in float32: the mean plus 1, times 4, less 2; of sizes that add up to 8 before it is clipped.
    assert_rounded(actions, np.clip(2 * mean.astype(np.float64), -2, 2), sizes=8, num_roundings=4)
    low, high = np.full(1, -2, np.float32), np.full(1, 2, np.float32)
    np.testing.assert_array_equal(actions, np.clip(low + (mean + 1.0) * (high - low) / 2.0, low, high))


def test_components_act_by_their_own_bounds() -> None:
    mean, actions = _gaussian("TestPushes-v0", "by_component")
    assert (np.abs(mean[:, 0]) > 1).any()
    stretched = np.clip(-1 + (mean[:, 0] + 1) * 2 / 2, -1, 1)
    np.testing.assert_array_equal(actions, np.stack([stretched, mean[:, 1]], axis=1))


def test_older_files_say_unsquash_of_boxes_with_an_open_bound() -> None:
    """Their policies were trained on actions as they are: none is stretched, but none leaves its bounds."""
    policy = make_portable("TestPushes-v0", seed=5)
    bounds = {"low": [-0.1, "-inf"], "high": ["inf", "inf"]}
    old = dataclasses.replace(policy, action_space={**policy.action_space, **bounds}, action_transform="unsquash")
    acting = NetworkPolicy(old)
    observations = 9 * np.random.default_rng(0).normal(size=(300, present(acting.observation_space.shape)[0]))
    mean = acting.outputs(observations)[:, :2]
    assert (mean[:, 0] < -0.1).any()
    np.testing.assert_array_equal(acting.act(observations), np.maximum(mean, np.array([[-0.1, -np.inf]], np.float32)))


def test_clipping_keeps_each_bound() -> None:
    mean, actions = _gaussian("TestPushes-v0", "clip")
    assert (np.abs(mean[:, 0]) > 1).any()
    np.testing.assert_array_equal(actions, np.stack([np.clip(mean[:, 0], -1, 1), mean[:, 1]], axis=1))
    mean, actions = _gaussian("Pendulum-v1", "none")
    np.testing.assert_array_equal(actions, mean)


@pytest.mark.parametrize("shape", [(), (3,), (5,), (2, 3), (1, 2, 4)])
def test_observations_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ObservationError, match=r"shape \(4,\)"):
        make_policy("CartPole-v1").act(np.zeros(shape))


def test_observations_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(ObservationError, match="must be numbers"):
        make_policy("CartPole-v1").act(["a", "b", "c", "d"])
    with pytest.raises(ObservationError):
        make_policy("CartPole-v1").act([[1, 2, 3, 4], [1, 2]])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite_are_named(value: float) -> None:
    portable = make_portable("CartPole-v1")
    NetworkPolicy(portable).check_finite()
    portable.network.layers[1].bias[3] = value
    with pytest.raises(NonFiniteWeightsError, match=r"1 weights .* in layer 1") as caught:
        NetworkPolicy(portable).check_finite()
    assert pickle.loads(pickle.dumps(caught.value)).message == caught.value.message
    # Not the learning rate alone: sums of large rewards are infinite in 32 bits.
    assert "scale rewards and observations down" in caught.value.hint


@pytest.mark.parametrize(
    ("place", "change"),
    [
        ("convolution 1", lambda network: network.conv[1].weight),
        ("convolution 0", lambda network: network.conv[0].bias),
        ("the observation statistics", lambda network: network.normalization.mean),
        ("the observation statistics", lambda network: network.normalization.std),
    ],
)
def test_all_parts_are_checked_for_numbers_that_are_not_finite(
    place: str, change: Callable[[PolicyNetwork], NDArray[np.float32]]
) -> None:
    policy = NetworkPolicy(make_image_policy())
    policy.check_finite()
    change(policy.portable.network).flat[0] = np.nan
    with pytest.raises(NonFiniteWeightsError, match=f"1 weights .* in {place}"):
        policy.check_finite()


def test_random_actions_follow_the_seed_alone() -> None:
    one, two = RandomPolicy.for_env("Pendulum-v1", seed=4), RandomPolicy.for_env("Pendulum-v1", seed=5)
    observations = np.zeros((20, 3))
    first = one.act(observations)
    assert not np.array_equal(first, two.act(observations))
    two.reset(4)
    np.testing.assert_array_equal(first, two.act(observations))
    assert not np.array_equal(first, one.act(observations))


def test_random_actions_are_uniform_and_of_another_stream_than_the_env() -> None:
    policy = RandomPolicy.for_env("CartPole-v1", seed=7)
    actions = policy.act(np.zeros((4000, 4)))
    assert abs(cast("NDArray[Any]", actions).mean() - 0.5) < 0.05
    space: gym.spaces.Discrete[Any] = gym.spaces.Discrete(2, seed=7)  # as env.reset(seed=7) seeds the env's generator
    assert [space.sample() for _ in range(50)] != cast("NDArray[Any]", actions)[:50].tolist()


def test_a_random_policy_leaves_the_env_s_own_generator_alone() -> None:
    env = gym.make("CartPole-v1")
    env.action_space.seed(1)
    expected = [env.action_space.sample() for _ in range(20)]
    env.action_space.seed(1)
    RandomPolicy(env.observation_space, env.action_space, env_id="CartPole-v1").act(np.zeros((9, 4)))
    assert [env.action_space.sample() for _ in range(20)] == expected


def test_random_actions_of_another_kind_are_refused() -> None:
    with pytest.raises(TuneJobsError, match="MultiDiscrete"):
        RandomPolicy(gym.spaces.Box(-1, 1, (2,)), gym.spaces.MultiDiscrete([2, 2]), env_id="x")


@pytest.mark.parametrize("env_id", ENVS)
def test_a_loaded_policy_acts_as_the_saved_one(env_id: str, tmp_path: Path) -> None:
    policy = make_policy(env_id, activation="gelu")
    save_policy(policy.portable, tmp_path)
    loaded = load_policy(str(tmp_path))
    assert (loaded.env_id, loaded.env_args, loaded.description) == (env_id, {}, f"PPO on {env_id}")
    observations = np.random.default_rng(0).normal(size=(40, present(policy.observation_space.shape)[0]))
    np.testing.assert_array_equal(loaded.act(observations), policy.act(observations))
