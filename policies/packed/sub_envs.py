"""Sub-environments that are stepped one after the other, and where they live: here, or in a process of their own."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.envs import make_env
from policies.errors import EnvError
from policies.spaces import observation_dtype


class HostDiedError(EnvError):
    """A process of sub-environments has ended."""


class Host(Protocol):
    """Where some sub-environments live.

    Calls are sent to all hosts first and received from them afterwards, so that processes work at the same time.
    """

    def send(self, method: str, *args: Any) -> None:
        """Ask for a method of `SubEnvs`.

        Raises:
            HostDiedError: The process has ended.
        """

    def receive(self) -> Any:
        """What the method that was asked for last returned.

        Raises:
            HostDiedError: The process has ended.
            EnvError: The method raised it.
        """

    def close(self) -> None:
        """Close all sub-environments."""


@dataclass(frozen=True, eq=False)
class SubStep:
    """What a step of a host's sub-environments gave, in the order in which they were added."""

    final_observations: NDArray[Any]
    first_observations: dict[int, NDArray[Any]]
    """Where an episode ended: the first of the next one, by place."""
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    errors: dict[str, EnvError]
    """Members one of whose sub-environments raised; what else is here of these means nothing."""


class SubEnvs:
    """Scalar environments, each of a member, with the wrappers that their arguments ask for.

    Args:
        env_id: Gymnasium id.
        env_args: As `policies.envs.make_env` takes them.
    """

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None) -> None:
        self._env_id, self._env_args = env_id, dict(env_args or {})
        self._envs: list[tuple[str, gym.Env[Any, Any]]] = []

    def add(self, member_id: str, seeds: Sequence[int]) -> list[NDArray[Any]]:
        """Make sub-environments of a member, one for each seed.

        Returns:
            Their first observations.

        Raises:
            EnvError: One cannot be made or reset; none is there then.
        """
        made: list[tuple[str, gym.Env[Any, Any]]] = []
        try:
            observations = []
            for seed in seeds:
                env = make_env(self._env_id, self._env_args)
                made.append((member_id, env))
                observations.append(self._reset(env, seed))
        except EnvError:
            _close(made)
            raise
        self._envs += made
        return observations

    def remove(self, member_id: str) -> None:
        """Close a member's sub-environments, if it has any here."""
        _close([pair for pair in self._envs if pair[0] == member_id])
        self._envs = [pair for pair in self._envs if pair[0] != member_id]

    def step(self, actions: NDArray[Any]) -> SubStep:
        """Step all; where an episode ends, begin the next.

        Args:
            actions: One for each, as the env takes them.
        """
        num = len(self._envs)
        space = self._envs[0][1].observation_space
        finals: NDArray[Any] = np.zeros((num, *(space.shape or ())), dtype=observation_dtype(space))
        firsts: dict[int, NDArray[Any]] = {}
        rewards = np.zeros(num, dtype=np.float32)
        terminated, truncated = np.zeros(num, dtype=np.bool_), np.zeros(num, dtype=np.bool_)
        errors: dict[str, EnvError] = {}
        # As RLlib sends it: NumPy scalars for Discrete actions fail `isinstance(action, int)` in some envs.
        each = actions.tolist() if actions.ndim == 1 else actions
        for place, ((member_id, env), action) in enumerate(zip(self._envs, each, strict=True)):
            if member_id in errors:
                continue
            try:
                rewards[place], terminated[place], truncated[place] = self._step(env, action, finals[place])
                if terminated[place] or truncated[place]:
                    firsts[place] = self._reset(env, None)
            except EnvError as error:
                errors[member_id] = error
        return SubStep(finals, firsts, rewards, terminated, truncated, errors)

    def close(self) -> None:
        """Close all."""
        _close(self._envs)
        self._envs = []

    def _step(self, env: gym.Env[Any, Any], action: Any, final: NDArray[Any]) -> tuple[float, bool, bool]:
        """Step one; its observation goes into `final`."""
        try:
            observation, reward, terminated, truncated, _ = env.step(action)
            self._check_shape(env, observation)
            final[:] = observation
            return float(reward), bool(terminated), bool(truncated)
        except Exception as error:  # an env may raise anything
            raise self._failed("step", error) from error

    def _reset(self, env: gym.Env[Any, Any], seed: int | None) -> NDArray[Any]:
        try:
            observation, _ = env.reset(seed=seed)
            self._check_shape(env, observation)
            # A copy: some envs return the array that they go on writing to.
            return np.array(observation, dtype=observation_dtype(env.observation_space))
        except Exception as error:  # an env may raise anything
            raise self._failed("reset", error) from error

    def _check_shape(self, env: gym.Env[Any, Any], observation: Any) -> None:
        if np.shape(observation) != env.observation_space.shape:
            raise EnvError(
                f"it returned an observation of shape {np.shape(observation)}, not {env.observation_space.shape}"
            )

    def _failed(self, method: str, error: Exception) -> EnvError:
        return EnvError(
            f"{self._env_id} raised an error in {method}(): {type(error).__name__}: {error}.",
            "Mend the env, or choose another one.",
        )


class HereHost:
    """Sub-environments in this very process."""

    def __init__(self, env_id: str, env_args: Mapping[str, Any] | None) -> None:
        self._sub_envs = SubEnvs(env_id, env_args)
        self._asked: tuple[str, tuple[Any, ...]] = ("close", ())

    def send(self, method: str, *args: Any) -> None:
        """See `Host.send`."""
        self._asked = method, args

    def receive(self) -> Any:
        """See `Host.receive`."""
        method, args = self._asked
        return getattr(self._sub_envs, method)(*args)

    def close(self) -> None:
        """See `Host.close`."""
        self._sub_envs.close()


def _close(envs: Sequence[tuple[str, gym.Env[Any, Any]]]) -> None:
    for _, env in envs:
        with contextlib.suppress(Exception):  # what is left of an env that has failed may raise anything
            env.close()  # type: ignore[no-untyped-call]
