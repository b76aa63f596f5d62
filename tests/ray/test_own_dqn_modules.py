"""DQN with an RLModule of RLlib's own kind: which of our hyperparameters reach it, and which are refused."""

from __future__ import annotations

import math
from typing import Any, cast

import pytest
from network_builds import build
from rllib_cases import Build, module_of

from policies.errors import SpecError
from policies.hyperparams import TrainedHyperparams, make_hyperparams
from tune_jobs.plan.user_code import check_rl_module, load_source
from tune_jobs.spec.sweep_spec import SweepSpec

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["build"]

MODULES = "tune_jobs_test_modules"


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The module of test classes may be imported, in this test alone."""
    monkeypatch.setattr("policies.envs.modules._allowed", {MODULES})


def spec_of(name: str, **values: Any) -> Any:
    from policies.networks.rl_modules import module_spec

    return module_spec(cast("TrainedHyperparams", make_hyperparams("dqn", values)), f"{MODULES}:{name}")


def test_epsilon_by_episodes_is_refused_where_rllib_counts_env_steps() -> None:
    with pytest.raises(SpecError, match="epsilon_unit episode does not reach rl_module") as caught:
        spec_of("PlainDQN", epsilon_unit="episode", epsilon_decay=300)
    assert "epsilon_unit: env_step" in caught.value.hint
    for name, unit in (("PlainDQN", "env_step"), ("OwnDQN", "episode")):
        assert spec_of(name, epsilon_unit=unit, epsilon_decay=300).module_class.__name__ == name


@pytest.mark.parametrize(
    ("algorithm", "asked", "name", "words"),
    [
        ("ppo", {}, "NoValues", "'tune_jobs_test_modules:NoValues' is not a ValueFunctionAPI"),
        ("dqn", {}, "OwnPPO", "is not a QNetAPI, which the algorithm needs"),
        ("ppo", {}, "OwnDQN", "is not a ValueFunctionAPI"),
        ("dqn", {"hyperparams.epsilon_unit": "episode"}, "PlainDQN", "epsilon_unit episode does not reach"),
        ("dqn", {"space.epsilon_schedule": {"grid": ["linear", "exponential"]}}, "PlainDQN", "epsilon_schedule expo"),
        ("dqn", {"space.target_network": {"grid": [True, False]}}, "PlainDQN", "target_network is false"),
    ],
)
def test_a_plan_refuses_what_no_trial_could_train(algorithm: str, asked: dict[str, Any], name: str, words: str) -> None:
    spec = own_spec(algorithm, asked, name)
    with pytest.raises(SpecError, match=words):
        check_rl_module(spec)


@pytest.mark.parametrize(
    ("algorithm", "asked", "name"),
    [
        ("ppo", {}, "OwnPPO"),
        ("dqn", {"space.lr": {"loguniform": [1e-4, 1e-2]}, "space.epsilon_schedule": {"grid": ["linear"]}}, "PlainDQN"),
        (
            "dqn",
            {
                "hyperparams.epsilon_unit": "episode",
                "space.target_network": {"grid": [True, False]},
                "hyperparams.double_q": False,
            },
            "OwnDQN",
        ),
    ],
)
def test_a_plan_takes_what_can_be_trained(algorithm: str, asked: dict[str, Any], name: str) -> None:
    check_rl_module(own_spec(algorithm, asked, name))


def own_spec(algorithm: str, asked: dict[str, Any], name: str) -> SweepSpec:
    source: dict[str, Any] = {"env": "CartPole-v1", "algorithm": algorithm, "rl_module": f"{MODULES}:{name}"}
    for place, value in asked.items():
        section, _, key = place.partition(".")
        source.setdefault(section, {})[key] = value
    return load_source(source)


def test_a_module_without_statistics_of_observations_trains_where_they_are_asked_for(build: Build) -> None:
    """As PPO's do: the module gets the setting, and normalises as it likes."""
    algo, _ = build("dqn", rl_module=f"{MODULES}:PlainDQN", normalize_observations=True)
    module = module_of(algo)
    assert module.model_config["normalize_observations"]
    assert not hasattr(module, "update_observation_statistics")
    found = algo.train()["learners"]["default_policy"]
    assert math.isfinite(found["total_loss"])
    assert algo.num_updates > 0
