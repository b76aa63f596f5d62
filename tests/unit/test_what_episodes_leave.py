"""What a plan says of environments whose rewards or observations depend on the episodes before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from policies.envs.first_step import Carried
from policies.envs.make import check_env
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.file import load_spec

ENV = "LeavesSomething-v0"
NUMBERS = spaces.Box(-9, 9, (2,), np.float32)


class Walk(gym.Env[Any, Any]):
    """What its steps give may depend on how often it was reset."""

    action_space: gym.Space[Any] = spaces.Box(-1, 1, (2,), np.float32)
    observation_space: gym.Space[Any] = NUMBERS
    resets = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.resets += 1
        return self.seen(0.0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.seen(1.0), 2.0, False, False, {}

    def seen(self, place: float) -> Any:
        return np.array([place, 3], np.float32)


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    yield
    gym.registry.pop(ENV, None)


def notes(make: Callable[[], gym.Env[Any, Any]], algorithm: str = "ppo") -> list[str]:
    gym.register(ENV, cast("Any", make))
    info = check_env(ENV, None, None if algorithm in ("random", "constant") else cast("Any", algorithm))
    found = env_notes(load_spec({"env": ENV, "algorithm": algorithm}), info)
    return [note for note in found if "are made vectors" not in note]


def test_an_env_that_does_the_same_again_gets_no_note() -> None:
    assert notes(Walk) == []
    assert check_env(ENV, None).carried == Carried()


# -- Gymnasium's wrappers that count what they see


@pytest.mark.parametrize(
    ("algorithm", "instead"),
    [
        ("ppo", "Leave it out, and set hyperparams.normalize_rewards: true, which scales what is learned from, "),
        ("dqn", "Leave it out, and set hyperparams.reward_scale, which scales what is learned from, "),
        ("random", "Leave it out."),
    ],
)
@pytest.mark.parametrize("env_id", ["CartPole-v1", "MountainCar-v0", "FrozenLake-v1"])
def test_rewards_that_are_scaled_by_those_before_are_told(algorithm: str, instead: str, env_id: str) -> None:
    """Also where the first reward, as of FrozenLake, is zero however it is scaled."""
    (note,) = notes(lambda: NormalizeReward(gym.make(env_id)), algorithm)
    assert note.startswith(f"{ENV} has a NormalizeReward around it, which divides rewards by what it has seen ")
    assert instead in note


@pytest.mark.parametrize(("algorithm", "instead"), [("ppo", ": true"), ("random", "")])
def test_so_are_observations(algorithm: str, instead: str) -> None:
    # In the chain of wrappers that is common with PPO.
    env: Any = gym.wrappers.ClipReward(NormalizeReward(NormalizeObservation(gym.make("Pendulum-v1"))), -10, 10)
    ours = [note for note in notes(lambda: env, algorithm) if "around it" in note]
    assert ["NormalizeReward around" in ours[0], "NormalizeObservation around" in ours[1]] == [True, True]
    assert ("hyperparams.normalize_observations" in ours[1]) == bool(instead)
    assert not any("reset twice" in note for note in ours)


def test_those_that_do_not_count_any_more_are_no_matter() -> None:
    def frozen() -> gym.Env[Any, Any]:
        observations: Any = NormalizeObservation(Walk())
        rewards: Any = NormalizeReward(observations)
        observations.update_running_mean = rewards.update_running_mean = False
        return cast("gym.Env[Any, Any]", rewards)

    assert notes(frozen) == []


# -- whatever else is left


class Accumulates(Walk):
    """Its reward grows with its resets."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.seen(1.0), 2.0 * self.resets, False, False, {}


class Drifts(Walk):
    """Its steps grow with its resets, and are written into one array."""

    def __init__(self) -> None:
        self.array = np.zeros(2, np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.seen(float(self.resets)), 2.0, False, False, {}

    def seen(self, place: float) -> Any:
        self.array[:] = super().seen(place)
        return self.array


class Overwrites(Walk):
    """Does the same again, though it writes into its action, and always into the same arrays."""

    def __init__(self) -> None:
        self.array = np.zeros(2, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.array[:] = 0
        return self.array, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        action *= 2
        self.array += action
        return self.array, float(action[0]), False, False, {}


class Masks(Accumulates):
    """Allows another action in each episode, which gives another reward."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict({"action_mask": spaces.MultiBinary(2), "numbers": NUMBERS})

    def seen(self, place: float) -> Any:
        mask = np.array([self.resets % 2, (self.resets + 1) % 2], np.int8)
        return {"action_mask": mask, "numbers": np.zeros(2, np.float32)}


class OneStep(Accumulates):
    """Can be stepped once only."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.resets > 1:
            raise RuntimeError("no more")
        return super().step(action)


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (Accumulates, "its first step differs: its reward is 2 and then 4. Where an episode depends"),
        (Drifts, "its first step differs: of its observation [0] is 1 and then 2. Where an episode depends"),
    ],
)
def test_a_first_step_that_differs_on_the_same_seed_and_action_is_told(env: type[Walk], words: str) -> None:
    (note,) = notes(env)
    assert note.startswith(f"{ENV} was reset twice with the same seed, and given the same action, and {words}")


@pytest.mark.parametrize("env", [Overwrites, Masks, OneStep])
def test_nothing_is_said_where_no_step_can_be_compared_or_it_is_the_same(env: type[Walk]) -> None:
    assert not any("reset twice" in note for note in notes(env))
