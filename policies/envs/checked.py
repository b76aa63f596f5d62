"""Refuse NaN and infinite rewards and observations where an environment returns them.

A NaN or an infinite number in a reward or an observation ruins the weights that are trained on it, many steps later
and far away. A space with infinite bounds allows any number, but neither of these.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.byte_images import as_bytes
from policies.envs.faults import close_env, env_failed
from policies.envs.masks import num_masked, seen_by_networks
from policies.envs.stacked import WithMembers
from policies.envs.tallies import only_tally
from policies.errors import EnvError, EnvFailedError

_LARGEST = float(np.finfo(np.float32).max)
"""The largest number of 32 bits; training computes in 32 bits, where anything larger is infinite."""
_LARGEST_32 = np.finfo(np.float32).max
"""The same number as a NumPy scalar of 32 bits; numbers of 16 bits would be compared with infinity otherwise."""
_MEND_VECTORISED = "Mend its vector_entry_point, or register the env without one."
_HINT = "Mend the env: training on it would ruin the weights."


def is_sound(values: NDArray[Any]) -> bool:
    """Whether all numbers are finite, in 32 bits too."""
    # Comparisons with NaN are false.
    return values.dtype == np.uint8 or bool((np.abs(values) <= _LARGEST_32).all())


def reward_as_number(reward: Any) -> float:
    """Return a reward as a float; arrays and lists of any shape may hold it, if they hold a single number.

    Raises:
        TypeError: The reward is not a number.
        ValueError: There are several numbers, or none.
    """
    if isinstance(reward, np.ndarray | list | tuple):
        # From NumPy 2.4 on, float() takes arrays only if they have no dimensions.
        reward = np.asarray(reward).item()
    return float(reward)


class PlainSteps(gym.Wrapper[Any, Any, Any, Any]):
    """Wraps a sub-environment of a vector: its actions and rewards are plain numbers, and its infos are empty.

    Nothing here reads infos, but Gymnasium makes arrays of them, and fails where two environments' infos differ in type
    or shape, or where a number has more than 64 bits.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment."""
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        # Gymnasium takes them from an array, and NumPy's scalars fail `isinstance(action, int)` in some environments.
        if isinstance(action, np.integer):
            action = int(action)
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return observation, reward_as_number(reward), terminated, truncated, {}


def check_reward(reward: float, env_id: str, num_steps: int) -> None:
    """Refuse a reward that is not finite.

    Args:
        reward: A reward as the env returned it.
        env_id: The env's id, for the message.
        num_steps: Env steps of the episode, including the one that gave the reward.

    Raises:
        EnvFailedError: The reward is NaN or infinite.
    """
    if not abs(reward) <= _LARGEST:
        raise EnvFailedError(
            f"The reward of env step {num_steps} of an episode of {env_id} was {_name(reward)}.", _HINT
        )


def check_observation(observation: Any, env_id: str, num_steps: int, space: gym.Space[Any] | None = None) -> None:
    """Refuse an observation that is not finite, whatever the bounds of its space.

    Args:
        observation: An observation of any shape.
        env_id: The env's id, for the message.
        num_steps: Env steps of the episode so far; 0: the reset returned the observation.
        space: What it is of, for the message; None: it is what the env itself returned.

    Raises:
        EnvFailedError: A number in it is NaN or infinite.
    """
    values = np.asarray(observation)
    if is_sound(values):
        return
    place = _first_unsound(values)
    which = f"after env step {num_steps}" if num_steps else "from reset(), at the beginning"
    raise EnvFailedError(
        f"The observation {which} of an episode of {env_id} was {_name(float(values.flat[place]))} "
        f"({_where(values, place, space)}).",
        _HINT,
    )


def unsound_number(observations: NDArray[Any], space: gym.Space[Any]) -> str | None:
    """Say which number of an observation, or of a batch, is the first that is not finite, and where; None: none is.

    Args:
        observations: Numbers of the space's shape, or several of such.
        space: What they are of.
    """
    if is_sound(observations):
        return None
    index, place = divmod(_first_unsound(observations), math.prod(space.shape or ()))
    values = observations.reshape(-1, *(space.shape or ()))[index]
    which = "" if observations.shape == space.shape else f" in observation {index} of the batch, counted from 0"
    return f"{_name(float(values.flat[place]))} ({_where(values, place, space)}){which}"


def _first_unsound(values: NDArray[Any]) -> int:
    return int(np.flatnonzero(~(np.abs(values) <= _LARGEST_32))[0])


def _where(values: NDArray[Any], place: int, space: gym.Space[Any] | None) -> str:
    """Return where the env itself has a number of what is observed, which may begin with a mask."""
    before = 0 if space is None else num_masked(space)
    if space is not None and isinstance(seen := seen_by_networks(space), WithMembers):
        return seen.name_of(place - before)
    return f"number {place - before} of its {values.size - before}, counted from 0"


def _name(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "infinite" if value > 0 else "minus infinity"
    return f"{value:g}, which is infinite in 32 bits"


class CheckedEnvs(gym.vector.VectorWrapper):
    """Wraps a vector environment: its errors become `EnvError`s, and its rewards and observations have to be finite.

    It is for vector environments that reset in the step after an episode's end, as `make_vector_env` makes them. A
    user's own vectorised version may return lists, or rewards as a column; this wrapper makes them arrays of the
    expected shape. It returns no infos, as nothing reads them.

    Args:
        env: A vector environment without a failure penalty, as the env's own rewards are checked.
        env_id: The env's id, for messages.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], env_id: str) -> None:
        super().__init__(env)
        self._env_id = env_id
        self._shape = (env.num_envs, *(env.single_observation_space.shape or ()))
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._ended = np.zeros(env.num_envs, dtype=np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset all sub-environments.

        Raises:
            EnvFailedError: A sub-environment raised an error, or its observation is not finite.
        """
        try:
            observations, _ = self.env.reset(seed=seed, options=options)
        except BaseException as error:
            raise env_failed(f"{self._env_id} raised an error in reset()", error) from error
        self._lengths[:], self._ended[:] = 0, False
        observations = self._as_observations(observations)
        self._check(observations)
        return observations, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all sub-environments.

        Raises:
            EnvFailedError: A sub-environment raised an error, or its reward or observation is not finite.
            EnvError: The vectorised version returned something other than rows of numbers.
        """
        try:
            observations, rewards, terminated, truncated, _ = self.env.step(actions)
        except BaseException as error:
            raise env_failed(f"{self._env_id} raised an error in step()", error, in_step=True) from error
        row = self._shape[:1]
        observations = self._as_observations(observations)
        rewards = self._as_array(rewards, "rewards", row).reshape(row)
        terminated, truncated = (
            self._as_array(values, what, row).reshape(row).astype(np.bool_, copy=False)
            for values, what in ((terminated, "terminated"), (truncated, "truncated"))
        )
        self._lengths += 1
        self._lengths[self._ended] = 0
        if not is_sound(rewards):
            for reward, length in zip(rewards.tolist(), self._lengths.tolist(), strict=True):
                check_reward(reward, self._env_id, length)
        self._check(observations)
        ended = np.logical_or(terminated, truncated)
        if (tally := only_tally()) is not None:
            tally.add(int(np.count_nonzero(~self._ended)), int(np.count_nonzero(ended)))
        self._ended = ended
        return observations, rewards, terminated, truncated, {}

    def _as_observations(self, values: Any) -> NDArray[Any]:
        observations = self._as_array(values, "observations", self._shape)
        if self.env.single_observation_space.dtype != np.uint8:
            return observations
        try:
            return as_bytes(observations)
        except ValueError as error:
            raise EnvError(f"The vectorised {self._env_id} returned {error}.", _MEND_VECTORISED) from None

    def _as_array(self, values: Any, what: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Return what a vectorised version returned as an array of this shape; one row may come as a column.

        It is a copy, as an environment may write all its steps into the same array.
        """
        try:
            array = np.array(values)
        except Exception:  # noqa: BLE001 (ragged lists, say)
            array = np.empty(0, dtype=object)
        if array.dtype.kind in "biuf" and (array.shape == shape or (len(shape) == 1 and array.size == shape[0])):
            return array
        raise EnvError(
            f"The vectorised {self._env_id} returned {what} of shape {array.shape} and dtype {array.dtype}, not "
            f"numbers of shape {shape}.",
            _MEND_VECTORISED,
        )

    def _check(self, observations: NDArray[Any]) -> None:
        if not is_sound(observations):
            for observation, length in zip(observations, self._lengths.tolist(), strict=True):
                check_observation(observation, self._env_id, length, self.env.single_observation_space)

    def close(self, **kwargs: Any) -> None:
        """Close all sub-environments; errors of closing are ignored."""
        del kwargs
        close_env(self.env)
