"""Algorithms with other networks than the default, and what the tests of networks look at."""

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rllib_cases import Build

from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.portable.file import PortablePolicy

SMALL: dict[str, dict[str, Any]] = {
    "ppo": {"hidden_sizes": (16,), "train_batch_size": 64, "minibatch_size": 32, "num_epochs": 2, "num_envs": 2},
    "dqn": {"hidden_sizes": (16,), "env_steps_per_iteration": 40, "learning_starts": 10, "train_batch_size": 8},
}


@pytest.fixture
def build() -> Iterator[Build]:
    """(algorithm, env id, env arguments, rl_module, hyperparameters) -> (Algorithm, hyperparameters)"""
    from policies.rllib.config import build_algorithm_config

    built = []

    def make(
        algorithm: Algorithm,
        env_id: str = "CartPole-v1",
        env_args: dict[str, Any] | None = None,
        rl_module: str | None = None,
        **values: Any,
    ) -> tuple[Any, TrainedHyperparams]:
        hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, {**SMALL[algorithm], **values}))
        config = build_algorithm_config(hyperparams, env_id=env_id, env_args=env_args, seed=3, rl_module=rl_module)
        torch.manual_seed(0)
        built.append(config.build_algo())
        return built[-1], hyperparams

    yield make
    for algo in built:
        algo.stop()


def portable(algo: Any, hyperparams: TrainedHyperparams, env_args: dict[str, Any] | None = None) -> PortablePolicy:
    from policies.rllib.restore import portable_policy

    return portable_policy(algo, hyperparams, env_id=algo.config.env, env_args=env_args or {})


def observations_of(algo: Any, num: int = 1_000, scale: float = 1.0) -> NDArray[Any]:
    space = algo.env_runner.env.single_observation_space
    rng = np.random.default_rng(5)
    if len(space.shape) == 3:
        high = 256 if space.dtype == np.uint8 else 1.0
        return (rng.uniform(0, high, (num, *space.shape))).astype(space.dtype)
    return (scale * rng.normal(size=(num, *space.shape))).astype(np.float32)


def rllib_outputs(algo: Any, obs: NDArray[Any]) -> Any:
    """What the acting module gives before actions are chosen."""
    module = algo.env_runner.module
    with torch.no_grad():
        batch = {"obs": torch.from_numpy(obs)}
        if hasattr(module, "compute_q_values"):
            return module.compute_q_values(batch)["qf_preds"].numpy()
        return module.forward_inference(batch)["action_dist_inputs"].numpy()
