"""Train the tasks once: every setting with many seeds, and keep what each iteration showed.

`python -m tests.benchmarks.choice.collecting TASK...` writes `data/TASK.parquet`, a row an iteration of each trial, and
`data/TASK.json`: the settings, the machine, the date, the versions. It takes minutes to half an hour a task on 2 cores.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import tune_jobs
from tests.benchmarks.ppo import machine_name
from tune_jobs.store.opening import open_sweep

HERE = Path(__file__).parent
TASKS = HERE / "tasks"
DATA = HERE / "data"


def task_names() -> list[str]:
    """Return the names of all tasks."""
    return sorted(path.stem for path in TASKS.glob("*.yaml"))


def collect(name: str, storage: Path) -> None:
    """Train one task and write its data.

    Raises:
        RuntimeError: A trial failed: the data would lack a seed.
    """
    started = time.monotonic()
    result = tune_jobs.launch(TASKS / f"{name}.yaml", name=name, storage=storage, finish=False)
    wall_s = time.monotonic() - started
    failed = [trial.trial_id for trial in result.trials if trial.status != "completed"]
    if failed:
        raise RuntimeError(f"{len(failed)} trials of {name} did not complete, such as {failed[0]}")
    store = open_sweep(result.folder)
    rows = []
    for trial in result.trials:
        for item in store.trial(trial.trial_id).read_iterations():
            finite = [value for value in item.episode_returns if math.isfinite(value)]
            rows.append(
                {
                    "point": trial.point_index,
                    "seed": trial.seed_index,
                    "num_env_steps": item.num_env_steps,
                    "training_return": _known(item.training_return),
                    "evaluation_return": _known(item.evaluation_return),
                    "num_episodes": len(finite),
                    "sum_of_returns": sum(finite),
                    "sum_of_squares": sum(value * value for value in finite),
                }
            )
    types: dict[str, Any] = {
        "point": np.int16, "seed": np.int16, "num_env_steps": np.int32, "training_return": np.float32,
        "evaluation_return": np.float32, "num_episodes": np.int32, "sum_of_returns": np.float32,
        "sum_of_squares": np.float32,
    }  # fmt: skip
    DATA.mkdir(exist_ok=True)
    pd.DataFrame(rows).astype(types).to_parquet(DATA / f"{name}.parquet", compression="zstd", index=False)
    points = {trial.point_index: trial.point for trial in result.trials}
    about = {
        "task": name,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine_name(),
        "python": platform.python_version(),
        "versions": result.sweep.versions,
        "wall_s": round(wall_s),
        "num_env_steps": sum(trial.num_env_steps for trial in result.trials),
        "points": [points[index] for index in sorted(points)],
    }
    (DATA / f"{name}.json").write_text(json.dumps(about, indent=1) + "\n")
    print(f"{name}: {about['num_env_steps']:,} env steps in {wall_s:.0f} s", flush=True)


def _known(value: float | None) -> float:
    return math.nan if value is None else value


def main() -> None:
    """Train the named tasks, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(task_names())}; none: all")
    for name in parser.parse_args().tasks or task_names():
        with tempfile.TemporaryDirectory() as storage:
            collect(name, Path(storage))


if __name__ == "__main__":
    main()
