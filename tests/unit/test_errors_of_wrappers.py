"""An error of a user's own wrapper is told as it is, whatever members the wrapper leaves out."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import registered

from policies.envs.flat import MAX_SIZE
from policies.envs.make import check_env
from policies.errors import EnvError, EnvFailedError

IMAGE = spaces.Box(0, 1, (3,), np.float32)
LEFT_OUT = {"mission": spaces.Text(10), "much": spaces.Box(0, 1, (MAX_SIZE,), np.int8)}


class Inner(gym.Env[Any, Any]):
    """Observes a member of which no vector can be made."""

    action_space = spaces.Discrete(2)

    def __init__(self, beside: str) -> None:
        self.observation_space = spaces.Dict({"image": IMAGE, "beside": LEFT_OUT[beside]})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return {"image": np.zeros(3, np.float32), "beside": None}, {"legal": np.ones(2, np.int8)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return {"image": np.zeros(3, np.float32), "beside": None}, 1.0, False, False, {"legal": np.ones(2, np.int8)}


class Alone(gym.ObservationWrapper[Any, Any, Any]):
    """Observes one of its members alone, if it has that."""

    def __init__(self, beside: str = "mission", name: str = "image") -> None:
        super().__init__(Inner(beside))
        self.observation_space, self.name = IMAGE, name

    def observation(self, observation: Any) -> Any:
        return observation[self.name]


@pytest.mark.parametrize("beside", LEFT_OUT)
def test_its_own_error_is_told_with_its_place(beside: str) -> None:
    with registered("TestAlone-v0", Alone):
        check_env("TestAlone-v0", {"beside": beside})
        words = r"cannot be reset.*: KeyError: 'imagee' \(.*test_errors_of_wrappers\.py:\d+ in observation\)"
        with pytest.raises(EnvFailedError, match=words):
            check_env("TestAlone-v0", {"beside": beside, "name": "imagee"})


def test_a_mask_that_is_not_there_is_told_with_what_there_is() -> None:
    with registered("TestAlone-v0", Alone):
        with pytest.raises(EnvError, match=r"asks for a mask .* there is no info\['legl'\]") as caught:
            check_env("TestAlone-v0", {"action_mask": "legl"})
        assert caught.value.hint == "Write env.action_mask: legal; or false, if that is no mask."
