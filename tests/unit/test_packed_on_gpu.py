"""Packs on a GPU: an iteration there gives the weights that it gives on the CPU, but for rounding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from policies.hyperparams import make_hyperparams
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no GPU here")

PPO = {"train_batch_size": 256, "minibatch_size": 64, "num_epochs": 2, "num_envs": 4}
DQN = {"train_batch_size": 32, "learning_starts": 64, "env_steps_per_iteration": 256, "num_envs": 4}
TOLERANCE = 1e-4
"""Between an NVIDIA H100 and a CPU weights differ by up to 2e-6 after an iteration of packs such as these; a step of
Adam that is not made, or made twice, changes them by up to 1e-3."""


def weights_after(device: str, algorithm: str, settings: list[dict[str, Any]]) -> list[dict[str, np.ndarray[Any, Any]]]:
    """Train a member for each of some settings for an iteration; returns their weights."""
    hyperparams: list[Any] = [make_hyperparams(algorithm, each) for each in settings]  # type: ignore[arg-type]
    envs = make_packed_envs("CartPole-v1", {}, hyperparams[0].num_envs, kind="vectorised")
    stack = make_stack(hyperparams[0], envs, device)
    for index, each in enumerate(hyperparams):
        stack.add(new_member(f"t{index:04d}", each, index, envs.observation_space, envs.action_space), index)
    stack.train_iteration()
    weights = [dict(stack.member(f"t{index:04d}").weights) for index in range(len(settings))]
    envs.close()
    return weights


@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("ppo", [PPO, PPO | {"hidden_sizes": (48, 64), "activation": "relu"}]),
        # These act on the GPU, too.
        ("ppo", [PPO | {"hidden_sizes": (1024, 1024), "lr": 1e-4}]),
        ("dqn", [DQN, DQN | {"hidden_sizes": (32, 64)}]),
        ("dqn", [DQN | {"replay": "prioritized", "double_q": True, "dueling": True}] * 2),
    ],
)
def test_an_iteration_gives_the_same_weights_there(algorithm: str, settings: list[dict[str, Any]]) -> None:
    here, there = (weights_after(device, algorithm, settings) for device in ("cpu", "cuda"))
    for ours, theirs in zip(here, there, strict=True):
        assert ours.keys() == theirs.keys()
        for name, values in ours.items():
            assert np.abs(np.asarray(theirs[name], np.float64) - values).max() < TOLERANCE, name
