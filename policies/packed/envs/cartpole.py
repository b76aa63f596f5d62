"""Step CartPole for all members of a pack in one object: the steps of Gymnasium's vectorised version, other resets.

That version draws the start states of all sub-environments from one generator, and resets a sub-environment in the
step after its episode's end. Here each member draws from a generator of its own, and where an episode has ended the
next one's start state is set at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from policies import random_streams
from policies.errors import EnvError
from policies.packed.envs.cartpole_rows import CartPoleRows
from policies.packed.envs.penalty import Penalty
from policies.packed.envs.rows import MemberRows, Rows
from policies.packed.envs.vector import Step


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
