"""Observations whose numbers are too large for networks, or hardly differ from zero once they are divided."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered

from policies.envs import modules
from policies.envs.first_step import Largest
from policies.envs.make import check_env
from policies.guard import guarded
from policies.packed.envs.make import StepTime, measure_step
from tests.narrowing import present
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

FILTERS: dict[str, Any] = {"conv_filters": [[4, 3, 2]]}


def notes(env_id: str, env_args: dict[str, Any], **sweep: Any) -> list[str]:
    spec = load_spec({"env": {"id": env_id, "args": env_args}, "algorithm": "ppo", "hyperparams": FILTERS, **sweep})
    return [
        note
        for note in env_notes(spec, check_env(env_id, env_args))
        if "to a usual size" in note or "to that size" in note
    ]


def test_bytes_of_which_few_are_used_are_told_with_what_brings_them_to_a_size() -> None:
    (note,) = notes("TestBits-v0", {"highest": 255})
    assert note == (
        "The first image of TestBits-v0 has numbers of up to 1, and its space allows 255: divided by 255, as images "
        "of bytes are, they are next to nothing for a network. hyperparams.normalize_observations: true brings them to "
        "a usual size; so does a space that says what they are."
    )
    assert len(notes("TestBits-v0", {"highest": 20})) == 1


@pytest.mark.parametrize("sweep", [
    {"hyperparams": {**FILTERS, "normalize_observations": True}},
    {"space": {"normalize_observations": {"grid": [True, False]}}},
    {"rl_module": "my_modules:Mine"},
    {"algorithm": "random", "hyperparams": {}},
], ids=str)  # fmt: skip
def test_who_normalises_or_has_a_network_of_their_own_is_not_told(sweep: dict[str, Any]) -> None:
    assert notes("TestBits-v0", {"highest": 255}, **sweep) == []


@pytest.mark.parametrize(
    ("env_id", "env_args"),
    [
        ("TestBits-v0", {"highest": 1}), ("TestBits-v0", {"highest": 19}), ("TestShades-v0", {}),
        ("TestMaskedShades-v0", {}), ("TestFineShades-v0", {}), ("CartPole-v1", {}),
    ],
)  # fmt: skip
def test_usual_images_and_vectors_are_not_told(env_id: str, env_args: dict[str, Any]) -> None:
    assert notes(env_id, env_args) == []


def test_the_largest_number_is_that_of_the_image_and_not_of_the_mask() -> None:
    wanted = Largest(1.0, "[0, 0, 0]")
    assert check_env("TestBits-v0", {"highest": 255}).largest == wanted
    assert guarded.check_env("TestBits-v0", {"highest": 255}).largest == wanted
    image, _ = gym.make("TestMaskedShades-v0").reset(seed=0)
    place = [int(index) for index in np.unravel_index(image.argmax(), image.shape)]
    assert check_env("TestMaskedShades-v0", {}).largest == Largest(float(image.max()), str(place))


def test_an_image_that_is_all_black_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    inner: Any = gym.make("TestShades-v0").unwrapped
    monkeypatch.setattr(type(inner), "_observation", lambda self: np.zeros((12, 9, 2), np.uint8))
    for env_id in ("TestShades-v0", "TestMaskedShades-v0"):
        assert present(check_env(env_id, {}).largest).value == 0
        assert notes(env_id, {}) == []


class Prices(gym.Env[Any, Any]):
    """Observes a price, on its own or as a member, and what it was before."""

    action_space: Any = gym.spaces.Discrete(2)

    def __init__(self, price: float = 41_250.5, in_a_dict: bool = False) -> None:
        self.price, self.in_a_dict = price, in_a_dict
        numbers = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.observation_space: Any = gym.spaces.Dict({"hour": gym.spaces.Discrete(24), "last": numbers})
        if not in_a_dict:
            self.observation_space = numbers

    def _seen(self) -> Any:
        numbers = np.array([0.5, self.price, 1.0], np.float32)
        return {"hour": 3, "last": numbers} if self.in_a_dict else numbers

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._seen(), 0.0, True, False, {}


@pytest.fixture
def prices() -> Iterator[str]:
    with registered("TestPrices-v0", Prices):
        yield "TestPrices-v0"


PLAIN: dict[str, Any] = {"hyperparams": {}}


@pytest.mark.parametrize(
    ("env_args", "words"),
    [
        ({}, r"as large as 41,250 ([1])"),
        ({"price": -300.0}, "as large as -300 ([1])"),
        ({"price": 3e12}, "as large as 3e+12 ([1])"),
        ({"price": 10.0}, "as large as 10 ([1])"),
        ({"in_a_dict": True}, "as large as 41,250 (observation['last'][1])"),
    ],
    ids=str,
)
def test_large_numbers_are_told_with_their_place(prices: str, env_args: dict[str, Any], words: str) -> None:
    (note,) = notes(prices, env_args, **PLAIN)
    assert note == (
        f"The first observation of TestPrices-v0 has numbers {words}: networks learn little from numbers that are far "
        "from 1. hyperparams.normalize_observations: true brings all to that size."
    )
    assert notes(prices, env_args, hyperparams={"normalize_observations": True}) == []


def test_numbers_of_a_usual_size_are_not_told(prices: str) -> None:
    assert notes(prices, {"price": 9.9}, **PLAIN) == []
    for env_id in ("CartPole-v1", "Acrobot-v1", "Pendulum-v1", "LunarLander-v3", "FrozenLake-v1", "HalfCheetah-v5"):
        assert notes(env_id, {}, **PLAIN) == []


class Costs(Prices):
    """Each step costs something."""

    def __init__(self, cost: float = -300.0) -> None:
        super().__init__(1.0)
        self.cost = cost

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._seen(), self.cost, True, False, {}


@pytest.fixture
def costs() -> Iterator[str]:
    with registered("TestCosts-v0", Costs):
        yield "TestCosts-v0"


class Returns(Prices):
    """Observes by how much a price has changed."""

    def __init__(self, change: float = 0.012) -> None:
        super().__init__(1.0)
        self.change = change

    def _seen(self) -> Any:
        return np.array([0.001, -self.change, 0.0], np.float32)


@pytest.mark.parametrize(("change", "is_told"), [(0.012, True), (0.099, True), (0.1, False), (2.0, False)])
def test_small_numbers_in_all_of_random_play_are_told(change: float, *, is_told: bool) -> None:
    with registered("TestReturns-v0", Returns):
        step = measure_step("TestReturns-v0", {"change": change})
        assert step.largest == pytest.approx(change)
        packs = PackPlan(1, 1, 1.0, 0.0, (), "scalar", 5.0, 0, largest=step.largest)
        env = {"id": "TestReturns-v0", "args": {"change": change}}
        info = check_env("TestReturns-v0", {"change": change})
        told = env_notes(load_spec({"env": env, "algorithm": "ppo"}), info, packs)
        words = (
            "No number that TestReturns-v0 observes in random play is as far from 0 as 0.1: the largest is "
            f"{change:.2g}, and networks hardly tell such numbers apart. hyperparams.normalize_observations: true "
            "brings all to a usual size."
        )
        assert told == ([words] if is_told else [])
        normalised = {"env": env, "algorithm": "ppo", "hyperparams": {"normalize_observations": True}}
        assert env_notes(load_spec(normalised), info, packs) == []


def test_the_largest_number_of_random_play_is_behind_the_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    inner: Any = gym.make("TestShades-v0").unwrapped
    monkeypatch.setattr(type(inner), "_observation", lambda self: np.zeros((12, 9, 2), np.uint8))
    assert measure_step("TestMaskedShades-v0", {}).largest == 0.0


@pytest.mark.parametrize(
    ("sweep", "is_told"),
    [
        ({"space": {"conv_filters": {"choice": [[[4, 3, 2]], [[8, 3, 2]]]}}}, False),
        ({"space": {"conv_filters": {"choice": [[[4, 3, 2]], None]}}}, True),
        ({"hyperparams": FILTERS}, False),
        (PLAIN, True),
    ],
    ids=str,
)
def test_bytes_beside_others_are_large_unless_every_trial_has_convolutions(
    sweep: dict[str, Any], *, is_told: bool
) -> None:
    spec = load_spec({"env": {"id": "TestBeside-v0"}, "algorithm": "ppo", **sweep})
    info = check_env("TestBeside-v0", {})
    assert present(info.largest).place.startswith("observation['image'][")
    notes = [note for note in env_notes(spec, info) if "as large as" in note]
    assert len(notes) == (1 if is_told else 0)


def on_rewards(reward: float | None, algorithm: str = "dqn", env_id: str = "CartPole-v1", **sweep: Any) -> list[str]:
    spec = load_spec({"env": {"id": env_id}, "algorithm": algorithm, **sweep})
    packs = PackPlan(1, 1, 1.0, 0.0, (), "scalar", 5.0, 0, reward=reward)
    return [note for note in env_notes(spec, check_env(env_id, {}), packs) if "eward" in note]


@pytest.mark.parametrize(
    ("reward", "shown", "scale"),
    [(300.0, "300", "0.01"), (5.0, "5", "0.1"), (20_000.0, "20,000", "0.0001"), (40.0, "40", "0.01")],
)
def test_dqn_is_told_of_large_rewards_with_what_scales_them(reward: float, shown: str, scale: str) -> None:
    (note,) = on_rewards(reward)
    assert note.startswith(
        f"Rewards of CartPole-v1 are of about {shown} a step: DQN's values begin near 0, and come late"
    )
    assert note.endswith(
        f" hyperparams.reward_scale: {scale} has it learn from smaller ones, and changes no return. PPO hardly minds, "
        "and has normalize_rewards."
    )
    assert on_rewards(reward, "ppo") == []
    assert on_rewards(reward, hyperparams={"reward_scale": float(scale)}) == []
    assert on_rewards(reward, space={"reward_scale": {"loguniform": [1e-5, 1]}}) == []


@pytest.mark.parametrize(("atari", "is_told"), [(True, False), ({"clip_rewards": False}, True)])
def test_rewards_that_training_sees_as_signs_are_not_large(atari: Any, *, is_told: bool) -> None:
    # The file alone tells what training sees.
    spec = load_spec({"env": {"id": "CartPole-v1", "atari": atari}, "algorithm": "dqn"})
    packs = PackPlan(1, 1, 1.0, 0.0, (), "scalar", 5.0, 0, reward=6.0)
    notes = [note for note in env_notes(spec, check_env("CartPole-v1", {}), packs) if "reward_scale" in note]
    assert len(notes) == (1 if is_told else 0)


def test_dqn_is_not_told_of_usual_rewards() -> None:
    for reward in (4.9, 0.0, None):
        assert on_rewards(reward) == []
    spec = load_spec({"env": "CartPole-v1", "algorithm": "dqn"})
    assert env_notes(spec, check_env("CartPole-v1", {})) == []


def test_how_large_rewards_are_is_measured_with_how_long_a_step_takes(
    costs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert measure_step(costs, {"cost": -300.0}).reward == 300.0
    # Every third of random play's is -10, that of a move that is not possible.
    assert guarded.measure_step("Taxi-v3", {}).reward == 1.0
    assert measure_step("CartPole-v1", {}).reward is None
    monkeypatch.setattr(modules, "_allowed", {"hostile_envs"})
    assert measure_step("hostile_envs:Hostile", {"how": "fail", "where": "step"}) == StepTime(None)


def test_the_plan_of_packs_tells_of_rewards(monkeypatch: pytest.MonkeyPatch) -> None:
    told = StepTime(5.0, reward=300.0, largest=0.05)
    monkeypatch.setattr(guarded, "measure_step", lambda env_id, env_args, *, timeout_s: told)
    plan = make_plan(load_spec({"env": "CartPole-v1", "algorithm": "dqn"}), Machine(2, 0))
    assert [note for note in plan.notes if "Rewards of CartPole-v1 are of about 300 a step" in note]
    assert [note for note in plan.notes if "the largest is 0.05" in note]
    assert SweepPlan.from_json(plan.to_json()).notes == plan.notes
