"""The program whose results are recorded: its command line, and the folder that its sweeps leave."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LIMIT_S = 600.0
"""Of one command."""
_INTERRUPTED = 130


class ProgramError(Exception):
    """The program did not do what a recording needs."""


@dataclass(frozen=True)
class Program:
    """A tune-jobs of any version.

    Args:
        path: The executable.
    """

    path: Path

    def launch(self, spec: Path, name: str) -> None:
        """Run a sweep, from `spec`'s folder, in its storage folder `sweeps`."""
        self._run(spec.parent, "launch", str(spec), "--name", name, "--no-finish", "--progress", "none")

    def resume(self, sweep: Path) -> None:
        """Go on with a sweep."""
        self._run(sweep.parent.parent, "resume", str(sweep), "--no-finish", "--progress", "none")

    def trials(self, sweep: Path) -> Any:
        """What `trials --json` says of a sweep."""
        return json.loads(self._run(sweep.parent.parent, "trials", str(sweep), "--json"))

    def best(self, sweep: Path, num_episodes: int) -> Any:
        """Choose and confirm the best of a sweep: what `best --json` says."""
        episodes = ("--num-episodes", str(num_episodes))
        return json.loads(self._run(sweep.parent.parent, "best", str(sweep), *episodes, "--json"))

    def launch_and_interrupt(self, spec: Path, name: str, num_trials: int, iteration: int) -> None:
        """Run a sweep until all its trials have their checkpoint of an iteration, and interrupt it as Ctrl-C does.

        Where each trial is when it hears of that depends on time. What came after that checkpoint is therefore deleted,
        and on resuming all go on from it: what the program has to be able to do anyway, after a kill.

        Raises:
            ProgramError: It was not interrupted as it should, or not before a trial's end: then make it longer.
        """
        sweep = spec.parent / "sweeps" / name
        process = self._start(spec.parent, "launch", str(spec), "--name", name, "--no-finish", "--progress", "none")
        try:
            deadline = time.monotonic() + _LIMIT_S
            pattern = f"trials/*/checkpoints/{iteration:06d}/manifest.json"
            while len(list(sweep.glob(pattern))) < num_trials and process.poll() is None:
                if time.monotonic() > deadline:
                    raise ProgramError(f"no checkpoint of iteration {iteration} of all trials in {_LIMIT_S:g} s")
                time.sleep(0.01)
            process.send_signal(signal.SIGINT)
            output, errors = _output(process)
        finally:
            _end(process)
        if process.returncode != _INTERRUPTED:
            raise ProgramError(f"interrupted, it ended with exit code {process.returncode}:\n{output}{errors}")
        if ended := [trial["trial_id"] for trial in self.trials(sweep) if trial["status"] != "paused"]:
            raise ProgramError(f"not paused by the interruption: {', '.join(ended)}")
        for folder in sweep.glob("trials/*/checkpoints/*"):
            if folder.name.isdigit() and int(folder.name) > iteration:
                shutil.rmtree(folder)

    def _run(self, folder: Path, *arguments: str) -> str:
        process = self._start(folder, *arguments)
        try:
            output, errors = _output(process)
        finally:
            _end(process)
        if process.returncode != 0:
            raise ProgramError(f"{arguments[0]} ended with exit code {process.returncode}:\n{output}{errors}")
        return output

    def _start(self, folder: Path, *arguments: str) -> subprocess.Popen[str]:
        # Beside Ray's own, these would let the sweep run elsewhere or find other modules than the program's.
        hidden = {"RAY_ADDRESS", "PYTHONPATH", "TUNE_JOBS_STORAGE"}
        return subprocess.Popen(
            [str(self.path), *arguments],
            cwd=folder,
            env={name: value for name, value in os.environ.items() if name not in hidden},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )


def _output(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What it printed, to standard output and to standard error, until its end."""
    try:
        return process.communicate(timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        raise ProgramError(f"it took longer than {_LIMIT_S:g} s") from None


def _end(process: subprocess.Popen[str]) -> None:
    """Leave nothing running, if it has not ended."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
