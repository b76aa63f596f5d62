"""Classic control in rows is Gymnasium's own to the last bit, or there are no rows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control.acrobot import AcrobotEnv
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv
from gymnasium.envs.classic_control.pendulum import PendulumEnv
from numpy.typing import NDArray

from policies.envs.classic import physics_of
from policies.envs.classic_rows import ClassicRows
from policies.errors import EnvError
from policies.packed.envs.make import make_packed_envs

ENVS = ("MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1", "Acrobot-v1")
NUM = 60


def actions_of(space: gym.Space[Any], rng: np.random.Generator, kept: bool) -> NDArray[Any]:
    """Random actions, now and then the same for all, and for Box some at the bounds and beyond them."""
    if isinstance(space, gym.spaces.Discrete):
        num = int(space.n)
        return np.repeat(rng.integers(0, num), NUM) if kept else rng.integers(0, num, NUM)
    assert isinstance(space, gym.spaces.Box)
    if kept:
        return np.full((NUM, 1), space.high if rng.random() < 0.5 else space.low)
    drawn: NDArray[np.float64] = rng.uniform(-1.5, 1.5, (NUM, 1)) * space.high
    return drawn.astype(np.float32)


@pytest.mark.parametrize("env_id", ENVS)
def test_the_physics_is_that_of_gymnasium_to_the_last_bit(env_id: str) -> None:
    envs = [cast("Any", gym.make(env_id, disable_env_checker=True).unwrapped) for _ in range(NUM)]
    physics = [physics_of(env) for env in envs]
    one = physics[0]
    assert one is not None

    def start(row: int, seed: int | None = None) -> list[float]:
        envs[row].reset(seed=seed)
        own = physics[row]
        assert own is not None
        return own.state()

    states, rng = np.array([start(row, row) for row in range(NUM)]).T, np.random.default_rng(0)
    for number in range(300):
        # Long runs of one action lead to walls, to the largest speeds and around whole turns.
        actions = actions_of(envs[0].action_space, rng, kept=number % 60 >= 30)
        before = states.copy()
        step = one.step(states, actions)
        np.testing.assert_array_equal(states, before)
        states = step.states
        for row, action in enumerate(actions.tolist() if actions.ndim == 1 else actions):
            observation, reward, terminated, _, _ = envs[row].step(action)
            np.testing.assert_array_equal(step.observations[row], observation)
            assert step.observations.dtype == observation.dtype == np.float32
            assert (step.rewards[row], step.terminated[row]) == (reward, terminated)
            if terminated or number % 50 == row % 50:
                states[:, row] = start(row)


@pytest.mark.parametrize(
    ("env_id", "state", "action"),
    [
        ("MountainCar-v0", [0.3, 0.06], 2),
        ("MountainCarContinuous-v0", [0.3, 0.06], [1.0]),
        ("Acrobot-v1", [2, 0, 2, 0], 2),
    ],
)
def test_who_arrives_arrives_as_gymnasium_s_does(env_id: str, state: list[float], action: Any) -> None:
    env = cast("Any", gym.make(env_id, disable_env_checker=True).unwrapped)
    physics = physics_of(env)
    assert physics is not None
    env.reset(seed=3)
    env.state = np.array(state)
    states, arrived = np.array(physics.state())[:, None], 0
    taken = np.array(action, dtype=np.float32) if isinstance(action, list) else action
    for _ in range(10):
        step = physics.step(states, np.array([taken]))
        observation, reward, terminated, _, _ = env.step(taken)
        states = step.states
        np.testing.assert_array_equal(step.observations[0], observation)
        assert (step.rewards[0], step.terminated[0]) == (reward, terminated)
        arrived += terminated
    assert 0 < arrived < 10


def test_rows_have_the_time_limit_and_take_other_rows() -> None:
    rows = ClassicRows.make("Acrobot-v1", {"max_episode_steps": 3})
    assert rows is not None
    starts = [rows.start(seed=seed) for seed in (5, 6)]
    rows.put(np.array([start.state for start in starts]), np.array([0, 1]))
    ends = [rows.step(np.array([0, 0])).truncated.tolist() for _ in range(2)]
    assert ends == [[False, False], [False, True]]
    rows.restart(1, starts[0].state)
    assert rows.lengths.tolist() == [2, 0]
    np.testing.assert_array_equal(rows.states[1], starts[0].state)
    assert rows.step(np.array([1, 1])).truncated.tolist() == [True, False]
    rows.close()


def test_a_generator_gives_the_starts_of_an_env_of_its_own() -> None:
    rows, env = ClassicRows.make("Pendulum-v1", None), gym.make("Pendulum-v1")
    assert rows is not None
    generator, other = rows.generator(9), rows.generator(10)
    for number in range(3):
        observation, _ = env.reset(seed=9 if number == 0 else None)
        np.testing.assert_array_equal(rows.start(generator).observation, observation)
        rows.start(other)  # which draws from its own
    rows.close()


# -- where there are none


class Heavier(PendulumEnv):
    """One of somebody's own: the same class to `isinstance`, but not the same."""


@pytest.fixture
def heavier() -> Iterator[str]:
    gym.register("TestHeavier-v0", cast("Any", Heavier), max_episode_steps=20)
    yield "TestHeavier-v0"
    del gym.registry["TestHeavier-v0"]


def test_one_of_somebody_s_own_has_no_rows(heavier: str) -> None:
    assert ClassicRows.make(heavier, None) is None
    with pytest.raises(EnvError, match="no vectorised version"):
        make_packed_envs(heavier, None, 2, kind="vectorised")


@pytest.mark.parametrize(
    ("env_id", "env_args"),
    [("CartPole-v1", {}), ("Pendulum-v1", {"frame_stack": 2}), ("MountainCar-v0", {"pixels": True})],
)
def test_other_envs_and_those_in_wrappers_have_no_rows(env_id: str, env_args: dict[str, Any]) -> None:
    assert ClassicRows.make(env_id, env_args) is None


def test_an_acrobot_of_the_other_equations_has_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AcrobotEnv, "book_or_nips", "nips")
    assert ClassicRows.make("Acrobot-v1", None) is None


def test_where_gymnasium_steps_in_another_way_there_are_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    own = MountainCarEnv.step

    def another(self: MountainCarEnv, action: int) -> Any:
        observation, reward, *others = own(self, action)
        return np.nextafter(observation, np.float32(2)), reward, *others

    assert ClassicRows.make("MountainCar-v0", None) is not None
    monkeypatch.setattr(MountainCarEnv, "step", another)
    assert ClassicRows.make("MountainCar-v0", None) is None


@pytest.mark.parametrize(
    ("env_id", "env_args"),
    [
        ("Pendulum-v1", {"g": float("nan")}),
        ("Pendulum-v1", {"g": "strong"}),
        ("MountainCar-v0", {"goal_velocity": "fast"}),
    ],
)
def test_arguments_that_are_no_numbers_are_left_to_the_env_itself(env_id: str, env_args: dict[str, Any]) -> None:
    with np.errstate(all="ignore"):
        assert ClassicRows.make(env_id, env_args) is None
