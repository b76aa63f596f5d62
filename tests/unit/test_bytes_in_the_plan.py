"""Images of bytes that hardly differ from zero once they are divided by what their space allows."""

from __future__ import annotations

from typing import Any

import pytest

from policies.envs.make import check_env
from policies.guard import guarded
from tune_jobs.plan.env_notes import env_notes
from tune_jobs.spec.file import load_spec

pytestmark = pytest.mark.usefixtures("env_plugin")

FILTERS: dict[str, Any] = {"conv_filters": [[4, 3, 2]]}


def notes(env_id: str, env_args: dict[str, Any], **sweep: Any) -> list[str]:
    spec = load_spec({"env": {"id": env_id, "args": env_args}, "algorithm": "ppo", "hyperparams": FILTERS, **sweep})
    return [note for note in env_notes(spec, check_env(env_id, env_args)) if "bytes" in note]


def test_bytes_of_which_few_are_used_are_told_with_what_brings_them_to_a_size() -> None:
    (note,) = notes("TestBits-v0", {"highest": 255})
    assert note == (
        "The first images of TestBits-v0 have numbers of up to 1, and its space allows 255: divided by 255, as images "
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


def test_the_largest_byte_is_that_of_the_image_and_not_of_the_mask() -> None:
    assert check_env("TestBits-v0", {"highest": 255}).largest_byte == 1
    assert guarded.check_env("TestBits-v0", {"highest": 255}).largest_byte == 1
    # The brighter half is of 127 and more.
    assert 127 < (check_env("TestMaskedShades-v0", {}).largest_byte or 0) <= 255
    for env_id in ("CartPole-v1", "TestFineShades-v0", "FrozenLake-v1"):
        assert check_env(env_id, {}).largest_byte is None


def test_an_image_that_is_all_black_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium as gym
    import numpy as np

    inner: Any = gym.make("TestShades-v0").unwrapped
    monkeypatch.setattr(type(inner), "_observation", lambda self: np.zeros((12, 9, 2), np.uint8))
    for env_id in ("TestShades-v0", "TestMaskedShades-v0"):
        assert check_env(env_id, {}).largest_byte == 0
        assert notes(env_id, {}) == []
