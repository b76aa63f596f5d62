"""Step CartPole for all members of a pack in one object: Gymnasium's own vectorised version with other resets.

That version draws the start states of all sub-environments from one generator, and resets a sub-environment in the
step after its episode's end. Here each member draws from a generator of its own, and where an episode has ended the
next one's start state is set at once. The physics is Gymnasium's, to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv
from numpy.typing import NDArray

from policies import random_streams
from policies.envs.make import make_env, make_vector_env
from policies.errors import EnvError
from policies.packed.envs.penalty import Penalty
from policies.packed.envs.rows import MemberRows, Rows
from policies.packed.envs.vector import Step

_Flags = NDArray[np.bool_]


class CartPoleRows:
    """Cart-poles whose number changes; they never reset by themselves.

    Args:
        env: Gives the physics and the time limit; it belongs to this object from here on.
    """

    def __init__(self, env: CartPoleVectorEnv) -> None:
        self._env: Any = env
        # The env's step checks that the actions are 0 or 1, for the number of sub-environments it was made with. Here
        # that number changes, and the actions are a network's choices, which are always 0 or 1.
        env.action_space = _AnyActions()
        self.put(np.zeros((0, 4)), np.zeros(0, dtype=np.int32))

    @classmethod
    def make(cls, env_id: str, env_args: Mapping[str, Any] | None) -> CartPoleRows | None:
        """Return cart-poles, or None if the env is not CartPole or has wrappers that its vectorised version lacks.

        Raises:
            EnvError: In the same cases as `policies.envs.make.make_env`.
        """
        scalar = make_env(env_id, env_args)
        scalar.close()  # type: ignore[no-untyped-call]
        if type(scalar.unwrapped) is not CartPoleEnv:
            return None
        env = make_vector_env(env_id, env_args, 1)
        return cls(env) if type(env) is CartPoleVectorEnv else None  # with wrappers it is another class

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The observation space of one cart-pole."""
        return self._env.single_observation_space  # type: ignore[no-any-return]

    @property
    def states(self) -> NDArray[np.float64]:
        """The position, velocity, angle and angular velocity of each cart-pole, shape (num, 4)."""
        return self._env.state.T  # type: ignore[no-any-return]

    @property
    def lengths(self) -> NDArray[np.int32]:
        """The number of steps of each running episode, shape (num,)."""
        return self._env.steps  # type: ignore[no-any-return]

    def put(self, states: NDArray[np.float64], lengths: NDArray[Any]) -> None:
        """Replace the cart-poles by others, in any number.

        Args:
            states: Their states, shape (num, 4).
            lengths: The steps of their running episodes, shape (num,).
        """
        self._env.state = np.array(states.T, dtype=np.float64, order="C")
        self._env.steps = np.array(lengths, dtype=np.int32)
        self._no_resets = np.zeros(len(lengths), dtype=np.bool_)

    def draw_starts(self, generator: np.random.Generator, *shape: int) -> NDArray[np.float64]:
        """Draw start states, shape (*shape, 4)."""
        return generator.uniform(self._env.low, self._env.high, (*shape, 4))

    def restart(self, rows: Rows, states: NDArray[np.float64]) -> None:
        """Begin new episodes at some rows from these states, shape (len(rows), 4)."""
        self._env.state[:, rows] = states.T
        self._env.steps[rows] = 0

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32], _Flags, _Flags, _Flags]:
        """Step all cart-poles.

        Returns:
            Observations, shape (num, 4), rewards, terminated, truncated, and whether the episode has ended either way.
        """
        env = self._env
        # Otherwise the env would reset the sub-environments whose episodes ended in the step before.
        env.prev_done = self._no_resets
        observations, rewards, terminated, truncated, _ = env.step(actions)
        return np.ascontiguousarray(observations), rewards, terminated, truncated, env.prev_done

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


class _AnyActions(gym.spaces.MultiDiscrete):
    """An action space that accepts the actions of any number of cart-poles without a check."""

    def __init__(self) -> None:
        super().__init__([2])

    def contains(self, x: Any) -> bool:
        del x
        return True


class CartPoleEnvs:
    """The sub-environments of a pack that trains on CartPole; implements `PackedEnvs`.

    Args:
        env_id: Gymnasium id.
        env_args: Arguments of the env's constructor; None: none.
        num_envs: Sub-environments of each member.
        failure_penalty: Reward of steps that end by failure; None: the env's own reward.

    Raises:
        EnvError: The env is not a plain CartPole, or there is a penalty and it has no failure.
    """

    def __init__(
        self, env_id: str, env_args: Mapping[str, Any] | None, num_envs: int, *, failure_penalty: float | None = None
    ) -> None:
        rows = CartPoleRows.make(env_id, env_args)
        if rows is None:
            raise EnvError(
                f"{env_id} with arguments {dict(env_args or {})!r} has no vectorised version for packs; CartPole, "
                "MountainCar, Pendulum and Acrobot have, without frame_stack and pixels.",
                "Use the kind 'scalar' or 'processes'.",
            )
        self.num_envs = num_envs
        self.observation_space: gym.Space[Any] = rows.observation_space
        self.action_space: gym.Space[Any] = gym.spaces.Discrete(2)
        self.observations: NDArray[np.float32] = np.zeros((0, 4), dtype=np.float32)
        self.errors: dict[str, Exception] = {}
        self._rows = rows
        self._penalty = Penalty.find(env_id, env_args, failure_penalty)
        self._members = MemberRows(num_envs)
        self._generators: dict[str, np.random.Generator] = {}
        # The start state of each row's next episode if its running one ends in that step: (steps ahead, rows, 4).
        self._starts: NDArray[np.float64] = np.zeros((0, 0, 4))
        self._at = 0  # the index of the next step

    @property
    def member_ids(self) -> tuple[str, ...]:
        """In the order of their rows."""
        return self._members.ids

    def add(self, member_id: str, seed: int) -> None:
        """Add a member after all others, with its start states drawn from its seed."""
        self._members.add(member_id)
        generator = self._generators[member_id] = random_streams.seeded(seed)
        rows = self._rows
        states = rows.draw_starts(generator, self.num_envs)
        lengths = np.zeros(self.num_envs, dtype=np.int32)
        rows.put(np.concatenate([rows.states, states]), np.concatenate([rows.lengths, lengths]))
        left = self._starts[self._at :]
        drawn = rows.draw_starts(generator, len(left), self.num_envs)
        self._starts, self._at = np.concatenate([left, drawn], axis=1), 0
        self.observations = np.concatenate([self.observations, states.astype(np.float32)])

    def remove(self, member_id: str) -> None:
        """Remove a member; the rows after it move up."""
        self._choose(self._members.remove(member_id))
        del self._generators[member_id]

    def arrange(self, member_ids: Sequence[str]) -> None:
        """Put the members into this order; their running episodes go on."""
        self._choose(self._members.arrange(member_ids))

    def _choose(self, rows: Rows) -> None:
        self._rows.put(self._rows.states[rows], self._rows.lengths[rows])
        self._starts, self._at = self._starts[self._at :, rows], 0
        self.observations = self.observations[rows]

    def begin(self, num_steps: int) -> None:
        """Draw the start states of the next `num_steps` steps.

        Numbers drawn ahead but not used are used first, so that a member's numbers do not depend on `num_steps`.
        """
        left = self._starts[self._at :]
        missing = num_steps - len(left)
        if missing <= 0:
            return
        starts = np.empty((num_steps, len(self._members), 4))
        starts[: len(left)] = left
        for member_id in self._members.ids:
            drawn = self._rows.draw_starts(self._generators[member_id], missing, self.num_envs)
            starts[len(left) :, self._members.of(member_id)] = drawn
        self._starts, self._at = starts, 0

    def step(self, actions: NDArray[Any]) -> Step:
        """Step every row; where an episode ends, the next one begins."""
        if self._at == len(self._starts):
            self.begin(1)
        observations, own_rewards, terminated, truncated, ended = self._rows.step(actions)
        final_observations, rewards = observations, own_rewards
        if ended.any():
            rows = np.flatnonzero(ended)
            states = self._starts[self._at, rows]
            self._rows.restart(rows, states)
            observations = final_observations.copy()
            observations[rows] = states
        if self._penalty is not None:
            rewards = self._penalty.apply(own_rewards, terminated)
        self._at += 1
        self.observations = observations
        return Step(observations, final_observations, rewards, own_rewards, terminated, truncated)

    def close(self) -> None:
        """Close the environment."""
        self._rows.close()
