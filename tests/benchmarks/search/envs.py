"""MountainCar as ARLBench trains on it: its time limit is an end like the goal, after which nothing is worth anything.

In ARLBench nothing is worth anything after a step that is "done", and the 200th is (its `update` and its environments'
`step`). Gymnasium says `truncated` of it, and our DQN goes on with the next state's value. With that task's networks
and discount all states are then worth about the same -100 until the goal is reached, and of twelve settings none
reached it; nine of the same twelve did with the limit as an end. RL Zoo's (two layers of 256 units, ReLU, a discount
of .98) do either way.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.core import ActType, ObsType


class EndsAtItsTimeLimit(gymnasium.Wrapper[ObsType, ActType, ObsType, ActType]):
    """An environment whose truncated episodes are terminated ones."""

    def step(self, action: ActType) -> tuple[ObsType, Any, bool, bool, dict[str, Any]]:
        """Step, and say that an episode has terminated when it was truncated."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or truncated, False, info


def make(**options: Any) -> gymnasium.Env[Any, Any]:
    """Make MountainCar-v0 so."""
    return EndsAtItsTimeLimit(gymnasium.make("MountainCar-v0", **options))


gymnasium.register("EndingMountainCar-v0", make)
