"""Small networks and environments that several test modules use."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy
from policies.envs.make import check_env
from policies.portable.file import (
    ConvLayer,
    Layer,
    ModuleWeights,
    NetworkKind,
    Normalization,
    PolicyNetwork,
    PortablePolicy,
    describe_space,
    save_policy,
)

if TYPE_CHECKING:
    from policies.hyperparams import TrainedHyperparams


def untrained_policy(
    env_id: str, env_args: Mapping[str, Any], hyperparams: TrainedHyperparams, folder: Path
) -> NetworkPolicy:
    """That of a new trial of a pack, read from its file in a folder."""
    from policies.packed.initial import new_member
    from policies.packed.portable_member import portable_policy

    info = check_env(env_id, env_args)
    spaces = info.observation_space, info.action_space
    member = new_member("t0000", hyperparams, 3, *spaces)
    save_policy(portable_policy(member, *spaces, env_id=env_id, env_args=dict(env_args), training={}), folder)
    policy = load_policy(folder)
    assert isinstance(policy, NetworkPolicy)
    return policy


def make_portable(
    env_id: str,
    hidden: Sequence[int] = (16, 16),
    activation: str = "tanh",
    seed: int = 0,
    algorithm: str = "ppo",
    **env_args: Any,
) -> PortablePolicy:
    """A network with random weights for a registered env."""
    info = check_env(env_id, env_args)
    rng = np.random.default_rng(seed)
    space = info.action_space
    discrete = isinstance(space, gym.spaces.Discrete)
    assert space.shape is not None
    assert info.observation_space.shape is not None
    num_outputs = int(space.n) if isinstance(space, gym.spaces.Discrete) else 2 * space.shape[0]
    sizes = [info.observation_space.shape[0], *hidden, num_outputs]
    layers = []
    for index, (num_in, num_out) in enumerate(itertools.pairwise(sizes)):
        weight = rng.normal(size=(num_out, num_in)) / np.sqrt(num_in)
        bias = 0.1 * rng.normal(size=num_out)
        last = index == len(sizes) - 2
        layers.append(Layer(weight.astype(np.float32), bias.astype(np.float32), "linear" if last else activation))
    kind: NetworkKind = "gaussian" if not discrete else "q_values" if algorithm == "dqn" else "categorical"
    return PortablePolicy(
        network=PolicyNetwork(kind, tuple(layers)),
        algorithm=algorithm,
        env_id=info.env_id,
        env_args=env_args,
        observation_space=describe_space(info.observation_space),
        action_space=describe_space(info.action_space),
        action_transform="none" if discrete else "unsquash",
        training={"trial_id": "t0003", "iteration": 12},
    )


def make_policy(env_id: str, **kwargs: Any) -> NetworkPolicy:
    """A random network as a policy."""
    return NetworkPolicy(make_portable(env_id, **kwargs))


IMAGES = gym.spaces.Box(0, 255, (13, 10, 2), np.uint8)
CONV = ((5, 4, 2), (3, 2, 1))
"""(channels, kernel, stride); they make 4 x 3 pixels of such an image."""


def make_image_policy(
    activation: str = "relu", seed: int = 0, *, normalize: bool = True, num_actions: int = 3
) -> PortablePolicy:
    """A convolutional network with random weights for `IMAGES`."""
    rng = np.random.default_rng(seed)

    def weights(*shape: int) -> NDArray[np.float32]:
        drawn: NDArray[np.float64] = rng.normal(size=shape) / np.sqrt(np.prod(shape[1:]))
        return drawn.astype(np.float32)

    conv, channels = [], IMAGES.shape[2]
    for out_channels, kernel, stride in CONV:
        weight = weights(out_channels, channels, kernel, kernel)
        conv.append(ConvLayer(weight, weights(out_channels, 1)[:, 0], stride, activation))
        channels = out_channels
    sizes = [4 * 3 * channels, 16, num_actions]
    layers = [
        Layer(weights(num_out, num_in), weights(num_out, 1)[:, 0], "linear" if last else activation)
        for (num_in, num_out), last in zip(itertools.pairwise(sizes), (False, True), strict=True)
    ]
    mean, std = rng.uniform(0.3, 0.7, IMAGES.shape), rng.uniform(0.05, 0.5, IMAGES.shape)
    normalization = Normalization(mean.astype(np.float32), std.astype(np.float32), 4.0)
    network = PolicyNetwork(
        "q_values",
        tuple(layers),
        conv=tuple(conv),
        normalization=normalization if normalize else None,
        scale=1 / 255,
    )
    return PortablePolicy(
        network=network,
        algorithm="dqn",
        env_id="TestImages-v0",
        env_args={},
        observation_space=describe_space(IMAGES),
        action_space=describe_space(gym.spaces.Discrete(num_actions)),
    )


def make_module_portable() -> PortablePolicy:
    """A policy whose network is a class of the user's own; nothing of that name exists."""
    tensors: dict[str, NDArray[Any]] = {
        "trunk.weight": np.arange(8, dtype=np.float32).reshape(2, 4),
        "count": np.array(3, dtype=np.int64),
    }
    base = make_portable("CartPole-v1")
    module = ModuleWeights("no_such_package.networks:Mine", {"fcnet_hiddens": [2], "rate": 0.5}, tensors)
    return dataclasses.replace(base, network=PolicyNetwork("module", (), module=module))


# Weights on CartPole's position, velocity, angle and angular velocity, and how long they keep the pole up.
PUSHES = {
    "good": (0.1, 0.5, 10.0, 2.0),  # for ever
    "fair": (-0.1, 0.0, 1.0, 0.3),  # 200 to 500 steps
    "wobbly": (0.0, 0.0, 0.0, 1.0),  # 140 to 320
    "poor": (0.0, 0.0, 1.0, 0.0),  # 24 to 68
}


def balancing_policy(env_id: str = "CartPole-v0", skill: str = "good") -> NetworkPolicy:
    """A linear CartPole policy that balances the pole more or less well."""
    weight = np.array([np.zeros(4), PUSHES[skill]], dtype=np.float32)
    base = make_portable(env_id, hidden=())
    layers = (Layer(weight, np.zeros(2, np.float32)),)
    return NetworkPolicy(
        PortablePolicy(
            network=PolicyNetwork("categorical", layers),
            algorithm="ppo",
            env_id=base.env_id,
            env_args={},
            observation_space=base.observation_space,
            action_space=base.action_space,
        )
    )


class Walk(gym.Env[Any, Any]):
    """A point on a line that is moved by its action; it ends far out, or never. Actions start at 3."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, end: float | None = None, fail_at: int | None = None, render_mode: str | None = None) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gym.spaces.Discrete(2, start=3)
        self.render_mode = render_mode
        self.end, self.fail_at, self.position, self.steps = end, fail_at, 0.0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.steps = float(self.np_random.normal()), 0
        return np.array([self.position, 1.0]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        # Not `isinstance(action, int) or np.integer`: an env may well want a plain int.
        assert isinstance(action, int), type(action)
        assert action in {3, 4}
        self.steps += 1
        if self.steps == self.fail_at:
            raise RuntimeError("the motor broke")
        self.position += 0.1 * (2 * action - 7) + 0.01 * float(self.np_random.normal())
        terminated = self.end is not None and abs(self.position) > self.end
        return np.array([self.position, 1.0]), self.position, terminated, False, {}

    def render(self) -> Any:
        frame = np.zeros((10, 15, 3), np.uint8)
        frame[:, self.steps % 15] = 255
        return frame


class NotDrawable(Walk):
    """The same without a render mode."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()


class Pushes(gym.Env[Any, Any]):
    """Continuous actions, one bounded and one not."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = gym.spaces.Box(np.array([-1.0, -np.inf], np.float32), np.array([1.0, np.inf], np.float32))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample() * 0, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.shape == (2,)
        return np.zeros(3, np.float32), float(action.sum()), True, False, {}


class Odd(gym.Env[Any, Any]):
    """Spaces of any kind, to be refused."""

    def __init__(
        self, observation_space: gym.Space[Any] | None = None, action_space: gym.Space[Any] | None = None
    ) -> None:
        self.observation_space = observation_space or gym.spaces.Box(-1, 1, (2,))
        self.action_space = action_space or gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation_space.sample(), {}


def register_test_envs() -> None:
    """Register the envs above; more than once does no harm."""
    here: dict[str, Callable[..., gym.Env[Any, Any]]] = {
        "TestWalk-v0": Walk,
        "TestNotDrawable-v0": NotDrawable,
        "TestPushes-v0": Pushes,
        "TestOdd-v0": Odd,
    }
    for env_id, entry_point in here.items():
        if env_id not in gym.registry:
            limit = 50 if env_id == "TestNotDrawable-v0" else None
            gym.register(env_id, entry_point, max_episode_steps=limit)


@contextlib.contextmanager
def registered(env_id: str, env_class: type[gym.Env[Any, Any]]) -> Iterator[None]:
    """Have a class of a test's own registered while the block lasts."""
    register: Any = gym.register
    register(env_id, env_class)
    yield
    del gym.registry[env_id]
