"""Observations whose numbers are too large for networks, or hardly differ from zero once they are divided."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from policy_factory import registered

from policies.envs.first_step import Largest
from policies.envs.make import check_env
from policies.guard import guarded
from tests.narrowing import present
from tune_jobs.plan.env_notes import env_notes
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
