"""`python -m tests.kills`: kill the drivers of small sweeps with SIGKILL, resume them at once, and check what is there.

Drivers are killed alone, with their process group, or with all that they have started; while Ray starts, trials train,
checkpoints are written, or the best is chosen, filmed and reported. A line a kill; exit code 1 if one left a trial that
failed, a result, checkpoint or file that should not be so, or a process that did not end within seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml

from tests.kills.checks import problems
from tests.kills.plans import Kill, make_plan
from tests.kills.processes import Family

PROGRAM = str(Path(sys.executable).with_name("tune-jobs"))
_MOMENT_LIMIT_S, _RESUME_LIMIT_S = 300.0, 600.0


@dataclass
class Outcome:
    """What became of a kill."""

    kill: Kill
    killed_after_s: float = 0.0
    gone_s: float | None = None
    """Until the last process of the killed command had ended."""
    resume_s: float = 0.0
    iterations: str = ""
    """Of each trial: the latest checkpoint at the kill."""
    problems: list[str] = field(default_factory=list)


@dataclass
class _Killed:
    """The killed command's processes, and seconds within which they have to end."""

    family: Family
    limit_s: float


def run_kill(kill: Kill, folder: Path, limit_s: float) -> Outcome:
    """Launch, kill, resume and check one sweep.

    Args:
        kill: What to do.
        folder: An empty folder, for the sweep and what its commands print.
        limit_s: Seconds within which all processes of the killed command have to end.
    """
    outcome = Outcome(kill)
    spec = kill.spec(1000 + kill.number)
    (folder / "spec.yaml").write_text(spec, encoding="utf-8")
    sweep = folder / "sweeps" / "cut"
    flags = [] if kill.finishes else ["--no-finish"]
    with (folder / "output.txt").open("w", encoding="utf-8") as output:
        command = [PROGRAM, "launch", "spec.yaml", "--name", "cut", *flags]
        started = time.monotonic()
        process = _start(command, folder, output)
        with Family(process.pid) as family:
            try:
                _wait_for(_moment(kill, sweep), process)
                time.sleep(kill.delay_s)
                # What is over is over: the sweep was faster than the kill.
                if process.poll() is not None:
                    outcome.problems.append("the sweep was done before the kill")
                _strike(kill, process, family)
            finally:
                if process.poll() is None:
                    family.kill_all()
            process.wait()
            outcome.killed_after_s = time.monotonic() - started
            outcome.iterations = " ".join(str(_latest(trial)) for trial in sorted(sweep.glob("trials/*")))
            if not (sweep / "sweep.json").is_file():
                # Killed before there was a sweep: nothing to resume, launched again.
                command[1:] = ["launch", "spec.yaml", "--name", "again", *flags]
                sweep = folder / "sweeps" / "again"
            else:
                command[1:] = ["resume", str(sweep), *flags]
            _resume(outcome, command, folder, output, _Killed(family, limit_s))
    steps = int(yaml.safe_load(spec)["stop"]["num_env_steps"])
    if (sweep / "sweep.json").is_file():
        outcome.problems += problems(sweep, steps, finishes=kill.finishes)
    else:
        outcome.problems.append("there is no sweep")
    return outcome


def _start(command: list[str], folder: Path, output: IO[str]) -> subprocess.Popen[str]:
    output.write(f"$ {' '.join(command)}\n")
    output.flush()
    return subprocess.Popen(
        command, cwd=folder, stdin=subprocess.DEVNULL, stdout=output, stderr=output, text=True, start_new_session=True
    )


def _resume(outcome: Outcome, command: list[str], folder: Path, output: IO[str], killed: _Killed) -> None:
    started = time.monotonic()
    process = _start(command, folder, output)
    with Family(process.pid) as family:
        try:
            outcome.gone_s = killed.family.wait_until_gone(killed.limit_s)
            if outcome.gone_s is None:
                outcome.problems.append(f"still there {killed.limit_s:g} s after the kill: {killed.family.left}")
            code = process.wait(_RESUME_LIMIT_S)
            outcome.resume_s = time.monotonic() - started
            if code != 0:
                outcome.problems.append(f"{command[1]} ended with exit code {code}")
            if family.wait_until_gone(killed.limit_s) is None:
                outcome.problems.append(f"still there after {command[1]}: {', '.join(family.left)}")
        except subprocess.TimeoutExpired:
            outcome.problems.append(f"{command[1]} took longer than {_RESUME_LIMIT_S:g} s")
        finally:
            if process.poll() is None:
                family.kill_all()
            process.wait()


def _moment(kill: Kill, sweep: Path) -> Callable[[], bool]:
    """Whether the moment has come from which the kill's delay counts."""
    if kill.moment == "start":
        return (sweep / "sweep.json").is_file
    if kill.moment == "training":
        return lambda: any(sweep.glob("trials/*/checkpoints/[0-9]*"))
    if kill.moment == "checkpoint":
        # One that is being written, after there are some.
        return lambda: any(sweep.glob("trials/*/checkpoints/[0-9]*")) and any(sweep.glob("trials/*/checkpoints/.*"))
    return lambda: _is_trained(sweep)


def _is_trained(sweep: Path) -> bool:
    """Whether every trial has ended."""
    try:
        trials = [json.loads(path.read_bytes()) for path in sweep.glob("trials/*/trial.json")]
    except OSError:
        return False
    return bool(trials) and all(trial["status"] == "completed" for trial in trials)


def _wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + _MOMENT_LIMIT_S
    while not condition() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)


def _strike(kill: Kill, process: subprocess.Popen[str], family: Family) -> None:
    if process.poll() is not None:
        return
    if kill.how == "driver":
        process.kill()
    elif kill.how == "group":
        os.killpg(process.pid, signal.SIGKILL)
    else:
        family.kill_all()


def _latest(trial: Path) -> int:
    return max((int(path.name) for path in trial.glob("checkpoints/[0-9]*") if path.name.isdigit()), default=0)


def _line(outcome: Outcome) -> str:
    kill, gone = outcome.kill, "no" if outcome.gone_s is None else f"{outcome.gone_s:.1f}"
    verdict = "ok" if not outcome.problems else "; ".join(outcome.problems)
    return (
        f"{kill.number:>3}  {kill.engine:<6}  {kill.how:<6}  {kill.moment:<10}  {outcome.killed_after_s:>9.1f}  "
        f"{gone:>6}  {outcome.resume_s:>8.1f}  {outcome.iterations or '-':<15}  {verdict}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run with the command line's options."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=26, help="how many")
    parser.add_argument("--seed", type=int, default=8, help="of the moments")
    parser.add_argument("--only", default="", metavar="A-B,C", help="of them those of these numbers alone")
    parser.add_argument("--gone", type=float, default=10.0, metavar="S", help="seconds for all processes to end")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the sweeps there")
    options = parser.parse_args(arguments)
    plan = make_plan(options.kills, options.seed)
    if options.only:
        ranges = [part.partition("-") for part in options.only.split(",")]
        chosen = {number for first, _, last in ranges for number in range(int(first), int(last or first) + 1)}
        plan = [kill for kill in plan if kill.number in chosen]
    print(
        f"{'no':>3}  {'engine':<6}  {'killed':<6}  {'while':<10}  {'after s':>9}  {'gone s':>6}  {'resume s':>8}  "
        f"{'checkpoints':<15}  verdict"
    )
    outcomes = []
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tune-jobs-kills-") as temporary:
        for kill in plan:
            folder = (options.keep or Path(temporary)).absolute() / f"{kill.number:02d}"
            folder.mkdir(parents=True)
            outcomes.append(run_kill(kill, folder, options.gone))
            print(_line(outcomes[-1]), flush=True)
    failed = [outcome for outcome in outcomes if outcome.problems]
    slowest = max((outcome.gone_s for outcome in outcomes if outcome.gone_s is not None), default=0.0)
    print(
        f"{len(outcomes)} kills in {time.monotonic() - started:.0f} s: {len(outcomes) - len(failed)} without a problem "
        f"and {len(failed)} with one; the last process of a killed sweep ended after {slowest:.1f} s at the latest."
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
