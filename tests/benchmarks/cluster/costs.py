"""What the driver of a sweep of many trials uses: CPU time a trial and a report, and memory.

The trials of engine baseline play episodes of an env that waits (`asleep.py`), so that 10,000 trials x 3 s of work run
on two cores: what a trial does itself costs little, and what is left is Ray's and ours. Each is a trial for Tune, as
those of engine rllib are. Those of engine packed are small PPO trials on CartPole, as they can't wait one by one.
"""

from __future__ import annotations

import math
from typing import Any

from tests.benchmarks.cluster import nodes
from tests.benchmarks.cluster.asleep import NUM_STEPS
from tests.benchmarks.cluster.measured import Driven

Row = tuple[str, str, str]
_MOST_MS, _MOST_BYTES = 9.0, 2 * 1024**3
_NUM_NODES, _CPUS_A_NODE = 3, 8
WORK_S = 3.0


def waiting(num_trials: int, at_once: int, *, work_s: float = WORK_S, reports: int = 3) -> dict[str, Any]:
    """A sweep file's settings: trials that wait.

    Args:
        num_trials: Of the sweep.
        at_once: Trials that run at once.
        work_s: What a trial takes, but for what is the machine's; half a second or so of this is its evaluations.
        reports: Of each trial.
    """
    # A trial reports after each evaluation, and each evaluation is an episode.
    step_s = work_s / (2 * reports * NUM_STEPS)
    return {
        "env": {"id": "tests.benchmarks.cluster.asleep:BenchmarksAsleep-v0", "args": {"step_s": step_s}},
        "algorithm": "random",
        "seed": 1,
        "num_samples": num_trials,
        "hyperparams": {"env_steps_per_iteration": NUM_STEPS},
        "stop": {"num_env_steps": reports * NUM_STEPS},
        "evaluation": {"every_iterations": 1, "num_episodes": 1},
        "checkpoints": {"every_iterations": 1_000, "keep": 0},
        "resources": {"max_concurrent": at_once},
        "confirm": "none",
    }


def packed(num_trials: int) -> dict[str, Any]:
    """A sweep file's settings: PPO trials in packs, each of a few iterations."""
    return {
        "env": "CartPole-v1",
        "algorithm": "ppo",
        "engine": "packed",
        "seed": 1,
        "num_samples": num_trials,
        "space": {"lr": {"loguniform": [1e-4, 1e-2]}},
        "hyperparams": {"train_batch_size": 64, "minibatch_size": 64, "num_epochs": 1, "hidden_sizes": [8]},
        "stop": {"num_env_steps": 192},
        "evaluation": {"every_iterations": 3, "num_episodes": 1},
        "checkpoints": {"every_iterations": 1_000, "keep": 0},
        "confirm": "none",
    }


def rows(num_trials: int) -> list[Row]:
    """Measure and return the rows.

    Args:
        num_trials: Of the largest sweep.
    """
    at_once = _NUM_NODES * _CPUS_A_NODE
    found: list[Row] = []
    with nodes.cluster(_NUM_NODES, _CPUS_A_NODE) as here:
        for num in sorted({min(num_trials, size) for size in (300, num_trials)}):
            found += _told(f"{num:,} single trials x {WORK_S:g} s", nodes.drive(here, waiting(num, at_once)))
        few = min(num_trials, 300)
        found += _told(f"{few:,} single trials, 1 report each", nodes.drive(here, waiting(few, at_once, reports=1)))
        found += _told(
            f"{few:,} single trials, in an object store", nodes.drive(here, waiting(few, at_once), objects=True)
        )
        found += _told(f"{few:,} packed trials", nodes.drive(here, packed(few)))
    return found


def _told(name: str, driven: Driven) -> list[Row]:
    others = ", ".join(f"{kind} {1e3 * used / driven.num_trials:.1f}" for kind, used in driven.daemons_cpu_s.items())
    requests = f", {sum(driven.num_requests.values()) / driven.num_trials:.1f} requests" if driven.num_requests else ""
    told = (
        f"{driven.launch_ms_a_trial:.1f} (trials alone {driven.run_ms_a_trial:.1f}; {driven.reports_a_trial:.1f} "
        f"reports{requests}; beside it, Ray's {others}; {driven.run_wall_s:.0f} s)"
    )
    return [
        (f"CPU ms of the driver a trial, {name}", told, f"<= {_MOST_MS:g}"),
        (f"  memory, {name}", f"{math.ceil(driven.peak_bytes / 2**20):,} MiB", f"<= {_MOST_BYTES // 2**20:,} MiB"),
    ]
