"""Functions that stand in for runs of sweeps: what test_apart.py has called in processes of their own.

Run as a module, with a folder: calls `until_asked` in two threads, and does in the main thread what is said.
"""

import json
import logging
import os
import signal
import sys
import threading
import time
import warnings
from dataclasses import replace
from pathlib import Path

from analysis.records import SweepRecord
from policies.envs.modules import allow_modules, allowed_modules
from policies.errors import EnvError
from tune_jobs.process.interruption import current
from tune_jobs.sweeps.alone import run_alone
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult


def make_result(name: str = "mine") -> SweepResult:
    sweep = SweepRecord(
        name=name,
        state="completed",
        spec={},
        evaluation_seeds=(),
        confirmation_seeds=(),
        num_trials=0,
        created_at=0.0,
    )
    return SweepResult(name, sweep, [])


@run_alone
def tells(folder: Path, *, name: str) -> SweepResult:
    """Write down what it sees of its process, and change that process."""
    seen = {
        "pid": os.getpid(),
        "parent": os.getppid(),
        "thread is main": threading.current_thread() is threading.main_thread(),
        "modules": allowed_modules(),
        "argv": sys.argv,
        "path": sys.path,
        "variable": os.environ.get("RAY_OF_A_SWEEP"),
        "errors": str(Path("/proc/self/fd/2").readlink()),
    }
    (folder / name).write_text(json.dumps(seen))
    logging.getLogger("tune_jobs.of_a_test").warning("one is left out: %s", name)
    os.environ["TUNE_JOBS_OF_A_TEST"] = "1"
    allow_modules(["a_module_of_its_own"])
    os.dup2(os.open(folder / "output", os.O_WRONLY | os.O_CREAT), 1)
    return make_result(name)


@run_alone
def meets(folder: Path, *, name: str, other: str) -> SweepResult:
    """Return once the other one runs too."""
    (folder / name).touch()
    deadline = time.monotonic() + 120
    while not (folder / other).exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return make_result(name)


@run_alone
def fails(kind: str) -> SweepResult:
    class OwnError(Exception):
        """Of a class that no other process finds."""

    if kind == "dies":
        os._exit(5)
    if kind == "is killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "interrupted":
        with current().shielded():
            os.kill(os.getpid(), signal.SIGTERM)
        return make_result()
    raise {
        "env": EnvError("The env is broken.", "Mend it."),
        "own": OwnError("nobody knows it"),
        "ctrl-c": KeyboardInterrupt(),
    }[kind]


@run_alone
def until_asked(folder: Path, name: str) -> SweepResult:
    """Run until it is asked to stop, and a little longer, while a second signal would end it."""
    # No event: its lock may be held, in this very thread, where a signal comes just as it begins to wait.
    asked: list[bool] = []
    with current().asking(lambda: asked.append(True)):
        (folder / name).touch()
        deadline = time.monotonic() + 120
        while not asked:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(0.5)
    (folder / f"{name} saved").touch()
    return make_result(name)


def main(folder: Path, how: str) -> None:
    def call(name: str) -> None:
        try:
            until_asked(folder, name)
        except SweepInterrupted as interruption:
            if interruption.result == replace(make_result(name), interrupted=True):
                (folder / f"{name} raised").touch()

    threads = [threading.Thread(target=call, args=(name,), daemon=how == "ends") for name in ("one", "two")]
    for thread in threads:
        thread.start()
    if how == "drives":
        until_asked(folder, "main")
    if how == "joins":
        for thread in threads:
            thread.join()
    while how == "waits" and any(thread.is_alive() for thread in threads):
        time.sleep(0.01)
    while how == "ends" and len(list(folder.glob("*"))) < len(threads):
        time.sleep(0.01)


if __name__ == "__main__":
    warnings.simplefilter("error")
    # As other processes find it, not as `__main__`.
    from tests.integration import apart_runs

    apart_runs.main(Path(sys.argv[1]), sys.argv[2])
