"""What the driver of a sweep of many trials uses: CPU time a trial and a report, and memory.

The trials of engine baseline play episodes of an env that waits (`asleep.py`), so that 10,000 trials x 3 s of work run
on two cores: what a trial does itself costs little, and what is left is Ray's and ours. Each is a trial for Tune, as
those of engine rllib are. Those of engine packed are small PPO trials on CartPole, as they can't wait one by one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.benchmarks.cluster import nodes
from tests.benchmarks.cluster.asleep import NUM_STEPS
from tests.benchmarks.cluster.measured import Driven
from tests.benchmarks.ppo import machine_name

Row = tuple[str, str, str]
_MOST_MS, _MOST_BYTES = 9.0, 2 * 1024**3
_NUM_NODES, _CPUS_A_NODE = 3, 16
_FEW_AT_ONCE = 24
"""As each process takes three seconds of CPU time to start, a small sweep has fewer than there are places."""
WORK_S, _LONG_S = 3.0, 60.0
_FEW = 300


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


@dataclass(frozen=True)
class Case:
    """A sweep that is driven and measured."""

    kind: str
    """`single`, `objects` or `packed`."""
    name: str
    settings: dict[str, Any]


def cases(num_trials: int) -> list[Case]:
    """What is measured beside the largest sweep.

    Args:
        num_trials: Of each, at most.
    """
    few, at_once = min(num_trials, _FEW), _FEW_AT_ONCE
    return [
        Case("waits", f"1 trial of {_LONG_S:g} s", waiting(1, 1, work_s=_LONG_S, reports=1)),
        Case("single", f"{few:,} single trials, 1 report each", waiting(few, at_once, reports=1)),
        Case("single", f"{few:,} single trials, 6 reports each", waiting(few, at_once, reports=6)),
        Case("objects", f"{few:,} single trials in an object store", waiting(few, at_once)),
        Case("packed", f"{few:,} packed trials", packed(few)),
        Case("single", f"{few:,} single trials x {WORK_S:g} s", waiting(few, at_once)),
    ]


def largest(num_trials: int) -> Case:
    """The largest sweep, on all places that there are."""
    name = f"{num_trials:,} single trials x {WORK_S:g} s"
    return Case("single", name, waiting(num_trials, _NUM_NODES * _CPUS_A_NODE))


def rows(cases: Sequence[Case], save: Path | None = None) -> list[Row]:
    """Measure and return the rows.

    Args:
        cases: What to measure.
        save: A file for what was measured, which `model` reads, added to what it has; None: it is only told.
    """
    found: list[Row] = []
    kept = json.loads(save.read_text(encoding="utf-8"))["sweeps"] if save is not None and save.exists() else []
    with nodes.cluster(_NUM_NODES, _CPUS_A_NODE) as here:
        for case in cases:
            driven = nodes.drive(here, case.settings, objects=case.kind == "objects")
            found += _told(case.name, driven, case.settings.get("resources", {}).get("max_concurrent", 0))
            kept.append({"kind": case.kind, "name": case.name, "driven": driven.as_json()})
            if save is not None:
                # After each, as the last one takes long.
                told = {"machine": machine_name(), "date": f"{datetime.now(UTC):%Y-%m-%d}", "sweeps": kept}
                save.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return found


def wait_ms_a_trial(driven: Driven, places: int) -> float:
    """Milliseconds of wall time that a sweep takes for a trial beyond the trials' own work, divided by the places.

    It is what Ray Tune's documentation tells of 10,000 trials of one second on 16 places: 715.27 s, where 625 s is the
    least, so 9.0 ms (https://docs.ray.io/en/latest/tune/tutorials/tune-scalability.html).
    """
    return 1e3 * (driven.run_wall_s - driven.work_s / places) / driven.num_trials


def _told(name: str, driven: Driven, places: int) -> list[Row]:
    if driven.num_trials == 1:
        share = 1e3 * driven.run_cpu_s / driven.run_wall_s
        return [(f"CPU ms of the driver a second, {name}", f"{share:.1f}, its start included", "-")]
    others = ", ".join(f"{kind} {1e3 * used / driven.num_trials:.1f}" for kind, used in driven.daemons_cpu_s.items())
    requests = f", {sum(driven.num_requests.values()) / driven.num_trials:.1f} requests" if driven.num_requests else ""
    told = (
        f"{driven.launch_ms_a_trial:.1f} (trials alone {driven.run_ms_a_trial:.1f}; {driven.reports_a_trial:.1f} "
        f"reports{requests}; beside it, Ray's {others}; {driven.run_wall_s:.0f} s)"
    )
    # In a small sweep it is what processes take to start.
    waited = [(f"ms a trial beyond its work, {name}", f"{wait_ms_a_trial(driven, places):.1f}", f"<= {_MOST_MS:g}")]
    return [
        *(waited if places > _FEW_AT_ONCE else []),
        (f"CPU ms of the driver a trial, {name}", told, f"<= {_MOST_MS:g}"),
        (f"  memory, {name}", f"{math.ceil(driven.peak_bytes / 2**20):,} MiB", f"<= {_MOST_BYTES // 2**20:,} MiB"),
    ]
