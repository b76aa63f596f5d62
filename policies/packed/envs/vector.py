"""One vector of sub-environments for all members of a pack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

EnvKind = Literal["vectorised", "scalar", "processes"]


@dataclass(frozen=True, eq=False)
class Step:
    """What a step gave; arrays over all rows, which no later step changes."""

    observations: NDArray[Any]
    """After the step; where an episode ended, the first of the next one. Shape (M * N, ...)."""
    final_observations: NDArray[Any]
    """As the step left them, before any reset; the same array object if no episode ended."""
    rewards: NDArray[np.float32]
    """What the learner sees: with the failure penalty, if there is one."""
    own_rewards: NDArray[np.float32]
    """The env's own, of which returns are made; the same array object if there is no penalty."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class PackedEnvs(Protocol):
    """One vector of sub-environments for all members of a pack."""

    @property
    def num_envs(self) -> int:
        """Sub-environments of each member: N."""

    @property
    def observation_space(self) -> gym.Space[Any]:
        """Of one sub-environment."""

    @property
    def action_space(self) -> gym.Space[Any]:
        """Of one sub-environment."""

    @property
    def member_ids(self) -> tuple[str, ...]:
        """In the order of their rows."""

    @property
    def observations(self) -> NDArray[Any]:
        """Those that the next actions answer, shape (M * N, ...): float32, or uint8 where images are."""

    @property
    def errors(self) -> dict[str, Exception]:
        """Members whose env raised, by id: the `EnvError`. Their rows are zeros from that step on."""

    def add(self, member_id: str, seed: int) -> None:
        """A further member, after all others, its sub-environments reset from its seed.

        Raises:
            EnvError: Its environments cannot be made or reset; it is no member then.
        """

    def remove(self, member_id: str) -> None:
        """Close a member's sub-environments; the rows after it move up."""

    def arrange(self, member_ids: Sequence[str]) -> None:
        """Put the members into this order; their running episodes go on."""

    def begin(self, num_steps: int) -> None:
        """Say that so many steps come next, so that start states can be drawn ahead of them."""

    def step(self, actions: NDArray[Any]) -> Step:
        """Step every row.

        Args:
            actions: Of shape (M * N,), whole numbers from 0 (the start of a Discrete space is added here), or
                (M * N, action_dim), within the bounds of the Box space.
        """

    def close(self) -> None:
        """Close all environments; nothing after it."""
