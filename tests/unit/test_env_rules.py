"""An environment and the settings that have to go with it: refused when the sweep is planned, with both names."""

import json
import re
from typing import Any

import gymnasium as gym
import numpy as np
import odd_envs
import pytest

from policies.envs import modules as env_modules
from policies.envs.make import check_env
from policies.envs.modules import allow_modules
from policies.errors import EnvError, SpecError
from policies.hyperparams import Algorithm
from tune_jobs.plan.env_checks import check_env_rules
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import SweepPlan, make_plan
from tune_jobs.spec.file import load_spec

IMAGES, SIZED = "odd_envs:Images", "odd_envs:Sized"


@pytest.fixture(autouse=True)
def _own_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["odd_envs"])


def plan(env: str | dict[str, Any], algorithm: Algorithm = "ppo", **spec: dict[str, Any]) -> SweepPlan:
    return make_plan(load_spec({"env": env, "algorithm": algorithm, **spec}), Machine(num_cpus=2))


FILTERS = [[16, 8, 4], [32, 4, 2]]


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_images_go_with_convolutions_and_vectors_without(algorithm: Algorithm) -> None:
    made = plan(IMAGES, algorithm, hyperparams={"conv_filters": [[8, 4, 2]]})
    assert made.env.observes_images
    made = plan(
        {"id": "CartPole-v1", "pixels": True, "frame_stack": 4}, algorithm, hyperparams={"conv_filters": FILTERS}
    )
    assert made.env.observation_space.shape == (40, 60, 4)
    assert made.env.env_args == {"pixels": True, "frame_stack": 4}
    assert not plan({"id": "CartPole-v1", "frame_stack": 4}, algorithm).env.observes_images


@pytest.mark.parametrize(
    ("env", "spec", "words"),
    [
        (IMAGES, {}, r"odd_envs:Images has images.*but hyperparams\.conv_filters is null"),
        ({"id": "CartPole-v1", "pixels": True}, {}, r"CartPole-v1 has images.*conv_filters"),
        ("CartPole-v1", {"hyperparams": {"conv_filters": FILTERS}}, r"hyperparams\.conv_filters is.*CartPole-v1.*flat"),
        (
            "CartPole-v1",
            {"space": {"conv_filters": {"grid": [FILTERS]}}},
            r"space\.conv_filters is .*CartPole-v1.*flat",
        ),
        (
            IMAGES,
            {"space": {"conv_filters": {"choice": [[[8, 4, 2]], None]}}, "num_samples": 1},
            r"odd_envs:Images has images.*space\.conv_filters is null",
        ),
        (
            IMAGES,
            {"hyperparams": {"conv_filters": [[8, 17, 1]]}},
            r"hyperparams\.conv_filters does not fit odd_envs:Images: .*17 x 17",
        ),
    ],
)
def test_an_encoder_and_observations_that_do_not_go_together_are_refused_with_both_names(
    env: str | dict[str, Any], spec: dict[str, Any], words: str
) -> None:
    with pytest.raises(SpecError, match=words):
        plan(env, **spec)


@pytest.mark.parametrize(
    "shape",
    [
        *((size, size) for size in (1, 2, 3, 4, 7, 8, 10, 12, 19, 20, 36, 84)),
        (12, 60),
        (60, 2, 3),
        (10, 10, 4),
        (84, 84, 1),
    ],
    ids=str,
)
def test_filters_that_are_suggested_are_taken(shape: tuple[int, ...]) -> None:
    env = {"id": SIZED, "args": {"shape": list(shape)}}
    with pytest.raises(SpecError, match="conv_filters is null") as caught:
        plan(env)
    assert "Channels" not in caught.value.hint
    assert plan(env, hyperparams={"conv_filters": suggested(caught.value)}).trials


def suggested(error: SpecError) -> Any:
    (found,) = re.findall(r"such as (\[.*\])\.", error.hint)
    return json.loads(found)


@pytest.mark.parametrize("floats", [False, True])
@pytest.mark.parametrize("filters", [None, [[8, 5, 1]]], ids=str)
@pytest.mark.parametrize("frame_stack", [1, 4])
@pytest.mark.parametrize("shape", [(3, 12, 12), (4, 84, 84), (1, 10, 12)], ids=str)
def test_images_whose_channels_come_first_are_to_be_turned(
    shape: tuple[int, ...], frame_stack: int, filters: Any, floats: bool
) -> None:
    env = {"id": SIZED, "args": {"shape": list(shape), "floats": floats}, "frame_stack": frame_stack}
    with pytest.raises(SpecError) as caught:
        plan(env, hyperparams={"conv_filters": filters})
    assert f"Channels come last here, (rows, columns, channels), but {shape} looks" in caught.value.hint
    (wrapped,) = re.findall("`(.+?)`", caught.value.hint)
    wrapped = wrapped.replace("odd_envs.Sized()", f"odd_envs.Sized({shape}, {floats})")
    turned: Any = eval(wrapped, {"gymnasium": gym, "numpy": np, "odd_envs": odd_envs})
    assert turned.observation_space.shape == (*shape[1:], shape[0])
    assert turned.observation_space.contains(turned.reset()[0])
    if filters is None:
        assert all(kernel <= min(shape[1:]) for _, kernel, _ in suggested(caught.value))


@pytest.mark.parametrize(
    ("shape", "filters", "is_noted"),
    [
        ((3, 12, 12), [[8, 3, 1]], True),
        ((4, 84, 84), [[8, 4, 2]], True),
        ((1, 10, 12), [[8, 1, 1]], True),
        ((12, 12, 3), [[8, 3, 1]], False),
        ((5, 12, 12), [[8, 3, 1]], False),
        ((3, 3, 12), [[8, 3, 1]], False),
    ],
    ids=str,
)
def test_filters_that_happen_to_fit_images_whose_channels_come_first_are_noted(
    shape: tuple[int, ...], filters: Any, is_noted: bool
) -> None:
    notes = plan({"id": SIZED, "args": {"shape": list(shape)}}, hyperparams={"conv_filters": filters}).notes
    found = [note for note in notes if "Channels come last" in note]
    assert len(found) == is_noted
    if is_noted:
        assert f"but {shape} looks as if they came first." in found[0]
        assert found[0].endswith("puts the channels last.")


@pytest.mark.parametrize(
    "spec",
    [
        {"hyperparams": {"free_log_std": True}},
        {"space": {"free_log_std": {"choice": [False, True]}}, "num_samples": 1},
    ],
)
def test_a_free_deviation_without_continuous_actions_is_refused(spec: dict[str, Any]) -> None:
    (section,) = spec.keys() & {"hyperparams", "space"}
    with pytest.raises(SpecError, match=rf"{section}\.free_log_std is true, but .*CartPole-v1.*Discrete"):
        plan("CartPole-v1", **spec)
    assert plan("Pendulum-v1", **spec).trials


@pytest.mark.parametrize("algorithm", ["random", "constant"])
def test_baselines_need_no_encoder(algorithm: Algorithm) -> None:
    assert plan(IMAGES, algorithm).env.observes_images


@pytest.mark.parametrize("env_id", ["Acrobot-v1", "MountainCar-v0", "Pendulum-v1", IMAGES])
def test_a_penalty_for_an_env_without_failure_is_refused_with_both_names(env_id: str) -> None:
    with pytest.raises(SpecError, match=rf"env\.failure_penalty is -1, but {env_id} has no failure") as caught:
        plan({"id": env_id, "failure_penalty": -1}, hyperparams={})
    assert "env.failure_penalty" in caught.value.hint


def test_a_penalty_changes_nothing_of_what_others_than_training_make() -> None:
    made = plan({"id": "CartPole-v1", "failure_penalty": -100}, "dqn")
    assert made.env.env_args == {}


@pytest.mark.parametrize("name", ["frame_stack", "pixels", "action_mask", "failure_penalty"])
def test_wrappers_are_no_arguments_of_the_env(name: str) -> None:
    with pytest.raises(SpecError, match=rf"env\.args\.{name} is 1") as caught:
        plan({"id": "CartPole-v1", "args": {name: 1}})
    assert f"env.{name}" in caught.value.hint


def test_a_mask_that_is_named_goes_where_the_env_is_made_and_not_with_a_module_of_ones_own() -> None:
    for setting in ("action_mask", True):
        made = plan({"id": "Taxi-v3", "action_mask": setting}, "dqn")
        assert made.env.env_args == {"action_mask": setting}
        assert any("by info['action_mask'], are drawn" in note for note in made.notes)
    made = plan("Taxi-v3", "dqn")
    assert made.env.env_args == {}
    assert any("env.action_mask: true uses it" in note for note in made.notes)
    made = plan({"id": "Taxi-v3", "action_mask": False}, "dqn")
    assert made.env.env_args == {"action_mask": False}
    assert not any("action_mask" in note for note in made.notes)
    spec = load_spec({"env": "Taxi-v3", "algorithm": "dqn", "rl_module": "odd_envs:Net"})
    with pytest.raises(SpecError, match=r"Taxi-v3 says which actions are allowed .* but rl_module is 'odd_envs:Net'"):
        check_env_rules(spec, check_env("Taxi-v3", {"action_mask": True}), [])


def test_a_sweep_file_cannot_tell_env_runners_which_modules_are_allowed() -> None:
    with pytest.raises(EnvError, match="allowed_modules"):
        plan({"id": "CartPole-v1", "args": {"allowed_modules": ["os"]}})


def test_pixels_of_an_env_that_is_not_drawn_are_refused() -> None:
    with pytest.raises(EnvError, match=r"odd_envs:Images has pixels: true.*rgb_array"):
        plan({"id": IMAGES, "pixels": True})
