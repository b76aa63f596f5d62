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
    """The results of a step: arrays over all rows, which no later step changes."""

    observations: NDArray[Any]
    """Observations after the step, shape (M * N, ...); where an episode ended, the first one of the next episode."""
    final_observations: NDArray[Any]
    """Observations after the step, before any reset; the same array object if no episode ended."""
    rewards: NDArray[np.float32]
    """The rewards that the learner gets, with the failure penalty if there is one."""
    own_rewards: NDArray[np.float32]
    """The env's own rewards, which returns are the sums of; the same array object if there is no penalty."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    lost_lives: NDArray[np.bool_] | None = None
    """Where the step is an end for the learner, as a termination is, but the episode goes on; None: nowhere."""

    @property
    def is_last(self) -> NDArray[np.bool_]:
        """Whether nothing that comes later counts for the learner: the episode was terminated, or a life lost."""
        return self.terminated if self.lost_lives is None else self.terminated | self.lost_lives


class PackedEnvs(Protocol):
    """One vector of sub-environments for all members of a pack."""

    @property
    def num_envs(self) -> int:
        """The number of sub-environments of each member: N."""

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The observation space of one sub-environment."""

    @property
    def action_space(self) -> gym.Space[Any]:
        """The action space of one sub-environment."""

    @property
    def member_ids(self) -> tuple[str, ...]:
        """The members in the order of their rows."""

    @property
    def observations(self) -> NDArray[Any]:
        """The observations that the next actions answer, shape (M * N, ...): float32, or uint8 for images."""

    @property
    def errors(self) -> dict[str, Exception]:
        """The errors of members whose env raised one, by member id. Their rows are zeros from that step on."""

    def add(self, member_id: str, seed: int) -> None:
        """Add a member after all others, with its sub-environments reset with its seed.

        Raises:
            EnvError: Its environments cannot be made or reset; then it is not added.
        """

    def remove(self, member_id: str) -> None:
        """Close a member's sub-environments; the rows after it move up."""

    def arrange(self, member_ids: Sequence[str]) -> None:
        """Put the members into this order; their running episodes go on."""

    def begin(self, num_steps: int) -> None:
        """Announce that `num_steps` steps come next, so that start states can be drawn ahead."""

    def step(self, actions: NDArray[Any]) -> Step:
        """Step every row.

        Args:
            actions: Shape (M * N,), whole numbers from 0 (the start of a Discrete space is added here), or shape
                (M * N, action_dim), within the bounds of the Box space.
        """

    def close(self) -> None:
        """Close all environments; no method may be called afterwards."""
