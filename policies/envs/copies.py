"""What steps copies of one environment together has to offer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray


class CopiesStep(NamedTuple):
    """What a step of some copies gives; no later step changes the arrays."""

    observations: NDArray[Any]
    """Shape (num, n), of the type that the environment gives."""
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    failures: dict[int, Exception]
    """What a simulation raised, by the number of the copy, whose other results mean nothing."""


class Stepper(Protocol):
    """Steps copies of one environment, all of which have its arguments; their resets are their own.

    Its steps are those of the environment to the last bit, without its time limit.
    """

    limit: int | None
    """The time limit, in env steps of an episode, which whoever steps has to keep; None: there is none."""

    def copy_of(self, env: gym.Env[Any, Any]) -> Any:
        """Return what `step` takes for an environment of its own, over all its episodes."""

    def step(self, copies: Sequence[Any], actions: NDArray[Any]) -> CopiesStep:
        """Step copies, of which there is at least one; they never reset by themselves.

        Args:
            copies: The copies, as `copy_of` returns them.
            actions: One for each, within the action space.
        """

    def close(self) -> None:
        """Close what it has made; the copies are not its own."""
