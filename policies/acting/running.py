"""Episodes that are being played in scalar environments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.checked import check_observation, check_reward, is_sound, reward_as_number
from policies.envs.copies import Stepper
from policies.envs.faults import env_failed
from policies.errors import EnvFailedError


class Running:
    """An episode that is being played in a scalar environment."""

    def __init__(self, env: gym.Env[Any, Any], index: int, seed: int) -> None:
        self.env, self.index, self.seed = env, index, seed
        self.length = 0
        self.total = 0.0
        self.has_terminated = False
        self.copy: Any = None
        self._space = env.observation_space
        try:
            observation, _ = env.reset(seed=seed)
        except BaseException as error:  # an env may raise anything
            raise self.failed("reset", error) from error
        self.observation = self._as_numbers(observation)
        check_observation(self.observation, self._env_id, 0, self._space)

    def step(self, action: Any) -> bool:
        """Step once and return whether the episode has ended."""
        # As RLlib sends it: NumPy scalars for Discrete actions fail `isinstance(action, int)` in some envs.
        if isinstance(action, np.generic):
            action = action.item()
        try:
            observation, reward, terminated, truncated, _ = self.env.step(action)
            self.length += 1
            reward = reward_as_number(reward)
        except BaseException as error:  # an env may raise anything
            raise self.failed("step", error) from error
        self.take(observation, reward)
        self.has_terminated = bool(terminated)
        return bool(terminated or truncated)

    def take(self, observation: Any, reward: float) -> None:
        """Take what a step has given."""
        self.total += reward
        self.observation = self._as_numbers(observation)
        if not (math.isfinite(reward) and is_sound(self.observation)):
            check_reward(reward, self._env_id, self.length)
            check_observation(self.observation, self._env_id, self.length, self._space)

    def _as_numbers(self, observation: Any) -> NDArray[Any]:
        """Return an observation as an array, not copied.

        Raises:
            EnvFailedError: It is something other than numbers of the space's shape.
        """
        try:
            array = np.asarray(observation)
        except Exception:  # noqa: BLE001 (ragged lists, say)
            array = np.empty(0, dtype=object)
        if array.dtype.kind in "biuf" and array.shape == self._space.shape:
            return array
        method = "step" if self.length else "reset"
        which = f"after env step {self.length}" if self.length else "from reset(), at the beginning"
        what = "None" if observation is None else f"of shape {array.shape} and dtype {array.dtype}"
        raise EnvFailedError(
            f"The observation {which} of the episode of {self._env_id} with seed {self.seed} was {what}, not numbers "
            f"of shape {self._space.shape}.",
            f"Mend its {method}(): each observation must be of the observation space.",
        )

    @property
    def _env_id(self) -> str:
        return self.env.spec.id if self.env.spec is not None else type(self.env.unwrapped).__name__

    def failed(self, method: str, error: BaseException) -> EnvFailedError:
        """Return what to raise for an error that the environment has raised in a method."""
        return env_failed(
            f"{self._env_id} raised an error in {method}() of the episode with seed {self.seed}, after {self.length} "
            "steps",
            error,
            in_step=method == "step",
        )


def step_together(stepper: Stepper, episodes: Sequence[Running], actions: NDArray[Any]) -> list[bool]:
    """Step episodes together, as each one's `step` would, and return which of them have ended."""
    copies = []
    for episode in episodes:
        episode.copy = episode.copy or stepper.copy_of(episode.env)
        copies.append(episode.copy)
    stepped = stepper.step(copies, actions)
    ended = []
    for place, episode in enumerate(episodes):
        if (failure := stepped.failures.get(place)) is not None:
            raise episode.failed("step", failure) from failure
        episode.length += 1
        episode.take(stepped.observations[place], float(stepped.rewards[place]))
        episode.has_terminated = bool(stepped.terminated[place])
        ended.append(episode.has_terminated or episode.length == stepper.limit)
    return ended
