"""The work every contender does: the tutorial's 20 trials on CartPole, 50,000 env steps each, none stopped early."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

ENV_ID = "CartPole-v1"
NUM_ENV_STEPS = 50_000
NUM_ENVS = 8
BATCH_SIZE = 1024
MINIBATCH_SIZE = 256
NUM_EPOCHS = 6
GAMMA = 0.98
GAE_LAMBDA = 0.8
NUM_SAMPLES = 5
CHECKPOINT_EVERY = 10
CHECKPOINTS_KEPT = 2
NUM_CPUS = 2


def points() -> list[dict[str, Any]]:
    """20 points: hidden size x activation x 5 learning rates."""
    rng = np.random.default_rng(0)
    grid = itertools.product(range(NUM_SAMPLES), (32, 64), ("linear", "relu"))
    return [
        {"hidden_size": size, "activation": activation, "lr": float(rng.uniform(1e-7, 1e-2))}
        for _, size, activation in grid
    ]


def hyperparams(point: dict[str, Any]) -> dict[str, Any]:
    """All that the work sets, for one point."""
    return {
        "num_envs": NUM_ENVS,
        "train_batch_size": BATCH_SIZE,
        "minibatch_size": MINIBATCH_SIZE,
        "num_epochs": NUM_EPOCHS,
        "gamma": GAMMA,
        "gae_lambda": GAE_LAMBDA,
        "hidden_sizes": [point["hidden_size"]],
        "activation": point["activation"],
        "lr": point["lr"],
    }


def sweep_file(
    num_env_steps: int = NUM_ENV_STEPS, *, engine: str = "auto", num_samples: int = NUM_SAMPLES
) -> dict[str, Any]:
    """The same work as a sweep file; evaluations, which the peers don't make, come on top.

    Args:
        num_env_steps: Of each trial.
        engine: What trains them.
        num_samples: Draws for each of the grid's four combinations.
    """
    return {
        "engine": engine,
        "env": ENV_ID,
        "algorithm": "ppo",
        "hyperparams": {
            "num_envs": NUM_ENVS,
            "train_batch_size": BATCH_SIZE,
            "minibatch_size": MINIBATCH_SIZE,
            "num_epochs": NUM_EPOCHS,
            "gamma": GAMMA,
            "gae_lambda": GAE_LAMBDA,
        },
        "space": {
            "hidden_sizes": {"grid": [[32], [64]]},
            "activation": {"grid": ["linear", "relu"]},
            "lr": {"uniform": [1e-7, 1e-2]},
        },
        "num_samples": num_samples,
        "stop": {"num_env_steps": num_env_steps},
        "checkpoints": {"every_iterations": CHECKPOINT_EVERY, "keep": CHECKPOINTS_KEPT},
    }
