"""The peer: plain Ray Tune + RLlib with the fast settings, as their documentation has one write it."""

from __future__ import annotations

import os
import sys
import tempfile
from typing import Any

os.environ["RAY_AIR_NEW_OUTPUT"] = "0"

import ray
from ray import tune
from ray.rllib.algorithms.ppo import PPO, PPOConfig

from tests.benchmarks import workload


def _config(point: dict[str, Any]) -> dict[str, Any]:
    config = (
        PPOConfig()
        .environment(workload.ENV_ID)
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=workload.NUM_ENVS,
            gym_env_vectorize_mode="vector_entry_point",
        )
        .learners(num_learners=0)
        .training(
            lr=point["lr"],
            gamma=workload.GAMMA,
            lambda_=workload.GAE_LAMBDA,
            train_batch_size_per_learner=workload.BATCH_SIZE,
            minibatch_size=workload.MINIBATCH_SIZE,
            num_epochs=workload.NUM_EPOCHS,
        )
        .rl_module(
            model_config={
                "fcnet_hiddens": [point["hidden_size"]],
                "fcnet_activation": point["activation"],
                "vf_share_layers": False,
            }
        )
    )
    settings: dict[str, Any] = config.to_dict()
    return settings


def main(num_env_steps: int) -> None:
    """Run the 20 trials, one new process each (RLlib's Algorithm can't be reused), two at once."""
    ray.init(address="local", num_cpus=workload.NUM_CPUS, include_dashboard=False, log_to_driver=False)
    for number, point in enumerate(workload.points()):
        assert _config(point)["lr"] == point["lr"], number
    tuner = tune.Tuner(
        PPO,
        param_space=tune.grid_search([_config(point) for point in workload.points()]),
        run_config=tune.RunConfig(
            storage_path=tempfile.mkdtemp(),
            stop={"num_env_steps_sampled_lifetime": num_env_steps},
            verbose=0,
            checkpoint_config=tune.CheckpointConfig(
                checkpoint_frequency=workload.CHECKPOINT_EVERY,
                num_to_keep=workload.CHECKPOINTS_KEPT,
                checkpoint_at_end=True,
            ),
        ),
    )
    results = tuner.fit()
    steps = [int(result.metrics["num_env_steps_sampled_lifetime"]) for result in results]
    assert len(steps) == len(workload.points()), steps
    assert min(steps) >= num_env_steps, steps
    print(sum(steps))
    ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]))
