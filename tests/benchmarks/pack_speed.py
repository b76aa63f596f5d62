"""`python -m tests.benchmarks.pack_speed`: env steps/s of one packed process, how far that is from what the machine's
matrix product would allow, and where the time goes. Prints JSON."""

from __future__ import annotations

import argparse
import cProfile
import itertools
import json
import math
import pstats
import statistics
import time
from collections import defaultdict
from typing import Any, cast

import torch

from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams, make_hyperparams
from tests.benchmarks import dqn, workload
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.training.packed import PackedEngine
from tune_jobs.training.protocol import TrialTask

# Where a profile's functions belong: the first that is in "file:function" counts.
_PARTS = {
    "bmm": "matrix products",
    "cartpole": "environments",
    "packed/networks.py": "layers but for their products",
    "packed/ppo/loss.py": "loss",
    "packed/dqn/loss.py": "loss",
    "log_softmax": "loss",
    "packed/optimizers.py": "optimizer",
    "packed/dqn/replay.py": "replay memory",
    "take": "replay memory",
    "random": "random numbers",
    "permuted": "random numbers",
}


def tasks(algorithm: str, num_members: int) -> list[TrialTask]:
    """Members of a pack with the benchmark's settings."""
    if algorithm == "ppo":
        points = [
            workload.hyperparams(point) for point in itertools.islice(itertools.cycle(workload.points()), num_members)
        ]
    else:
        points = [dqn.settings()[1].model_dump(mode="json")] * num_members
    return [
        TrialTask(
            sweep_place=".",
            trial_id=f"t{index:04d}",
            seed=1024 * index,
            algorithm=algorithm,
            hyperparams=point,
            env_id=workload.ENV_ID,
            env_args={},
            stop=StopSpec(),
            evaluation=EvaluationSpec(),
            checkpoints=CheckpointSpec(),
            evaluation_seeds=(0,),
        )
        for index, point in enumerate(points)
    ]


def flops_per_env_step(hyperparams: TrainedHyperparams) -> float:
    """Floating-point operations of the updates' matrix products, for each env step."""
    # CartPole: 4 numbers and the ones of the first bias, 2 actions.
    sizes = [5, *hyperparams.hidden_sizes, 2]
    products = [2.0 * inputs * outputs for inputs, outputs in itertools.pairwise(sizes)]
    # Forward, gradient of the weights, gradient of the inputs (not of the first layer's).
    trained = 3 * sum(products) - products[0]
    if isinstance(hyperparams, PPOHyperparams):
        return 2 * trained * hyperparams.num_epochs
    assert isinstance(hyperparams, DQNHyperparams)
    passes = trained + sum(products) * (2 if hyperparams.double_q else 1)
    return passes * hyperparams.train_batch_size * hyperparams.updates_per_env_step


def matrix_product_flops(size: int = 1024) -> float:
    """Floating-point operations/s of torch's product of two large matrices on one core."""
    one, other = torch.randn(size, size), torch.randn(size, size)
    times = []
    for _ in range(5):
        started = time.perf_counter()
        torch.mm(one, other)
        times.append(time.perf_counter() - started)
    return 2.0 * size**3 / min(times)


def shares(profile: cProfile.Profile) -> dict[str, float]:
    """Share of the time in each part, in percent; the profiler's own time makes small calls look larger."""
    totals: dict[str, float] = defaultdict(float)
    stats = cast("dict[tuple[str, int, str], tuple[Any, ...]]", vars(pstats.Stats(profile))["stats"])
    for (file, _, function), (_, _, own_time, *_) in stats.items():
        name = f"{file}:{function}"
        part = next((part for mark, part in _PARTS.items() if mark in name), "the rest of Python and torch")
        totals[part] += own_time
    whole = sum(totals.values())
    return {part: round(100 * value / whole, 1) for part, value in sorted(totals.items(), key=lambda item: -item[1])}


def measure(algorithm: str, num_members: int, num_iterations: int) -> dict[str, Any]:
    """Train a pack for some iterations and say how fast that was."""
    engine = PackedEngine()
    members = tasks(algorithm, num_members)
    for task in members:
        engine.add(task, None)
    hyperparams = [
        cast("TrainedHyperparams", make_hyperparams(cast("Any", algorithm), task.hyperparams)) for task in members
    ]
    engine.train_iteration()

    def env_steps() -> int:
        return sum(
            stats.num_env_steps for stats in engine.train_iteration().values() if not isinstance(stats, Exception)
        )

    speeds = []
    before = env_steps()
    for _ in range(num_iterations):
        started = time.perf_counter()
        after = env_steps()
        speeds.append((after - before) / (time.perf_counter() - started))
        before = after
    profile = cProfile.Profile()
    profile.enable()
    for _ in range(max(2, num_iterations // 4)):
        engine.train_iteration()
    profile.disable()
    engine.close()
    speed = statistics.median(speeds)
    flops = math.fsum(map(flops_per_env_step, hyperparams)) / num_members
    limit = matrix_product_flops()
    return {
        "env_steps_per_s": round(speed),
        "update_flops_per_env_step": round(flops),
        "matrix_product_gflops": round(limit / 1e9, 1),
        "limit_env_steps_per_s": round(limit / flops),
        "share_of_limit": round(speed * flops / limit, 3),
        "profile_percent": shares(profile),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algorithm", choices=["ppo", "dqn"], default="ppo")
    parser.add_argument("--members", type=int, default=20)
    parser.add_argument("--iterations", type=int, default=40)
    options = parser.parse_args()
    print(json.dumps(measure(options.algorithm, options.members, options.iterations)))


if __name__ == "__main__":
    main()
