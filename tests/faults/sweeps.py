"""The small sweeps that faults come to, and the commands that run them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from tests.kills.checks import problems
from tests.kills.processes import Family
from tune_jobs.store.logs import continued_from

ROOT = Path(__file__).parents[2]
PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
KINDS = ("packed", "rllib", "pbt", "tpe")
EVERY_ITERATIONS, NUM_ENV_STEPS = 3, 6_400
LIMIT_S = 900.0
_STARTUP = 4
"""Points that TPE draws before it chooses by results."""


def spec(kind: str, folder: Path, **changes: Any) -> dict[str, Any]:
    """A sweep file's settings, of a kind of sweep; it is slow while `slow` is in the folder."""
    env_args = {"slow": str(folder / "slow"), "fault": str(folder / "fault")}
    found: dict[str, Any] = {
        "env": {"id": "tests.faults.paced:FaultsPaced-v0", "args": env_args},
        "algorithm": "ppo",
        "seed": 11,
        "engine": "packed" if kind in ("packed", "tpe") else "rllib",
        "hyperparams": {
            "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2, "num_envs": 4, "hidden_sizes": [8],
        },
        "space": {"lr": {"loguniform": [1e-4, 1e-2]}},
        "num_samples": 2 if kind == "rllib" else 4,
        "stop": {"num_env_steps": NUM_ENV_STEPS},
        "evaluation": {"every_iterations": 6, "num_episodes": 2},
        "checkpoints": {"every_iterations": EVERY_ITERATIONS, "keep": 2},
        "resources": {"max_concurrent": 4 if kind == "packed" else 2},
    }  # fmt: skip
    if kind == "pbt":
        found |= {"scheduler": {"type": "pbt", "perturb_every_env_steps": 1_536}, "resources": {}}
    if kind == "tpe":
        found |= {"search": {"type": "tpe", "num_startup_trials": _STARTUP}, "num_samples": _STARTUP + 2}
    return found | changes


class Sweep:
    """A sweep `cut` in a folder, and the command that drives it.

    Args:
        folder: An empty folder.
        settings: The sweep file's.
        environment: Variables for the commands.
        flags: For `launch` and `resume`.
    """

    def __init__(
        self, folder: Path, settings: dict[str, Any], environment: dict[str, str] | None = None, *flags: str
    ) -> None:
        self.folder, self.place, self.flags = folder, folder / "sweeps" / "cut", flags
        self.slow, self.fault = folder / "slow", folder / "fault"
        (folder / "spec.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        self._environment = {**(environment or os.environ), "PYTHONPATH": str(ROOT)}
        self.output = folder / "output.txt"

    def begin(self, prefix: tuple[str, ...] = ()) -> subprocess.Popen[bytes]:
        """Launch it, or resume it if it is there."""
        module = ("--allow-module", "tests.faults.paced")
        verb = ["resume", str(self.place)] if (self.place / "sweep.json").is_file() else ["launch", "spec.yaml"]
        command = [*prefix, PROGRAM, *verb, "--no-finish", *self.flags]
        if verb[0] == "launch":
            command += ["--name", "cut", *module]
        with self.output.open("ab") as output:
            output.write(f"$ {' '.join(command)}\n".encode())
            output.flush()
            return subprocess.Popen(
                command, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                env=self._environment, start_new_session=True,
            )  # fmt: skip

    def end(self, process: subprocess.Popen[bytes] | None = None) -> list[str]:
        """Let it go on fast and to its end; what was wrong with that."""
        self.slow.unlink(missing_ok=True)
        process = process or self.begin()
        with Family(process.pid) as family:
            try:
                code = process.wait(LIMIT_S)
            except subprocess.TimeoutExpired:
                return [f"it took longer than {LIMIT_S:g} s"]
            finally:
                if process.poll() is None:
                    family.kill_all()
                process.wait()
        return [] if code == 0 else [f"exit code {code}: {self.said()}"]

    def said(self) -> str:
        """The last line that the commands printed."""
        lines = self.output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def records(self) -> list[dict[str, Any]]:
        """Of all trials."""
        return [json.loads(path.read_bytes()) for path in sorted(self.place.glob("trials/*/trial.json"))]

    def lines(self, trial_id: str) -> list[str]:
        """Of a trial's results, those that are whole."""
        try:
            text = (self.place / "trials" / trial_id / "results.jsonl").read_text(encoding="utf-8")
        except OSError:
            return []
        return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]

    def newest(self, trial_id: str) -> int:
        """The iteration of a trial's newest checkpoint."""
        paths = (self.place / "trials" / trial_id / "checkpoints").glob("[0-9]*/manifest.json")
        # Copies of another trial's have longer names.
        return max((int(path.parent.name) for path in paths if path.parent.name.isdigit()), default=0)

    def trial_ids(self) -> list[str]:
        """Of the trials that are there."""
        return [path.name for path in sorted(self.place.glob("trials/t*"))]


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[bytes], limit_s: float = LIMIT_S) -> bool:
    """Wait for a moment; False: the process ended before, or it never came."""
    deadline = time.monotonic() + limit_s
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


class Before:
    """What a sweep had when something was killed: every line up to a checkpoint has to be there ever after."""

    def __init__(self, sweep: Sweep) -> None:
        self._sweep = sweep
        self._checkpoints = {name: sweep.newest(name) for name in sweep.trial_ids()}
        self._lines = {name: sweep.lines(name) for name in self._checkpoints}

    @property
    def recomputed(self) -> int:
        """The most iterations of a trial that were written and have to be trained again."""
        return max((len(lines) - self._checkpoints[name] for name, lines in self._lines.items()), default=0)

    def problems(self) -> list[str]:
        """What was lost since, or would be trained again beyond an interval."""
        found = []
        for name, iteration in self._checkpoints.items():
            # Iterations up to a checkpoint, whose lines carry times to the microsecond: the very same.
            if self._sweep.lines(name)[:iteration] != self._lines[name][:iteration]:
                found.append(f"{name}: iterations before checkpoint {iteration} were trained again")
        # The one whose checkpoint was being written is the last of its interval.
        if self.recomputed > EVERY_ITERATIONS:
            found.append(f"{self.recomputed} iterations were lost, of {EVERY_ITERATIONS} between checkpoints")
        return found


def wrong(sweep: Sweep, kind: str, reference: Sweep, *, notes: str = "") -> list[str]:
    """What is wrong with a sweep that came to its end after a fault, beside one that met none.

    Args:
        sweep: The sweep.
        kind: Its kind.
        reference: The same, undisturbed.
        notes: A pattern of notes that its trials may have.
    """
    found = [
        text
        for text in problems(sweep.place, NUM_ENV_STEPS, finishes=False)
        # A population has copies of checkpoints, which are its own.
        if not (kind == "pbt" and "does not belong" in text) and not (notes and _only_notes(text, notes))
    ]
    ours, theirs = sweep.records(), reference.records()
    if [record["trial_id"] for record in ours] != [record["trial_id"] for record in theirs]:
        return [*found, f"trials {[record['trial_id'] for record in ours]}"]
    for mine, other in zip(ours, theirs, strict=True):
        name = str(mine["trial_id"])
        if mine["seed"] != other["seed"]:
            found.append(f"{name} has seed {mine['seed']}, undisturbed {other['seed']}")
        depends_on_results = kind == "pbt" or (kind == "tpe" and mine["index"] >= _STARTUP)
        if not depends_on_results and mine["point"] != other["point"]:
            found.append(f"{name} has point {mine['point']}, undisturbed {other['point']}")
        if not depends_on_results:
            found += _differences(sweep, reference, name)
    return found


def _only_notes(text: str, notes: str) -> bool:
    return bool(re.search(rf"is completed, failed 0 times, notes \(.*(?:{notes}).*\)", text))


def _differences(sweep: Sweep, reference: Sweep, name: str) -> list[str]:
    """Up to the first checkpoint that a trial went on from, its numbers are those of an undisturbed one."""
    limit = continued_from(sweep.place / "trials" / name / "log.txt")
    keys = ("iteration", "num_env_steps", "num_episodes", "training_return", "evaluation_return", "episode_returns")
    ours, theirs = ([json.loads(line) for line in which.lines(name)] for which in (sweep, reference))
    ours = [line for line in ours if limit is None or line["iteration"] <= limit]
    for mine, other in zip(ours, theirs, strict=False):
        if any(mine.get(key) != other.get(key) for key in keys):
            return [f"{name} differs at iteration {mine['iteration']} from an undisturbed one"]
    return [] if limit is not None or len(ours) == len(theirs) else [f"{name} has {len(ours)} iterations"]
