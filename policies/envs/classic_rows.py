"""Classic control whose copies are rows of arrays: their starts, their steps and their time limit.

A start is drawn by Gymnasium's own environment from the generator that the copy would have by itself, so that a row
plays the episodes of an environment of its own to the last bit. What is stepped is compared with that environment
where rows are made: if another version of Gymnasium steps in another way, there are none, and nothing but time is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.classic import Physics, physics_of
from policies.envs.faults import close_env
from policies.envs.make import make_env
from policies.envs.plain import is_plain

_COMPARED_STEPS = 40


class Start(NamedTuple):
    """The start of an episode."""

    state: NDArray[np.float64]
    """Shape (size of a state,)."""
    observation: NDArray[np.float32]


class RowsStep(NamedTuple):
    """What a step of all rows gives; the arrays are changed by no later step."""

    observations: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class ClassicRows:
    """Copies of an environment of classic control, whose number changes; they never reset by themselves.

    Args:
        env: The environment with its time limit; it belongs to this object from here on.
        physics: Its physics.
    """

    def __init__(self, env: gym.Env[Any, Any], physics: Physics) -> None:
        self._env, self._inner, self._physics = env, env.unwrapped, physics
        self._limit = None if env.spec is None else env.spec.max_episode_steps
        self.put(np.zeros((0, len(self.start(seed=0).state))), np.zeros(0, dtype=np.int64))

    @classmethod
    def make(cls, env_id: str, env_args: Mapping[str, Any] | None) -> ClassicRows | None:
        """Return no rows yet, or None if the env is not of classic control, is CartPole, or has wrappers.

        Raises:
            EnvError: In the same cases as `policies.envs.make.make_env`.
        """
        env = make_env(env_id, env_args)
        physics = physics_of(env.unwrapped) if is_plain(env) else None
        if physics is None or not _steps_alike(env.unwrapped, physics):
            close_env(env)
            return None
        return cls(env, physics)

    @property
    def states(self) -> NDArray[np.float64]:
        """The state of each row, shape (num, size of a state)."""
        return self._states.T

    def generator(self, seed: int) -> np.random.Generator:
        """Return the generator of an environment that is reset with this seed, before it has drawn anything."""
        return gym.utils.seeding.np_random(seed)[0]

    def start(self, generator: np.random.Generator | None = None, *, seed: int | None = None) -> Start:
        """Draw the start of an episode, from a generator or as a reset with a seed does."""
        if generator is not None:
            self._inner.np_random = generator
        observation, _ = self._inner.reset(seed=seed)
        return Start(np.array(self._physics.state()), np.array(observation, dtype=np.float32))

    def put(self, states: NDArray[np.float64], lengths: NDArray[Any]) -> None:
        """Replace the rows by others, in any number.

        Args:
            states: Their states, shape (num, size of a state).
            lengths: The steps of their running episodes, shape (num,).
        """
        self._states = np.array(states.T, dtype=np.float64, order="C")
        self.lengths = np.array(lengths, dtype=np.int64)

    def restart(self, row: int, state: NDArray[np.float64]) -> None:
        """Begin a new episode at a row."""
        self._states[:, row] = state
        self.lengths[row] = 0

    def step(self, actions: NDArray[Any]) -> RowsStep:
        """Step all rows, of which there is at least one.

        Args:
            actions: As the environment takes them, shape (num,) or (num, action_dim), within the bounds.
        """
        self._states, observations, rewards, terminated = self._physics.step(self._states, actions)
        self.lengths += 1
        truncated = self.lengths >= (np.inf if self._limit is None else self._limit)
        return RowsStep(observations, rewards, terminated, truncated)

    def close(self) -> None:
        """Close the environment."""
        close_env(self._env)


def _steps_alike(env: gym.Env[Any, Any], physics: Physics) -> bool:
    """Whether the physics takes the environment's own steps: compared from one start, with fixed actions.

    What fails, as with arguments that are none, is left to the environment itself.
    """
    try:
        return _are_equal(env, physics)
    except Exception:  # noqa: BLE001 (an env may raise anything)
        return False


def _are_equal(env: gym.Env[Any, Any], physics: Physics) -> bool:
    env.reset(seed=0)
    states = np.array(physics.state())[:, None]
    space = env.action_space
    for number in range(_COMPARED_STEPS):
        if isinstance(space, gym.spaces.Discrete):
            action: Any = number % int(space.n)
            actions = np.array([action])
        else:
            assert isinstance(space, gym.spaces.Box)
            # Through the whole range and to both bounds.
            share = np.float32(0.5 + 0.5 * np.cos(number))
            action = (space.low + share * (space.high - space.low)).astype(np.float32)
            actions = action[None]
        observation, reward, terminated, _, _ = env.step(action)
        stepped = physics.step(states, actions)
        states = stepped.states
        same = np.array_equal(stepped.observations[0], observation) and stepped.rewards[0] == reward
        if not same or stepped.terminated[0] != terminated:
            return False
    return True
