"""DQN with an RLModule of RLlib's own kind: which of our hyperparameters reach it, and which are refused."""

from __future__ import annotations

import math
from typing import Any, cast

import pytest
from network_builds import build
from rllib_cases import Build, module_of

from policies.errors import SpecError
from policies.hyperparams import TrainedHyperparams, make_hyperparams

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


def test_a_module_without_statistics_of_observations_trains_where_they_are_asked_for(build: Build) -> None:
    """As PPO's do: the module gets the setting, and normalises as it likes."""
    algo, _ = build("dqn", rl_module=f"{MODULES}:PlainDQN", normalize_observations=True)
    module = module_of(algo)
    assert module.model_config["normalize_observations"]
    assert not hasattr(module, "update_observation_statistics")
    found = algo.train()["learners"]["default_policy"]
    assert math.isfinite(found["total_loss"])
    assert algo.num_updates > 0
