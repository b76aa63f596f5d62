"""Faults that come to a running sweep once: of its environment, of a training process, of the storage.

Each is brought about after the first checkpoint. The driver may end by it, if it says how to go on; `resume` then does.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.faults.forked import Process
from tests.faults.outcomes import Outcome
from tests.faults.paced import used_memory
from tests.faults.sweeps import Before, Disturbed, Sweep, spec, wait_for, wrong
from tests.kills.processes import Family

_MEETS_S, _STOPPED_S, _OUTAGE_S, _ENDS_S = 120.0, 60.0, 30.0, 300.0
_TIMEOUT_S = 20.0
_TOLD_CHARACTERS = 2_000
_STORAGE_BYTES = 64 * 1024**2
_OVER = 0.03
"""The share of the memory by which an environment goes over what Ray allows."""
_CLONE_NEWNS = 0x00020000
ENV_FAULTS = ("exit", "hang", "memory")
STORAGE_FAULTS = ("full", "read-only", "gone")
_SLOW_OPERATION_S, _SLOW_S = 10.0, 120.0


def all_of(kind: str, undisturbed: Callable[[], Sweep]) -> dict[str, Callable[[Path], Outcome]]:
    """Each of these faults by its name, as a function of an empty folder."""
    found = {f"env: {how}, {kind}": _call(env_fault, kind, how, undisturbed) for how in ENV_FAULTS}
    found[f"process stopped for a minute, {kind}"] = lambda folder: stopped(folder, kind, undisturbed())
    found |= {f"storage {how}, {kind}": _call(storage_fault, kind, how, undisturbed) for how in STORAGE_FAULTS}
    if shutil.which("cc"):
        found[f"storage slow, {kind}"] = lambda folder: storage_slow(folder, kind, undisturbed())
    else:
        print(f"storage slow, {kind}: not run, as there is no C compiler (cc)")
    return found


def _call(
    act: Callable[[Path, str, str, Sweep], Outcome], kind: str, how: str, undisturbed: Callable[[], Sweep]
) -> Callable[[Path], Outcome]:
    return lambda folder: act(folder, kind, how, undisturbed())


def env_fault(folder: Path, kind: str, how: str, undisturbed: Sweep) -> Outcome:
    """An environment ends its process, hangs, or takes all memory, once; the trial is retried and ends as it should.

    Args:
        folder: An empty folder.
        kind: Of sweep.
        how: One of ENV_FAULTS.
        undisturbed: From `kills.reference`.
    """
    changes: dict[str, Any] = {"max_retries": 3}
    if how != "exit":
        changes["iteration_timeout_s"] = _TIMEOUT_S if how == "hang" else 600.0
    environment, fault = dict(os.environ), how
    if how == "memory":
        threshold = min(used_memory() + 0.17, 1.0 - 2 * _OVER)
        environment |= {"RAY_memory_usage_threshold": f"{threshold:.3f}"}
        fault = f"memory {threshold + _OVER:.3f}"
    sweep = Sweep(folder, spec(kind, folder, **changes), environment)

    def act(process: Process) -> list[str]:
        (folder / "fault.new").write_text(fault, encoding="utf-8")
        (folder / "fault.new").rename(sweep.fault)
        met = wait_for(lambda: not sweep.fault.exists(), process, _MEETS_S)
        return [] if met else [f"no environment met it: {sweep.said()}"]

    outcome = during(sweep, f"env: {how}, {kind}", act, Disturbed(kind, most_failures=1), undisturbed)
    if not any(record["num_failures"] for record in sweep.records()):
        outcome.problems.append("no trial has a failure on record")
    return outcome


def stopped(folder: Path, kind: str, undisturbed: Sweep) -> Outcome:
    """SIGSTOP of a training process for a minute: it goes on as if nothing had been."""
    sweep = Sweep(folder, spec(kind, folder))

    def act(_: Process) -> list[str]:
        pids = {int(record["pid"]) for record in sweep.records() if record["status"] == "running" and record["pid"]}
        pid = min(pids)
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(_STOPPED_S)
        finally:
            os.kill(pid, signal.SIGCONT)
        return []

    return during(sweep, f"process stopped for a minute, {kind}", act, Disturbed(kind), undisturbed)


def storage_fault(folder: Path, kind: str, how: str, undisturbed: Sweep) -> Outcome:
    """The storage is full, read-only or gone for half a minute, and then as before; needs root.

    Args:
        folder: An empty folder; its storage is a small file system in memory.
        kind: Of sweep.
        how: One of STORAGE_FAULTS.
        undisturbed: From `kills.reference`.
    """
    storage = folder / "sweeps"
    storage.mkdir()
    with _own_mounts(), _mounted(storage, "-t", "tmpfs", "-o", f"size={_STORAGE_BYTES}", "faults"):
        sweep = Sweep(folder, spec(kind, folder))

        def act(process: Process) -> list[str]:
            with _OUTAGES[how](storage):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_OUTAGE_S)
                return []

        may = Disturbed(kind, most_failures=99, notes=".")
        outcome = during(sweep, f"storage {how}, {kind}", act, may, undisturbed)
        if outcome.problems:
            # It is a file system that is gone with this process.
            shutil.copytree(storage, folder / "sweeps-left", symlinks=True)
    return outcome


def storage_slow(folder: Path, kind: str, undisturbed: Sweep) -> Outcome:
    """Each operation on the storage takes 10 s, for two minutes: the sweep waits, and nothing of it fails.

    Args:
        folder: An empty folder.
        kind: Of sweep.
        undisturbed: From `kills.reference`.
    """
    library, flag = folder / "slow_storage.so", folder / "storage-is-slow"
    _run("cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(Path(__file__).with_name("slow_storage.c")), "-ldl")
    storage = folder / "sweeps"
    storage.mkdir()
    variables = {
        "LD_PRELOAD": library, "SLOW_STORAGE": storage.resolve(), "SLOW_STORAGE_FLAG": flag,
        "SLOW_STORAGE_S": f"{_SLOW_OPERATION_S:g}",
    }  # fmt: skip
    # A library is loaded by programs that begin, not by forks.
    sweep = Sweep(folder, spec(kind, folder), prefix=("env", *(f"{name}={value}" for name, value in variables.items())))

    def act(process: Process) -> list[str]:
        flag.touch()
        trained = {int(record["pid"]) for record in sweep.records() if record["status"] == "running" and record["pid"]}
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_SLOW_S)
        flag.unlink()
        met = {int(path.suffix[1:]) for path in folder.glob(f"{flag.name}.*")}
        needed = {process.pid, *trained}
        return [] if needed <= met else [f"of the processes {needed}, only {needed & met} had to wait"]

    return during(sweep, f"storage slow, {kind}", act, Disturbed(kind), undisturbed)


@contextlib.contextmanager
def _full(storage: Path) -> Iterator[None]:
    path = storage / "everything-else"
    with contextlib.suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    try:
        yield
    finally:
        path.unlink()


@contextlib.contextmanager
def _read_only(storage: Path) -> Iterator[None]:
    # A second mount over the first: files that are open are written on, as none may be if the first is to change.
    with _mounted(storage, "--bind", str(storage)):
        _run("mount", "-o", "remount,bind,ro", str(storage))
        yield


@contextlib.contextmanager
def _gone(storage: Path) -> Iterator[None]:
    with _mounted(storage, "-t", "tmpfs", "-o", "ro,size=4k", "nothing"):
        yield


_OUTAGES = {"full": _full, "read-only": _read_only, "gone": _gone}


@contextlib.contextmanager
def _mounted(place: Path, *arguments: str) -> Iterator[None]:
    _run("mount", *arguments, str(place))
    try:
        yield
    finally:
        # Who has files open there keeps them.
        _run("umount", "--lazy", str(place))


def _run(*command: str) -> None:
    subprocess.run(command, check=True)


_has_own_mounts = False


@contextlib.contextmanager
def _own_mounts() -> Iterator[None]:
    """Give this process mounts of its own, once, which end with it and its children."""
    global _has_own_mounts  # noqa: PLW0603 (a process has one set)
    if not _has_own_mounts:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(_CLONE_NEWNS) != 0:
            raise OSError(ctypes.get_errno(), "no mounts of its own: run as root")
        _run("mount", "--make-rprivate", "/")
        _has_own_mounts = True
    yield


def during(
    sweep: Sweep, scenario: str, act: Callable[[Process], list[str]], may: Disturbed, undisturbed: Sweep
) -> Outcome:
    """Begin a sweep, do something to it when it has a checkpoint, and see it to its end.

    If the driver ended by it, it must have said what to do, and that is done.
    """
    started = time.monotonic()
    outcome = Outcome(scenario, "training")
    sweep.slow.touch()
    process = sweep.begin()
    with Family(process.pid) as family:
        if not wait_for(lambda: any(sweep.newest(name) for name in sweep.trial_ids()), process):
            family.kill_all()
            process.wait()
            outcome.problems.append(f"nothing trained: {sweep.said()}")
            return outcome
        before = Before(sweep)
        outcome.problems += act(process)
        sweep.slow.unlink()
        try:
            code = process.wait(_ENDS_S)
        except subprocess.TimeoutExpired:
            outcome.problems.append(f"it had not ended {_ENDS_S:g} s later: {sweep.said()}")
            family.kill_all()
            code = process.wait()
    outcome.moment = "the run ended well"
    if code != 0:
        outcome.moment = f"exit code {code}, resumed"
        left = Before(sweep)
        outcome.recomputed = left.recomputed
        # Without the first line, which is the command.
        outcome.told = sweep.output.read_text(encoding="utf-8", errors="replace").partition("\n")[2][-_TOLD_CHARACTERS:]
        if "tune-jobs resume" not in outcome.told:
            outcome.problems.append(f"exit code {code}, and nothing says how to go on: {sweep.said()}")
        # As the command says, where trials have failed for good.
        again = ("--retry-failed",) if "--retry-failed" in outcome.told else ()
        outcome.problems += [*sweep.end(sweep.begin(more=again)), *left.problems()]
    outcome.problems += [*before.problems(), *wrong(sweep, undisturbed, may)]
    outcome.seconds = time.monotonic() - started
    return outcome
