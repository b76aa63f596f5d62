"""Mappings from Python: NumPy's values and paths are taken, what JSON can't hold and what is too large is refused."""

import collections
import enum
import functools
import json
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from spec_errors import MINIMAL

from policies.errors import SpecError
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.plain_data import MAX_VALUES, to_plain
from tune_jobs.spec.ranges import Uniform
from tune_jobs.spec.sweep_spec import SweepSpec


class Colour(enum.StrEnum):
    RED = "red"


class Broken:
    def __repr__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.int64(3), 3),
        (np.float32(0.5), 0.5),
        (np.bool_(True), True),
        (np.str_("x"), "x"),
        (np.array(7), 7),
        (np.array([[1, 2], [3, 4]]), [[1, 2], [3, 4]]),
        (np.array([True, False]), [True, False]),
        (Path("a") / "b", "a/b"),
        (Colour.RED, "red"),
        ((1, (2, 3)), [1, [2, 3]]),
        ({np.int64(1): 2}, {"1": 2}),
        (collections.OrderedDict(a=None), {"a": None}),
        (Uniform(uniform=(1, 2)), {"uniform": [1.0, 2.0]}),
    ],
)
def test_python_values_become_plain_ones(value: Any, plain: Any) -> None:
    copied = to_plain({"x": value}, "sweep")["x"]
    assert copied == plain
    assert json.dumps(copied) == json.dumps(plain)
    assert type(copied) is type(plain)


def test_a_sweep_of_numpy_values_is_the_same_as_one_of_python_values(tmp_path: Path) -> None:
    with_numpy = {
        "env": {"id": "CartPole-v1", "args": {"path": tmp_path, "flag": np.bool_(False)}},
        "algorithm": "ppo",
        "hyperparams": {"num_epochs": np.int32(3), "hidden_sizes": np.array([64, 32])},
        "space": {"lr": {"grid": np.array([0.25, 0.5])}, "gamma": {"uniform": (np.float64(0.9), np.array(0.99))}},
        "num_samples": np.int64(2),
        "stop": {"time_s": np.float32(60)},
    }
    plain = {
        "env": {"id": "CartPole-v1", "args": {"path": str(tmp_path), "flag": False}},
        "algorithm": "ppo",
        "hyperparams": {"num_epochs": 3, "hidden_sizes": [64, 32]},
        "space": {"lr": {"grid": [0.25, 0.5]}, "gamma": {"uniform": [0.9, 0.99]}},
        "num_samples": 2,
        "stop": {"time_s": 60},
    }
    assert load_spec(with_numpy).model_dump_json() == load_spec(plain).model_dump_json()


@pytest.mark.parametrize(
    ("value", "part"),
    [
        (object(), "of type object, which JSON can't hold"),
        (Broken(), "a value is of type Broken"),
        (b"x", "b'x' is of type bytes"),
        ({1, 2}, "of type set"),
        (1j, "of type complex"),
        (int, "the class int"),
        (np.datetime64("2024-01-01"), "of type date"),
        (float("nan"), "nan is not a finite number"),
        (np.float32("inf"), "inf is not a finite number"),
        pytest.param(10**5000, "more than 40 digits", id="digits"),
        ({(1, 2): 3}, "has the key (1, 2), which is not a text"),
        ("a\ud800", r"has '\ud800', which is half a character"),
        ({"\udcff": 1}, r"has '\udcff', which is half a character"),
        (np.zeros(MAX_VALUES + 1), "more than 50,000 values"),
        (["x" * 1000] * 1000, "more than 262,144 characters"),
    ],
)
def test_what_a_sweep_folder_cannot_hold_is_told_with_its_place(value: Any, part: str) -> None:
    with pytest.raises(SpecError) as caught:
        load_spec({**MINIMAL, "env": {"id": "x", "args": {"thing": [value]}}})
    assert caught.value.message.startswith("sweep: env.args.thing[0]")
    assert part in caught.value.message
    assert caught.value.hint


def test_what_is_shared_is_counted_as_often_as_it_stands_there() -> None:
    shared: list[Any] = [1] * 10
    for _ in range(20):
        shared = [shared] * 10
    with pytest.raises(SpecError, match="more than 50,000 values"):
        load_spec({**MINIMAL, "env": {"id": "x", "args": {"a": shared}}})
    spec = cast("Any", SweepSpec).model_construct(env={"id": "x", "args": {"a": shared}})
    with pytest.raises(SpecError, match="more than 50,000 values"):
        to_plain(spec, "sweep")
    twice = [1, 2]
    assert to_plain({"a": twice, "b": twice}, "sweep") == {"a": [1, 2], "b": [1, 2]}


def test_what_contains_itself_or_is_too_deep_is_refused() -> None:
    own: dict[str, Any] = {}
    own["me"] = [own]
    with pytest.raises(SpecError, match=r"sweep: me\[0\]: contains itself"):
        load_spec(own)
    deep: list[Any] = []
    for _ in range(5_000):
        deep = [deep]
    with pytest.raises(SpecError, match="nested more than 64 deep"):
        load_spec({"env": deep})


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: {"id": env}], ids=["env", "env.id"])
def test_an_environment_that_is_an_object_is_answered_with_how_its_class_is_given(wrap: Any) -> None:
    with pytest.raises(SpecError, match="which JSON can't hold") as caught:
        load_spec({**MINIMAL, "env": wrap(gym.Env())})
    assert caught.value.hint == (
        "Give the class itself, with its arguments under args, as in {'id': MyEnv, 'args': {...}}; or a Gymnasium id."
    )


@pytest.mark.parametrize(
    "env", [lambda: gym.make("CartPole-v1"), functools.partial(gym.make, "CartPole-v1")], ids=["lambda", "partial"]
)
def test_an_environment_that_is_a_function_is_answered_with_how_it_is_registered(env: Any) -> None:
    with pytest.raises(SpecError, match="which JSON can't hold") as caught:
        load_spec({**MINIMAL, "env": env})
    assert caught.value.hint == (
        "Register it with gymnasium.register in a module of your own, and give the id after the module, as in "
        "my_envs:Name-v0."
    )


def test_what_is_no_environment_is_answered_with_what_a_sweep_holds() -> None:
    for fields in ({"env": b"x"}, {"env": {"id": "x", "args": {"make": print}}}):
        with pytest.raises(SpecError) as caught:
            load_spec({**MINIMAL, **fields})
        assert caught.value.hint.startswith("Give texts, numbers, true or false")
