"""What is said where the mask of actions is not where it is looked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from policy_factory import registered

from policies.acting.policy import RandomPolicy
from policies.envs.make import check_env
from policies.errors import EnvError, ObservationError

ENV = "TestHasLegal-v0"


class HasLegal(gym.Env[Any, Any]):
    """Its mask is called `legal`: a member, a method or an info."""

    action_space = spaces.Discrete(3)

    def __init__(self, place: str, size: int = 0) -> None:
        self.place, self.size = place, size
        self.observation_space: Any = spaces.Box(-1, 1, (2,), np.float32)
        if place == "observation":
            members = {"seen": self.observation_space, "legal": spaces.MultiBinary(3), "three": spaces.Box(-1, 1, (3,))}
            self.observation_space = spaces.Dict(members)

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        seen, mask = np.zeros(2, np.float32), np.ones(3, np.int8)
        if self.place == "observation":
            return {"seen": seen, "legal": mask, "three": np.zeros(3, np.float32)}, {}
        infos = {"legal": mask, "turn": 1, "scores": np.full(3, 0.5), "odd": object()}
        return seen, infos if self.place == "info" else {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, info = self._seen()
        return observation, 0.0, False, False, info


class LegalMethod(HasLegal):
    """Has it as a method, beside one that is none."""

    def legal(self) -> Any:
        return np.ones(3, np.int8)

    def is_legal(self, action: Any) -> bool:
        return bool(action < 3)

    @property
    def legally(self) -> Any:
        raise RuntimeError("not now")


@pytest.fixture(autouse=True)
def _envs() -> Iterator[None]:
    with registered(ENV, HasLegal), registered("TestLegalMethod-v0", LegalMethod):
        yield


@pytest.mark.parametrize("setting", [True, "legl"])
@pytest.mark.parametrize("place", ["observation", "method", "info"])
def test_a_mask_of_another_name_is_named(place: str, setting: Any) -> None:
    env_id = "TestLegalMethod-v0" if place == "method" else ENV
    name = setting if isinstance(setting, str) else "action_mask"
    with pytest.raises(
        EnvError, match=rf"^env\.action_mask asks .* {env_id} has not: there is no info\['{name}'\]"
    ) as caught:
        check_env(env_id, {"place": place, "action_mask": setting})
    assert "argument" not in str(caught.value)
    assert caught.value.hint == "Write env.action_mask: legal; or false, if that is no mask."
    mask = check_env(env_id, {"place": place, "action_mask": "legal"}).mask
    assert mask == {"method": "legal()"}.get(place, f"{place}['legal']")


def test_where_nothing_looks_like_a_mask_there_is_to_be_none() -> None:
    with pytest.raises(EnvError, match=r"nor a method; there is nothing\.") as caught:
        check_env("CartPole-v1", {"action_mask": True})
    assert "'action_mask': True" not in caught.value.message
    assert caught.value.hint == "Set env.action_mask: false, or leave it out: nothing of the env looks like a mask."


class Breaks(HasLegal):
    """Fails in one of its methods."""

    def __init__(self, where: str, number: int = 1) -> None:
        super().__init__("info")
        self.where = where
        if where == "init":
            raise RuntimeError("broken")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        raise RuntimeError("broken")


@pytest.mark.parametrize("where", ["init", "reset"])
def test_arguments_that_are_shown_are_the_constructors(where: str) -> None:
    args = {"where": where, "number": 2, "frame_stack": 2, "action_mask": "legal", "pixels": False}
    with registered("TestBreaks-v0", Breaks), pytest.raises(EnvError) as caught:
        check_env("TestBreaks-v0", args)
    assert f"with arguments {{'where': '{where}', 'number': 2}}" in caught.value.message


class Both(HasLegal):
    """Observes a tuple; its mask is a method, and an info too."""

    def __init__(self) -> None:
        super().__init__("info")
        self.observation_space = spaces.Tuple((spaces.Discrete(3), self.observation_space))

    def action_masks(self) -> Any:
        return np.ones(3, np.int8)

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        seen, infos = super()._seen()
        return (1, seen), infos


METHOD = 'mask=env.get_wrapper_attr("{}")()'


@pytest.mark.parametrize(
    ("args", "given"),
    [
        ({}, f", and {METHOD.format('action_masks')}."),
        ({"action_mask": "legal"}, f', and mask=info["legal"], or {METHOD.format("legal")} if it is a method.'),
        (
            {"action_mask": True},
            f', and mask=info["action_mask"], or {METHOD.format("action_masks")} if it is a method.',
        ),
        # Its observations begin with the newest mask.
        (
            {"frame_stack": 2},
            ", of an env with frame_stack: 2, with which it was trained: env = policy.make_env().",
        ),
    ],
    ids=str,
)
def test_a_policy_without_a_mask_says_where_it_is(args: dict[str, Any], given: str) -> None:
    with registered("TestBoth-v0", Both):
        policy = RandomPolicy.for_env("TestBoth-v0", args)
        own = (1, np.zeros(2, np.float32))
        for observations in (own, [own, own], np.zeros(2, np.float32)):
            with pytest.raises(ObservationError, match=r": there is no mask\.") as caught:
                policy.act(observations)
            assert caught.value.hint == f"Pass what env.reset or env.step returned{given}"
        if "frame_stack" not in args:
            assert policy.act(own, mask=[0, 1, 0]) == 1
        else:
            env = policy.make_env()
            assert policy.act(env.reset(seed=0)[0]) in range(3)


@pytest.mark.parametrize("num", [1, 2, 3])
def test_one_mask_is_not_one_for_each_observation(num: int) -> None:
    with registered("TestBoth-v0", Both):
        policy = RandomPolicy.for_env("TestBoth-v0")
        rows = [(1, np.zeros(2, np.float32))] * num
        # As many numbers as observations, or others.
        for mask in ([0, 1, 0], np.array([0, 1, 0]), (False, True, False)):
            with pytest.raises(ObservationError, match=f"one mask, not one for each of {num} observations"):
                policy.act(rows, mask)
        assert policy.act(rows, [[0, 1, 0]] * num).tolist() == [1] * num
        with pytest.raises(ObservationError, match=f"there are {num + 1} masks for {num} observations"):
            policy.act(rows, [[0, 1, 0]] * (num + 1))


def test_dqn_has_one_mask_for_combinations_of_choices() -> None:
    with registered("TestTwo-v0", Two):
        with pytest.raises(EnvError, match="2 choices at once") as caught:
            check_env("TestTwo-v0", {}, "dqn")
        assert caught.value.hint.startswith("Use 'algorithm: ppo'")
        # The expression would change the actions, and not the mask.
        assert "TransformAction" not in caught.value.hint
        assert "and have action_masks() say which combinations are allowed" in caught.value.hint
        with pytest.raises(EnvError, match="2 choices at once") as caught:
            check_env("TestTwo-v0", {"action_mask": False}, "dqn")
        assert "TransformAction" in caught.value.hint


class Two(HasLegal):
    """Two choices at once, with a mask."""

    action_space: Any = spaces.MultiDiscrete([3, 2])

    def __init__(self) -> None:
        super().__init__("method")

    def action_masks(self) -> Any:
        return np.ones(5, np.int8)
