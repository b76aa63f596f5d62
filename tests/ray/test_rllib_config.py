"""Every hyperparameter is found again where it acts: in the network, the optimizer, the loss, the replay buffer.

RLlib takes some settings and ignores them; so nothing here looks at the `AlgorithmConfig` alone. A case is a function
that builds an Algorithm and raises AssertionError unless its hyperparameter acts; one test calls the case of each
field, another fails for a field without one.
"""

from collections.abc import Iterator
from typing import Any, cast

import dqn_cases  # noqa: F401 (its cases register themselves)
import dqn_replay_cases  # noqa: F401
import network_cases  # noqa: F401
import numpy as np
import ppo_cases  # noqa: F401
import pytest
from rllib_cases import (
    CASES,
    SMALL,
    Build,
    count_updates,
    env_steps,
    linears,
    modules_of,
)
from torch import nn

from policies.hyperparams import (
    HYPERPARAMS_BY_ALGORITHM,
    Algorithm,
    DQNHyperparams,
    PPOHyperparams,
    TrainedHyperparams,
    make_hyperparams,
)
from policies.schedules import linear

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

TRAINED = {name: HYPERPARAMS_BY_ALGORITHM[name] for name in ("ppo", "dqn")}


@pytest.fixture
def build() -> Iterator[Build]:
    """Make an Algorithm from a few hyperparameters; all are stopped at the end."""
    from policies.rllib.config import build_algorithm_config

    built = []

    def make(algorithm: Algorithm, env_id: str = "CartPole-v1", num_env_runners: int = 0, **values: Any) -> Any:
        hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, {**SMALL[algorithm], **values}))
        config = build_algorithm_config(hyperparams, env_id=env_id, seed=1024, num_env_runners=num_env_runners)
        built.append(config.build_algo())
        return built[-1]

    yield make
    for algo in built:
        algo.stop()


@pytest.mark.parametrize(("algorithm", "field"), sorted(CASES))
def test_every_hyperparameter_acts(build: Build, algorithm: Algorithm, field: str) -> None:
    CASES[algorithm, field](build, algorithm)


def test_every_hyperparameter_has_a_case() -> None:
    """Whoever adds one: build_algorithm_config must hand it on, and a case above must show that it acts."""
    fields = {(name, field) for name, model in TRAINED.items() for field in model.model_fields}
    assert set(CASES) == fields


def test_defaults_are_the_ones_of_the_hyperparameters(build: Build) -> None:
    """A field that is left out has the default that its description states, not RLlib's."""
    for algorithm, model in TRAINED.items():
        fields = model.model_fields
        for module in modules_of(build(algorithm, hidden_sizes=fields["hidden_sizes"].default)):
            encoder = module.encoder.actor_encoder if algorithm == "ppo" else module.encoder
            assert [layer.out_features for layer in linears(encoder)] == [64, 64]
            kind = {"tanh": nn.Tanh, "relu": nn.ReLU}[fields["activation"].default]
            assert sum(isinstance(layer, kind) for layer in encoder.modules()) == 2


def test_the_seed_reaches_environment_and_runner(build: Build) -> None:
    algo = build("ppo")
    assert algo.env_runner.config.seed == 1024
    assert algo.env_runner._seed == 1024


@pytest.mark.parametrize("num_env_runners", [0, 2])
def test_resources_are_what_the_plan_counts(num_env_runners: int) -> None:
    """Trap: RLlib's default of two env runners makes three CPUs a trial, which a laptop of two never has."""
    from policies.rllib.config import build_algorithm_config

    for hyperparams in (PPOHyperparams(), DQNHyperparams()):
        config = build_algorithm_config(hyperparams, env_id="CartPole-v1", seed=0, num_env_runners=num_env_runners)
        assert (config.num_env_runners, config.num_learners, config.num_cpus_for_main_process) == (
            num_env_runners,
            0,
            1,
        )
        assert config.num_gpus_per_learner == 0
        # A failing env must end the trial: RLlib's restarts of it have no cap.
        assert not config.restart_failed_env_runners
        assert not config.restart_failed_sub_environments


def test_updates_per_env_step_are_the_same_with_env_runners(build: Build) -> None:
    # RLlib counts one sampling process too many, and would make twice the updates.
    algo = build("dqn", num_env_runners=2, updates_per_env_step=0.5, env_steps_per_iteration=96, num_envs=4)
    sizes = count_updates(algo)
    steps = env_steps(algo.train())
    assert steps >= 96
    assert abs(len(sizes) - 0.5 * steps) <= 8


def test_rllib_moves_schedules_by_the_same_formula() -> None:
    from ray.rllib.utils.schedules.scheduler import Scheduler

    from policies.rllib.config import _schedule

    rng = np.random.default_rng(0)
    for _ in range(200):
        start, final, num_steps = float(rng.random()), float(rng.random()), int(rng.integers(1, 10**6))
        theirs = Scheduler(fixed_value_or_schedule=_schedule(start, final, num_steps), framework="torch")
        for now in (0, num_steps // 2, num_steps - 1, int(rng.integers(0, num_steps))):
            assert theirs.update(timestep=now) == linear(start, final, num_steps, now)
        for now in (num_steps, num_steps + 1):
            assert theirs.update(timestep=now) == pytest.approx(
                linear(start, final, num_steps, now), rel=1e-15, abs=1e-16
            )
