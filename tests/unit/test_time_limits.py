"""The time limit that acts is the least of all around an environment, also of those that its own wrappers hide."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import pytest
from policy_factory import registered

from policies.envs.make import check_env, make_env
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.sweep_spec import SweepSpec

ENV = "TestCar-v0"


class Around(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper around MountainCar, of which Gymnasium cuts off episodes after 200 env steps."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0"))


class Unlimited(gym.Wrapper[Any, Any, Any, Any]):
    """The same around one without a limit."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0", max_episode_steps=-1))


class Seen(gym.ObservationWrapper[Any, Any, Any]):
    """What is seen is changed, which leaves `step` to Gymnasium."""

    def __init__(self) -> None:
        super().__init__(gym.make("MountainCar-v0"))

    def observation(self, observation: Any) -> Any:
        return -observation


class Paid(Around):
    """A wrapper with a step of its own, which passes on where episodes end."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self.env.step(action)
        return seen, float(reward) - 1.0, terminated, truncated, info


class GoesOn(Around):
    """A wrapper whose episodes don't end where those inside do."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        seen, reward, terminated, _, info = self.env.step(action)
        return seen, reward, terminated, False, info


def played(args: dict[str, Any] | None) -> int:
    env = make_env(ENV, args)
    env.reset(seed=0)
    for steps in range(1, 400):
        if env.step(1)[3]:
            return steps
    return 400


@pytest.mark.parametrize(
    ("kind", "asked", "limit"),
    [
        (Around, None, 200), (Around, 100, 100), (Around, 200, 200), (Around, 300, 200),
        (Unlimited, None, None), (Unlimited, 300, 300), (GoesOn, 300, 300), (GoesOn, 100, 100),
        (Seen, None, 200), (Seen, 300, 200), (Seen, 100, 100), (Paid, None, 200),
    ],
)  # fmt: skip
def test_the_limit_is_that_which_acts(kind: type[gym.Env[Any, Any]], asked: int | None, limit: int | None) -> None:
    args = None if asked is None else {"max_episode_steps": asked}
    with registered(ENV, kind):
        assert check_env(ENV, args).max_episode_steps == limit
        assert played(args) == (limit or 400)


@pytest.mark.parametrize(
    ("kind", "asked", "is_noted"),
    [(Around, 1000, True), (Seen, 1000, True), (Around, 200, False), (GoesOn, 1000, False)],
)
def test_the_plan_notes_a_limit_that_never_acts(kind: type[gym.Env[Any, Any]], asked: int, is_noted: bool) -> None:
    spec = SweepSpec.model_validate(
        {
            "env": {"id": ENV, "args": {"max_episode_steps": asked}},
            "algorithm": "ppo",
            "space": {"lr": {"grid": [1e-3]}},
        }
    )
    with registered(ENV, kind):
        notes = list(env_notes(spec, check_env(ENV, spec.env.args)))
    told = "env.args.max_episode_steps 1,000 never acts: TestCar-v0 cuts off episodes after 200 env steps by itself."
    assert any(told in note for note in notes) == is_noted
