"""The process that drives a sweep and measures what that costs it; `nodes.drive` starts it.

`python -m tests.benchmarks.cluster.driver FILE STORAGE ADDRESS` launches a sweep file on a cluster, and prints a line
of JSON. CPU time is that of this process alone, all its threads and Ray's C++ in it included; a run begins when Ray is
joined and the trials are about to start, and ends when the last record is written.
"""

from __future__ import annotations

import cProfile
import json
import os
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import tune_jobs
from tests.benchmarks.cluster.measured import Driven
from tune_jobs.ray_tune import run_trials as runs
from tune_jobs.store.record_keeper import RecordKeeper

PROFILE = "TUNE_JOBS_PROFILE"
"""Names a file for `cProfile` data of the run; the CPU times are of no use then."""


def cpu_s() -> float:
    """CPU seconds of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


class _Meter:
    """Takes the times around `run_trials`, and counts reports."""

    def __init__(self) -> None:
        self.num_reports, self.run_cpu_s, self.run_wall_s = 0, 0.0, 0.0

    def around(self, run: Callable[..., None]) -> Callable[..., None]:
        def measured(*args: Any) -> None:
            profile = cProfile.Profile(time.thread_time) if PROFILE in os.environ else None
            cpu, wall = cpu_s(), time.perf_counter()
            if profile is not None:
                profile.enable()
            try:
                run(*args)
            finally:
                if profile is not None:
                    profile.disable()
                    profile.dump_stats(os.environ[PROFILE])
                self.run_cpu_s += cpu_s() - cpu
                self.run_wall_s += time.perf_counter() - wall

        return measured

    def counting(self, progressed: Callable[..., None]) -> Callable[..., None]:
        def counted(*args: Any, **kwargs: Any) -> None:
            self.num_reports += 1
            progressed(*args, **kwargs)

        return counted


def main() -> None:
    """Launch, and print."""
    file, storage, address = sys.argv[1:]
    tune_jobs.allow_modules(["tests.benchmarks.cluster.asleep"])
    meter = _Meter()
    setattr(runs, "run_trials", meter.around(runs.run_trials))  # noqa: B010 (mypy knows a function by this name)
    setattr(RecordKeeper, "progressed", meter.counting(RecordKeeper.progressed))  # noqa: B010
    began_cpu, began = cpu_s(), time.perf_counter()
    result = tune_jobs.launch(file, name="bench", storage=storage, address=address, progress="none", finish=False)
    told = Driven(
        num_trials=len(result.trials),
        statuses=dict(Counter(str(trial.status) for trial in result.trials)),
        num_reports=meter.num_reports,
        run_cpu_s=meter.run_cpu_s,
        run_wall_s=meter.run_wall_s,
        launch_cpu_s=cpu_s() - began_cpu,
        launch_wall_s=time.perf_counter() - began,
        peak_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        work_s=sum(trial.time_s for trial in result.trials),
        num_env_steps=sum(trial.num_env_steps for trial in result.trials),
        training_s=max(trial.ended_at or 0.0 for trial in result.trials)
        - min(trial.started_at or 0.0 for trial in result.trials),
    )
    print(json.dumps(told.as_json()), flush=True)


if __name__ == "__main__":
    main()
