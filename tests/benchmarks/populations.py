"""Population based training in packs beside engine `rllib`: the same sweep file, one after the other in one run."""

from __future__ import annotations

import argparse
import datetime as dt
import os
import re
from pathlib import Path
from typing import Any

from tests.benchmarks import workload
from tests.benchmarks.ppo import Row, launch, median, records

NUM_MEMBERS = 12
NUM_ENV_STEPS = 40_000
PERTURB_EVERY = 5_000
_AT_LEAST = 10
_BUILT = re.compile(r"^(\S+ \S+) process \d+: built from seed", re.MULTILINE)


def sweep_file(engine: str, num_env_steps: int = NUM_ENV_STEPS) -> dict[str, Any]:
    """A population on the workload's CartPole: seven comparisons of twelve members, with the default evaluations."""
    given = workload.sweep_file(num_env_steps, engine=engine, num_samples=NUM_MEMBERS)
    return given | {
        "hyperparams": given["hyperparams"] | {"hidden_sizes": [64], "activation": "relu"},
        "space": {"lr": {"loguniform": [1e-4, 1e-2]}, "entropy_coeff": {"uniform": [0.0, 0.02]}},
        "scheduler": {"type": "pbt", "perturb_every_env_steps": PERTURB_EVERY},
    }


def speed(folder: Path) -> float:
    """Env steps of all trials a second, from the first one's start to the last one's end, with all that is between.

    Logs say to the second when a trial was built for the first time; records, when its present process began with it.
    """
    logs = [path.read_text() for path in folder.glob("trials/*/log.txt")]
    built = [match[1] for match in map(_BUILT.search, logs) if match is not None]
    begun = min(dt.datetime.fromisoformat(when).timestamp() for when in built)
    found = records(folder)
    ended = max(record["ended_at"] for record in found)
    return float(sum(record["num_env_steps"] for record in found) / (ended - begun))


def rows(options: argparse.Namespace) -> list[Row]:
    """The speed of both engines, with their ratio pair by pair, and what the whole commands take."""
    speeds: dict[str, list[float]] = {"packed": [], "rllib": []}
    walls: dict[str, list[float]] = {"packed": [], "rllib": []}
    changes: dict[str, int] = {}
    load = os.getloadavg()[0]
    for _ in range(options.repeats):
        for engine in ("packed", "rllib"):
            done, folder = launch(sweep_file(engine), "--no-finish")
            speeds[engine].append(speed(folder))
            walls[engine].append(done.wall_s)
            changes[engine] = sum(len(record["changes"]) for record in records(folder))
    ratios = sorted(ours / theirs for ours, theirs in zip(speeds["packed"], speeds["rllib"], strict=True))
    told = f"{median(ratios):.1f} x ({ratios[0]:.1f} to {ratios[-1]:.1f}), load {load:.1f} at the start"
    return [
        *(
            (
                f"env steps/s, population of {NUM_MEMBERS}, {engine}",
                f"{median(speeds[engine]):,.0f}; {changes[engine]} copies; the command {median(walls[engine]):.0f} s",
                "",
            )
            for engine in speeds
        ),
        ("  packs beside engine rllib", told, f">= {_AT_LEAST} x"),
    ]
