"""A script that trains its own environment in its own Ray, and restores what was trained.

It is run by test_users_notebook.py. Its module lies in a folder that it puts on Python's path itself, as notebooks do
with `../src`.
"""

import importlib
import json
import random
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch

import tune_jobs

STORAGE, SOURCE = map(Path, sys.argv[1:])
SPEC = {
    "algorithm": "ppo",
    "hyperparams": {"hidden_sizes": [8], "num_envs": 2, "train_batch_size": 128, "minibatch_size": 64},
    "stop": {"num_env_steps": 256},
    "evaluation": {"num_episodes": 2},
}


def launch(name: str, **resources: Any) -> list[str]:
    maze = importlib.import_module("notebooks_envs").Maze
    spec = {**SPEC, "env": maze, **({"resources": resources} if resources else {})}
    result = tune_jobs.launch(spec, name=name, storage=STORAGE, progress="none", finish=False)
    return [f"{trial.engine}: {trial.status} {trial.error or ''}".strip() for trial in result.trials]


def state() -> dict[str, str]:
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    return {
        "random": str(random.getstate()),
        "numpy": str(np.random.get_state()),  # noqa: NPY002
        "torch": str(torch.get_rng_state().tolist()),
        "exact": str((torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.deterministic)),
        "signals": str(handlers),
    }


def main() -> None:
    sys.path.append(str(SOURCE))
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    said: dict[str, Any] = {"packed": launch("one"), "single": launch("two", num_env_runners=1)}
    ray.shutdown()

    before = state()
    algorithm = tune_jobs.restore("one", storage=STORAGE)
    after = state()
    said["changed"] = [name for name, value in before.items() if after[name] != value]
    said["listens at"] = ray.get_runtime_context().gcs_address.rpartition(":")[0]
    said["trains on"] = int(algorithm.train()["training_iteration"])
    algorithm.stop()
    ray.shutdown()
    print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main()
