"""The small sweeps that faults come to, and the commands that run them."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.faults.forked import Forked, Process
from tests.kills.checks import problems
from tests.kills.processes import Family, end_with_parent
from tune_jobs.store.logs import continued_from

ROOT = Path(__file__).parents[2]
PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
KINDS = ("packed", "rllib", "pbt", "tpe")
EVERY_ITERATIONS, NUM_ENV_STEPS, PACE_S = 3, 6_400, 0.004
LIMIT_S = 900.0
_STARTUP = 4
"""Points that TPE draws before it chooses by results."""
_TIMES = {"time_s", "waited_s"}


def spec(kind: str, folder: Path, *, pace_s: float = PACE_S, **changes: Any) -> dict[str, Any]:
    """A sweep file's settings, of a kind of sweep; while `slow` is in the folder, each env step takes `pace_s`."""
    env_id = f"tests.faults.paced:Faults{'Alike' if kind == 'packed' else 'Paced'}-v0"
    env_args = {"slow": str(folder / "slow"), "pace_s": pace_s, "fault": str(folder / "fault")}
    found: dict[str, Any] = {
        "env": {"id": env_id, "args": env_args},
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
        num_cpus: Of the driver's own Ray.
        prefix: A command that runs the rest of its arguments, for `launch` and `resume`.
    """

    def __init__(
        self,
        folder: Path,
        settings: dict[str, Any],
        environment: dict[str, str] | None = None,
        *flags: str,
        num_cpus: int = 2,
        prefix: tuple[str, ...] = (),
    ) -> None:
        self.num_cpus, self._prefix = num_cpus, prefix
        self.folder, self.place, self.flags = folder, folder / "sweeps" / "cut", flags
        self.slow, self.fault = folder / "slow", folder / "fault"
        (folder / "spec.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        self._environment = {**(environment or os.environ), "PYTHONPATH": str(ROOT)}
        self.output = folder / "output.txt"

    def begin(self, more: tuple[str, ...] = ()) -> Process:
        """Launch it, or resume it if it is there; in a fork of this process, unless it has a prefix or flags.

        Args:
            more: Flags of this command alone.
        """
        module = ("--allow-module", "tests.faults.paced")
        verb = ["resume", str(self.place)] if (self.place / "sweep.json").is_file() else ["launch", "spec.yaml"]
        command = [*self._prefix, PROGRAM, *verb, "--no-finish", *self.flags, *more]
        if verb[0] == "launch":
            command += ["--name", "cut", *module]
        with self.output.open("ab") as output:
            output.write(f"$ {' '.join(command)}\n".encode())
            output.flush()
            if not self._prefix and not self.flags:
                return Forked(command, self.folder, self._environment, self.output, self.num_cpus)
            return subprocess.Popen(
                command, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                env=self._environment, start_new_session=True,
                preexec_fn=end_with_parent,  # noqa: PLW1509 (it makes one system call)
            )  # fmt: skip

    def end(self, process: Process | None = None) -> list[str]:
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


def wait_for(condition: Callable[[], bool], process: Process, limit_s: float = LIMIT_S) -> bool:
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


@dataclass(frozen=True)
class Disturbed:
    """What a fault may have left in the trials' records."""

    kind: str
    most_failures: int = 0
    """Of a trial."""
    notes: str = ""
    """A pattern of the notes that a trial may have."""


def wrong(sweep: Sweep, reference: Sweep, may: Disturbed) -> list[str]:
    """What is wrong with a sweep that came to its end after a fault, beside one that met none.

    Args:
        sweep: The sweep.
        reference: The same, undisturbed.
        may: What the fault may have left.
    """
    found = [
        text
        for text in problems(sweep.place, NUM_ENV_STEPS, finishes=False)
        # Their statuses, failures and notes are looked at below; a population has copies of checkpoints, its own.
        if not _OF_STATUS.match(text) and not (may.kind == "pbt" and "does not belong" in text)
    ]
    ours, theirs = sweep.records(), reference.records()
    if [record["trial_id"] for record in ours] != [record["trial_id"] for record in theirs]:
        return [*found, f"trials {[record['trial_id'] for record in ours]}"]
    for mine, other in zip(ours, theirs, strict=True):
        name = str(mine["trial_id"])
        notes = [note for note in mine["notes"] if not (may.notes and re.search(may.notes, note))]
        if mine["status"] != "completed" or mine["num_failures"] > may.most_failures or notes:
            said = f"{name} is {mine['status']}, failed {mine['num_failures']} times, notes {notes}"
            found.append(f"{said}: {str(mine['error'])[:300]}")
        if mine["seed"] != other["seed"]:
            found.append(f"{name} has seed {mine['seed']}, undisturbed {other['seed']}")
        depends_on_results = may.kind == "pbt" or (may.kind == "tpe" and mine["index"] >= _STARTUP)
        if not depends_on_results and mine["point"] != other["point"]:
            found.append(f"{name} has point {mine['point']}, undisturbed {other['point']}")
        if not depends_on_results:
            found += _differences(sweep, reference, name, whole=may.kind == "packed")
    return found


_OF_STATUS = re.compile(r"t\d{4} is \w+, failed \d+ times")


def _differences(sweep: Sweep, reference: Sweep, name: str, *, whole: bool) -> list[str]:
    """Where a trial's numbers are not those of an undisturbed one; all of them, but for times.

    Args:
        sweep: The sweep.
        reference: The same, undisturbed.
        name: The trial.
        whole: Whether it has to come to the same though it went on from a checkpoint: a pack does, whose generators are
            in its checkpoints, where all episodes begin alike. In general they begin with new seeds then, and RLlib
            draws its exploration and batches anew: so else up to the first checkpoint that it went on from.
    """
    limit = None if whole else continued_from(sweep.place / "trials" / name / "log.txt")
    ours, theirs = ([json.loads(line) for line in which.lines(name)] for which in (sweep, reference))
    ours = [line for line in ours if limit is None or line["iteration"] <= limit]
    for mine, other in zip(ours, theirs, strict=False):
        keys = [key for key in (mine.keys() | other.keys()) - _TIMES if mine.get(key) != other.get(key)]
        if keys:
            return [f"{name} differs in {sorted(keys)} at iteration {mine['iteration']} from an undisturbed one"]
    if limit is not None:
        return []
    if len(ours) != len(theirs):
        return [f"{name} has {len(ours)} iterations, undisturbed {len(theirs)}"]
    hashes = [_last_weights(which, name) for which in (sweep, reference)]
    return [f"{name} has other weights in the end than an undisturbed one"] if hashes[0] != hashes[1] else []


def _last_weights(sweep: Sweep, name: str) -> str:
    checkpoint = sweep.place / "trials" / name / "checkpoints" / f"{sweep.newest(name):06d}"
    return hashlib.sha256((checkpoint / "policy.safetensors").read_bytes()).hexdigest()
