"""Play greedy episodes of classic control in arrays, as scalar environments would: CartPole, and the others."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies.acting.policy import Policy
from policies.envs import calls
from policies.envs.checked import check_observation, check_reward, is_sound
from policies.envs.classic import is_classic
from policies.envs.classic_rows import ClassicRows
from policies.envs.make import make_vector_env

_MAX_CARTPOLES = 256
_MAX_ROWS = 4096


class Starts(NamedTuple):
    """The starts of episodes."""

    states: NDArray[np.float64]
    """Shape (num, size of a state)."""
    observations: NDArray[np.float32]
    """Shape (num, n)."""


class CartPolePlayer:
    """Plays CartPole in Gymnasium's own vectorised version, which is ten times as fast as ten environments.

    That version draws the start states of all sub-environments from one generator. So the states are drawn here as
    the scalar env draws them, seed by seed, and put into the vectorised version. From equal states the two take the
    same steps, to the last bit; tests compare the returns and lengths of both.
    """

    def __init__(self, env: Any, start_states: NDArray[np.float64]) -> None:
        self._env = env
        self.starts = Starts(start_states, start_states.astype(np.float32))

    @classmethod
    def make_if_cartpole(
        cls, scalar_env: gym.Env[Any, Any], env_id: str, env_args: Mapping[str, Any], seeds: Sequence[int]
    ) -> CartPolePlayer | None:
        """Return a player for a CartPole without further wrappers, or None for any other env."""
        from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv

        inner = scalar_env.unwrapped
        if type(inner) is not CartPoleEnv or (scalar_env.spec and scalar_env.spec.additional_wrappers):
            return None
        if scalar_env.observation_space.shape != inner.observation_space.shape:  # pixels, or stacked frames
            return None
        vector_env = make_vector_env(env_id, env_args, min(len(seeds), _MAX_CARTPOLES))
        if type(vector_env) is not CartPoleVectorEnv:
            return None
        start_states = []
        for seed in seeds:
            scalar_env.reset(seed=seed)
            start_states.append(copy.copy(inner.state))
        return cls(vector_env, np.array(start_states, dtype=np.float64))

    def play(self, policy: Policy, max_episode_steps: int) -> list[tuple[float, int]]:
        """Play one episode from each start state and return the return and the length of each."""
        num_envs: int = self._env.num_envs
        results: list[tuple[float, int]] = []
        for first in range(0, len(self.starts.states), num_envs):
            chunk = self.starts.states[first : first + num_envs]
            results += self._play_chunk(policy, chunk, max_episode_steps)
        return results

    def _play_chunk(
        self, policy: Policy, start_states: NDArray[np.float64], max_episode_steps: int
    ) -> list[tuple[float, int]]:
        env, num_episodes = self._env, len(start_states)
        env.reset(seed=0)  # clears the step counters; the states it draws are replaced
        env.state[:, :num_episodes] = start_states.T
        observations = env.state.T.astype(np.float32)
        returns, lengths = np.zeros(num_episodes), np.zeros(num_episodes, dtype=np.int64)
        running = np.ones(num_episodes, dtype=bool)
        actions = np.zeros(env.num_envs, dtype=np.int64)
        for _ in range(max_episode_steps):
            actions[:num_episodes] = policy.act_on_rows(observations[:num_episodes])
            observations, rewards, terminated, truncated, _ = env.step(actions)
            # Sub-environments whose episode has ended begin further ones by themselves, which do not count.
            returns[running] += rewards[:num_episodes][running]
            lengths[running] += 1
            running &= ~(terminated | truncated)[:num_episodes]
            if not running.any():
                break
        return [(float(total), int(length)) for total, length in zip(returns, lengths, strict=True)]


class RowsPlayer:
    """Plays other classic control than CartPole, whose copies are rows."""

    def __init__(self, rows: ClassicRows, env_id: str, seeds: Sequence[int]) -> None:
        self.rows, self._env_id = rows, env_id
        starts = [rows.start(seed=seed) for seed in seeds]
        self.starts = Starts(
            np.array([start.state for start in starts]), np.array([start.observation for start in starts])
        )

    @classmethod
    def make_if_classic(
        cls, scalar_env: gym.Env[Any, Any], env_id: str, env_args: Mapping[str, Any], seeds: Sequence[int]
    ) -> RowsPlayer | None:
        """Return a player, or None for any other env, of which none is made, or one in further wrappers."""
        rows = ClassicRows.make(env_id, env_args) if is_classic(scalar_env) else None
        return None if rows is None else cls(calls.watch_rows(rows), env_id, seeds)

    def play(self, policy: Policy, max_episode_steps: int) -> list[tuple[float, int]]:
        """Play one episode from each start and return the return and the length of each.

        Raises:
            EnvFailedError: A reward or an observation is not finite, as an action was not.
        """
        results: list[tuple[float, int]] = []
        for first in range(0, len(self.starts.states), _MAX_ROWS):
            states, observations = (part[first : first + _MAX_ROWS] for part in self.starts)
            results += self._play_some(policy, states, observations, max_episode_steps)
        return results

    def _play_some(
        self, policy: Policy, states: NDArray[Any], observations: NDArray[Any], max_episode_steps: int
    ) -> list[tuple[float, int]]:
        num = len(states)
        returns, lengths, episodes = np.zeros(num), np.zeros(num, dtype=np.int64), np.arange(num)
        rows = self.rows
        rows.put(states, lengths)
        for number in range(1, max_episode_steps + 1):
            observations, rewards, terminated, truncated = rows.step(policy.act_on_rows(observations))
            if not (is_sound(rewards) and is_sound(observations)):
                for reward, observation in zip(rewards.tolist(), observations, strict=True):
                    check_reward(reward, self._env_id, number)
                    check_observation(observation, self._env_id, number)
            returns[episodes] += rewards
            lengths[episodes] = number
            if (ended := terminated | truncated).any():
                left = np.flatnonzero(~ended)
                if not left.size:
                    break
                rows.put(rows.states[left], rows.lengths[left])
                observations, episodes = observations[left], episodes[left]
        return list(zip(returns.tolist(), lengths.tolist(), strict=True))

    def close(self) -> None:
        """Close the environment."""
        self.rows.close()
