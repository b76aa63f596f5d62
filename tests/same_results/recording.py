"""What a sweep gave, as one JSON document: all that has to be the same whenever it is run again.

Recorded of each sweep:

- its trials as `trials --json` tells them: point, seed, hyperparameters, engine, status, why it stopped, iterations,
  env steps, episodes, returns, best iteration, changes of a population, kept checkpoints;
- every line of each `results.jsonl`: returns and lengths of episodes, evaluation, losses;
- SHA-256 of the weights and networks of each kept checkpoint and of the best policy (`policy.safetensors`,
  `policy.json`), and of the packed engine's whole state (`state.safetensors`, `state.json`): optimizer, replay memory,
  generators. RLlib's own checkpoints are pickles, whose bytes depend on more than what they say; the weights that its
  learner has are in `policy.safetensors`;
- the winner, its score, and each episode in which it was confirmed on fresh seeds, beside a random policy's.

Left out: when and how long (`_VOLATILE`), in which process, on which machine. Nothing else differs between two runs of
one program; of logs, event files and Ray Tune's own state, which tell when and where things happened, nothing is read.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from pathlib import Path
from typing import Any

import yaml

from tests.same_results.program import Program
from tests.same_results.sweeps import Sweep

_VOLATILE = frozenset({"time", "time_s", "waited_s", "started_at", "ended_at", "node", "pid", "ran_with"})
"""Fields of records that say when, how long and where."""
_HASHED = ("policy.safetensors", "policy.json", "state.safetensors", "state.json")
_NUM_CONFIRMATIONS = 10


def record(program: Program, sweep: Sweep, folder: Path) -> dict[str, Any]:
    """Run a sweep and tell what it gave.

    Args:
        program: What runs it.
        sweep: What to run.
        folder: An empty folder.

    Raises:
        ProgramError: It did not run as it should.
    """
    spec, ran = folder / "sweep.yaml", folder / "sweeps" / sweep.name
    spec.write_text(yaml.safe_dump(sweep.spec), encoding="utf-8")
    if sweep.stopped_at is None:
        program.launch(spec, sweep.name)
    else:
        program.launch_and_interrupt(spec, sweep.name, sweep.num_trials, sweep.stopped_at)
        program.resume(ran)
    best = program.best(ran, _NUM_CONFIRMATIONS)
    return {
        "trials": {trial["trial_id"]: lasting(trial) for trial in program.trials(ran)},
        "results": {path.parent.name: _lines(path) for path in sorted(ran.glob("trials/*/results.jsonl"))},
        "sha256": _hashes(ran),
        "best": lasting(best),
    }


def lasting(value: Any) -> Any:
    """A document without the fields that say when, how long and where, at any depth."""
    if isinstance(value, dict):
        return {key: lasting(inner) for key, inner in value.items() if key not in _VOLATILE}
    return [lasting(inner) for inner in value] if isinstance(value, list) else value


def machine() -> dict[str, Any]:
    """What rounding and the number of processes depend on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return {"processor": model or platform.processor(), "cpus": os.cpu_count(), "system": platform.system()}


def _lines(path: Path) -> list[Any]:
    return [lasting(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def _hashes(sweep: Path) -> dict[str, str]:
    """By the path in the sweep folder."""
    found = (path for folder in ("trials", "best") for name in _HASHED for path in sweep.glob(f"{folder}/**/{name}"))
    return {path.relative_to(sweep).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(found)}
