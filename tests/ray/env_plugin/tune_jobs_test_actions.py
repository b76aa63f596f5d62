"""Environments whose actions are of any kind, and such as forbid some of them."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

REPLIES: dict[str, gym.Space[Any]] = {
    "multi-discrete": spaces.MultiDiscrete([2, 3], start=[1, -1]),
    "multi-binary": spaces.MultiBinary(2),
    "tuple of choices": spaces.Tuple((spaces.Discrete(2, start=3), spaces.MultiDiscrete([3, 2]))),
    "dict of choices": spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Dict({"c": spaces.MultiBinary([1, 1])})}),
    "matrix": spaces.Box(-1.0, 1.0, (2, 1), np.float64),
    "whole numbers": spaces.Box(-3, 4, (2,), np.int64),
    "dict of numbers": spaces.Dict({"up": spaces.Box(0.0, 1.0, (1,)), "on": spaces.Box(-np.inf, np.inf, ())}),
}


class Reply(gym.Env[NDArray[np.float32], Any]):
    """The observation tells two signs, and each action has two parts, in a space of each kind.

    16 steps; half a reward for each part that says its sign: its first value, or a number above the mean, for a sign of
    1. Who gets one of the two right and guesses the other has 12 of 16.

    Args:
        kind: A key of `REPLIES`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, kind: str = "multi-discrete") -> None:
        self.kind = kind
        self.observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = REPLIES[kind]
        self.wanted = np.zeros(2, np.float32)
        self.ticks = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._observation(), {}

    def _observation(self) -> NDArray[np.float32]:
        self.wanted = self.np_random.choice([-1.0, 1.0], 2).astype(np.float32)
        return self.wanted

    def _said(self, action: Any) -> tuple[bool, bool]:
        if self.kind == "multi-discrete":
            return action[0] == 1, action[1] == -1
        if self.kind == "multi-binary":
            return action[0] == 0, action[1] == 0
        if self.kind == "tuple of choices":
            return action[0] == 3, action[1][0] == 0
        if self.kind == "dict of choices":
            return action["b"] == 0, action["a"]["c"][0, 0] == 0
        if self.kind == "dict of numbers":
            return action["up"][0] > 0.5, action["on"] > 0
        middle = 0.0 if self.kind == "matrix" else 0.5
        first, second = (float(number) for number in np.ravel(action))
        return first > middle, second > middle

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.ticks += 1
        reward = float(np.mean(np.array(self._said(action)) == (self.wanted > 0)))
        return self._observation(), reward, self.ticks >= 16, False, {}


class Forbidding(gym.Env[Any, Any]):
    """Any action that is allowed may be taken, but only the most liked one of these has a reward.

    Which ones are allowed is drawn at each step and said by the mask alone. 16 steps; a forbidden action raises an
    error. The values of each choice are liked in the order 2, 0, 3, 1. Who draws among the allowed ones gets less than
    half of all rewards. At the end nothing is allowed.

    Args:
        place: Where the mask is: `observation`, `info` or `method`.
        num_choices: For several choices at once, each for its share of the reward; None: one.
        goes_wrong: What the mask is in the third step: `nothing` allowed, `short`, `twos`, or `missing`; None: as ever.
        lists: Whether it lists the actions that are allowed in place of a mask, as an info or by a method.
    """

    metadata = {"render_modes": []}  # noqa: RUF012
    ORDER = (2, 0, 3, 1)

    def __init__(
        self,
        *,
        place: str = "observation",
        num_choices: int | None = None,
        goes_wrong: str | None = None,
        lists: bool = False,
    ) -> None:
        self.place, self.goes_wrong, self.lists = place, goes_wrong, lists
        self.sizes = [4] * (num_choices or 1)
        numbers = spaces.Box(-1.0, 1.0, (2,), np.float32)
        mask = spaces.MultiBinary(sum(self.sizes))
        self.observation_space = (
            spaces.Dict({"observation": numbers, "action_mask": mask}) if place == "observation" else numbers
        )
        self.action_space = (
            spaces.Discrete(4, start=7) if num_choices is None else spaces.MultiDiscrete(np.array(self.sizes))
        )
        self.ticks = 0
        self.mask: NDArray[np.int8] = np.ones(sum(self.sizes), np.int8)
        if place == "method":
            self.action_masks = self._said

    def _said(self) -> Any:
        if self.lists:
            return [7 + int(index) for index in np.flatnonzero(self.mask)]
        if self.ticks != 2 or self.goes_wrong is None:
            return self.mask.copy()
        return {"nothing": 0 * self.mask, "short": self.mask[1:], "twos": 2 * self.mask}.get(self.goes_wrong)

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        masks = [self.np_random.integers(0, 2, size) for size in self.sizes]
        for mask in masks:
            mask[self.np_random.integers(len(mask))] = 1
        self.mask = np.concatenate(masks).astype(np.int8) * (self.ticks < 16)
        numbers = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        said = self._said()
        told = {} if said is None else {"action_mask": said}
        if self.place == "observation":
            return {"observation": numbers, **told}, {}
        return numbers, told if self.place == "info" else {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.ticks = 0
        return self._seen()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        right = []
        choices = [action - 7] if isinstance(self.action_space, spaces.Discrete) else list(action)
        for choice, mask in zip(choices, np.split(self.mask, len(self.sizes)), strict=True):
            if not mask[choice]:
                raise RuntimeError(f"the action {action} is forbidden by {self.mask}")
            right.append(choice == next(value for value in self.ORDER if mask[value]))
        self.ticks += 1
        observation, info = self._seen()
        return observation, float(np.mean(right)), self.ticks >= 16, False, info


class ForbiddingTwo(Forbidding):
    """The same with two choices at once."""

    def __init__(self) -> None:
        super().__init__(num_choices=2)
