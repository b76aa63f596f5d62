"""Sub-environments that are stepped one after the other, in this process or in one of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs.checked import check_observation, check_reward, is_sound, reward_as_number
from policies.envs.faults import close_env, env_failed
from policies.envs.make import make_env
from policies.envs.spaces import observation_dtype
from policies.errors import EnvError


class HostDiedError(EnvError):
    """A process that steps sub-environments has ended."""

    in_company = False
    """Whether it had sub-environments of several members, any of which may have ended it."""


class Host(Protocol):
    """Runs some sub-environments, in this process or in another.

    Calls are sent to all hosts first and received from them afterwards, so that processes work at the same time.
    """

    def send(self, method: str, *args: Any) -> None:
        """Ask the host to call a method of `SubEnvs`.

        Raises:
            HostDiedError: The process has ended.
        """

    def receive(self) -> Any:
        """Return the result of the method that was asked for last.

        Raises:
            HostDiedError: The process has ended.
            EnvError: The method raised it.
        """

    def close(self) -> None:
        """Close all sub-environments."""


@dataclass(frozen=True, eq=False)
class SubStep:
    """The results of a step of a host's sub-environments, in the order in which they were added."""

    final_observations: NDArray[Any]
    first_observations: dict[int, NDArray[Any]]
    """Where an episode ended, the next episode's first observation, by the sub-environment's index."""
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    errors: dict[str, EnvError]
    """Errors of members whose sub-environments raised one; the other values of these members mean nothing."""
    lost_lives: NDArray[np.bool_] | None = None
    """Where a game lost a life and goes on; None: nobody asked."""


@dataclass(eq=False)
class _SubEnv:
    member_id: str
    env: gym.Env[Any, Any]
    num_steps: int = 0
    """Steps of the running episode."""


class SubEnvs:
    """Scalar environments of several members, with the wrappers that their arguments ask for.

    Args:
        env_id: Gymnasium id.
        env_args: The same as for `policies.envs.make.make_env`.
    """

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None) -> None:
        self._env_id, self._env_args = env_id, dict(env_args or {})
        self._envs: list[_SubEnv] = []

    def add(self, member_id: str, seeds: Sequence[int]) -> list[NDArray[Any]]:
        """Make sub-environments of a member, one for each seed.

        Returns:
            Their first observations.

        Raises:
            EnvError: One cannot be made or reset; then none is added.
        """
        made: list[_SubEnv] = []
        try:
            observations = []
            for seed in seeds:
                one = _SubEnv(member_id, make_env(self._env_id, self._env_args))
                made.append(one)
                observations.append(self._reset(one, seed))
        except EnvError:
            _close(made)
            raise
        self._envs += made
        return observations

    def remove(self, member_id: str) -> None:
        """Close a member's sub-environments, if it has any here."""
        _close([one for one in self._envs if one.member_id == member_id])
        self._envs = [one for one in self._envs if one.member_id != member_id]

    def step(self, actions: NDArray[Any]) -> SubStep:
        """Step all sub-environments; where an episode ends, begin the next.

        Args:
            actions: One action for each, as the env takes them.
        """
        num = len(self._envs)
        space = self._envs[0].env.observation_space
        finals: NDArray[Any] = np.zeros((num, *(space.shape or ())), dtype=observation_dtype(space))
        firsts: dict[int, NDArray[Any]] = {}
        rewards = np.zeros(num, dtype=np.float32)
        terminated, truncated = np.zeros(num, dtype=np.bool_), np.zeros(num, dtype=np.bool_)
        errors: dict[str, EnvError] = {}
        # As RLlib sends it: NumPy scalars for Discrete actions fail `isinstance(action, int)` in some envs.
        each = actions.tolist() if actions.ndim == 1 else actions
        lengths = [0] * num
        for place, (one, action) in enumerate(zip(self._envs, each, strict=True)):
            if one.member_id in errors:
                continue
            try:
                rewards[place], terminated[place], truncated[place] = self._step(one, action, finals[place])
                lengths[place] = one.num_steps
                if terminated[place] or truncated[place]:
                    firsts[place] = self._reset(one, None)
            except EnvError as error:
                errors[one.member_id] = error
        if not (is_sound(rewards) and is_sound(finals)):
            owners = [one.member_id for one in self._envs]
            errors = find_unsound(owners, rewards, finals, lengths, env_id=self._env_id, space=space) | errors
        return SubStep(finals, firsts, rewards, terminated, truncated, errors)

    def close(self) -> None:
        """Close all sub-environments."""
        _close(self._envs)
        self._envs = []

    def _step(self, one: _SubEnv, action: Any, final: NDArray[Any]) -> tuple[float, bool, bool]:
        """Step one sub-environment; its observation goes into `final`."""
        one.num_steps += 1
        try:
            observation, reward, terminated, truncated, _ = one.env.step(action)
            self._check_shape(one.env, observation)
            final[:] = observation
            return reward_as_number(reward), bool(terminated), bool(truncated)
        except BaseException as error:  # an env may raise anything
            raise self._failed("step", error) from error

    def _reset(self, one: _SubEnv, seed: int | None) -> NDArray[Any]:
        try:
            observation, _ = one.env.reset(seed=seed)
            self._check_shape(one.env, observation)
            # A copy, because some envs return an array that they change later.
            first = np.array(observation, dtype=observation_dtype(one.env.observation_space))
        except BaseException as error:  # an env may raise anything
            raise self._failed("reset", error) from error
        one.num_steps = 0
        check_observation(first, self._env_id, 0, one.env.observation_space)
        return first

    def _check_shape(self, env: gym.Env[Any, Any], observation: Any) -> None:
        if np.shape(observation) != env.observation_space.shape:
            raise EnvError(
                f"it returned an observation of shape {np.shape(observation)}, not {env.observation_space.shape}"
            )

    def _failed(self, method: str, error: BaseException) -> EnvError:
        return env_failed(f"{self._env_id} raised an error in {method}()", error, in_step=method == "step")


def find_unsound(
    owners: Sequence[str],
    rewards: NDArray[Any],
    finals: NDArray[Any],
    lengths: Sequence[int],
    *,
    env_id: str,
    space: gym.Space[Any] | None = None,
) -> dict[str, EnvError]:
    """Return the errors of members whose rewards or observations are not finite.

    Args:
        owners: The member of each sub-environment.
        rewards: The rewards of a step, one for each.
        finals: What each observed after it.
        lengths: The steps of each one's episode.
        env_id: Gymnasium id, for messages.
        space: What they observed is of it; None: it is what the env itself returned.
    """
    errors: dict[str, EnvError] = {}
    for place, owner in enumerate(owners):
        if owner not in errors:
            try:
                check_reward(float(rewards[place]), env_id, lengths[place])
                check_observation(finals[place], env_id, lengths[place], space)
            except EnvError as error:
                errors[owner] = error
    return errors


class HereHost:
    """Steps sub-environments in this process.

    Args:
        sub_envs: `SubEnvs`, or what has its methods.
    """

    def __init__(self, sub_envs: Any) -> None:
        self._sub_envs = sub_envs
        self._asked: tuple[str, tuple[Any, ...]] = ("close", ())

    def send(self, method: str, *args: Any) -> None:
        """Remember the method and its arguments, for `receive`."""
        self._asked = method, args

    def receive(self) -> Any:
        """Call the method that was asked for last, and return its result."""
        method, args = self._asked
        return getattr(self._sub_envs, method)(*args)

    def close(self) -> None:
        """Close all sub-environments."""
        self._sub_envs.close()


def _close(envs: Sequence[_SubEnv]) -> None:
    for one in envs:
        close_env(one.env)
