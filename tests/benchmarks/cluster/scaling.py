"""Two nodes beside one: env steps/s of the same sweep in packs, each node held on a core of its own.

The head runs no trial. On a machine of two cores, it and the driver take what they need from the nodes' cores, which is
the worse for two nodes, as then no core is free.
"""

from __future__ import annotations

import os
import statistics
from typing import Any

from tests.benchmarks.cluster import nodes

Row = tuple[str, str, str]
_LEAST = 1.9
_NUM_TRIALS, _NUM_ENV_STEPS = 256, 50_000


def _sweep() -> dict[str, Any]:
    """A sweep file's settings: PPO on CartPole in packs, all trials of one length."""
    return {
        "env": "CartPole-v1",
        "algorithm": "ppo",
        "engine": "packed",
        "seed": 1,
        "num_samples": _NUM_TRIALS,
        "space": {"lr": {"loguniform": [1e-4, 1e-2]}},
        "hyperparams": {"num_envs": 8, "train_batch_size": 1024, "minibatch_size": 256, "num_epochs": 6},
        "stop": {"num_env_steps": _NUM_ENV_STEPS},
        "evaluation": {"every_iterations": 25, "num_episodes": 5},
        "checkpoints": {"every_iterations": 1_000, "keep": 0},
        "confirm": "none",
    }


def rows(repeats: int) -> list[Row]:
    """Measure by turns, and return the row.

    Raises:
        RuntimeError: This machine has one core.
    """
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise RuntimeError(f"Two nodes need a core each; this process may use {len(cores)}.")
    speeds: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(repeats):
        for num_nodes, found in speeds.items():
            with nodes.cluster(num_nodes, 1, cores[:num_nodes]) as here:
                found.append(nodes.drive(here, _sweep()).env_steps_per_s)
    ratio = statistics.median(two / one for one, two in zip(speeds[1], speeds[2], strict=True))
    told = ", ".join(f"{num} {statistics.median(found):,.0f}" for num, found in speeds.items())
    return [
        (f"env steps/s of 2 nodes beside 1, a core each, of {len(cores)}", f"{ratio:.2f} x ({told})", f">= {_LEAST} x")
    ]
